"""The least-squares step that stays inside the priors' support."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.error_models.linearise import least_squares

# A step goes at most this part of the way to a limit, so that a limit is approached, not hit.
_PART = 0.9
# Nearer than this, in prior standard deviations, an unknown counts as lying on the limit.
_ON_LIMIT = 1e-8


def bounded_step(
    rows: Array, target: Array, room: tuple[Array, Array], rank: float | None = None
) -> Array:
    """Solve ``rows @ d = target`` by least squares with ``d`` inside the room that is left.

    Unknowns whose step would leave are taken part of the way to their limit and the others are
    solved again given that, so that the step still points downhill.

    Parameters
    ----------
    rows : ndarray, shape (k, l)
    target : ndarray, shape (k,)
    room : tuple of ndarray, each shape (l,)
        Distances down and up to the limits, infinite where there is none.
    rank : float, optional
        See :func:`~bayesoleo.error_models.linearise.least_squares`.

    Returns
    -------
    ndarray, shape (l,)
    """
    lowest, highest = (-_reach(room[0]), _reach(room[1]))
    step = least_squares(rows, target, rank)
    stopped = np.zeros(step.size, dtype=bool)
    while True:
        beyond = ~stopped & ((step < lowest) | (step > highest))
        if not beyond.any():
            return step
        stopped |= beyond
        step[beyond] = np.clip(step[beyond], lowest[beyond], highest[beyond])
        free = ~stopped
        if free.any():
            left = target - rows[:, stopped] @ step[stopped]
            step[free] = least_squares(rows[:, free], left, rank)


def _reach(distance: Array) -> Array:
    return np.where(distance <= _ON_LIMIT, 0.0, _PART * distance)


def is_cut(step: Array, room: tuple[Array, Array]) -> bool:
    """Whether an unknown was stopped on its way to a limit that it does not lie on yet."""
    reach = _reach(np.where(step < 0, *room))
    return bool(np.any((reach > 0) & np.isfinite(reach) & (np.abs(step) >= reach)))


def on_limit(room: tuple[Array, Array]) -> NDArray[np.bool_]:
    """Which unknowns, shape (l,), lie on a limit of their support."""
    return np.minimum(*room) <= _ON_LIMIT
