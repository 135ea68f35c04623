"""Frequency range in which a channel's spectrum stands above its noise.

Noise can be told from a signal only where the spectrum falls to a floor that extends to the highest
frequencies. A signal that fills the band up to half the sampling rate shows no floor, and its noise
cannot be determined.

References
----------
Welch, P. D. (1967). The use of fast Fourier transform for the estimation of power spectra. IEEE
Transactions on Audio and Electroacoustics 15(2), 70-73.

Widrow, B. and Kollar, I. (2008). Quantization Noise. Cambridge University Press, chapter 5.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import uniform_filter1d

from bayesoleo._types import Array

#: Samples below which there is no spectrum worth the name.
FEWEST_SAMPLES = 64
#: Segments that are averaged at least, half overlapping, and the longest of them in samples.
_SEGMENTS, _LONGEST = 8, 4096
#: Shape of Kaiser's window: side lobes 105 dB down, so that slow motion does not pass for a floor.
_SHAPE = 14.0
#: Bins over which a window of that shape spreads a line, to either side.
MAIN_LOBE = 5
#: Part of the band over which a floor is looked for; the lowest such part is the floor.
_FLOOR_PART = 0.125
#: A spectrum is taken as signal where it exceeds the floor this many times: keeping a line reduces
#: the error of a value once its power is twice the floor. Where a derivative is taken, noise that
#: is not white does the more harm the higher its frequency, so a signal has to be twice as large
#: as the noise there (four times its power).
_VALUE, _DERIVATIVE = 2.0, 5.0
#: Signal over noise, in power of the derivative, at which a part of the spectrum beyond a gap
#: stays.
_BEYOND_GAP = 4.0
#: Floors that make a smaller part of the power than this may be cut whatever their shape: three
#: thousandths of the amplitude.
NEGLIGIBLE = 1e-5
#: Ratio of the lower to the upper half of what is cut: a floor of noise is flat, but for so many
#: standard errors of the two. With two, white noise of 300 samples was called signal in 4 % of
#: records, and then counted as none; with four in 0.7 %.
_FLAT, _SCATTER = 1.2, 4.0
#: A cut this close to half the sampling rate is none.
_WHOLE = 0.9


@dataclass(frozen=True)
class Spectrum:
    """Power of a channel by frequency.

    Parameters
    ----------
    frequency : ndarray, shape (K,)
        Hz, above zero, equidistant.
    density : ndarray, shape (K,)
        One-sided power spectral density, square of the channel's unit per Hz.
    floor : ndarray, shape (K,)
        Density of what cannot be told from noise: the lowest level, or that of rounding.
    averaged : float
        Independent values that each density is the mean of.
    """

    frequency: Array
    density: Array
    floor: Array
    averaged: float

    @property
    def highest(self) -> float:
        """Half the sampling rate, Hz."""
        return float(self.frequency[-1])

    @property
    def power(self) -> float:
        """Variance of the channel."""
        return float(self.density.sum() * self.frequency[0])

    @property
    def noise(self) -> float:
        """Standard deviation of a sample's noise: the floor over all frequencies."""
        return float(np.sqrt(self.floor.sum() * self.frequency[0]))

    def between(self, low: float, high: float) -> float:
        """Variance of the channel between two frequencies in Hz."""
        inside = (self.frequency > low) & (self.frequency <= high)
        return float(self.density[inside].sum() * self.frequency[0])

    def fastest(self, part: float, derivative: int = 0, cut: float = np.inf) -> float:
        """Frequency in Hz above which only a part of a derivative's power lies, up to a cut."""
        power = self.frequency ** (2 * derivative) * self.density * (self.frequency <= cut)
        above = np.cumsum(power[::-1])[::-1]
        return float(self.frequency[np.flatnonzero(above >= part * above[0])[-1]])

    def held(self, cut: float, derivative: int) -> float:
        """Root mean square of a derivative up to a cut in Hz."""
        power = self.frequency ** (2 * derivative) * self.density * (self.frequency <= cut)
        return self._root(power, derivative)

    def lost(self, cut: float, derivative: int) -> float:
        """Root mean square of a derivative above a cut, where it clearly exceeds the floor."""
        above = np.zeros(self.frequency.size)
        for first, end in self._parts(derivative):
            above[first:end] = np.maximum(self.density - self.floor, 0.0)[first:end]
        power = self.frequency ** (2 * derivative) * above * (self.frequency > cut)
        return self._root(power, derivative)

    def _root(self, power: Array, derivative: int) -> float:
        total = float(np.sqrt(power.sum() * self.frequency[0]))
        return float((2.0 * np.pi) ** derivative * total)

    def cut(self, derivative: int) -> float:
        """Frequency above which there is nothing but noise, for a derivative to be taken.

        Parameters
        ----------
        derivative : int
            The highest that is taken of the channel. Noise grows with the frequency to this power,
            so that more is asked of what lies far up.

        Returns
        -------
        float
            Hz; infinite where noise cannot be told from signal.
        """
        parts = self._parts(derivative)
        if not parts:
            return np.inf
        weight = self.frequency ** (2 * derivative)
        signal_power = weight * np.maximum(self.density - self.floor, 0.0)
        noise = np.cumsum(weight * self.floor)
        while len(parts) > 1:
            first, end = parts[-1]
            if signal_power[first:end].sum() > _BEYOND_GAP * noise[end - 1]:
                break
            parts.pop()
        end = parts[-1][1]
        if end >= _WHOLE * self.frequency.size or not self._is_noise(end):
            return np.inf
        return float(self.frequency[end - 1])

    def _parts(self, derivative: int) -> list[tuple[int, int]]:
        """Runs of bins in which there is signal, first and end."""
        smooth = uniform_filter1d(self.density, MAIN_LOBE, mode="nearest")
        scatter = np.sqrt(1.0 / (self.averaged * 0.5 * MAIN_LOBE))
        ratio = max(_VALUE if derivative == 0 else _DERIVATIVE, 1.0 + 4.0 * scatter)
        above = np.concatenate([[0], (smooth > ratio * self.floor).astype(np.int8), [0]])
        edges = np.flatnonzero(np.diff(above))
        return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]

    def _is_noise(self, first: int) -> bool:
        """Whether the spectrum above a bin looks like noise: flat, or next to nothing."""
        rest = self.density[first:] / self.floor[first:]
        if self.floor[first:].sum() * self.frequency[0] < NEGLIGIBLE * self.power:
            return True
        half = rest.size // 2
        lower, upper = np.median(rest[:half]), np.median(rest[half:])
        margin = _FLAT + _SCATTER * np.sqrt(2.0 / (self.averaged * max(half, 1)))
        return bool(lower < margin * upper)


def spectrum_of(values: Array, step: float, quantum: float = 0.0) -> Spectrum | None:
    """Spectrum of equidistant samples by Welch's method; None where there are too few.

    Parameters
    ----------
    values : ndarray, shape (N,)
    step : float
        Sampling interval, s.
    quantum : float
        Step of the grid that the samples lie on; zero where there is none.
    """
    # Only transients need it, and loading it takes as long as much of a search of periodic runs.
    from scipy import signal

    if values.size < FEWEST_SAMPLES or not np.ptp(values) > 0:
        return None
    size = segment_length(values.size)
    frequency, density = signal.welch(
        values, 1.0 / step, ("kaiser", _SHAPE), size, 3 * size // 4, detrend="linear"
    )
    # The window correlates segments that overlap by three quarters: two thirds of them count.
    averaged = max(2.0 * (values.size / size - 0.5), 1.0)
    frequency, density = frequency[1:], np.maximum(density[1:], 1e-300)
    floor = np.full(density.size, _lowest(density, averaged))
    if quantum > 0.0:
        floor = np.maximum(floor, rounding_density(frequency, values, step, quantum))
    return Spectrum(frequency, density, floor, averaged)


def lines_of(frequency: Array, power: Array, rounding: Array) -> Spectrum:
    """The same of harmonics, with the power of each and that which rounding has at it.

    Parameters
    ----------
    frequency : ndarray, shape (K,)
        Of all harmonics, Hz or orders.
    power, rounding : ndarray, shape (K,)
        Variance that a harmonic stands for; mean of that of rounding errors.
    """
    density, spacing = power / frequency[0], frequency[0]
    floor = np.maximum(_lowest(density, 1.0), rounding / spacing)
    return Spectrum(frequency, density, np.maximum(floor, 1e-300), 1.0)


def segment_length(samples: int) -> int:
    """Length of the segments that a record is cut into."""
    return int(min(max(2 * samples // (_SEGMENTS + 1), FEWEST_SAMPLES // 2), _LONGEST))


def rounding_density(frequency: Array, values: Array, step: float, quantum: float) -> Array:
    r"""One-sided density of rounding errors.

    Where a signal crosses many steps of the grid in a sampling interval the error is white, with
    variance :math:`q^2/12`. One that crosses :math:`r` steps a second jumps by :math:`q` as often:
    below that rate its error is spread over the rate, above it falls with the frequency squared.

    Parameters
    ----------
    frequency : ndarray, shape (K,)
        Hz.
    values : ndarray, shape (N,)
        Samples.
    step : float
        Sampling interval, s.
    quantum : float
        Step of the grid.
    """
    rate = max(float(np.abs(np.diff(values)).mean()) / (quantum * step), 1e-300)
    jumps = 2.0 * rate * quantum**2 * step**2 / (2.0 - 2.0 * np.cos(2 * np.pi * frequency * step))
    return np.minimum(jumps, quantum**2 / 6.0 * max(1.0 / rate, step))


def _lowest(density: Array, averaged: float) -> float:
    """Lowest level of a spectrum over a part of the band; lines in it do not count."""
    width = min(max(round(_FLOOR_PART * density.size), 8), density.size)
    # The median of a mean of a few exponentials lies below their mean.
    below = (1.0 - 1.0 / (9.0 * averaged)) ** 3
    first = range(0, density.size - width + 1, max(width // 2, 1))
    return float(min(np.median(density[k : k + width]) for k in first)) / below
