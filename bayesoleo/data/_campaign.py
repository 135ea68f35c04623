"""Campaigns: a folder with ``campaign.toml`` and one file a run, loaded in SI and checked.

Sample times must be equidistant; the rounding of written time stamps is tolerated.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array, Float
from bayesoleo.data._campaign_folders import dataset_folder
from bayesoleo.data._campaign_toml import (
    FILE,
    Channel,
    Declaration,
    RunDeclaration,
    read_declaration,
)
from bayesoleo.data._files import read_columns
from bayesoleo.data._sample_quality import Stretches, bridged, impossible_sample, masked
from bayesoleo.errors import CampaignError, check_path, choose

# Names of a time column in seconds that need not be declared.
_TIME_COLUMNS = tuple(
    word + unit
    for word in ("time", "Time", "TIME", "t")
    for unit in ("", "_s", " s", " [s]", "[s]", " (s)", "(s)", "/s")
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
        If times are missing, do not increase, leave a gap, or are too coarse for their spacing.
    """
    if time.size < 3:
        raise CampaignError("fewer than three samples", column=column, value=time.size)
    missing = np.flatnonzero(~np.isfinite(time))
    if missing.size:
        raise CampaignError(f"no time in row {before + missing[0] + 1}", column=column)
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

    @property
    def time_step(self) -> float:
        """Sampling interval, s."""
        return float((self.time[-1] - self.time[0]) / (self.time.size - 1))


@dataclass(frozen=True)
class CampaignData:
    """A loaded campaign.

    Parameters
    ----------
    name, description : str
        As declared.
    controlled : str or None
        The channel that the rig controls.
    path : Path
        Folder of ``campaign.toml``.
    channels : mapping of str to Channel
        Declared channels by name.
    runs : tuple of Run
        In the order declared.
    sha256 : str
        Of ``campaign.toml`` and all run files, in the order of the runs.
    rig : mapping of str to (float, float)
        Limits of the rig in a further run, SI, infinite where there is none.
    """

    name: str
    description: str
    controlled: str | None
    path: Path
    channels: Mapping[str, Channel]
    runs: tuple[Run, ...]
    sha256: str
    rig: Mapping[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def units(self) -> dict[str, str]:
        """SI unit of each channel."""
        return {name: channel.si_unit for name, channel in self.channels.items()}

    def run(self, label: str) -> Run:
        """The run with this label.

        Parameters
        ----------
        label : str
            As declared.

        Raises
        ------
        CampaignError
            If no run has this label; the message lists the labels.
        """
        for run in self.runs:
            if run.label == label:
                return run
        raise CampaignError(
            "no such run", run=label, hint=choose(label, [run.label for run in self.runs])
        )


def load_campaign(path: str | os.PathLike[str]) -> CampaignData:
    """Load a campaign and check it.

    Parameters
    ----------
    path : path-like
        The campaign's folder, or its ``campaign.toml``.

    Returns
    -------
    CampaignData
        All runs, in SI.

    Raises
    ------
    CampaignError
        If the campaign is invalid; one line that says where and why, and how to correct it.
    """
    check_path(path, "path", hint='write load_campaign("folder")')
    given = Path(path)
    toml = given if given.suffix == ".toml" else given / FILE
    declaration = read_declaration(toml)
    folder = _data_folder(declaration, toml.parent)
    runs = tuple(_load_run(run, declaration.channels, folder) for run in declaration.runs)
    _check_shared(runs)
    return CampaignData(
        name=declaration.name,
        description=declaration.description,
        controlled=declaration.controlled,
        path=toml.parent,
        channels=dict(declaration.channels),
        runs=runs,
        sha256=_checksum(toml, [folder / run.file for run in declaration.runs]),
        rig=declaration.rig,
    )


def _check_shared(runs: tuple[Run, ...]) -> None:
    """Raise where two runs are the same stretch of a file: it would count twice, or be fitted and
    held out at once."""
    for later, run in enumerate(runs):
        for other in runs[:later]:
            common = min(run.time[-1], other.time[-1]) - max(run.time[0], other.time[0])
            shorter = min(np.ptp(run.time), np.ptp(other.time))
            if run.file == other.file and common > 0.5 * shorter:
                raise CampaignError(
                    f"holds the same samples as run {other.label}",
                    file=run.file,
                    run=run.label,
                    key="file",
                    hint="name its own file, or cut both with start and stop",
                )


def _data_folder(declaration: Declaration, folder: Path) -> Path:
    if declaration.dataset is None:
        return folder
    files = tuple(dict.fromkeys(run.file for run in declaration.runs))
    return dataset_folder(declaration.dataset, files)


def _checksum(toml: Path, files: list[Path]) -> str:
    total = hashlib.sha256(toml.read_bytes())
    for file in dict.fromkeys(files):
        total.update(hashlib.sha256(file.read_bytes()).digest())
    return total.hexdigest()


def _load_run(declared: RunDeclaration, channels: Mapping[str, Channel], folder: Path) -> Run:
    """Load one run; errors name the run and its file."""
    try:
        wanted = {channel.column for channel in channels.values()}
        wanted |= {declared.time} if declared.time else set(_TIME_COLUMNS)
        file = folder / declared.file
        columns = read_columns(file, declared.delimiter, declared.header_delimiter, wanted)
        whole, column = _time(declared, columns, channels)
        # The cut comes first, because samples outside may have gaps.
        part = window(whole, declared.start, declared.stop)
        time = _frozen(uniform_time(whole[part], column, part.start) if column else whole[part])
        away = masked(time, declared.mask)
        samples = {
            name: _samples(channel, columns, whole, part, away)
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
    )


def _frozen(values: Array) -> Array:
    values = np.ascontiguousarray(values, dtype=float)
    values.setflags(write=False)
    return values


def _column(columns: Mapping[str, Array], name: str) -> Array:
    if name not in columns:
        raise CampaignError("no such column", column=name, hint=choose(name, columns))
    return columns[name]


def _time(
    declared: RunDeclaration, columns: Mapping[str, Array], channels: Mapping[str, Channel]
) -> tuple[Array, str | None]:
    """Times as written, and their column; None where they follow from a sample rate."""
    if declared.sample_rate is not None:
        first = _column(columns, next(iter(channels.values())).column)
        return np.arange(first.size) / declared.sample_rate, None
    if declared.time is not None:
        return _column(columns, declared.time), declared.time
    for name in _TIME_COLUMNS:
        if name in columns:
            return columns[name], name
    raise CampaignError(
        "no time column",
        hint="it is found by names such as time, time_s, time [s] or t; if yours, in seconds, has "
        f"another, write time = '...', or give sample_rate; {choose('time', columns)}",
    )


def _samples(
    channel: Channel,
    columns: Mapping[str, Array],
    time: Array,
    part: slice,
    away: NDArray[np.bool_],
) -> Array:
    values = _column(columns, channel.column)
    if values.size != time.size:
        raise CampaignError(
            f"column has {values.size} samples and time {time.size}", column=channel.column
        )
    values, time = values[part], time[part]
    gap = ~np.isfinite(values)
    missing = np.flatnonzero(gap & ~away)
    if missing.size:
        raise CampaignError(
            f"{missing.size} missing value(s), the first at {time[missing[0]]:.6g} s",
            column=channel.column,
            value=float(values[missing[0]]),
            hint="cut the run there with start or stop, mask the gap, or fill it",
        )
    if gap.any():  # masked samples do not count, so that any number serves
        values = bridged(values[None], gap)[0]
    _check_size(channel, values)
    row, beyond = impossible_sample(values)
    if row is not None:
        raise CampaignError(
            f"sample in row {part.start + row + 1}, at {time[row]:.6g} s, is {beyond} as far from"
            " the median as the others",
            column=channel.column,
            value=float(values[row]),
            hint="correct it, mask that time, or cut the run there with start or stop",
        )
    if np.ptp(values) == 0:
        raise CampaignError(
            "channel is constant",
            column=channel.column,
            value=float(values[0]),
            hint="make it a condition of the run, or check the sensor",
        )
    return _frozen(channel.to_si(values))


#: Sizes of numbers whose sixth powers, up and down, are numbers too.
SMALLEST, LARGEST = 1e-50, 1e50


def _check_size(channel: Channel, values: Array) -> None:
    """Raise where the products of samples would overflow, or vanish, as in a wrong unit."""
    with np.errstate(all="ignore"):
        for sizes in (values, channel.to_si(values)):
            swing, size = float(np.ptp(sizes)), float(np.median(np.abs(sizes)))
            if size > LARGEST or 0 < swing < SMALLEST:
                raise CampaignError(
                    f"{'size' if size > LARGEST else 'swing'} of the samples is out of range",
                    column=channel.column,
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
