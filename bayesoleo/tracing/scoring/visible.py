"""Which sensitivities are real, and which only the round-off of a solution.

A constant force on a coordinate that no output contains moves the model and shows nowhere. Its
computed sensitivity is not zero but some last digits, and a score divides by it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.prediction.run import RunPredictor, Samples
from bayesoleo.solvers.status import Status

#: A sensitivity is looked at again if a parameter that moves a state by all of its size moves an
#: output by less of its own: solutions are good to some 1e-13 of their size, and what is real is
#: found real by the second look.
SUSPECT = 1e-9
#: Relative change of the constants for the second look: far above round-off, and far too small for
#: a real sensitivity to follow by more than ``REPEATS`` of its size.
CHANGE, REPEATS = 1e-9, 1e-3


def resolved_sensitivities(
    run: RunPredictor, p: Array, samples: Samples, changed: Sequence[int]
) -> Array:
    """Derivatives of the outputs, zero where they are round-off.

    What is suspiciously small is computed once more with constants that differ in the tenth digit:
    a derivative repeats, round-off does not.

    Parameters
    ----------
    run : RunPredictor
        At its anchor.
    p : ndarray, shape (L, np)
        Constants of the samples.
    samples : Samples
        With derivatives ``(L, ny, na, N)``.
    changed : sequence of int
        Which of the constants may be changed for the second look.

    Returns
    -------
    ndarray, shape (L, ny, na, N)
    """
    y_p = samples.y_p
    assert y_p is not None
    if run.anchor is None:
        return y_p  # a force law is evaluated, not solved
    suspect = _suspects(run, y_p)
    if not suspect.any():
        return y_p
    nearby = p.copy()
    # Each by a factor of its own, lest a common one scale all equations and change no digit.
    nearby[:, changed] *= 1 + CHANGE * np.linspace(1.0, 2.0, len(changed))
    again = run.predict(nearby, derivatives=True)
    if again.y_p is None or (again.status != Status.CONVERGED.value).any():
        return y_p
    moved = np.linalg.norm(again.y_p - y_p, axis=-1)
    noisy = suspect & (moved > REPEATS * np.linalg.norm(y_p, axis=-1))
    return np.where(noisy[..., None], 0.0, y_p)


def _suspects(run: RunPredictor, y_p: Array) -> NDArray[np.bool_]:
    """Where outputs hardly move with a parameter though states do, shape (L, ny, na)."""
    assert run.anchor is not None
    size = np.abs(run.anchor.x).max(axis=0)
    moved = np.abs(run.anchor.x_p).max(axis=1)
    # A state at rest counts as moved without limit; whether that is real shows in the second look.
    relative = np.where(moved > 0, 1e200, 0.0)
    np.divide(moved, size, out=relative, where=size > 1e-150)
    reach = relative.max(axis=1)
    output = np.abs(run.measured).max(axis=1)
    found = np.abs(y_p).max(axis=-1)
    return cast(NDArray[np.bool_], (found > 0) & (found <= SUSPECT * output[:, None] * reach))
