"""The labelled groups are what ArviZ expects."""

import json

import arviz as az
import numpy as np
import pytest
import xarray as xr
from posterior_targets import Gaussian

from bayesoleo.model._priors import LogNormal, Normal
from bayesoleo.posterior import Mixture, sample, to_datasets


class Named(Gaussian):
    """Two parameters, one by run, and an output's variance, over eight runs."""

    runs = tuple(f"run {k}" for k in range(8))

    def __init__(self):
        super().__init__(np.ones(3))
        self.names = ("stiffness", "offset[run 3]", "log_variance_force")

    def __call__(self, phi):
        height, _ = super().__call__(phi)
        return height, np.repeat(height[:, None] / 8, 8, axis=1)


@pytest.fixture(scope="module")
def samples():
    mixture = Mixture(np.zeros((1, 3)), np.eye(3)[None], np.zeros(1))
    return sample(Named(), mixture, seed=1, quick=True, progress=False)


@pytest.fixture(scope="module")
def tree(samples):
    groups = to_datasets(
        samples,
        (Normal(0, 1), LogNormal(2, 0.1)),
        units={"stiffness": "N/m", "force": "N"},
        long_names={"stiffness": "stiffness of the spring"},
    )
    return xr.DataTree.from_dict(groups)


def test_arviz_summarises_and_compares(tree):
    summary = az.summary(tree)
    assert list(summary.index) == ["stiffness", "offset[run 3]", "log_variance_force"]
    assert np.isfinite(az.loo(tree).elpd)


def test_variables_say_what_they_are(tree, samples):
    posterior = tree["posterior"]
    assert posterior["stiffness"].dims == ("chain", "draw")
    assert posterior["stiffness"].attrs == {
        "units": "N/m",
        "long_name": "stiffness of the spring",
    }
    assert posterior["log_variance_force"].attrs["units"] == "ln((N)^2)"
    np.testing.assert_array_equal(posterior["ensemble"], samples.ensemble)
    assert tree["log_likelihood"]["runs"].dims == ("chain", "draw", "run")
    for group in tree.children.values():
        for variable in group.data_vars.values():
            assert {"units", "long_name"} <= set(variable.attrs)


def test_the_prior_holds_draws_of_the_priors(tree):
    draws = tree["prior"]["offset[run 3]"]
    # 2000 draws of ln x with sd 0.1: four errors
    assert float(np.log(draws).mean()) == pytest.approx(np.log(2), abs=0.4 / np.sqrt(2000))


def test_the_tree_survives_a_file(tree, samples, tmp_path):
    tree.to_netcdf(tmp_path / "tree.nc", engine="h5netcdf")
    with xr.open_datatree(tmp_path / "tree.nc", engine="h5netcdf") as back:
        stats = back["sample_stats"].attrs
        assert json.loads(stats["acceptance"]) == samples.acceptance
        assert set(json.loads(stats["effective_sample_size"])) == set(samples.names)
        np.testing.assert_array_equal(back["posterior"]["stiffness"], samples.draws[:, :, 0])
