"""Where a function that rises from zero first reaches a level, along rays from one point."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array

# In units of the radius that the second-order expansion foresees.
_FARTHEST = 30.0
_GROW = 1.6
_ITERATIONS = 40
# Relative to the level; contours are looked at, or compared with intervals of two digits.
_TOLERANCE = 1e-3


def first_crossing(
    function: Callable[[Array, NDArray[np.int64]], Array], rays: int, level: float
) -> Array:
    """Radius on each ray, in units of the expected one; infinite where the level is not reached.

    Parameters
    ----------
    function : callable
        ``function(radius, index)`` for radii ``(m,)`` on the rays ``index (m,)``: shape (m,), zero
        at radius zero, near ``level * radius**2`` where the expansion holds; may be infinite.
    rays : int
    level : float

    Returns
    -------
    ndarray, shape (rays,)
    """
    low, high = np.zeros(rays), np.full(rays, np.inf)
    root_low = np.zeros(rays)
    radius, done = np.ones(rays), np.zeros(rays, dtype=bool)
    for _ in range(_ITERATIONS):
        work = np.flatnonzero(~done)
        if work.size == 0:
            break
        value = np.maximum(function(radius[work], work), 0.0)
        root = np.sqrt(value / level)  # nearly proportional to the radius
        close = np.abs(root - 1) <= 0.5 * _TOLERANCE
        done[work[close]] = True
        below = root < 1
        for k, r, under in zip(work, root, below, strict=True):
            if done[k]:
                continue
            if under:
                low[k], root_low[k] = radius[k], r
            else:
                high[k] = radius[k]
            radius[k] = _next(low[k], high[k], radius[k], r, root_low[k])
            # Between a finite value and a failure the edge is found to a thousandth.
            if high[k] - low[k] <= _TOLERANCE * max(low[k], 1e-6) or low[k] >= _FARTHEST:
                done[k] = True
                radius[k] = low[k] if low[k] < _FARTHEST else np.inf
    return radius


def _next(low: float, high: float, radius: float, root: float, root_low: float) -> float:
    if not np.isfinite(high):
        aim = radius / root if root > 0 else np.inf
        return float(min(max(aim, 1.05 * radius), _GROW * radius))
    if not np.isfinite(root) or root == 0:
        return 0.5 * (low + high)
    # Beyond the level, between the lower end and here; below it, as a proportion.
    between = low + (radius - low) * (1 - root_low) / (root - root_low) if root >= 1 else 0.0
    aim = between if root >= 1 else radius / root
    margin = 0.02 * (high - low)
    inside = low + margin < aim < high - margin
    return float(aim if inside else 0.5 * (low + high))
