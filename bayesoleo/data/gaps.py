"""Stretches of a record that are not to count: a sensor that dropped out, a rig that was touched.

Their samples take no part in estimates. Where a periodic channel drives a model, or is looked at
for its noise, they are bridged by what the other periods show.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.data.transforms import HarmonicBasis
from bayesoleo.errors import CampaignError

Stretches = tuple[tuple[float, float], ...]

#: Part of a record that has to be left.
LEAST_PART = 0.5
# Each iteration brings what is bridged nearer by the number of periods, two at least.
_ITERATIONS = 40


def read_stretches(value: Any, run: str, file: str) -> Stretches:
    """The key ``mask`` of a run: pairs of seconds on the file's own clock.

    Raises
    ------
    CampaignError
        If it is anything else.
    """

    def good(pair: Any) -> bool:
        return (
            isinstance(pair, list)
            and len(pair) == 2
            and all(isinstance(end, int | float) and not isinstance(end, bool) for end in pair)
            and pair[0] < pair[1]
        )

    if not isinstance(value, list) or not all(good(pair) for pair in value):
        raise CampaignError(
            "must be pairs of seconds, from and to",
            file=file,
            run=run,
            key="mask",
            value=value,
            hint="write mask = [[1.0, 1.5], [7.2, 7.3]]",
        )
    return tuple((float(first), float(last)) for first, last in value)


def masked(time: Array, stretches: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Samples within the stretches, both ends included, shape (N,).

    Parameters
    ----------
    time : ndarray, shape (N,)
        Equidistant times, s.
    stretches : sequence of (float, float)
        From and to, s, on the same clock.

    Raises
    ------
    CampaignError
        If a stretch holds no sample, or too few samples are left.
    """
    inside, slack = np.zeros(time.size, dtype=bool), 1e-3 * (time[1] - time[0])
    for first, last in stretches:
        here = (time >= first - slack) & (time <= last + slack)
        if not here.any():
            raise CampaignError(
                "no sample lies in this stretch",
                key="mask",
                value=[first, last],
                hint=f"the run is from {time[0]:.6g} to {time[-1]:.6g} s",
            )
        inside |= here
    if np.mean(inside) > 1 - LEAST_PART:
        raise CampaignError(
            f"{100 * np.mean(inside):.3g} % of the run is masked",
            key="mask",
            hint="mask less than half of it, or cut the run with start and stop",
        )
    return inside


def bridged(values: Array, inside: NDArray[np.bool_], step: float | None = None) -> Array:
    """Channels with other values where they are masked.

    Parameters
    ----------
    values : ndarray, shape (c, N)
    inside : ndarray of bool, shape (N,)
        Which samples are masked.
    step : float, optional
        Cycles per sample: the values are then those of least squares on all harmonics of the other
        samples, as far as another period shows them. Without, a straight line.

    Returns
    -------
    ndarray, shape (c, N)
    """
    filled, place = np.array(values, dtype=float), np.arange(inside.size)
    for channel in filled:
        channel[inside] = np.interp(place[inside], place[~inside], channel[~inside])
    if step is None:
        return filled
    basis = HarmonicBasis(inside.size, step)
    for _ in range(_ITERATIONS):
        filled[:, inside] = basis.fit(filled)[:, inside]
    return filled
