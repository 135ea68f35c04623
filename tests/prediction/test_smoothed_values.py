"""Values of a smoothed signal between its samples, and of its pieces for an integrator."""

import numpy as np
import pytest
from synthetic_runs import exact_signal

from bayesoleo.prediction._inputs import input_rows, signal_of_transient
from bayesoleo.prediction._records import transient_record
from bayesoleo.solvers._switching import evaluate

STEP = 0.02
TIME = STEP * np.arange(120)


def test_derivatives_are_those_of_the_polynomial():
    """Between its samples a polynomial of fifth degree is itself, with all derivatives."""
    cubic = np.polynomial.Polynomial([1.0, -2.0, 3.0, 0.5])
    smoothed = exact_signal(cubic(TIME), STEP)
    for derivative in range(3):
        expected = cubic.deriv(derivative)(1.234)
        # The states at the samples are differences of neighbours, exact for a cubic.
        assert smoothed.at(np.array([1.234]), derivative)[0] == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("derivative", range(3))
def test_pieces_for_an_integrator_follow_the_curve(derivative):
    """Cubics through four points between neighbouring samples and their middles."""
    record = transient_record("a", TIME, {"force": np.sin(4 * TIME)})
    rows = tuple(("force", k) for k in range(derivative + 1))
    times = np.linspace(TIME[0], TIME[-1], 977)
    pieces = evaluate(signal_of_transient(record, rows), times)
    curve = input_rows(record, rows, times / TIME[-1])
    np.testing.assert_allclose(pieces, curve, atol=1e-5 * 4.0**derivative)
