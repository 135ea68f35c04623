"""Samples of a run: the rows and columns of its file, its times, and its channels in SI.

Sample times must be equidistant. The rounding of written time stamps is tolerated; unevenly spaced
samples are interpolated, with a note.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array, Float
from bayesoleo._units import SECOND_MEANINGS, parse_unit
from bayesoleo.data._campaign_toml import FILE, Channel, RunDeclaration
from bayesoleo.data._sample_quality import Stretches, bridged, impossible_sample, masked
from bayesoleo.data._text_layout import TIME_UNITS, FileColumns, is_time, time_unit, unit_in_name
from bayesoleo.errors import CampaignError, DataWarning, choose, number_of

#: Part of the spacings that must deviate, and the largest spacing over the median, for a record to
#: be resampled. Larger gaps hold no information, and a spline would invent it.
_UNEVEN, _LARGEST_SPACING = 0.05, 3.0
#: Rows at the end of a file that are looked at first for the last value.
_TAIL = 1000


@dataclass(frozen=True)
class Run:
    """One run as loaded, in SI.

    Parameters
    ----------
    label, file, group, role, kind : str
        As declared; ``role`` is ``fit`` or ``hold-out``, ``kind`` is ``periodic`` or ``transient``.
    frequency : float or None
        Declared approximate frequency, Hz; None for a transient.
    time : ndarray, shape (N,)
        Equidistant sample times on the file's own clock, s.
    samples : mapping of str to ndarray, shape (N,)
        Each channel, SI.
    conditions, condition_sd : mapping of str to float
        Known constants and, where declared, their standard deviations, SI.
    condition_units : mapping of str to str
        SI unit of each condition.
    mask : tuple of (float, float)
        Masked stretches, from and to, s on the file's own clock.
    bandwidths : mapping of str to float
        Frequencies up to which channels count as inputs, Hz, where declared.
    held : frozenset of str
        Channels whose value is held from one sample to the next.
    """

    label: str
    file: str
    group: str
    role: str
    kind: str
    frequency: float | None
    time: Float[Array, " samples"]
    samples: Mapping[str, Float[Array, " samples"]]
    conditions: Mapping[str, float] = field(default_factory=dict)
    condition_units: Mapping[str, str] = field(default_factory=dict)
    condition_sd: Mapping[str, float] = field(default_factory=dict)
    mask: Stretches = ()
    bandwidths: Mapping[str, float] = field(default_factory=dict)
    held: frozenset[str] = frozenset()

    @property
    def time_step(self) -> float:
        """Sampling interval, s."""
        return float((self.time[-1] - self.time[0]) / (self.time.size - 1))


@dataclass(frozen=True)
class LoadedRun:
    """A run, the columns that it is of, and its rows of the file."""

    run: Run
    columns: tuple[str, ...]
    first: int
    last: int


def columns_of(run: RunDeclaration, channels: Mapping[str, Channel]) -> dict[str, str]:
    """Column of each channel in a run."""
    return {name: run.columns.get(name, channel.column) for name, channel in channels.items()}


def load_run(
    declared: RunDeclaration,
    channels: Mapping[str, Channel],
    read: Callable[[RunDeclaration], FileColumns],
) -> LoadedRun:
    """Load one run; errors name the run and its file.

    Parameters
    ----------
    declared : RunDeclaration
    channels : mapping of str to Channel
    read : callable
        Gives the columns of a run's file.
    """
    try:
        table = read(declared)
        names = columns_of(declared, channels)
        whole, column = _time(declared, table, names)
        rows, size = _rows_of(declared, table, names, whole), whole.size
        # Without a time column the clock of a part starts with it.
        whole = whole[: rows.stop - rows.start] if column is None else whole[rows]
        # The cut comes first, because samples outside may have gaps.
        part = window(whole, declared.start, declared.stop)
        written, before = whole[part], rows.start + part.start
        time = _even_time(declared, written, column, before)
        away = masked(time, declared.mask)
        part = slice(before, before + time.size)
        samples = {
            name: _samples(channel, names[name], table, part, (written, time, size), away)
            for name, channel in channels.items()
        }
        _check_periods(declared, time)
    except CampaignError as error:
        raise CampaignError(
            error.problem,
            file=error.file or declared.file,
            run=declared.label,
            column=error.column,
            key=error.key,
            value=error.value,
            hint=error.hint,
        ) from error
    _compare_units(declared, table, names, channels)
    run = _made(declared, channels, time, samples)
    return LoadedRun(run, tuple(names.values()), part.start, part.stop)


def _even_time(declared: RunDeclaration, written: Array, column: str | None, before: int) -> Array:
    """Equidistant times of a run; a note where the samples were not."""
    if column is None:
        return _frozen(written)
    if not is_uneven(written):
        return _frozen(uniform_time(written, column, before))
    step = (written[-1] - written[0]) / (written.size - 1)
    spacing = np.diff(written)
    warnings.warn(
        f"run {declared.label}: samples are unevenly spaced, {spacing.min():.3g} to "
        f"{spacing.max():.3g} s apart; they were interpolated to steps of {step:.6g} s by a cubic "
        "spline, which smooths noise a little",
        DataWarning,
        stacklevel=2,
    )
    return _frozen(written[0] + step * np.arange(written.size))


def _rows_of(
    declared: RunDeclaration, table: FileColumns, names: Mapping[str, str], time: Array
) -> slice:
    """Rows of the file that are this run's: of its segment, up to where its columns end."""
    first, last = 0, _length(table, names, time)
    if declared.rows is not None:
        first, last = declared.rows[0] - 1, min(declared.rows[1], last)
        if declared.rows[1] > time.size:
            raise CampaignError(
                f"the file has {number_of(time.size, 'row')}", key="rows", value=list(declared.rows)
            )
    elif isinstance(declared.segment, tuple):
        first, last = _rows_with(table, *declared.segment)
    elif declared.segment is not None:
        starts = [0, *(np.flatnonzero(np.diff(time[:last]) < 0) + 1), last]
        if declared.segment >= len(starts):
            raise CampaignError(
                f"time starts anew {number_of(len(starts) - 2, 'time')} in this file, which makes "
                f"{number_of(len(starts) - 1, 'segment')}",
                key="segment",
                value=declared.segment,
                hint="write the number of one of them, or rows = [first, last]",
            )
        first, last = starts[declared.segment - 1], starts[declared.segment]
    return slice(int(first), int(last))


def _length(table: FileColumns, names: Mapping[str, str], time: Array) -> int:
    """Rows up to the last one in which any channel of the run has a value."""
    ends = []
    for name in names.values():
        values = _column(table, name)
        filled = np.flatnonzero(np.isfinite(values[-_TAIL:])) + max(0, values.size - _TAIL)
        if not filled.size:
            filled = np.flatnonzero(np.isfinite(values))
        ends.append(int(filled[-1]) + 1 if filled.size else values.size)
    # A column that is shorter than the others because the run ended is cut; one that differs by its
    # number of samples is a fault, which is reported where the samples are taken.
    return min(max(ends), time.size)


def _rows_with(table: FileColumns, column: str, value: float) -> tuple[int, int]:
    """Rows in which a column has a value; they must follow one another."""
    values = _column(table, column)
    here = np.flatnonzero(values == value)
    if not here.size:
        known = ", ".join(f"{v:g}" for v in np.unique(values[np.isfinite(values)])[:12])
        raise CampaignError(
            "no row has this value", column=column, key="segment", value=value,
            hint=f"the column holds {known}",
        )  # fmt: skip
    if here[-1] - here[0] + 1 != here.size:
        raise CampaignError(
            "rows with this value do not follow one another",
            column=column,
            key="segment",
            value=value,
            hint="write rows = [first, last] instead",
        )
    return int(here[0]), int(here[-1]) + 1


def _compare_units(
    declared: RunDeclaration,
    table: FileColumns,
    names: Mapping[str, str],
    channels: Mapping[str, Channel],
) -> None:
    """Warn where the file states another unit than the campaign."""
    for name, column in names.items():
        stated, channel = table.units.get(column), channels[name]
        if stated is None or abs(channel.scale) != 1:
            continue
        if not any(_same(one, channel.unit) for one in (stated, SECOND_MEANINGS.get(stated, ""))):
            warnings.warn(
                f"run {declared.label}, file {declared.file}: the file says that column {column} "
                f"is in {stated}, and {FILE} that it is in {channel.unit}; {channel.unit} is taken",
                DataWarning,
                stacklevel=2,
            )


def _same(stated: str, unit: str) -> bool:
    """Whether two units convert alike; one that cannot be read may."""
    if not stated:
        return False
    try:
        there, here = parse_unit(stated), parse_unit(unit)
    except CampaignError:
        return True
    return there.si_name == here.si_name and bool(np.isclose(there.factor, here.factor, rtol=1e-9))


def _made(
    declared: RunDeclaration,
    channels: Mapping[str, Channel],
    time: Array,
    samples: Mapping[str, Array],
) -> Run:
    return Run(
        label=declared.label,
        file=declared.file,
        group=declared.group,
        role=declared.role,
        kind=declared.kind,
        frequency=declared.frequency,
        time=time,
        samples=samples,
        conditions=dict(declared.conditions),
        condition_units=dict(declared.condition_units),
        condition_sd=dict(declared.condition_sd),
        mask=declared.mask,
        bandwidths={n: c.bandwidth for n, c in channels.items() if c.bandwidth is not None},
        held=frozenset(name for name, channel in channels.items() if channel.held),
    )


def _frozen(values: Array) -> Array:
    values = np.ascontiguousarray(values, dtype=float)
    values.setflags(write=False)
    return values


def _column(table: FileColumns, name: str) -> Array:
    if name in table.columns:
        return table.columns[name]
    if name in table.names:
        raise CampaignError("column holds no numbers", column=name)
    hint = choose(name, table.names)
    if table.names and table.names[0] == "1":
        hint = f"the file does not name its columns; write a number from 1 to {len(table.names)}"
    raise CampaignError("no such column", column=name, hint=hint)


def _time(
    declared: RunDeclaration, table: FileColumns, names: Mapping[str, str]
) -> tuple[Array, str | None]:
    """Times in seconds, and their column; None where they follow from a sample rate."""
    first = next(iter(names.values()))
    if declared.sample_rate is not None:
        return np.arange(_column(table, first).size) / declared.sample_rate, None
    name = declared.time or _time_column(table.columns, first)
    if name is not None:
        return _column(table, name) * _seconds(declared, table, name), name
    rate = table.sample_rate.get(first)
    if rate is not None:
        return np.arange(_column(table, first).size) / rate, None
    damaged = _time_column(table.faults, first)
    if damaged is not None:
        raise _or_a_rate(table.faults[damaged])
    raise CampaignError("no time column", hint=_where_times_are(table))


def _or_a_rate(fault: CampaignError) -> CampaignError:
    """The fault of a time column, which a known sample rate makes dispensable."""
    return CampaignError(
        fault.problem,
        file=fault.file,
        column=fault.column,
        value=fault.value,
        hint=f"{fault.hint}, or give sample_rate",
    )


def _where_times_are(table: FileColumns) -> str:
    """What to write where no column is known to be time."""
    hint = (
        "it is found by names such as time, time_s, Time [ms] or t; if yours has another, write "
        f"time = '...', or give sample_rate; {choose('time', table.names)}"
    )
    for number in ("Ts", "dt", "fs", "Fs"):
        if number in table.numbers:
            value = table.numbers[number]
            rate = value if number in ("fs", "Fs") else 1 / value
            hint = (
                f"the file holds {number} = {value:g}; if that is the sampling, write "
                f"sample_rate = {rate:g}"
            )
    return hint


def _time_column(names: Collection[str], first: str) -> str | None:
    """The column of time: beside the first channel in its group, or of the whole file."""
    beside = re.match(r"(.*[/.])?", first)
    group = beside[0] if beside else ""
    for name in names:
        if name.startswith(group) and is_time(name[len(group) :]):
            return name
    return next((name for name in names if is_time(name)), None)


def _seconds(declared: RunDeclaration, table: FileColumns, name: str) -> float:
    """Seconds in the unit of the time column: as declared, as the file says, or one."""
    in_name = time_unit(name) or unit_in_name(name)
    for unit in (declared.time_unit, table.units.get(name), in_name):
        if unit is not None and unit.lower() in TIME_UNITS:
            return TIME_UNITS[unit.lower()]
    return 1.0


def _samples(
    channel: Channel,
    column: str,
    table: FileColumns,
    part: slice,
    times: tuple[Array, Array, int],
    away: NDArray[np.bool_],
) -> Array:
    """Samples of a channel, SI; ``times`` are those written, those wanted, and how many in all."""
    values = _column(table, column)
    written, time, size = times
    if values.size != size:
        raise CampaignError(
            f"column has {number_of(values.size, 'sample')} and time {size}", column=column
        )
    values = values[part]
    _check_finite(values, written, column, part.start, away)
    if not np.array_equal(written, time) and is_uneven(written):
        values = resample(written, time, values)
    gap = ~np.isfinite(values)
    missing = np.flatnonzero(gap & ~away)
    if missing.size:
        raise CampaignError(
            f"{number_of(missing.size, 'missing value')}, the first at {time[missing[0]]:.6g} s",
            column=column,
            value=float(values[missing[0]]),
            hint="cut the run there with start or stop, mask the gap, or fill it",
        )
    if gap.any():  # masked samples do not count, so that any number serves
        values = bridged(values[None], gap)[0]
    _check_size(channel, column, values)
    row, beyond = impossible_sample(values)
    if row is not None:
        raise CampaignError(
            f"sample in row {part.start + row + 1}, at {time[row]:.6g} s, is {beyond} as far from"
            " the median as the others",
            column=column,
            value=float(values[row]),
            hint="correct it, mask that time, or cut the run there with start or stop",
        )
    if np.ptp(values) == 0:
        raise CampaignError(
            "channel is constant",
            column=column,
            value=float(values[0]),
            hint="make it a condition of the run, or check the sensor",
        )
    return _frozen(channel.to_si(values))


def _check_finite(
    values: Array, time: Array, column: str, before: int, away: NDArray[np.bool_]
) -> None:
    """Raise where a sample that is not masked is infinite: it was written, and is not missing."""
    found = np.flatnonzero(np.isinf(values) & ~away)
    if found.size:
        row = int(found[0])
        raise CampaignError(
            f"{number_of(found.size, 'infinite value')}, the first in row {before + row + 1}, at "
            f"{time[row]:.6g} s",
            column=column,
            value=float(values[row]),
            hint="write what was measured, mask that time, or cut the run there with start or stop",
        )


#: Sizes of numbers whose sixth powers, up and down, are numbers too.
SMALLEST, LARGEST = 1e-50, 1e50


def _check_size(channel: Channel, column: str, values: Array) -> None:
    """Raise where the products of samples would overflow, or vanish, as in a wrong unit."""
    with np.errstate(all="ignore"):
        for sizes in (values, channel.to_si(values)):
            swing, size = float(np.ptp(sizes)), float(np.median(np.abs(sizes)))
            if size > LARGEST or 0 < swing < SMALLEST:
                raise CampaignError(
                    f"{'size' if size > LARGEST else 'swing'} of the samples is out of range",
                    column=column,
                    value=size if size > LARGEST else swing,
                    hint=f"give samples between {SMALLEST:g} and {LARGEST:g}, in this unit and SI",
                )


def _check_periods(declared: RunDeclaration, time: Array) -> None:
    if declared.frequency is None:
        return
    step = (time[-1] - time[0]) / (time.size - 1)
    periods = declared.frequency * step * time.size
    # A record from 0 to 2 T without its end point is one sample short of two periods. The declared
    # frequency is approximate, so that a few per cent short of two may still be two true periods.
    if periods < 1.9:
        raise CampaignError(
            f"fewer than two periods in {time[-1] - time[0]:.6g} s",
            key="frequency",
            value=declared.frequency,
            hint="record two periods or more, or correct the frequency",
        )
    if declared.frequency * step > 0.25:
        raise CampaignError(
            f"fewer than four samples a period at {1 / step:.6g} Hz",
            key="frequency",
            value=declared.frequency,
            hint="correct the frequency or the sample_rate",
        )


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
        If times are missing or infinite, do not increase, leave a gap, or are too coarse for their
        spacing.
    """
    if time.size < 3:
        raise CampaignError("fewer than three samples", column=column, value=time.size)
    missing = np.flatnonzero(~np.isfinite(time))
    if missing.size:
        first = float(time[missing[0]])
        what, value = ("no", None) if np.isnan(first) else ("infinite", first)
        raise CampaignError(
            f"{what} time in row {before + missing[0] + 1}", column=column, value=value
        )
    spacing = np.diff(time)
    back = np.flatnonzero(spacing <= 0)
    # Time stamps that are rounded more coarsely than the spacing repeat: a message of its own.
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
    # The roundest step within the resolution of the stamps is taken: 0.025, not 0.0250000003.
    step = _roundest(step, 0.5 * resolution / time.size)
    first = _roundest(float(np.mean(time)) + step * float(index[0]), 0.5 * resolution)
    return first + step * np.arange(time.size, dtype=float)


def _check_gaps(time: Array, spacing: Array, resolution: float, column: str) -> None:
    usual = float(np.median(spacing))
    deviation = np.abs(spacing - usual)
    row = int(np.argmax(deviation))
    if deviation[row] <= _allowed(usual, resolution):
        return
    if spacing[row] > 1.49 * usual:
        missing = max(1, round(spacing[row] / usual) - 1)
        raise CampaignError(
            f"gap of {number_of(missing, 'missing sample')} after {time[row]:.6g} s",
            column=column,
            hint="cut the run there with start or stop",
        )
    raise CampaignError(
        f"spacing at {time[row]:.6g} s is {spacing[row]:.6g} s instead of {usual:.6g} s",
        column=column,
        hint="cut the run there with start or stop, or correct that time",
    )


def _allowed(usual: float, resolution: float) -> float:
    """Deviation of a spacing that rounding of the time stamps explains."""
    return max(0.02 * usual, min(1.05 * resolution, 0.49 * usual))


def is_uneven(time: Array) -> bool:
    """Whether samples are unevenly spaced throughout, with no gap and no step back.

    A single wrong spacing is a fault of the record; a clock that jitters is how it was sampled.

    Parameters
    ----------
    time : ndarray, shape (N,)
        As written, s.
    """
    spacing = np.diff(time)
    if time.size < 20 or not np.all(spacing > 0):
        return False
    usual = float(np.median(spacing))
    off = np.abs(spacing - usual) > _allowed(usual, _written_resolution(time))
    return bool(np.mean(off) > _UNEVEN and spacing.max() <= _LARGEST_SPACING * usual)


def resample(time: Array, new: Array, values: Array) -> Array:
    """Values at other times by a cubic spline; missing where the nearest sample is missing.

    Parameters
    ----------
    time, new : ndarray, shape (N,)
        Times of the samples, increasing, and those wanted, s.
    values : ndarray, shape (N,)

    Returns
    -------
    ndarray, shape (N,)
    """
    from scipy.interpolate import make_interp_spline

    good = np.isfinite(values)
    if good.sum() < 4:
        return values
    found = np.asarray(make_interp_spline(time[good], values[good], k=3)(new), dtype=float)
    if not good.all():
        nearest = np.clip(np.searchsorted(0.5 * (time[1:] + time[:-1]), new), 0, time.size - 1)
        found[~good[nearest]] = np.nan
    return found


def _written_resolution(time: Array) -> float:
    """Power of ten of which all stamps are multiples; zero if they are written in full."""
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
        If fewer than three samples are given or left.
    """
    if time.size < 3:
        raise CampaignError("fewer than three samples", value=time.size)
    # The slack of a thousandth of a sample includes a sample that is exactly at an end.
    slack = 1e-3 * abs(float(np.nanmedian(np.diff(time))))
    low = -np.inf if start is None else start - slack
    high = np.inf if stop is None else stop + slack
    inside = np.flatnonzero((time >= low) & (time <= high))
    if inside.size < 3:
        raise CampaignError(
            "fewer than three samples between start and stop",
            key="start" if start is not None else "stop",
            value=(start, stop),
            hint=f"the file runs from {np.nanmin(time):.6g} to {np.nanmax(time):.6g} s",
        )
    return slice(int(inside[0]), int(inside[-1]) + 1)
