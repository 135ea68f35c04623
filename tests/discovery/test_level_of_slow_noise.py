"""Noise on the lines by which structures are compared, where it is slow."""

from __future__ import annotations

from types import SimpleNamespace as Stub

import numpy as np
import pytest
from scipy.signal import lfilter

from bayesoleo.data._noise import noise_spectrum
from bayesoleo.discovery._spectral_data import RunLines

PERIODS, EACH = 5, 60
SIZE = PERIODS * EACH


def level_of(noise: np.ndarray, lines: np.ndarray) -> np.ndarray:
    average = np.tile(noise.reshape(PERIODS, EACH).mean(axis=0), PERIODS)
    rest = noise - average
    sigma = np.sqrt(np.sum(rest**2) / (SIZE - EACH))
    error = Stub(
        spectrum=noise_spectrum(rest, PERIODS),
        average=Stub(sigma=sigma, samples=SIZE, number=EACH),
        rounding=0.0,
    )
    run = RunLines(Stub(periodic=True, periods=PERIODS), lines)
    return run.level(error)[: lines.size]


@pytest.mark.parametrize("memory", [0.0, 0.3, 0.7, 0.9])
def test_harmonics_are_not_said_to_be_quieter_than_they_are(memory):
    """The mean square of a line over its level, were the level known, is one."""
    lines = np.arange(0, 8 * PERIODS, PERIODS)
    squares = []
    for seed in range(400):
        rng = np.random.default_rng(seed)
        noise = lfilter([1.0], [1.0, -memory], rng.standard_normal(SIZE + 200))[200:]
        power = np.abs(np.fft.rfft(noise, norm="ortho"))[lines] ** 2
        squares.append(power / level_of(noise, lines))
    mean = np.mean(squares, axis=0)
    # The mean of 400 is known to 7 % at zero and 5 % elsewhere, and a level of some twenty
    # coefficients makes it a tenth too large. Averaged with that of all lines it was 2.1 at zero
    # for a memory of 0.7, and 2.8 for 0.9. Where the spectrum has no flat part, noise is overstated
    # on its slope: no effect is named for that.
    assert mean[0] < (1.5 if memory < 0.9 else 2.2)
    assert (mean[1:] < 1.5).all()
    assert (mean > (0.6 if memory < 0.9 else 0.4)).all()
