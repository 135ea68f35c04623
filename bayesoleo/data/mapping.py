"""Records on a regular grid of one period, as a solver or a reader of a figure wants them.

The thesis maps one period by linear interpolation (Verbeek 1993, appendix B). A band-limited map
uses all periods at once: least squares on the harmonics that the samples determine, evaluated on
the grid, so that it adds no error of its own to a signal without higher ones.
"""

from __future__ import annotations

from typing import Literal, cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.data.averaging import periodic_average
from bayesoleo.errors import InputError

Method = Literal["band-limited", "linear"]


def on_grid(
    values: Array,
    time_step: float,
    frequency: float,
    points: int,
    *,
    method: Method = "band-limited",
    period: int = 0,
) -> Array:
    """One period of a signal at the phases ``0, 1/points, 2/points, ...`` of its first sample.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times over whole periods.
    time_step : float
        Sampling interval, s.
    frequency : float
        Fundamental frequency, Hz.
    points : int
        Of the grid.
    method : {"band-limited", "linear"}, optional
        By all harmonics, from all periods; or between the neighbouring samples of one period, whose
        error falls with the square of the sampling interval.
    period : int, optional
        Which period is interpolated linearly, from zero.

    Returns
    -------
    ndarray, shape (points,)
        In the signal's unit.

    Raises
    ------
    InputError
        If the method is unknown or the period is not in the record.
    """
    if method == "band-limited":
        return periodic_average(values, time_step, frequency).on_phase(points)
    if method != "linear":
        raise InputError(
            "unknown method", key="method", value=method, hint="use 'band-limited' or 'linear'"
        )
    signal = np.asarray(values, dtype=float)
    place = (period + np.arange(points) / points) / (frequency * time_step)
    last = signal.size - 1
    # The last interval of the last period ends with the first sample of a period, one period back.
    length = 1 / (frequency * time_step)
    if period < 0 or place[-1] > last + 1:
        raise InputError(
            "record does not hold this period",
            key="period",
            value=period,
            hint=f"it holds {int((last + 1) / length)}",
        )
    index = np.arange(signal.size + 1, dtype=float)
    closed = np.append(signal, np.interp(signal.size - length, index[:-1], signal))
    return cast(Array, np.interp(place, index, closed))
