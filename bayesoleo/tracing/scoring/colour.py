"""How much more a score varies than white noise would make it: by the noise's spectrum, and by its
scatter between periods."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from bayesoleo._types import Array
from bayesoleo.data import periodic_average
from bayesoleo.data.noise_spectrum import NoiseSpectrum, noise_spectrum

if TYPE_CHECKING:
    from bayesoleo.tracing.scoring.base import Base, RunBase


#: Degrees of freedom of a variance that is not measured.
ASSUMED = 1e9


def inflation_of(base: Base, directions: Sequence[Array]) -> tuple[float, int]:
    """Variance of a score over white noise's, at least one, and its degrees of freedom.

    The spectrum of each output's noise says how much of it lies along the direction; it uses all
    lines between harmonics, and so knows it well from few periods. What it cannot see - noise that
    comes and goes, or that outputs share - shows in the scatter of the score between periods, which
    is believed where it is larger than the spectrum would seldom let it be.

    Parameters
    ----------
    base : Base
        Residuals and spectra by run.
    directions : sequence of ndarray, shape (m,)
        What the effect adds to each run, in noise units, outputs one after the other.
    """
    white = sum(float(d @ d) for d in directions)
    if not white > 0:
        return 1.0, 0
    parts = [
        _by_spectrum(run, d, _spectra(base, r, d))
        for r, (run, d) in enumerate(zip(base.runs, directions, strict=True))
    ]
    variance = sum(value for value, _ in parts)
    scatter = sum(value**2 / free for value, free in parts if free > 0)
    freedom = variance**2 / scatter if scatter > 0 else ASSUMED
    between, degrees = _between_periods(base.runs, directions)
    # Against the spectrum's own uncertainty: neither is exact.
    unsteady = degrees > 0 and between / variance > stats.f.isf(
        base.policy.unsteady, degrees, freedom
    )
    if unsteady:
        variance, freedom = between, degrees
    return max(1.0, variance / white), 0 if freedom >= ASSUMED else max(1, int(freedom))


def _spectra(base: Base, r: int, direction: Array) -> tuple[NoiseSpectrum, ...]:
    """Spectra of a run's noise, without what a direction that does not repeat would explain of it.

    A drift lies between the harmonics, where noise is measured: it must not count as its own noise.
    """
    run = base.runs[r]
    if not run.spectra:
        return ()
    parts = direction.reshape(len(run.spectra), -1)
    most = base.policy.aperiodic_power
    if not any(_wanders(part, s, most) for part, s in zip(parts, run.spectra, strict=True)):
        return run.spectra
    record, found = base.fit.records[r], []
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    for k, left in enumerate((run.residual - direction).reshape(parts.shape)):
        average = periodic_average(left, step, record.frequency)
        unit = run.scale[k * left.size]
        found.append(noise_spectrum((left - average.values) / unit, record.periods))
    return tuple(found)


def _wanders(signal: Array, spectrum: NoiseSpectrum, most: float) -> bool:
    """Whether a good part of a signal does not repeat from period to period."""
    power = spectrum.power(signal)
    return bool(power.sum() - power[:: spectrum.lines].sum() > most * power.sum())


def _by_spectrum(
    run: RunBase, direction: Array, spectra: tuple[NoiseSpectrum, ...]
) -> tuple[float, float]:
    """Variance of the score of one run and its degrees of freedom, zero where it is assumed."""
    if not spectra:
        return float(direction @ direction), 0.0
    size, variance, scatter = direction.size // len(spectra), 0.0, 0.0
    for k, spectrum in enumerate(spectra):
        part = slice(k * size, (k + 1) * size)
        power = spectrum.power(direction[part]) * run.scale[part][0] ** 2
        own, free = float(power @ spectrum.level), spectrum.freedom(power)
        variance += own
        scatter += own**2 / free if free > 0 else 0.0
    return variance, variance**2 / scatter if scatter > 0 else 0.0


def _between_periods(runs: Sequence[RunBase], directions: Sequence[Array]) -> tuple[float, int]:
    """The same variance by the scatter of the score between periods.

    A direction that repeats moves the mean over periods only, so that what was estimated takes one
    degree of freedom a run from the scatter.
    """
    total, degrees = 0.0, 0
    for run, direction in zip(runs, directions, strict=True):
        # What the effect itself would explain is no noise, and must not count as such.
        sums = np.bincount(run.period, direction * (run.residual - direction))
        if sums.size > 1:
            total += sums.size * float(np.var(sums, ddof=1))
            degrees += sums.size - 1
    return total, degrees
