"""How the period of a record is found, in numbers that a figure can show.

References
----------
Verbeek (1993), appendix B: eqs. B.1 and B.2, figures B.1 and B.2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.data.period import autocovariance, coarse_period, residual_time_shift

#: Part of a period to either side of it that the zoom shows, and shifts at most in a curve.
ZOOM, MOST_SHIFTS = 0.01, 4000
_FEWEST = 5


@dataclass(frozen=True)
class PeriodSearch:
    """Shift functions of a signal, and the parabola through the bottom of the first valley.

    Parameters
    ----------
    shifts : ndarray, shape (L,)
        Samples, up to a little more than two periods.
    residual : ndarray, shape (L,)
        Residual time shift function at them (eq. B.2), square of the signal's unit.
    covariance : ndarray, shape (L,)
        Autocovariance at them (eq. B.1).
    near : ndarray, shape (Z,)
        Shifts next to one period.
    near_residual : ndarray, shape (Z,)
    parabola : ndarray, shape (3,)
        Coefficients in ``near - period_in_samples``, the highest power first.
    period_in_samples : float
        Minimum of the parabola.
    time_step : float
        s.
    """

    shifts: NDArray[np.int64]
    residual: Array
    covariance: Array
    near: NDArray[np.int64]
    near_residual: Array
    parabola: Array
    period_in_samples: float
    time_step: float

    @property
    def frequency(self) -> float:
        """By the parabola alone, Hz."""
        return 1 / (self.period_in_samples * self.time_step)


def period_search(values: Array, time_step: float, nominal: float) -> PeriodSearch:
    """Shift functions of one signal near a nominal frequency.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times over two periods or more.
    time_step : float
        Sampling interval, s.
    nominal : float
        Declared frequency, Hz.

    Returns
    -------
    PeriodSearch

    Raises
    ------
    CampaignError
        If the signal does not repeat near that frequency.
    """
    signal = np.asarray(values, dtype=float)
    period = coarse_period(signal[None], 1 / (nominal * time_step), time_step)
    last = min(int(2.2 * period), signal.size - 2)
    shifts = np.unique(np.linspace(1, last, min(last, MOST_SHIFTS)).astype(np.int64))
    half = max(_FEWEST, round(ZOOM * period))
    centre = round(period)
    near = np.arange(centre - half, min(centre + half, signal.size - 2) + 1)
    valley = residual_time_shift(signal, near)
    curvature, slope, level = np.polyfit(near - period, valley, 2)
    bottom = -0.5 * slope / curvature if curvature > 0 else 0.0
    return PeriodSearch(
        shifts=shifts,
        residual=residual_time_shift(signal, shifts),
        covariance=autocovariance(signal, shifts),
        near=near,
        near_residual=valley,
        parabola=np.array([curvature, 0.0, level - curvature * bottom**2]),
        period_in_samples=period + bottom,
        time_step=time_step,
    )
