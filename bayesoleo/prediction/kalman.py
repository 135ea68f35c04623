"""Kalman filter and smoother of a process whose third derivative is white noise.

Time is in sampling intervals and noise in standard deviations of a sample's, so that one number is
left: the roughness, variance of the process's noise in an interval. The smoothed mean is a quintic
smoothing spline (Wahba 1978) whose gain at the angular frequency w per sample is
``1 / (1 + w**6 / roughness)`` inside a long record.

References
----------
Wahba, G. (1978). Improper priors, spline smoothing and the problem of guarding against model errors
in regression. J. Royal Statistical Society B 40(3), 364-372.
"""

from __future__ import annotations

import numba
import numpy as np

from bayesoleo._types import Array
from bayesoleo.solvers.schemes.elimination import eliminate

#: Variance of the state before the first sample, over that of a sample's noise.
DIFFUSE = 1e9


def process_noise() -> Array:
    """Covariance that unit white noise in the third derivative adds to the state in a unit step."""
    return np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])


@numba.njit(nogil=True, cache=True)
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


@numba.njit(nogil=True, cache=True)
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


@numba.njit(nogil=True, cache=True)
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


@numba.njit(nogil=True, cache=True)
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


@numba.njit(nogil=True, cache=True)
def walk(steps: Array) -> Array:
    """States of the process from its increments ``(N, 3)``, from zero."""
    states = np.zeros_like(steps)
    for n in range(1, steps.shape[0]):
        states[n, 0] = states[n - 1, 0] + states[n - 1, 1] + 0.5 * states[n - 1, 2] + steps[n, 0]
        states[n, 1] = states[n - 1, 1] + states[n - 1, 2] + steps[n, 1]
        states[n, 2] = states[n - 1, 2] + steps[n, 2]
    return states
