"""Band-limited interpolation of samples, with the Kalman smoother on which it is based.

The smoother models a process whose third derivative is white noise. Time is in sampling intervals
and noise in standard deviations of a sample, so that one number remains: the roughness, the
variance of the process noise in an interval. The smoothed mean is a quintic smoothing spline (Wahba
1978) whose gain at the angular frequency w per sample is ``1 / (1 + w**6 / roughness)`` inside a
long record. Between its points it consists of quintic pieces, given by value, first and second
derivative.

A signal that was sampled fast enough is the sum of its frequencies up to half the sampling rate
(Shannon 1949), which the discrete Fourier transform gives with all derivatives. A record is not
one period of that transform. Near its ends the curve is therefore a smoothing spline of twice the
band, and beyond them the record is continued by reflection, so that value, slope and curvature are
continuous, until it may fade out.

References
----------
Wahba, G. (1978). Improper priors, spline smoothing and the problem of guarding against model errors
in regression. J. Royal Statistical Society B 40(3), 364-372.

Shannon, C. E. (1949). Communication in the presence of noise. Proceedings of the IRE 37(1), 10-21.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import perm
from typing import cast

import numpy as np
from scipy import fft

from bayesoleo._compiled import cached
from bayesoleo._types import Array
from bayesoleo.solvers._elimination import eliminate

#: Variance of the state before the first sample, over that of a sample's noise.
DIFFUSE = 1e9
#: Lengths in periods of the highest frequency: of the end that the spline is fitted to (it is
#: joined over half of it), and of the continuation beyond the record.
_END, _BEYOND = 8.0, 8.0
#: The same of the end that follows from the spectrum, with its fewest and most samples; part of the
#: cut-off frequency up to which its lines count; size of its mean and slope over the signal's; its
#: weakest line and smallest noise over the signal's, in power and in size; most lines for each
#: sample, since what lies closer together is one line within so few samples.
_KNOWN, _FEWEST, _MOST, _PASSED, _FREE, _LEAST, _SMALLEST = 16.0, 32, 256, 1.5, 10.0, 1e-9, 1e-7
_LINES = 8
#: Roughness of a spline that goes through its samples, to 3e-5; more would compete with the start,
#: of which nothing is known.
_EXACT = 1e7


def process_noise() -> Array:
    """Covariance that unit white noise in the third derivative adds to the state in a unit step."""
    return np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])


@cached()
def _advance(x: Array, p: Array, roughness: float, noise: Array, ahead: Array) -> None:
    """One step of the state ``x (3,)`` and its covariance ``p (3, 3)``, in place."""
    x[0] += x[1] + 0.5 * x[2]
    x[1] += x[2]
    for i in range(3):
        for j in range(3):
            row = p[i, j]
            if i == 0:
                row += p[1, j] + 0.5 * p[2, j]
            elif i == 1:
                row += p[2, j]
            ahead[i, j] = row
    for i in range(3):
        for j in range(3):
            value = ahead[i, j]
            if j == 0:
                value += ahead[i, 1] + 0.5 * ahead[i, 2]
            elif j == 1:
                value += ahead[i, 2]
            p[i, j] = value + roughness * noise[i, j]


@cached()
def _update(x: Array, p: Array, innovation: float, gain: Array) -> float:
    """Take in one sample with unit noise; returns the innovation's variance."""
    variance = p[0, 0] + 1.0
    for i in range(3):
        gain[i] = p[i, 0] / variance
    for i in range(3):
        x[i] += gain[i] * innovation
    for i in range(3):
        for j in range(i, 3):
            p[i, j] -= gain[i] * gain[j] * variance
            p[j, i] = p[i, j]
    return float(variance)


@cached()
def _filter(
    values: Array, roughness: float, noise: Array, kept: Array, covariances: Array, store: bool
) -> tuple[float, float]:
    """Forward pass; returns the sum of squared innovations and of log variances after three."""
    x, p, ahead, gain = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    x[0] = values[0]
    for i in range(3):
        p[i, i] = DIFFUSE
    squares = logs = 0.0
    for n in range(values.size):
        if n > 0:
            _advance(x, p, roughness, noise, ahead)
        innovation = values[n] - x[0]
        variance = _update(x, p, innovation, gain)
        if n >= 3:
            squares += innovation * innovation / variance
            logs += np.log(variance)
        if store:
            kept[n] = x
            covariances[n] = p
    return squares, logs


def innovations(values: Array, roughness: float) -> tuple[float, float]:
    """Twice the negative log-likelihood but for constants, and the variance of a sample's noise."""
    empty = np.empty((0, 3)), np.empty((0, 3, 3))
    squares, logs = _filter(values, roughness, process_noise(), *empty, False)
    free = values.size - 3
    variance = max(squares / free, 1e-300)
    return free * float(np.log(variance)) + logs, variance


def smooth(values: Array, roughness: float) -> Array:
    """Smoothed states ``(N, 3)`` in units of the step, by the Rauch-Tung-Striebel recursion."""
    size = values.size
    kept, covariances = np.empty((size, 3)), np.empty((size, 3, 3))
    _filter(values, roughness, process_noise(), kept, covariances, True)
    _backward(kept, covariances, roughness, process_noise())
    return kept


@cached()
def _backward(kept: Array, covariances: Array, roughness: float, noise: Array) -> None:
    ahead, x = np.zeros((3, 3)), np.zeros(3)
    for n in range(kept.shape[0] - 2, -1, -1):
        x[:] = kept[n]
        p = covariances[n].copy()
        _advance(x, p, roughness, noise, ahead)
        # ahead is A P; the gain P A' (A P A' + Q)^-1 solves a symmetric system.
        weights = ahead.copy()
        eliminate(p, weights, 0.0)
        change = kept[n + 1] - x
        for i in range(3):
            for j in range(3):
                kept[n, i] += weights[j, i] * change[j]


@cached()
def walk(steps: Array) -> Array:
    """States of the process from its increments ``(N, 3)``, from zero."""
    states = np.zeros_like(steps)
    for n in range(1, steps.shape[0]):
        states[n, 0] = states[n - 1, 0] + states[n - 1, 1] + 0.5 * states[n - 1, 2] + steps[n, 0]
        states[n, 1] = states[n - 1, 1] + states[n - 1, 2] + steps[n, 1]
        states[n, 2] = states[n - 1, 2] + steps[n, 2]
    return states


def pieces(states: Array, step: float) -> Array:
    """Coefficients ``(N - 1, 6)`` by rising power over each interval, made one.

    Parameters
    ----------
    states : ndarray, shape (N, 3)
        Value, first and second derivative at the points.
    step : float
        Interval between them, s.
    """
    scaled = states * step ** np.arange(3)
    return _quintic(scaled[:-1], scaled[1:])


def evaluate_pieces(coefficients: Array, time: Array, step: float, derivative: int) -> Array:
    """Value or derivative at times in s since the first point, shape of `time`."""
    scaled = time / step
    index = np.clip(scaled.astype(np.int64), 0, len(coefficients) - 1)
    inside, found = scaled - index, coefficients[index]
    total = np.zeros(inside.shape)
    for power in range(5, derivative - 1, -1):
        total = total * inside + perm(power, derivative) * found[:, power]
    return np.asarray(total / step**derivative)


def _quintic(left: Array, right: Array) -> Array:
    """Coefficients ``(M, 6)`` by rising power on the unit interval, from states at its ends."""
    value, rate, bend = left.T
    jump = right[:, 0] - (value + rate + bend / 2)
    rise = right[:, 1] - (rate + bend)
    turn = right[:, 2] - bend
    return np.stack(
        [
            value,
            rate,
            bend / 2,
            10 * jump - 4 * rise + turn / 2,
            -15 * jump + 7 * rise - turn,
            6 * jump - 3 * rise + turn / 2,
        ],
        axis=1,
    )


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
    values: Array,
    step: float,
    band: Band,
    per_sample: int,
    exponent: float = 1.0,
    noise: float | None = None,
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
    noise : float, optional
        Standard deviation of a sample's noise where the curve is that of a signal, whose own
        spectrum then says how it goes on to its ends.

    Returns
    -------
    ndarray, shape ((N - 1) * per_sample + 1, 3)
    """
    if noise is None or not np.isfinite(band.cut):
        first, last = _end(values, step, band), _end(values[::-1], step, band)
    else:
        first, last = (_end_by_spectrum(x, step, band.cut, noise) for x in (values, values[::-1]))
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


def _end_by_spectrum(values: Array, step: float, cut: float, noise: float) -> Array:
    """States ``(n, 3)`` at the first samples: the mean of a stationary process with the spectrum of
    the whole record, given these samples (Wiener 1949).

    At an end a spline has neighbours on one side only, and its second derivative is off by a tenth
    of its size even without noise. The spectrum knows how such a signal goes on.
    """
    size = values.size
    count = min(max(int(_KNOWN / (cut * step)), _FEWEST), size, _MOST)
    centre, spread = float(np.mean(values[:count])), float(np.std(values)) or 1.0
    omega = 2.0 * np.pi * fft.rfftfreq(size, step)
    window = np.hanning(size)
    power = np.abs(fft.rfft(window * (values - values.mean()))) ** 2
    power *= 2.0 / (size * float(np.sum(window**2)))
    chosen = (omega > 0) & (omega <= 2.0 * np.pi * _PASSED * cut)
    beyond = power[omega > 2.0 * np.pi * _PASSED * cut]
    if beyond.size:  # what is cut off is noise here, also where nobody could tell it from signal
        noise = max(noise, float(np.sqrt(0.5 * size * beyond.mean())))
    # Less the noise's own share of each line; what is left is never quite nothing.
    power = np.maximum(power[chosen] - 2.0 * noise**2 / size, _LEAST * spread**2 / size)
    omega, power = _in_groups(omega[chosen], power, _LINES * count)
    amplitude = np.sqrt(power)
    time = step * np.arange(count)
    turn = np.multiply.outer(omega, time)
    cosine, sine = (amplitude[:, None] * part(turn) for part in (np.cos, np.sin))
    slope, flat, one = spread / (step * size), np.zeros((1, count)), np.ones((1, count))
    rows = np.concatenate([_FREE * spread * one, _FREE * slope * time[None], cosine, sine])
    rates = np.concatenate([flat, _FREE * slope * one, -omega[:, None] * sine])
    rates = np.concatenate([rates, omega[:, None] * cosine])
    bends = np.concatenate([flat, flat, -(omega[:, None] ** 2) * cosine])
    bends = np.concatenate([bends, -(omega[:, None] ** 2) * sine])
    left, sizes, right = np.linalg.svd(rows, full_matrices=False)
    shrunk = sizes / (sizes**2 + max(noise, _SMALLEST * spread) ** 2)
    weights = left @ (shrunk * (right @ (values[:count] - centre)))
    states = np.stack([weights @ part for part in (rows, rates, bends)], axis=1)
    states[:, 0] += centre
    return states


def _in_groups(omega: Array, power: Array, most: int) -> tuple[Array, Array]:
    """Lines of a spectrum, neighbours together where there are more than so many.

    The sum of their power, at its mean frequency: what is much shorter than the record cannot tell
    them from each other.
    """
    if omega.size <= most:
        return omega, power
    first = np.linspace(0, omega.size, most, endpoint=False).astype(int)
    together = np.add.reduceat(power, first)
    return np.add.reduceat(omega * power, first) / together, together


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
