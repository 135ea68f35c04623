"""Quintic pieces between equidistant points with value, first and second derivative."""

from __future__ import annotations

from math import perm

import numpy as np

from bayesoleo._types import Array


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
