"""A smoothed signal gives the same values one by one as all at once."""

import numpy as np
import pytest
from synthetic_runs import exact_signal

from bayesoleo.prediction._band_limited import smooth_signal

STEP = 0.02
TIME = STEP * np.arange(120)


@pytest.mark.parametrize("derivative", range(4))
def test_one_value_at_a_time(derivative):
    rng = np.random.default_rng(3)
    smoothed = smooth_signal(np.sin(4 * TIME) + 0.01 * rng.standard_normal(TIME.size), STEP)
    # Inside, on samples, on both ends and beyond them.
    where = np.array([-0.01, 0.0, 0.013, STEP, 1.0, 1.2345, TIME[-1], TIME[-1] + 0.01])
    single = [smoothed.at_once(float(t), derivative) for t in where]
    together = smoothed.at(where, derivative)
    np.testing.assert_allclose(single, together, rtol=1e-12, atol=1e-12 * np.abs(together).max())


def test_derivatives_are_those_of_the_polynomial():
    """Between its samples a polynomial of fifth degree is itself, with all derivatives."""
    cubic = np.polynomial.Polynomial([1.0, -2.0, 3.0, 0.5])
    smoothed = exact_signal(cubic(TIME), STEP)
    for derivative in range(3):
        expected = cubic.deriv(derivative)(1.234)
        # The states at the samples are differences of neighbours, exact for a cubic.
        assert smoothed.at_once(1.234, derivative) == pytest.approx(expected, rel=1e-6)
