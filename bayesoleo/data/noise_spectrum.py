"""The spectrum of a periodic run's noise, from the lines between its harmonics.

What repeats has lines at the harmonics only. A record of P periods has P - 1 lines between two of
them, and these hold noise alone. Averaged over neighbours they say what noise there is *at* the
harmonics, flat or not.

References
----------
Pintelon and Schoukens (2012), System Identification: A Frequency Domain Approach, sections 2.5
and 3.5; Satterthwaite (1946), Biometrics Bulletin 2(6), 110-114, for degrees of freedom.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from bayesoleo._types import Array

#: Lines that are averaged lie within this many periods' worth of lines, or this part of the
#: frequency, whichever is wider: one harmonic on either side where noise may be steep.
HARMONICS, PART = 1.0, 0.25
#: The same of the mean. Slow noise is largest there and falls on either side alike, so that lines
#: of a whole harmonic would say half of it; elsewhere what is steep is rather said too large.
AT_MEAN = 0.5


@dataclass(frozen=True)
class NoiseSpectrum:
    """Noise by spectral line of a run.

    Parameters
    ----------
    level : ndarray, shape (N // 2 + 1,)
        Variance of a single sample that white noise of this line's strength would have, by line.
    lines : int
        Lines from one harmonic to the next: the number of periods.
    samples : int
        Number N of samples.
    """

    level: Array
    lines: int
    samples: int

    @cached_property
    def weights(self) -> Array:
        """Real coefficients that each line stands for: two, and one at the ends."""
        found = np.full(self.level.size, 2.0)
        found[0] = 1.0
        if self.samples % 2 == 0:
            found[-1] = 1.0
        return found

    @property
    def noise(self) -> float:
        """Standard error of the average over periods, root mean square over the period."""
        return float(np.sqrt(self._at_harmonics().sum() / self.samples))

    @property
    def coefficients(self) -> float:
        """Number of equally noisy coefficients that the average's noise scatters like."""
        power = self._at_harmonics()
        weights = np.where(power > 0, self.weights, 1.0)
        return float(power.sum() ** 2 / np.sum(power**2 / weights))

    @property
    def free(self) -> float:
        """Degrees of freedom of :attr:`noise` squared."""
        return self.freedom(np.where(self._harmonic(), self.weights, 0.0))

    def _harmonic(self) -> NDArray[np.bool_]:
        return np.asarray(np.arange(self.level.size) % self.lines == 0)

    def _at_harmonics(self) -> Array:
        return np.where(self._harmonic(), self.weights * self.level, 0.0)

    def power(self, signal: Array) -> Array:
        """Weight of each line in the variance of ``signal @ noise``, shape (N // 2 + 1,)."""
        transform = scipy.fft.rfft(signal)
        power: Array = self.weights * np.abs(transform) ** 2 / self.samples
        return power

    def freedom(self, power: Array) -> float:
        """Degrees of freedom of ``power @ level``: few lines have said what the level is."""
        used = ~self._harmonic()
        low, high = _windows(self.level.size, self.lines)
        counts = np.maximum(_between(used.astype(float), low, high), 1.0)
        spread = np.zeros(self.level.size + 1)
        np.add.at(spread, low, power / counts)
        np.add.at(spread, high, -power / counts)
        measured = np.where(used, np.cumsum(spread)[:-1] * self.level, 0.0)
        scatter = float(np.sum(2.0 * measured**2 / self.weights))
        return 2.0 * float(measured.sum()) ** 2 / scatter if scatter > 0 else 0.0


def noise_spectrum(rest: Array, periods: int) -> NoiseSpectrum:
    """Spectrum of noise.

    Parameters
    ----------
    rest : ndarray, shape (N,)
        What of a signal does not repeat, over whole periods.
    periods : int
        Their number, at least two.
    """
    size = rest.size
    power = np.abs(scipy.fft.rfft(rest)) ** 2 / size
    used = (np.arange(power.size) % periods != 0).astype(float)
    low, high = _windows(power.size, periods)
    level = _between(power * used, low, high) / np.maximum(_between(used, low, high), 1.0)
    return NoiseSpectrum(level, periods, size)


def _windows(size: int, periods: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First line of each line's neighbourhood, and the first beyond it."""
    line = np.arange(size)
    half = np.maximum(HARMONICS * periods, PART * line).astype(np.int64)
    half[:1] = max(1, int(AT_MEAN * periods))
    high = np.minimum(line + half + 1, size)
    return np.maximum(line - half, 0), high


def _between(values: Array, low: NDArray[np.int64], high: NDArray[np.int64]) -> Array:
    """Sums of values from ``low`` to before ``high``."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    sums: Array = total[high] - total[low]
    return sums
