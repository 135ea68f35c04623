"""A point estimate as the group ``point`` of a result, and in a terminal."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo import _schema as schema
from bayesoleo.errors import InputError
from bayesoleo.estimation import estimate, polish, to_dataset


@pytest.fixture(scope="module")
def pair(gas_spring):
    problem = gas_spring(0, 0.1)
    robust = estimate(problem)
    return robust, polish(problem, robust)


def test_the_group_has_its_variables_and_dims(pair):
    robust, mode = pair
    dataset = to_dataset(mode, mbe=robust, units=["1"])
    square = (schema.PARAMETER, schema.PARAMETER_COLUMN)
    dims = {
        schema.START: (schema.PARAMETER,),
        schema.MBE: (schema.PARAMETER,),
        schema.ESTIMATE: (schema.PARAMETER,),
        schema.SD: (schema.PARAMETER,),
        schema.UNIT: (schema.PARAMETER,),
        schema.COVARIANCE: square,
        schema.VARIANCE: (schema.OUTPUT,),
        schema.HISTORY: (schema.ITERATION, schema.PARAMETER),
        schema.OBJECTIVE: (schema.ITERATION,),
    }
    assert {name: variable.dims for name, variable in dataset.data_vars.items()} == dims
    assert all({"units", "long_name"} <= set(v.attrs) for v in dataset.data_vars.values())
    assert dataset[schema.START].item() == 1.0
    assert dataset[schema.MBE].item() == robust["exponent"]
    assert dataset[schema.ESTIMATE].item() == mode["exponent"]
    assert dataset.attrs["status"] == "converged"
    assert dataset.attrs["iterations"] == robust.iterations + mode.iterations


def test_the_history_is_that_of_both_stages(pair):
    robust, mode = pair
    dataset = to_dataset(mode, mbe=robust)
    lines = robust.iterations + mode.iterations + 2
    assert dataset.sizes[schema.ITERATION] == lines
    assert list(dataset["method"].values[[0, -1]]) == ["mbe", "be"]


def test_without_its_mbe_a_mode_says_that_it_does_not_know(pair):
    robust, mode = pair
    assert np.isnan(mode.to_dataset()[schema.MBE]).all()
    assert robust.to_dataset()[schema.MBE].item() == robust["exponent"]


def test_it_can_be_written(pair, tmp_path):
    robust, mode = pair
    to_dataset(mode, mbe=robust, units=["1"]).to_netcdf(tmp_path / "point.nc", engine="h5netcdf")


def test_units_must_fit(pair):
    with pytest.raises(InputError, match="one entry per parameter"):
        to_dataset(pair[0], units=["m", "s"])


def test_text_names_what_matters(pair):
    text = str(pair[1])
    assert "exponent" in text
    assert "be: converged; " in text
    assert "residual standard deviation" in text
