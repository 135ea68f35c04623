"""A product of two gains, of which data tell the product alone, has a mode all the same."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from bayesoleo.estimation._problem import Evaluation, Misfit
from bayesoleo.model._priors import Normal
from bayesoleo.posterior import LogDensity
from bayesoleo.posterior._laplace import _inverse, find_mode, start_coordinates
from bayesoleo.solvers._orbit import Status

TIME = np.linspace(0.0, 6.0, 200)
Y = 3.0 * np.sin(TIME) + 1e-9 * np.random.default_rng(0).standard_normal(TIME.size)


@dataclass(frozen=True)
class Gains:
    """``y = a b sin t`` with noise so small that the priors are nothing beside it."""

    names = ("a", "b")
    outputs = ("y",)
    runs = ("run 1",)
    priors = (Normal(1.0, 1e4), Normal(1.0, 1e4))
    start = np.array([1.5, 2.0])
    counts = np.array([[TIME.size]])

    def evaluate(self, theta):
        wave = np.sin(TIME)
        slope = np.column_stack([theta[1] * wave, theta[0] * wave])
        return Evaluation((Y - theta[0] * theta[1] * wave,), (slope,), Status.CONVERGED)

    def misfit(self, theta):
        away = Y - theta[:, :1] * theta[:, 1:2] * np.sin(TIME)
        return Misfit(np.sum(away**2, axis=1)[:, None, None], np.zeros(len(theta), dtype=int))


def test_a_numerical_failure_is_a_status_and_no_error():
    density = LogDensity(Gains())
    mode = find_mode(density, start_coordinates(density, Gains.start))
    assert np.isfinite(mode.covariance).all()
    assert np.isfinite(mode.log_weight)
    # The product is known to noise; what keeps it is open to rounding, ten thousand times as wide.
    a, b = mode.centre[:2]
    along, across = np.array([a, -b]), np.array([b, a])
    block = mode.covariance[:2, :2]
    assert along @ block @ along > 1e8 * (across @ block @ across)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_an_open_direction_keeps_a_large_variance_in_any_units(scale):
    units = np.array([scale, 1.0])
    row = np.array([1.0, 1.0])
    singular = np.outer(row, row) / np.outer(units, units)
    found = _inverse(singular * 1e18) * 1e18 / np.outer(units, units)
    np.linalg.cholesky(found)
    assert row @ found @ row == pytest.approx(1.0, rel=1e-3)
    across = np.array([1.0, -1.0])
    assert across @ found @ across > 1e10


def test_a_regular_precision_is_inverted_as_it_is():
    precision = np.array([[4.0, 1.0], [1.0, 9.0]])
    np.testing.assert_array_equal(_inverse(precision), np.linalg.inv(precision))
