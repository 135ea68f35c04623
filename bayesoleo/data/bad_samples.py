"""Samples that no sensor measured: a number alone far beyond all others."""

from __future__ import annotations

import numpy as np

from bayesoleo._types import Array

#: Beyond the next sample by this factor a few samples are taken for mistakes: it is the resolution
#: of a converter of twenty bits, and between the samples of a pulse there is no such step.
BEYOND = 1e6
#: Beyond this, in any unit, squares overflow before they are summed.
LARGEST = 1e100
#: Part of the samples that may stand alone.
FEW = 0.005


def impossible_sample(values: Array) -> tuple[int | None, str]:
    """The first sample that stands far beyond all but a few.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Finite.

    Returns
    -------
    row : int or None
        Where it stands; None where there is none.
    beyond : str
        How far beyond the others, in words.
    """
    if float(np.abs(values).max()) > LARGEST:
        return int(np.argmax(np.abs(values))), "more than 1e100 times"
    away = np.abs(values - np.median(values))
    most = min(max(1, int(FEW * values.size)), values.size - 1)
    largest = np.sort(np.partition(away, values.size - most - 1)[values.size - most - 1 :])[::-1]
    # Where all others are alike a pulse may be one.
    steps = largest[:-1] / np.where(largest[1:] > 0, largest[1:], np.inf)
    alone = np.flatnonzero(steps > BEYOND)
    if not alone.size:
        return None, ""
    last = alone[-1]
    return int(np.flatnonzero(away >= largest[last])[0]), f"{steps[last]:.2g} times"
