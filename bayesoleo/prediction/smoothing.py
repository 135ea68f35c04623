r"""Signals that do not repeat: a smooth curve through noisy samples, with its derivatives.

A signal is taken as a process whose third derivative is white noise, sampled with white noise. Its
smoothed mean is a quintic smoothing spline (Wahba 1978), found by a Kalman filter and a backward
pass in O(N); how smooth it is follows from the filter's innovations, by maximum likelihood. Value,
velocity and acceleration at the samples define the spline between them, and the same model gives
draws of what the smoothing leaves uncertain.

References
----------
Wahba, G. (1978). Improper priors, spline smoothing and the problem of guarding against model errors
in regression. J. Royal Statistical Society B 40(3), 364-372.

Durbin, J. and Koopman, S. J. (2002). A simple and efficient simulation smoother for state space
time series analysis. Biometrika 89(3), 603-616.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import perm

import numba
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.optimize import minimize_scalar

from bayesoleo.errors import InputError
from bayesoleo.solvers.schemes.elimination import eliminate

Array = NDArray[np.float64]

#: Process noise over measurement noise, per sample: logarithms to base ten that are tried.
ROUGHNESS = np.linspace(-16.0, 6.0, 23)
#: Variance of the state before the first sample, over that of a sample's noise.
DIFFUSE = 1e9


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A curve through equidistant samples, quintic between them.

    Parameters
    ----------
    step : float
        Sampling interval, s.
    states : ndarray, shape (N, 3)
        Value, first and second derivative at the samples; SI.
    noise : float
        Standard deviation of a sample's white noise, SI; zero for a curve that is known.
    roughness : float
        Process noise over measurement noise, per sample.
    """

    step: float
    states: Array
    noise: float = 0.0
    roughness: float = 0.0

    def evaluate(self, phase: Array, frequency: float, derivative: int = 0) -> Array:
        """Value or time derivative.

        Parameters
        ----------
        phase : ndarray, shape (M,)
            Parts of the record's length since the first sample.
        frequency : float
            Reciprocal of that length, Hz.
        derivative : int
            Order of the time derivative; beyond the fifth all are zero.

        Returns
        -------
        ndarray, shape (M,)
            In the channel's SI unit per second to the power ``derivative``.
        """
        return self.at(phase / frequency, derivative)

    def at(self, time: Array, derivative: int = 0) -> Array:
        """The same at times in s since the first sample, shape (M,)."""
        scaled = np.asarray(time, dtype=float) / self.step
        index = np.clip(scaled.astype(np.int64), 0, len(self.states) - 2)
        inside, coefficients = scaled - index, self.pieces[index]
        total = np.zeros(inside.shape)
        for power in range(5, derivative - 1, -1):
            total = total * inside + perm(power, derivative) * coefficients[:, power]
        return total / self.step**derivative

    @cached_property
    def pieces(self) -> Array:
        """Coefficients ``(N - 1, 6)`` by rising power over each sampling interval, made one."""
        scaled = self.states * self.step ** np.arange(3)
        return _quintic(scaled[:-1], scaled[1:])

    def at_once(self, time: float, derivative: int = 0) -> float:
        """One value, as :meth:`at`, without the cost of arrays: integrators ask for many."""
        scaled = time / self.step
        index = min(max(int(scaled), 0), len(self.states) - 2)
        inside, total = scaled - index, 0.0
        piece = self.pieces[index]
        for power in range(5, derivative - 1, -1):
            total = total * inside + perm(power, derivative) * float(piece[power])
        return total / self.step**derivative

    def part(self, samples: slice) -> Smoothed:
        """The same curve over some of the samples, counted from the first of them."""
        return replace(self, states=self.states[samples])

    def errors(self, count: int, seed: int = 0) -> list[Smoothed]:
        """Draws of what may lie between this curve and the true one.

        Parameters
        ----------
        count : int
            How many.
        seed : int
            Seeds them.
        """
        if self.noise == 0.0:
            return []
        rng, size = np.random.default_rng(seed), len(self.states)
        root = np.linalg.cholesky(_process_noise() * self.roughness)
        unit = self.noise / self.step ** np.arange(3)
        found = []
        for _ in range(count):
            true = _walk(rng.standard_normal((size, 3)) @ root.T)
            seen = _smooth(true[:, 0] + rng.standard_normal(size), self.roughness)
            found.append(Smoothed(self.step, (true - seen) * unit))
        return found


def smooth_signal(values: Array, step: float) -> Smoothed:
    """Find the smooth curve behind noisy samples.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times; at least eight samples.
    step : float
        Sampling interval, s.

    Returns
    -------
    Smoothed
        With the noise and the roughness that make the innovations most likely.

    Raises
    ------
    InputError
        If there are too few samples.
    """
    if values.size < 8:
        raise InputError(
            "too few samples to smooth", value=values.size, hint="record eight or more"
        )
    size = float(np.std(values)) or 1.0
    scaled = np.ascontiguousarray((values - values[0]) / size)

    def cost(logarithm: float) -> float:
        return float(_innovations(scaled, 10.0**logarithm)[0])

    costs = [cost(value) for value in ROUGHNESS]
    best = int(np.argmin(costs))
    low, high = ROUGHNESS[max(best - 1, 0)], ROUGHNESS[min(best + 1, ROUGHNESS.size - 1)]
    found = minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 1e-2})
    logarithm = float(found.x) if found.fun < costs[best] else float(ROUGHNESS[best])
    states = _smooth(scaled, 10.0**logarithm) * size / step ** np.arange(3)
    states[:, 0] += values[0]
    noise = size * float(np.sqrt(_innovations(scaled, 10.0**logarithm)[1]))
    return Smoothed(step, states, noise, 10.0**logarithm)


def exact_signal(values: Array, step: float) -> Smoothed:
    """The curve through samples that have no noise: the quintic interpolating spline.

    Parameters
    ----------
    values : ndarray, shape (N,)
        At equidistant times from zero; at least six.
    step : float
        Their interval, s.
    """
    if values.size < 6:
        raise InputError("too few samples", value=values.size, hint="give six or more")
    time = step * np.arange(values.size)
    spline = make_interp_spline(time, values, k=5)
    return Smoothed(step, np.stack([spline(time, nu=k) for k in range(3)], axis=1))


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


def _process_noise() -> Array:
    """Covariance that unit white noise in the third derivative adds to the state in a unit step."""
    return np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])


@numba.njit(nogil=True, cache=True)
def _advance(x, p, roughness, noise, ahead):
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


@numba.njit(nogil=True, cache=True)
def _update(x, p, innovation, gain):
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
    return variance


@numba.njit(nogil=True, cache=True)
def _filter(values, roughness, noise, kept, covariances, store):
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


def _innovations(values: Array, roughness: float) -> tuple[float, float]:
    """Twice the negative log-likelihood but for constants, and the variance of a sample's noise."""
    empty = np.empty((0, 3)), np.empty((0, 3, 3))
    squares, logs = _filter(values, roughness, _process_noise(), *empty, False)
    free = values.size - 3
    variance = max(squares / free, 1e-300)
    return free * float(np.log(variance)) + logs, variance


def _smooth(values: Array, roughness: float) -> Array:
    """Smoothed states ``(N, 3)`` in units of the step, by the Rauch-Tung-Striebel recursion."""
    size = values.size
    kept, covariances = np.empty((size, 3)), np.empty((size, 3, 3))
    _filter(values, roughness, _process_noise(), kept, covariances, True)
    _backward(kept, covariances, roughness, _process_noise())
    return kept


@numba.njit(nogil=True, cache=True)
def _backward(kept, covariances, roughness, noise):
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


@numba.njit(nogil=True, cache=True)
def _walk(steps):
    """States of the process from its increments ``(N, 3)``, from zero."""
    states = np.zeros_like(steps)
    for n in range(1, steps.shape[0]):
        states[n, 0] = states[n - 1, 0] + states[n - 1, 1] + 0.5 * states[n - 1, 2] + steps[n, 0]
        states[n, 1] = states[n - 1, 1] + states[n - 1, 2] + steps[n, 1]
        states[n, 2] = states[n - 1, 2] + steps[n, 2]
    return states
