"""Parameters that the data say nothing about are named."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.errors import InputError
from bayesoleo.estimation import FunctionProblem, data_against_prior, estimate
from bayesoleo.model._priors import Normal
from bayesoleo.systems import system


def test_only_what_the_data_do_not_see_is_named():
    """The third unknown has no effect; the second is known before as well as after."""
    rng = np.random.default_rng(1)
    x = np.linspace(0, 1, 40)
    y = 2 + 0.3 * x + rng.normal(0, 0.1, x.size)
    priors = [Normal(1.0, 5.0), Normal(0.3, 1e-3), Normal(7.0, 2.0)]
    problem = FunctionProblem(
        lambda x, t: t[0] + t[1] * x + 0 * t[2], x, y, priors, ["level", "slope", "colour"]
    )
    found = data_against_prior(estimate(problem, "be"), priors)
    assert found["said_nothing"].values.tolist() == [False, True, True]
    assert float(found["ratio"].sel(parameter="colour")) == pytest.approx(1.0)
    assert found.attrs["statement"] == "the data add nothing to the prior of slope, colour"
    seen = data_against_prior({"level": 0.1}, {"level": priors[0]})
    assert seen.attrs["statement"] == "the data add to the prior of every parameter"


def test_constants_known_to_a_tolerance_were_not_asked():
    found = data_against_prior(
        {"piston_area": 1e-7}, [Normal(3.5e-3, 3e-4)], model=system("f16n2d2")
    )
    assert "orifice_damping was held" in found.attrs["statement"]
    assert float(found["ratio"].sel(parameter="orifice_damping")) == 1.0


def test_a_parameter_without_a_prior_is_refused():
    with pytest.raises(InputError, match="key a: no prior is given"):
        data_against_prior({"a": 1.0}, {"b": Normal(0.0, 1.0)})
