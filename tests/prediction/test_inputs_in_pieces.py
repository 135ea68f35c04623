"""Many harmonics of an input as cubic pieces, for motions from which a solver only starts."""

import numpy as np
import pytest
from synthetic_runs import harmonics, run

from bayesoleo.prediction._inputs import MANY_HARMONICS, PIECES_PER_CYCLE, signal_of_rows
from bayesoleo.solvers._switching import evaluate

ROWS = (("force", 0), ("force", 1), ("time", 0), ("force", 2))


def multisine(count: int, frequency: float = 0.1):
    rng = np.random.default_rng(0)
    values = np.exp(2j * np.pi * rng.random(count + 1))
    values[0] = 0.3
    return run("broad", {"force": harmonics(np.arange(count + 1), values)}, frequency)


@pytest.mark.parametrize("count", [100, 1001])
def test_pieces_are_as_good_as_a_start_has_to_be(count):
    """The error of a cubic with the ends' values and slopes is ``(w h)**4 / 384`` of a harmonic."""
    record = multisine(count)
    exact, pieces = (signal_of_rows(record, ROWS, exact=way) for way in (True, False))
    assert exact.knots.size == 0
    assert pieces.knots.size > PIECES_PER_CYCLE * count
    rng = np.random.default_rng(1)
    times = np.append(rng.uniform(0.0, 10.0, 2000), [0.0, 10.0])
    wanted, found = evaluate(exact, times), evaluate(pieces, times)
    orders = np.arange(count + 1)
    error = (2 * np.pi / PIECES_PER_CYCLE) ** 4 / 384 * (orders / count) ** 4
    for row, derivative in ((0, 0), (1, 1), (3, 2)):
        amplitude = (2 * np.pi * 0.1 * orders) ** derivative
        rms = np.sqrt(0.5 * np.sum((amplitude * error) ** 2))
        # Errors of harmonics add in squares; of thousands of times the largest is four rms.
        assert np.sqrt(np.mean((found[row] - wanted[row]) ** 2)) < 1.2 * rms
        assert np.abs(found[row] - wanted[row]).max() < 6.0 * rms
    assert not found[2].any()


def test_few_harmonics_are_summed():
    record = multisine(MANY_HARMONICS - 1)
    found = signal_of_rows(record, ROWS, exact=False)
    assert found.knots.size == 0
    np.testing.assert_array_equal(found.cosine, signal_of_rows(record, ROWS).cosine)
