"""Certified nonlinear regressions: the NIST Statistical Reference Datasets."""

from __future__ import annotations

import numpy as np
import pytest
from nist_models import FUNCTIONS, complex_step, read

from bayesoleo.estimation import FunctionProblem, estimate
from bayesoleo.model._priors import Normal
from bayesoleo.solvers._orbit import Status

pytestmark = pytest.mark.reference

DIGITS = 6
# Its residuals are the 14th digit of the data: their variance needs more than double precision.
BELOW_ROUNDING = {"Lanczos1"} if np.finfo(np.longdouble).eps > 1e-18 else set()
# From the far start MBE with weak priors ends in a permutation of the exponentials (Lanczos), or
# runs to infinity, where NIST itself names a minimum (MGH09) or a plateau (MGH10, MGH17).
OTHER_OPTIMUM = {"Lanczos1", "Lanczos2", "Lanczos3", "MGH09", "MGH10", "MGH17"}


def fit(path, start, method, derivatives="exact", **options):
    """Estimate one set with priors a thousand times wider than the start is large."""
    certified, function = read(path), FUNCTIONS[path.stem]
    begin = certified.starts[start]
    problem = FunctionProblem(
        function,
        certified.x,
        certified.y,
        [Normal(value, 1e3 * abs(value)) for value in begin],
        jacobian=complex_step(function) if derivatives == "exact" else None,
    )
    if method is None:
        return estimate(problem, bias_corrected=True), certified
    # bias-corrected, because NIST divides by the degrees of freedom; 1e-10 because the slowest set
    # (Thurber) gains a third of a digit an iteration
    point = estimate(
        problem, method, tolerance=1e-10, max_iterations=1000, bias_corrected=True, **options
    )
    return point, certified


def agreed_digits(values, certified):
    error = np.max(np.abs(values - certified) / np.abs(certified))
    return -np.log10(max(error, 1e-16))


def check(point, certified, name):
    assert point.status is Status.CONVERGED
    assert agreed_digits(point.theta, certified.theta) >= DIGITS
    if name not in BELOW_ROUNDING:
        sd = np.sqrt(np.diag(point.covariance_likelihood))
        assert agreed_digits(sd, certified.sd) >= DIGITS


@pytest.mark.parametrize("derivatives", ["exact", "differences"])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_mbe_from_the_near_start(data_set, name, derivatives):
    point, certified = fit(data_set("nist") / f"{name}.dat", 1, "mbe", derivatives)
    check(point, certified, name)


@pytest.mark.parametrize("name", sorted(set(FUNCTIONS) - OTHER_OPTIMUM))
def test_mbe_from_the_far_start(data_set, name):
    point, certified = fit(data_set("nist") / f"{name}.dat", 0, "mbe")
    check(point, certified, name)


@pytest.mark.parametrize("start", [pytest.param(0, marks=pytest.mark.slow), 1])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_default_settings_from_both_starts(data_set, name, start):
    """Neither a method nor a tolerance nor derivatives are given."""
    path = data_set("nist") / f"{name}.dat"
    point, certified = fit(path, start, None, "differences")
    check(point, certified, name)


@pytest.mark.slow
@pytest.mark.parametrize("start", [0, 1])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_levenberg_marquardt_from_both_starts(data_set, name, start):
    path = data_set("nist") / f"{name}.dat"
    point, certified = fit(path, start, "levenberg-marquardt")
    check(point, certified, name)
