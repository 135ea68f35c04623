"""Residuals that are nothing but noise, as the search holds them."""

from __future__ import annotations

import numpy as np

from bayesoleo.data._noise import noise_spectrum
from bayesoleo.discovery._score_basis import Base, RunBase

PER_PERIOD = 50


def base_of_noise(rng, *, shared, periods, measured=True):
    """One run with two outputs of unit noise, the same in both or not, and a direction."""
    size = periods * PER_PERIOD
    first = rng.standard_normal(size)
    second = first if shared else rng.standard_normal(size)
    phase = np.arange(size) / PER_PERIOD
    spectra = tuple(noise_spectrum(_what_does_not_repeat(x), periods) for x in (first, second))
    run = RunBase.of(
        np.ones(2 * size),
        np.concatenate([first, second]),
        np.zeros((0, 2 * size)),
        np.zeros((0, 2 * size)),
        np.tile(np.floor(phase + 1e-9).astype(np.int64), 2),
        spectra if measured else (),
    )
    wave = 1e-3 * np.sin(2 * np.pi * phase)
    empty = np.zeros((0, 0))
    return Base(None, [run], empty, np.zeros(0), 1.0, 1.0, 1.0), np.concatenate([wave, wave])


def _what_does_not_repeat(signal):
    mean = signal.reshape(-1, PER_PERIOD).mean(axis=0)
    return signal - np.tile(mean, signal.size // PER_PERIOD)
