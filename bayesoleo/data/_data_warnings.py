"""Warnings about reduced records: drift, doubtful frequencies, noise.

The warnings are sentences about drift, about a frequency that is a multiple or a fraction of the
true one, and about a channel without a periodic signal.

A record that drifts is no periodic equilibrium: its average over periods belongs to no motion that
occurred, and the drift counts as noise. (Verbeek 1993 notes the slow drift of the gas pressure.)
The drift of the mean or the amplitude of a channel from period to period is therefore tested.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array
from bayesoleo.data._fourier import HarmonicBasis, basis_of
from bayesoleo.data._harmonics import foreign_lines
from bayesoleo.data._noise import average_on, periodic_average
from bayesoleo.data._quiet_channels import noise_of_channels, quiet_channels
from bayesoleo.data._sample_quality import clipped, coarse_steps, repeating_rounding
from bayesoleo.prediction._records import Disturbances, Record

#: Probability of flagging any channel of a run without drift.
FALSE_ALARM = 1e-3
#: Smallest change over the record, in standard deviations of a single sample, that is reported.
LEAST_CHANGE = 0.2
_BINS = 24

#: A harmonic belongs to the motion if it exceeds both limits: a part of the total power, and a
#: ratio to the power of the noise (twice its variance), which noise exceeds with probability 2e-9.
STRAY_POWER, STRAY_RATIO = 1e-5, 20.0
#: A longer period is that of the motion if it leaves at most the part ``LEFT`` of the variance that
#: does not repeat in the declared period; noise would leave all of it. The non-repeating part must
#: also exceed the part ``LEAST`` of the channel's deviation: it is half of the motion where the
#: declared frequency is double, but a per cent for an unsettled start and zero for the rounding of
#: samples without noise.
LEFT, LEAST = 0.25, 0.05
#: Samples at the end of a record that say how far a channel moves from one to the next.
NEAR = 50
#: Times as far as that it may move between two pieces of one record, and times as far as that it
#: ranges where it moves: noise alone ranges less far than it changes.
SEAM, MOVES = 3.0, 2.0
#: Multiples of the declared period that are tried.
LONGER = (2, 3)


@dataclass(frozen=True)
class Drift:
    """Trend of one channel over a record.

    Parameters
    ----------
    channel : str
    mean, mean_sd : float
        Change of the mean from the beginning to the end of the record, and its standard deviation,
        SI.
    amplitude, amplitude_sd : float
        Relative change of the amplitude of the periodic part, and its standard deviation.
    noise : float
        Standard deviation of a single sample about the average over periods, SI.
    swing : float
        Root mean square of the periodic part about its mean, SI.
    """

    channel: str
    mean: float
    mean_sd: float
    amplitude: float
    amplitude_sd: float
    noise: float
    swing: float

    @property
    def p_value(self) -> float:
        """Probability of a trend as large, of mean or amplitude, in a record without one."""
        scores = abs(self.mean) / self.mean_sd, abs(self.amplitude) / self.amplitude_sd
        return min(1.0, float(2 * 2 * distributions.norm.sf(max(scores))))

    @property
    def change(self) -> float:
        """Larger change of the two, in standard deviations of a single sample."""
        return max(abs(self.mean), abs(self.amplitude) * self.swing) / self.noise


def drift(values: Array, time_step: float, frequency: float, channel: str = "") -> Drift:
    """Fit a linear trend to the mean and to the amplitude of a periodic signal.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Over two periods or more.
    time_step : float
        Sampling interval, s.
    frequency : float
        Hz.
    channel : str, optional
        Name of the signal.

    Returns
    -------
    Drift
        Standard deviations allow for the colour of the noise.
    """
    signal = np.asarray(values, dtype=float)
    average = periodic_average(signal, time_step, frequency)
    swing = average.values - average.values.mean()
    rms = float(np.sqrt(np.mean(swing**2)))
    time = (np.arange(signal.size) - 0.5 * (signal.size - 1)) / signal.size
    shapes = np.stack((time, time * swing))
    # The average absorbs a part of a trend, which is therefore projected out of the regressors.
    columns = shapes - basis_of(signal.size, time_step * frequency).fit(shapes)
    rest = signal - average.values
    # Each column is scaled: that of the amplitude may be negligible beside that of the mean.
    length = np.sqrt(np.mean(columns**2, axis=1, keepdims=True))
    length[length == 0] = 1.0
    inverse = np.linalg.pinv(columns / length).T
    found = inverse @ rest
    noise = rest - found @ (columns / length)
    sd = np.array([_coloured_sd(row, noise) for row in inverse])
    change, error = found / length[:, 0], np.maximum(sd / length[:, 0], 1e-300)
    return Drift(
        channel=channel,
        mean=float(change[0]),
        mean_sd=float(error[0]),
        amplitude=float(change[1]),
        amplitude_sd=float(error[1]),
        noise=max(average.sigma, 1e-300),
        swing=rms,
    )


def record_drifts(record: Record) -> tuple[Drift, ...]:
    """Trend of every channel of a periodic run; none for a transient."""
    if not record.periodic:
        return ()
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    return tuple(
        drift(values, step, record.frequency, name) for name, values in record.samples.items()
    )


def drifting(record: Record) -> tuple[Drift, ...]:
    """Channels whose trend is significant and large enough to matter."""
    found = record_drifts(record)
    return tuple(
        item
        for item in found
        if item.p_value * len(found) < FALSE_ALARM and item.change > LEAST_CHANGE
    )


def _coloured_sd(weights: Array, noise: Array) -> float:
    """Standard deviation of ``weights @ noise`` by the noise's own smoothed spectrum."""
    samples = noise.size
    transfer = np.abs(fft.rfft(weights)) ** 2
    spectrum = np.abs(fft.rfft(noise)) ** 2 / samples
    width = np.ones(min(2 * _BINS + 1, spectrum.size))
    smooth = np.convolve(spectrum, width, "same")
    # Bins on the harmonics are empty: the average over periods contains them.
    used = np.convolve((spectrum > 1e-12 * spectrum.max(initial=0.0)).astype(float), width, "same")
    double = np.full(transfer.size, 2.0)
    double[0] = 1.0
    if samples % 2 == 0:
        double[-1] = 1.0
    return float(np.sqrt(np.sum(double * transfer * smooth / np.maximum(used, 1.0)) / samples))


def motions_per_period(record: Record) -> int:
    """Number of periods of the motion in a declared period: two if the frequency is half.

    Parameters
    ----------
    record : Record

    Returns
    -------
    int
        The greatest common divisor of the harmonics that exceed the noise of any channel; one
        for a transient.
    """
    strong: set[int] = set()
    for harmonics in record.harmonics.values():
        power, moves = np.abs(harmonics.coefficients) ** 2, harmonics.orders > 0
        least = STRAY_POWER * float(power[moves].sum())
        clear = power > np.maximum(least, 2 * STRAY_RATIO * harmonics.variances)
        strong.update(int(order) for order in harmonics.orders[moves & clear])
    return int(np.gcd.reduce(sorted(strong))) if strong else 1


def periods_per_motion(record: Record) -> tuple[int, str]:
    """Number of declared periods in a period of the motion: two if the frequency is double.

    Parameters
    ----------
    record : Record

    Returns
    -------
    periods : int
        One for a transient, and where the record is too short or has masked stretches.
    channel : str
        The channel with the clearest evidence; empty where the number is one.
    """
    if not record.periodic or record.kept is not None:
        return 1, ""
    step = record.frequency * (record.time[-1] - record.time[0]) / (record.time.size - 1)
    for count in LONGER:
        # A comparison needs two of the longer periods.
        if record.periods < 2 * count:
            continue
        basis = HarmonicBasis(record.time.size, step / count)
        left = {
            name: average_on(basis, values).sigma / record.signal_noise[name]
            for name, values in record.samples.items()
            if record.signal_noise[name] > LEAST * np.std(values)
        }
        name = min(left, key=lambda name: left[name], default="")
        if name and left[name] ** 2 < LEFT:
            return count, name
    return 1, ""


def data_warnings(records: Sequence[Record], units: Mapping[str, str] | None = None) -> list[str]:
    """Warnings about records that are usable but should be checked.

    Parameters
    ----------
    records : sequence of Record
        Reduced runs.
    units : mapping of str to str, optional
        SI unit of each channel, for the numbers.

    Returns
    -------
    list of str
        Each names the run, the finding and the remedy.
    """
    known = {} if units is None else units
    periods = [_about_period(record) for record in records]
    found = [sentence for sentences in periods for sentence in sentences]
    found += [
        _sentence(record, item, _unit(known, item.channel))
        for record in records
        for item in drifting(record)
    ]
    found += _about_removed(records, known)
    found += _about_quiet(records, known)
    for record, doubts in zip(records, periods, strict=True):
        # Lines between the harmonics of a wrong frequency are harmonics of the true one.
        found += [] if doubts else _about_channels(record, known)
    return found + _about_pieces(records)


def _about_quiet(records: Sequence[Record], units: Mapping[str, str]) -> list[str]:
    """Channels of transients that count as constant, because they show noise alone."""
    noise = noise_of_channels(records)
    runs: dict[str, list[str]] = {}
    for record in records:
        for channel in quiet_channels(record, noise):
            runs.setdefault(channel, []).append(record.label)
    return [
        f"{_runs(labels)}: {channel} shows nothing but the noise that its sensor has in other runs,"
        f" {noise[channel]:.3g}{_unit(units, channel)}; it counts as constant there"
        for channel, labels in runs.items()
    ]


def _about_pieces(records: Sequence[Record]) -> list[str]:
    """Transients that are pieces of one record, one sentence for each such record."""
    chains: list[list[Record]] = []
    for record in sorted(records, key=lambda one: float(one.time[0])):
        chain = next((one for one in chains if _goes_on(one[-1], record)), None)
        if chain is None:
            chains.append([record])
        else:
            chain.append(record)
    return [
        f"{_runs([one.label for one in chain])} seem to be pieces of one record: all but the first"
        " go on where another one ends. A parameter that differs from run to run may then stand for"
        " what changes along it, such as the amplitude"
        for chain in chains
        if len(chain) > 1
    ]


def _goes_on(before: Record, after: Record) -> bool:
    """Whether one transient's clock and all of its channels that move go on in another one."""
    if before.periodic or after.periodic or min(before.time.size, after.time.size) < NEAR:
        return False
    step = float(before.time[-1] - before.time[-2])
    if not abs(after.time[0] - before.time[-1] - step) < step:
        return False
    jumps = [_jump(before, after, name) for name in before.samples if name in after.samples]
    told = [jump for jump in jumps if jump is not None]
    return bool(told) and max(told) <= SEAM


def _jump(before: Record, after: Record, channel: str) -> float | None:
    """Change of a channel between two records over its usual change between two samples there; None
    where it rests, or shows noise only."""
    first, last = (
        one.samples[channel][slice(None) if one.kept is None else one.kept]
        for one in (after, before)
    )
    if min(first.size, last.size) < NEAR:
        return None
    usual = float(np.quantile(np.abs(np.diff(last[-NEAR:])), 0.9))
    if not usual > 0.0 or not np.std(last) > MOVES * usual:
        return None
    return float(abs(first[0] - last[-1]) / usual)


def removed_text(records: Sequence[Record], units: Mapping[str, str]) -> str:
    """What was removed from channels, in sentences; empty where nothing was.

    Parameters
    ----------
    records : sequence of Record
    units : mapping of str to str
        Of the channels, as they are told.
    """
    return "; ".join(_about_removed(records, units))


def _about_removed(records: Sequence[Record], units: Mapping[str, str]) -> list[str]:
    """What was removed from channels, one sentence a channel and kind."""
    found = []
    for channel in dict.fromkeys(name for r in records for name in r.disturbances):
        there = [(r, r.disturbances[channel]) for r in records if channel in r.disturbances]
        unit = _unit(units, channel)
        found += _about_drift(channel, there, unit)
        tones = [(tone, r.label) for r, item in there for tone in item.tones]
        if tones:
            loudest, where = max(tones, key=lambda pair: pair[0].amplitude)
            runs = list(dict.fromkeys(label for _, label in tones))
            which = "" if len(tones) == 1 else f"the loudest in run {where} "
            found.append(
                f"{channel} has a tone that is no harmonic of the drive ({_runs(runs)}), {which}"
                f"at {loudest.frequency:.4g} Hz with the amplitude "
                f"{loudest.amplitude:.3g}{unit}: it was removed; to keep it leave tone out of "
                "disturbances"
            )
        runs = [r.label for r, item in there if item.degrees]
        if runs:
            least = min(item.degrees for _, item in there if item.degrees)
            found.append(
                f"{channel} has outliers ({_runs(runs)}), as noise with {least:g} degrees of "
                "freedom of the t distribution has: they were weighted down; to keep them leave "
                "tails out of disturbances"
            )
    return found


def _about_drift(
    channel: str, there: Sequence[tuple[Record, Disturbances]], unit: str
) -> list[str]:
    """The drift that was removed from a channel, with the runs in which it was found."""
    drifts = {r.label: item.drift for r, item in there if item.drift and not item.drift_elsewhere}
    if not drifts:
        return []
    others = any(item.drift_elsewhere for _, item in there)
    alike = (
        ", and alike in the other periodic runs, since their sensor is the same" if others else ""
    )
    return [
        f"{channel} drifts ({_runs(list(drifts))}), by up to {max(drifts.values()):.2g}{unit} root "
        f"mean square: the drift was removed{alike}, and the mean of each run is estimated as "
        "unknown; to keep it leave drift out of disturbances"
    ]


def _runs(labels: Sequence[str]) -> str:
    """Labels after the word run; the first few of many."""
    some = ", ".join(labels[:4])
    more = f" and {len(labels) - 4} more" if len(labels) > 4 else ""
    return f"run{'s' if len(labels) > 1 else ''} {some}{more}"


def _unit(units: Mapping[str, str], channel: str) -> str:
    """The unit as it follows a number; empty for a dimensionless channel."""
    unit = units.get(channel, "(SI)")
    return f" {unit}" if unit else ""


def _about_channels(record: Record, units: Mapping[str, str]) -> list[str]:
    """Warnings about foreign lines, saturation and coarse steps of channels."""
    where = f"run {record.label}: "
    found = [
        f"{where}{line.channel} has a line at {line.frequency:.4g} Hz with the amplitude "
        f"{line.amplitude:.3g}{_unit(units, line.channel)}, which is no harmonic of "
        f"{record.frequency:.4g} Hz: a periodic source besides the drive, or a free "
        "oscillation that has not died away; it counts as noise"
        for line in foreign_lines(record)
    ]
    found += [
        f"{where}{item.channel} is cut off at its {item.end} value, {item.value:.4g}"
        f"{_unit(units, item.channel)}, for {100 * item.share:.2g} % of the samples; "
        + _about_the_cut(item.channel)
        for item in clipped(record)
    ]
    for channel, step in coarse_steps(record).items():
        stays = repeating_rounding(step, record.signal_noise[channel])
        unit = _unit(units, channel)
        what = (
            f"where samples fall on the same phases in every period, a rounding error of "
            f"{stays:.2g}{unit} repeats"
            if record.periodic
            else "rounding counts as noise, although it is no noise where the channel rests"
        )
        found.append(
            f"{where}{channel} goes in steps of {step:.3g}{unit}, "
            f"{step / max(record.signal_noise[channel], 1e-300):.2g} times the noise of a sample; "
            f"{what}"
        )
    return found


def _about_the_cut(channel: str) -> str:
    """What a record that is cut off may mean: the sensor ends there, or the system does."""
    return (
        f"if the sensor of {channel} ends there, mask these stretches; if {channel} itself does, "
        "as a tank that overflows or a part that reaches a stop, the record shows the effect: keep "
        "it"
    )


def frequency_warnings(records: Sequence[Record]) -> list[str]:
    """The warnings about the frequency; if there are any, all further results are doubtful.

    Parameters
    ----------
    records : sequence of Record
        Reduced runs.

    Returns
    -------
    list of str
    """
    return [sentence for record in records for sentence in _about_period(record)]


def _about_period(record: Record) -> list[str]:
    """Warnings about the period of one run."""
    count, channel = periods_per_motion(record)
    if count > 1:
        # Harmonics are then a part of the motion's: of how often it repeats they say nothing.
        return [
            f"run {record.label}: {channel} repeats only after {count} declared periods, and the "
            f"difference between these counts as noise; write frequency = "
            f"{record.frequency / count:.4g}"
        ]
    found = []
    times = motions_per_period(record)
    if times > 1:
        found.append(
            f"run {record.label}: the motion repeats {times} times in a declared period, as if "
            f"that were {times} periods; write frequency = {times * record.frequency:.4g}"
        )
    return found + [
        f"run {record.label}: nothing in {name} repeats at {record.frequency:.4g} Hz above its "
        "noise; look at the record, leave the run out, or declare it as kind = 'transient'"
        for name, harmonics in record.harmonics.items()
        if not (harmonics.orders > 0).any()
    ]


def _sentence(record: Record, item: Drift, unit: str) -> str:
    by_mean = abs(item.mean) / item.mean_sd >= abs(item.amplitude) / item.amplitude_sd
    if by_mean:
        size, sd = item.mean, item.mean_sd
        what = f"mean moves by {size:.3g} ± {sd:.1g}{unit}"
    else:
        size, sd = 100 * item.amplitude, 100 * item.amplitude_sd
        what = f"amplitude changes by {size:.3g} ± {sd:.1g} %"
    return (
        f"run {record.label}: {item.channel} drifts, its {what} over the record, "
        f"{item.change:.2g} times the noise of a sample; cut the run with start or stop, "
        "or count the drift as noise"
    )
