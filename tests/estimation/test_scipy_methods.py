"""SciPy's optimisers through the same interface end where the estimators end."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.estimation import FunctionProblem, estimate
from bayesoleo.estimation._scipy_methods import LEAST_SQUARES, MINIMISERS
from bayesoleo.model._priors import LogNormal, Normal, TruncatedNormal
from bayesoleo.solvers._orbit import Status

TIME = np.linspace(0.0, 4.0, 50)
#: Methods that stop by a fixed smallest radius or count, not by the asked tolerance.
COARSE = {"COBYLA": 1e-3, "trust-constr": 1e-4, "CG": 1e-4}


def decay(x, theta):
    return theta[0] * np.exp(-theta[1] * x)


@pytest.fixture(scope="module")
def problem():
    y = decay(TIME, [2.0, 0.7]) + np.random.default_rng(0).normal(0, 0.05, TIME.size)
    return FunctionProblem(decay, TIME, y, [Normal(1.5, 0.5), LogNormal(1.0, 0.5)], ["a", "k"])


@pytest.mark.parametrize("objective", ["diagonal", "likelihood"])
@pytest.mark.parametrize("name", [*LEAST_SQUARES, *MINIMISERS])
def test_ends_where_the_estimators_end(problem, name, objective):
    reference = estimate(
        problem, "be" if objective == "diagonal" else "gauss-newton", objective=objective
    )
    point = estimate(problem, f"scipy:{name}", objective=objective)
    assert point.method == f"scipy:{name}"
    apart = np.abs(point.theta - reference.theta) / reference.sd
    # in standard deviations: 1e-8 of a flat optimum is 1e-4 of its width
    assert apart.max() < COARSE.get(name, 5e-4)
    assert (np.diff(point.history_objective) > 0).all()
    np.testing.assert_allclose(point.sd, reference.sd, rtol=1e-2)


@pytest.mark.parametrize("name", ["trf", "L-BFGS-B", "Nelder-Mead"])
def test_bounds_are_kept(problem, name):
    bounded = FunctionProblem(
        decay, TIME, problem.data[0], [TruncatedNormal(1.5, 0.5, 0, 1.8), LogNormal(1.0, 0.5)]
    )
    point = estimate(bounded, f"scipy:{name}")
    assert (point.history[:, 0] <= 1.8 + 1e-12).all()
    assert point.theta[0] == pytest.approx(1.8, abs=1e-3)


def test_a_start_that_cannot_be_evaluated_is_a_status():
    broken = FunctionProblem(lambda x, t: x * np.nan, TIME, TIME, [Normal(1.0, 1.0)])
    assert estimate(broken, "scipy:trf").status is Status.NOT_FINITE
