"""Sample times: equidistant or refused, with the rounding of written time stamps forgiven."""

from __future__ import annotations

import numpy as np

from bayesoleo._types import Array
from bayesoleo.errors import CampaignError


def uniform_time(time: Array, column: str, before: int = 0) -> Array:
    """Replace written time stamps by the equidistant times they were rounded from.

    Parameters
    ----------
    time : ndarray, shape (N,)
        As written, s.
    column : str
        Name of the column, for messages.
    before : int, optional
        Rows of the file that were cut off before the first, for messages.

    Returns
    -------
    ndarray, shape (N,)
        Least-squares equidistant times, s.

    Raises
    ------
    CampaignError
        If times are missing, do not increase, leave a gap, or are too coarse to tell their spacing.
    """
    if time.size < 3:
        raise CampaignError("fewer than three samples", column=column, value=time.size)
    missing = np.flatnonzero(~np.isfinite(time))
    if missing.size:
        raise CampaignError(f"no time in row {before + missing[0] + 1}", column=column)
    spacing = np.diff(time)
    back = np.flatnonzero(spacing <= 0)
    # Stamps rounded more coarsely than the spacing repeat; say so rather than that time stands
    # still.
    resolution = _written_resolution(time)
    if back.size and np.mean(spacing == 0) > 0.05:
        raise CampaignError(
            "time stamps are rounded more coarsely than the samples are spaced",
            column=column,
            value=float(time[back[0]]),
            hint="give sample_rate instead of a time column",
        )
    if back.size:
        row = int(back[0])
        raise CampaignError(
            f"time does not increase in row {before + row + 2}",
            column=column,
            value=float(time[row + 1]),
            hint="sort the rows by time, or keep one part with start and stop",
        )
    _check_gaps(time, spacing, resolution, column)
    index = np.arange(time.size) - 0.5 * (time.size - 1)
    step = float(np.dot(index, time) / np.dot(index, index))
    # A step that the stamps cannot tell from a rounder one is that one: 0.025, not 0.0250000003.
    step = _roundest(step, 0.5 * resolution / time.size)
    first = _roundest(float(np.mean(time)) + step * float(index[0]), 0.5 * resolution)
    return first + step * np.arange(time.size, dtype=float)


def _check_gaps(time: Array, spacing: Array, resolution: float, column: str) -> None:
    usual = float(np.median(spacing))
    allowed = max(0.02 * usual, min(1.05 * resolution, 0.49 * usual))
    deviation = np.abs(spacing - usual)
    row = int(np.argmax(deviation))
    if deviation[row] <= allowed:
        return
    if spacing[row] > 1.49 * usual:
        raise CampaignError(
            f"gap of {spacing[row] / usual:.3g} samples at {time[row]:.6g} s",
            column=column,
            hint="cut the run there with start or stop",
        )
    raise CampaignError(
        f"spacing at {time[row]:.6g} s is {spacing[row]:.6g} s instead of {usual:.6g} s",
        column=column,
        hint="resample the run to a fixed rate",
    )


def _written_resolution(time: Array) -> float:
    """Power of ten that all stamps are multiples of; zero if they are written in full."""
    probe = time[:: max(1, time.size // 500)]
    for decimals in range(12):
        scale = max(float(np.max(np.abs(probe))), 1e-300)
        if np.all(np.abs(np.round(probe, decimals) - probe) <= 4e-16 * scale):
            return 10.0**-decimals
    return 0.0


def _roundest(value: float, tolerance: float) -> float:
    """The number with fewest digits within the tolerance."""
    if abs(value) <= max(tolerance, 1e-14):
        return 0.0
    for digits in range(1, 16):
        rounded = float(f"{value:.{digits}g}")
        if abs(rounded - value) <= max(tolerance, 4e-16 * abs(value)):
            return rounded
    return value


def window(time: Array, start: float | None, stop: float | None) -> slice:
    """Samples from ``start`` to ``stop``, both included, s.

    Parameters
    ----------
    time : ndarray, shape (N,)
        As written, s.
    start, stop : float, optional
        Ends of the part to keep, s, on the file's own time.

    Raises
    ------
    CampaignError
        If nothing is left, or there was nothing.
    """
    if time.size < 3:
        raise CampaignError("fewer than three samples", value=time.size)
    # A thousandth of a sample keeps an end that was meant to be on a sample on it.
    slack = 1e-3 * abs(float(np.nanmedian(np.diff(time))))
    low = -np.inf if start is None else start - slack
    high = np.inf if stop is None else stop + slack
    inside = np.flatnonzero((time >= low) & (time <= high))
    if inside.size < 3:
        raise CampaignError(
            "nothing is left between start and stop",
            key="start" if start is not None else "stop",
            value=(start, stop),
            hint=f"the file runs from {np.nanmin(time):.6g} to {np.nanmax(time):.6g} s",
        )
    return slice(int(inside[0]), int(inside[-1]) + 1)
