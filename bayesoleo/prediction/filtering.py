r"""Band-limited interpolation of samples that do not repeat.

Between its samples a signal that was sampled fast enough is the sum of its frequencies up to half
the sampling rate (Shannon 1949), which the discrete Fourier transform gives with all derivatives.
A record does not end where a period of that transform would. Near its ends the curve is a smoothing
spline of twice the band, and beyond them the record is continued by reflection, so that value,
slope and curvature go on, until it may fade out.

References
----------
Shannon, C. E. (1949). Communication in the presence of noise. Proceedings of the IRE 37(1), 10-21.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy import fft

from bayesoleo._types import Array
from bayesoleo.prediction.kalman import smooth
from bayesoleo.prediction.quintic import evaluate_pieces, pieces

#: Periods of the highest frequency that the spline at an end is fitted to, half of which it is
#: joined over, and by which a record is continued.
_END, _BEYOND = 8.0, 8.0
#: Roughness of a spline that goes through its samples, to 3e-5; more would compete with the start,
#: of which nothing is known.
_EXACT = 1e7


@dataclass(frozen=True)
class Band:
    """Frequencies that a curve through samples holds.

    Parameters
    ----------
    cut : float
        Frequency in Hz above which there was nothing but noise; infinite where nothing is cut off.
    upper : float
        Frequency in Hz above which there is a negligible part of the curve.
    held, lost : float
        Root mean square of what the curve holds, and of what was cut off beyond a flat floor of
        noise; of the derivative that it is for.
    fade : float
        Part of the cut over which the gain falls to nothing.
    """

    cut: float
    upper: float
    held: float = 0.0
    lost: float = 0.0
    fade: float = 0.5

    def gain(self, frequency: Array) -> Array:
        """Part of an amplitude that stays, shape of `frequency`."""
        if not np.isfinite(self.cut):
            return np.ones(frequency.shape)
        part = np.clip((frequency / self.cut - 1.0) / self.fade, 0.0, 1.0)
        return np.asarray(np.cos(0.5 * np.pi * part) ** 2)


def filtered(
    values: Array, step: float, band: Band, per_sample: int, exponent: float = 1.0
) -> Array:
    """Value and two derivatives of the band-limited curve on a finer grid.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Samples; at least eight.
    step : float
        Their interval, s.
    band : Band
        What passes.
    per_sample : int
        Points of the grid in an interval.
    exponent : float
        Power of the band's gain.

    Returns
    -------
    ndarray, shape ((N - 1) * per_sample + 1, 3)
    """
    first, last = _end(values, step, band), _end(values[::-1], step, band)
    inside = _transformed(values, step, band, per_sample, exponent, first[0], last[0])
    backward = np.array([1.0, -1.0, 1.0])
    states = _joined(inside, first, step, per_sample)
    return cast(Array, _joined(states[::-1] * backward, last, step, per_sample)[::-1] * backward)


def _end(values: Array, step: float, band: Band) -> Array:
    """States ``(n, 3)`` at the first samples: a smoothing spline of twice the band."""
    cut = min(band.cut, 0.5 / step)
    count = min(max(int(_END / (cut * step)), 32), values.size)
    roughness = (4.0 * np.pi * cut * step) ** 6 if np.isfinite(band.cut) else _EXACT
    level = values[0]
    states = smooth(np.ascontiguousarray(values[:count] - level), roughness)
    states[:, 0] += level
    return states / step ** np.arange(3)


def _transformed(
    values: Array, step: float, band: Band, per_sample: int, exponent: float, *ends: Array
) -> Array:
    """The same by the discrete Fourier transform, right but near the ends."""
    count, cut = values.size, min(band.cut, 0.5 / step)
    slope = (ends[1][0] - ends[0][0]) / (count - 1)
    rest = values - ends[0][0] - slope * np.arange(count)
    reach = min(count - 1, max(int(_BEYOND / (cut * step)), 64))
    bends = [0.5 * end[2] * step**2 for end in ends]
    before = _reflected(rest[: reach + 1], bends[0])[::-1]
    whole = np.concatenate([before, rest, _reflected(rest[::-1][: reach + 1], bends[1])])
    size = fft.next_fast_len(whole.size, real=True)
    size += size % 2
    spectrum, frequency = fft.rfft(whole, size), fft.rfftfreq(size, step)
    spectrum *= band.gain(frequency) ** exponent
    # The highest frequency stands for two, of either sign, once the grid is finer.
    spectrum[-1] *= 0.5 if per_sample > 1 else 1.0
    fine, states = size * per_sample, np.empty(((count - 1) * per_sample + 1, 3))
    for order in range(3):
        part = spectrum * (2j * np.pi * frequency) ** order
        found = fft.irfft(part, fine) * per_sample
        states[:, order] = found[reach * per_sample :][: states.shape[0]]
    states[:, 0] += ends[0][0] + slope / per_sample * np.arange(states.shape[0])
    states[:, 1] += slope / step
    return states


def _reflected(values: Array, bend: float) -> Array:
    """What comes after the end of samples that begin with it, fading out."""
    place, width = np.arange(1, values.size), values.size / 4.0
    even = bend * place**2 / (1.0 + (place / width) ** 2)
    fade = np.clip(2.0 * (1.0 - place / values.size), 0.0, 1.0)
    return cast(Array, (2.0 * even - values[1:]) * np.sin(0.5 * np.pi * fade) ** 2)


def _joined(states: Array, spline: Array, step: float, per_sample: int) -> Array:
    """States that begin as a spline and go over into what they were within half its length."""
    count = (len(spline) - 1) * per_sample // 2
    time = step / per_sample * np.arange(count, dtype=np.float64)
    coefficients = pieces(spline, step)
    begin = np.stack([evaluate_pieces(coefficients, time, step, k) for k in range(3)], axis=1)
    # A polynomial with three derivatives that are zero at either end, by Leibniz's rule.
    part, length = np.arange(count) / max(count, 1), max(count, 1) * step / per_sample
    weight = np.polynomial.Polynomial([1, 0, 0, 0, -35, 84, -70, 20])
    w = [weight.deriv(k)(part) / length**k if k else weight(part) for k in range(3)]
    gap = begin - states[:count]
    joined = states.copy()
    joined[:count, 0] += w[0] * gap[:, 0]
    joined[:count, 1] += w[0] * gap[:, 1] + w[1] * gap[:, 0]
    joined[:count, 2] += w[0] * gap[:, 2] + 2.0 * w[1] * gap[:, 1] + w[2] * gap[:, 0]
    return joined
