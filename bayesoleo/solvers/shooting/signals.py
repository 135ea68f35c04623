"""Inputs as compiled code takes them: a Fourier series, a piecewise cubic in time, or their sum."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from bayesoleo._types import Array
from bayesoleo.solvers.schemes.elimination import jit


class InputSignal(NamedTuple):
    """Rows of inputs, each with its derivatives as rows of their own.

    ``u(t) = sum_k cosine[:, k] cos(k w t) + sine[:, k] sin(k w t)`` plus, between ``knots[m]`` and
    ``knots[m + 1]``, the cubic ``sum_j pieces[m, :, j] (t - knots[m])**j``; beyond the knots the
    nearest cubic goes on.

    Parameters
    ----------
    rate : float
        Fundamental angular frequency ``w``, rad/s.
    cosine, sine : ndarray, shape (nu, K)
        Coefficients of the harmonics 0, 1, ..., K - 1.
    knots : ndarray, shape (M + 1,) or (0,)
        Seconds, rising.
    pieces : ndarray, shape (M, nu, 4)
        Coefficients of the cubics.
    """

    rate: float
    cosine: Array
    sine: Array
    knots: Array
    pieces: Array


def periodic_signal(frequency: float, cosine: Array, sine: Array) -> InputSignal:
    """A signal of harmonics only; ``cosine`` and ``sine`` are ``(nu, K)``."""
    count = cosine.shape[0]
    return InputSignal(
        2 * np.pi * frequency,
        np.array(cosine, dtype=float, order="C"),
        np.array(sine, dtype=float, order="C"),
        np.zeros(0),
        np.zeros((0, count, 4)),
    )


def piecewise_signal(knots: Array, pieces: Array) -> InputSignal:
    """A signal of cubics between knots only; ``pieces`` is ``(M, nu, 4)``."""
    none = np.zeros((pieces.shape[1], 0))
    return InputSignal(
        0.0,
        none,
        none.copy(),
        np.array(knots, dtype=float),
        np.array(pieces, dtype=float, order="C"),
    )


def evaluate(signal: InputSignal, times: Array) -> Array:
    """Rows at times ``(N,)`` in s, shape (nu, N)."""
    u = np.empty((signal.cosine.shape[0], times.size))
    rows_at(signal, 0.0, 1.0, np.ascontiguousarray(times, dtype=float), u)
    return u


@jit
def rows_at(signal: InputSignal, start: float, step: float, positions: Array, u: Array) -> None:
    """Fill ``u (nu, N)`` with the rows at ``start + step * positions``."""
    for i in range(positions.size):
        t = start + step * positions[i]
        u[:, i] = 0.0
        _add_harmonics(signal, t, u, i)
        if signal.knots.size > 0:
            _add_piece(signal, t, u, i)


@jit
def _add_harmonics(signal: InputSignal, t: float, u: Array, i: int) -> None:
    """Cosines and sines of all harmonics by rotation: round-off grows with the order only."""
    count, harmonics = signal.cosine.shape
    if harmonics == 0:
        return
    turn, lift = np.cos(signal.rate * t), np.sin(signal.rate * t)
    c, s = 1.0, 0.0
    for k in range(harmonics):
        for row in range(count):
            u[row, i] += signal.cosine[row, k] * c + signal.sine[row, k] * s
        c, s = c * turn - s * lift, c * lift + s * turn


@jit
def _add_piece(signal: InputSignal, t: float, u: Array, i: int) -> None:
    pieces = signal.pieces.shape[0]
    m = int(np.searchsorted(signal.knots, t, side="right")) - 1
    m = min(max(m, 0), pieces - 1)
    x = t - signal.knots[m]
    for row in range(u.shape[0]):
        b = signal.pieces[m, row]
        u[row, i] += b[0] + x * (b[1] + x * (b[2] + x * b[3]))
