"""Where the quantities of an error model are most likely, with the residuals held."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from bayesoleo._types import Array
from bayesoleo.error_models.differences import derivatives

# Differences are taken over so much, in coordinates of about unit spread.
_SCALE = 0.2
# A walker need not start at the top: the sampler goes on from here.
_GAIN, _ITERATIONS = 1e-3, 40
# Longest step, and furthest from the first guess: beyond it a share is zero or one for any purpose.
_RADIUS, _REACH = 3.0, 12.0
# Least curvature a step is taken by.
_FLAT = 1e-2


def climb(height: Callable[[Array], Array], guesses: Sequence[Array]) -> Array:
    """The best of the maxima that are reached from some guesses.

    Newton's method, all rows of an iteration in one call: for three coordinates a library's
    minimiser, which asks for one row at a time, spends its time on itself.

    Parameters
    ----------
    height : callable
        Of coordinates (W, m), shape (W,); what is not finite is taken for very low.
    guesses : sequence of ndarray, shape (m,)

    Returns
    -------
    ndarray, shape (m,)
    """

    def finite(rows: Array) -> Array:
        return np.nan_to_num(height(rows), nan=-1e12, neginf=-1e12)

    return max((_top(finite, guess) for guess in guesses), key=lambda found: found[0])[1]


def _top(height: Callable[[Array], Array], guess: Array) -> tuple[float, Array]:
    """Height and place of the maximum next to a guess."""
    eta, lengths = np.array(guess, dtype=float), 0.5 ** np.arange(10)
    scale = _SCALE * np.eye(eta.size)
    before = float(height(eta[None])[0])
    for _ in range(_ITERATIONS):
        _, gradient, hessian = derivatives(height, eta, scale)
        step = _SCALE * _uphill(gradient, hessian, _FLAT * _SCALE**2)
        step *= min(1.0, _RADIUS / max(float(np.linalg.norm(step)), 1e-300))
        trials = np.clip(eta + lengths[:, None] * step, guess - _REACH, guess + _REACH)
        values = height(trials)
        best = int(np.argmax(values))
        if not values[best] > before:
            break
        gain, before, eta = values[best] - before, float(values[best]), trials[best]
        if gain < _GAIN:
            break
    return before, eta


def _uphill(gradient: Array, hessian: Array, flat: float) -> Array:
    """Newton's step with all curvatures turned downwards: it leads away from saddles."""
    curvature, axes = np.linalg.eigh(hessian)
    return axes @ ((axes.T @ gradient) / np.maximum(np.abs(curvature), flat))
