r"""Frequency response of runs with a broadband periodic input, and their nonlinear distortion.

A multisine run has several excited lines in one period. Three things are found from it before any
model is made. Differences between periods are noise. Differences between realisations, runs of the
same amplitude spectrum with other random phases, are noise and stochastic nonlinear distortion.
Lines that the input does not excite, the detection lines, show the even and the odd distortion.

Of realisation :math:`m` of :math:`M`, :math:`U` and :math:`Y` are harmonics of input and output,
averaged over periods. The best linear approximation and its two variances are the robust method

.. math::
    G = \frac 1 M \sum_m G_m, \quad G_m = \frac{Y_m}{U_m}, \qquad
    \sigma_{total}^2 = \frac{\sum_m |G_m - G|^2}{M (M - 1)}, \qquad
    \sigma_n^2 = \frac 1 {M^2} \sum_m
    \frac{\sigma_Y^2 + |G|^2 \sigma_U^2 - 2 \Re(\bar G \sigma_{YU}^2)}{|U_m|^2}

of Pintelon and Schoukens (2012), section 4.3; :math:`M (\sigma_{total}^2 - \sigma_n^2)` is the
variance of the stochastic distortion of one realisation. An input that is distorted has power at
detection lines; the response to it is removed to first order, :math:`Y - G U`, with :math:`G`
interpolated between the excited lines.

The noise covariances are those of the lines that a record of P periods has between its harmonics.
They hold exactly the differences between periods, and none of what repeats.

References
----------
Pintelon and Schoukens (2012), System Identification: A Frequency Domain Approach, 2nd ed., sections
4.3 and 7; Schoukens, Vaes and Pintelon (2016), IEEE Control Systems Magazine 36(3), 38-69.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy import fft

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._schema import variable
from bayesoleo._types import Array, ComplexArray, Flags, Integers
from bayesoleo.data._campaign import CampaignData
from bayesoleo.data._fourier import HarmonicBasis
from bayesoleo.data._reduction import ReducedCampaign, reduce_campaign
from bayesoleo.data._sample_quality import bridged
from bayesoleo.errors import InputError, choose
from bayesoleo.prediction._records import Record

#: A line is excited if its amplitude is so many times the standard deviation of its noise,
ABOVE_NOISE = 10.0
#: and this part of the largest amplitude near it: within two octaves, or so many orders. An input
#: that is distorted by a few per cent has lines that are above its noise and yet not excited.
NEAR_SHARE, OCTAVES, NEAR_ORDERS = 0.1, 2.0, 16
#: And this part of the largest of all, so that the harmonics of a sine stay out however high.
SHARE = 0.01
#: Excited lines of a multisine at least; a distorted sine has fewer.
FEWEST_LINES = 5
#: Lines between harmonics that are averaged for the noise at one, where a record has as many.
NOISE_LINES = 20
#: Two amplitude spectra are one if their difference is at most this part of them, and so are mean
#: values (as a part of the rms) and fundamental frequencies; conditions are, to a hundredth.
ALIKE, SAME_FREQUENCY, SAME_CONDITION = 0.1, 1e-3, 0.01
#: Correlation of two inputs without noise, shifted in time at will, from which their phases are the
#: same. Of ten thousand pairs of realisations of five lines, at most three come as near by chance.
SAME_PHASES = 0.995
#: Orders are told up to so many times the highest that is excited, and so many beyond it.
REACH, BEYOND = 3, 24

EXCITED, EVEN, ODD, MIXED, SUBHARMONIC, OTHER = (
    "excited", "even", "odd", "mixed", "subharmonic", "other input",
)  # fmt: skip
#: Kinds of detection lines. Where even and odd lines are excited, either distortion falls on all.
PARITIES = (EVEN, ODD, MIXED, SUBHARMONIC)
Values = NDArray[np.inexact[Any]]
#: Why a transient is left out.
A_TRANSIENT = "a transient"
LEVEL, LINE, KIND, PARITY = "level", "line", "kind", "parity"


def frequency_response(
    campaign: CampaignData | ReducedCampaign,
    drive: str | None = None,
    outputs: Sequence[str] | str | None = None,
    *,
    others: Sequence[str] = (),
    excited: Sequence[int] | None = None,
) -> xr.Dataset:
    """Best linear approximation, noise and nonlinear distortion of periodic runs, by level.

    A level holds the runs of one group that have the same period, conditions, mean and amplitude
    spectrum of the input, each within a tolerance; runs of it with other phases are realisations. A
    run of a single sine is a level with one excited line, whose harmonics are detection lines.

    Parameters
    ----------
    campaign : CampaignData or ReducedCampaign
    drive : str, optional
        The measured input; by default the channel that the rig controls.
    outputs : str or sequence of str, optional
        By default all other channels.
    others : sequence of str, optional
        Further inputs. Lines that they excite are no detection lines; a run in which one shares a
        line with the drive is left out, since its output cannot be divided between them.
    excited : sequence of int, optional
        Orders that are excited; by default those of the input's amplitudes that are ten times their
        noise, a tenth of the largest near them, and a hundredth of the largest of all.

    Returns
    -------
    xarray.Dataset
        By output, level and line: ``response`` (complex), with ``noise_sd`` and, of two
        realisations or more, ``total_sd``; ``distortion_sd``, of the stochastic distortion of one
        realisation; ``output_amplitude``, at detection lines after correction for the input, with
        ``output_noise`` and ``p_value``; ``input_part``, which the correction removed. By level and
        line ``frequency``, ``order``, ``kind``, ``input_amplitude``, ``input_noise``. By output,
        level and parity of the detection lines, all of them together, ``distortion``,
        ``distortion_noise`` (rms, SI) and ``distortion_p``; ``stochastic``, ``stochastic_noise``
        and ``stochastic_p`` likewise at the excited lines. Lines that a level does not have, noise
        of a single period, and what needs realisations, are not a number. The attribute
        ``left_out`` lists the runs that take no part, with the reason (JSON).

    Raises
    ------
    InputError
        If there is no such channel, or no periodic run with an excited line.

    References
    ----------
    Pintelon and Schoukens (2012), sections 4.3 and 7.
    """
    reduced = campaign if isinstance(campaign, ReducedCampaign) else reduce_campaign(campaign)
    units = reduced.campaign.units
    drive = _channel(drive or reduced.campaign.controlled, units)
    wanted = [outputs] if isinstance(outputs, str) else outputs
    if wanted is None:
        wanted = [name for name in units if name != drive and name not in others]
    for name in (*wanted, *others):
        _channel(name, units)
    left_out: dict[str, str] = {}
    channels = (drive, *others, *wanted)
    runs = list(_spectra(reduced.records, channels, len(others), excited, left_out))
    if not (runs and wanted):
        said = "; ".join(f"{label}: {reason}" for label, reason in left_out.items())
        raise InputError(
            f"no periodic run has an excited line and an output ({said or 'no run'})",
            key="drive",
            value=drive,
            hint="name the channel that was excited periodically",
        )
    rows = range(1 + len(others), len(channels))
    levels = [_level(group, rows, excited) for group in _groups(runs)]
    # Frequencies that differ by noise alone are one.
    levels.sort(key=lambda one: (float(f"{one.fundamental:.3g}"), one.input_rms))
    return _dataset(levels, drive, wanted, units, left_out)


def has_multisine(records: Sequence[Record], drive: str) -> bool:
    """Whether any record is periodic with enough excited lines of a channel; takes no time.

    Parameters
    ----------
    records : sequence of Record
    drive : str
    """
    for record in records:
        own = record.harmonics.get(drive)
        if own is None or own.orders[-1] < FEWEST_LINES:
            continue
        amplitude, noise = np.zeros(own.orders[-1] + 1), np.zeros(own.orders[-1] + 1)
        amplitude[own.orders] = np.abs(own.coefficients)
        noise[own.orders] = np.sqrt(2.0 * own.variances)
        if excited_orders(amplitude, noise).size >= FEWEST_LINES:
            return True
    return False


def excited_orders(amplitude: Array, noise: Array) -> Integers:
    """Orders of the excited lines of an input, ascending.

    Parameters
    ----------
    amplitude : ndarray, shape (K + 1,)
        By order.
    noise : ndarray, shape (K + 1,)
        Standard deviation of the noise of each, as of a complex number; NaN where it is not known.
    """
    size = amplitude.copy()
    size[0] = 0.0
    loud = ~(size < ABOVE_NOISE * noise) & (size > SHARE * size.max())
    found = [
        k for k in np.flatnonzero(loud) if size[k] >= NEAR_SHARE * size[slice(*_near(int(k)))].max()
    ]
    return np.array(found, dtype=np.int64)


def _near(order: int) -> tuple[int, int]:
    """First order of the neighbourhood of one, and the first beyond it."""
    ratio = 2.0**OCTAVES
    low, high = min(order / ratio, order - NEAR_ORDERS), max(order * ratio, order + NEAR_ORDERS)
    return max(int(low), 1), int(high) + 1


def line_kinds(highest: int, excited: Integers, others: Integers) -> NDArray[np.str_]:
    """Kind of each order from 0 to the highest; that of 0, the mean, is empty.

    A nonlinearity makes sums and differences of excited orders, an even one of an even number of
    them. Where all excited orders are odd multiples of their greatest common divisor, even and odd
    distortion fall on different lines. An order that is no multiple of it is a subharmonic.

    Parameters
    ----------
    highest : int
    excited, others : ndarray of int
        Orders that the input excites, and those of other inputs.
    """
    orders = np.arange(highest + 1)
    every = np.union1d(excited, others)
    divisor = int(np.gcd.reduce(every))
    apart = bool(np.all((every // divisor) % 2 == 1))
    parity = np.where((orders // divisor) % 2 == 0, EVEN, ODD) if apart else MIXED
    kinds = np.where(orders % divisor == 0, parity, SUBHARMONIC).astype(f"<U{len(OTHER)}")
    kinds[0] = ""
    kinds[others[others <= highest]] = OTHER
    kinds[excited] = EXCITED
    return cast(NDArray[np.str_], kinds)


@dataclass(frozen=True)
class _Spectrum:
    """Harmonics of the channels of a run, the drive first, and the lines between them.

    Parameters
    ----------
    record : Record
    coefficients : ndarray of complex, shape (c, K + 1)
        Averaged over periods, SI.
    lines : ndarray of complex, shape (c, L)
        Spectrum of what does not repeat; zero at lines that say nothing.
    used : ndarray of bool, shape (L,)
        Lines that say something of the noise.
    low, high : ndarray of int, shape (K + 1,)
        First line of the neighbourhood of each order, and the first beyond it.
    excited, others : ndarray of int
        Orders that the drive excites, and those of other inputs.
    """

    record: Record
    coefficients: ComplexArray
    lines: ComplexArray
    used: Flags
    low: Integers
    high: Integers
    excited: Integers
    others: Integers

    @property
    def bins(self) -> Array:
        """Lines that the noise of each order is the mean of, shape (K + 1,)."""
        return _between(self.used.astype(float), self.low, self.high).real

    def variance(self, row: int, response: ComplexArray | float = 0.0) -> Array:
        """Variance of the harmonics of ``y - response u`` by noise alone, shape (K + 1,).

        That of a complex number, the sum of those of its real and its imaginary part; NaN where the
        record has no lines between harmonics.
        """
        u, y = self.lines[0], self.lines[row]
        power = _between(np.abs(y) ** 2, self.low, self.high).real
        if np.any(response):
            cross = _between(y * u.conj(), self.low, self.high)
            own = _between(np.abs(u) ** 2, self.low, self.high).real
            power = power + np.abs(response) ** 2 * own - 2.0 * (np.conj(response) * cross).real
        bins = self.bins
        return np.where(bins > 0, np.maximum(power, 0.0) / np.maximum(bins, 1.0), np.nan)

    def freedom(self, variance: Array, orders: Integers) -> float:
        """Degrees of freedom of the sum of variances at orders, whose neighbourhoods overlap.

        References
        ----------
        Satterthwaite (1946), Biometrics Bulletin 2(6), 110-114.
        """
        weight = np.zeros(self.used.size + 1)
        share = 1.0 / np.maximum(self.bins[orders], 1.0)
        np.add.at(weight, self.low[orders], share)
        np.add.at(weight, self.high[orders], -share)
        middle = 0.5 * (self.low + self.high - 1)
        level = np.interp(np.arange(self.used.size), middle, variance)
        part = np.where(self.used, np.cumsum(weight)[:-1] * level, 0.0)
        whole = float(np.sum(part**2))
        return 2.0 * float(part.sum()) ** 2 / whole if whole > 0 else 0.0


def _between(values: Array | ComplexArray, low: Integers, high: Integers) -> ComplexArray:
    """Sums of values from ``low`` to before ``high``."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    return cast(ComplexArray, total[high] - total[low])


def _channel(name: str | None, units: Mapping[str, str]) -> str:
    if name is None or name not in units:
        raise InputError(
            "no such channel", key="channel", value=name, hint=choose(name or "", list(units))
        )
    return name


def _spectra(
    records: Sequence[Record],
    channels: Sequence[str],
    others: int,
    excited: Sequence[int] | None,
    left_out: dict[str, str],
) -> Iterator[_Spectrum]:
    """Spectra of the runs that take part; the others are noted with the reason."""
    for record in records:
        if not record.periodic:
            left_out[record.label] = A_TRANSIENT
            continue
        one = _spectrum(record, channels, others, excited)
        if not one.excited.size:
            left_out[record.label] = f"no line of {channels[0]} stands out of its noise"
        elif np.intersect1d(one.excited, one.others).size:
            names = ", ".join(channels[1 : 1 + others])
            left_out[record.label] = f"{channels[0]} and another input ({names}) share lines"
        else:
            yield one


def _spectrum(
    record: Record, channels: Sequence[str], others: int, excited: Sequence[int] | None
) -> _Spectrum:
    step = record.frequency * float(record.time[-1] - record.time[0]) / (record.time.size - 1)
    values = np.array([record.samples[name] for name in channels])
    kept = 1.0
    if record.kept is not None:
        values, kept = bridged(values, ~record.kept, step), float(np.mean(record.kept))
    basis = HarmonicBasis(record.time.size, step)
    coefficients = basis.coefficients(values)
    rest = fft.rfft(values - basis.evaluate(coefficients), axis=1)
    used = _off_harmonics(rest.shape[1], basis, record)
    # A line's power is then that of a coefficient's noise; bridged samples have none.
    lines = cast(ComplexArray, np.where(used, rest, 0.0) * (2.0 / record.time.size / kept))
    low, high = _windows(used, basis, record.periods)
    none = np.empty(0, np.int64)
    made = _Spectrum(record, coefficients, lines, used, low, high, none, none)
    own, *more = (
        excited_orders(np.abs(coefficients[row]), np.sqrt(made.variance(row)))
        for row in range(1 + others)
    )
    if excited is not None:
        given = np.unique(np.asarray(excited, dtype=np.int64))
        own = given[(given > 0) & (given <= basis.highest)]
    return replace(made, excited=own, others=np.unique(np.concatenate([none, *more])))


def _off_harmonics(size: int, basis: HarmonicBasis, record: Record) -> Flags:
    """Lines that hold noise alone: half a line or more off all harmonics, and of what drift was
    removed from none."""
    if record.periods < 2:
        return np.zeros(size, dtype=bool)
    periods = basis.samples * basis.step
    orders = np.arange(size) / periods
    off = np.abs(orders - np.round(orders)) * periods >= 0.5
    terms = max((found.terms for found in record.disturbances.values()), default=0)
    off[: 1 + (terms + 1) // 2] = False
    return off


def _windows(used: Flags, basis: HarmonicBasis, periods: int) -> tuple[Integers, Integers]:
    """Neighbourhood of each order: half an order on either side, more where that has few lines."""
    length = basis.samples * basis.step
    half = max(0.5 * length, 0.5 * NOISE_LINES * length / max(periods - 1, 1))
    centre = basis.orders * length
    low = np.clip(np.ceil(centre - half), 0, used.size).astype(np.int64)
    high = np.clip(np.floor(centre + half) + 1, 0, used.size).astype(np.int64)
    return low, high


def _groups(runs: Sequence[_Spectrum]) -> list[list[list[_Spectrum]]]:
    """Runs by level, and within a level by realisation: runs of the same phases are one."""
    groups: list[list[list[_Spectrum]]] = []
    for run in runs:
        group = next((one for one in groups if _same_level(one[0][0], run)), None)
        if group is None:
            groups.append([[run]])
            continue
        alike = next((one for one in group if _same_phases(one[0], run)), None)
        if alike is None:
            group.append([run])
        else:
            alike.append(run)
    return groups


def _same_level(one: _Spectrum, other: _Spectrum) -> bool:
    """Whether two runs differ in nothing but the phases of their input."""
    a, b = one.record, other.record
    if a.group != b.group or set(a.conditions) != set(b.conditions):
        return False
    if abs(a.frequency / b.frequency - 1.0) > SAME_FREQUENCY:
        return False
    if not all(
        np.isclose(a.conditions[name], b.conditions[name], rtol=SAME_CONDITION, atol=0.0)
        for name in a.conditions
    ):
        return False
    size = min(one.coefficients.shape[1], other.coefficients.shape[1])
    first, second = np.abs(one.coefficients[0, :size]), np.abs(other.coefficients[0, :size])
    # Noise makes spectra differ too.
    noise = float(np.nansum(one.variance(0)[1:size]) + np.nansum(other.variance(0)[1:size]))
    power = float(np.sum(first[1:] ** 2))
    shift = one.coefficients[0, 0].real - other.coefficients[0, 0].real
    return bool(
        np.sum((first[1:] - second[1:]) ** 2) <= ALIKE**2 * power + 2.0 * noise
        and abs(shift) <= ALIKE * np.sqrt(0.5 * power)
    )


def _same_phases(one: _Spectrum, other: _Spectrum) -> bool:
    """Whether two inputs are the same signal but for the time at which their records begin."""
    orders = one.excited[one.excited < other.coefficients.shape[1]]
    first, second = one.coefficients[0, orders], other.coefficients[0, orders]
    length = fft.next_fast_len(32 * (int(orders[-1]) + 1))
    product = np.zeros(length, dtype=complex)
    product[orders] = first.conj() * second
    # The largest over all shifts, on a grid whose steps turn no phase by more than 0.2 rad.
    peak = float(np.max(fft.ifft(product).real)) * length
    power = [float(np.sum(np.abs(size) ** 2)) for size in (first, second)]
    noise = [float(np.nansum(run.variance(0)[orders])) for run in (one, other)]
    least = SAME_PHASES * np.sqrt(power[0] * power[1]) - 0.5 * (noise[0] + noise[1])
    return bool(peak >= least)


@dataclass(frozen=True)
class _Level:
    """Runs of one level.

    Parameters
    ----------
    fundamental : float
        Hz.
    input_rms : float
        Of the excited lines, SI.
    input_share : float
        Amplitude of the input at detection lines, without its noise, over that at excited lines;
        rms over lines.
    runs : tuple of str
    realisations, periods : int
        Periods are those of the shortest run.
    kinds : ndarray of str, shape (L,)
        Of the lines, from order 1 on.
    by_line : mapping of str to ndarray, shape (L,) or (outputs, L)
    pooled : mapping of str to ndarray, shape (outputs,) or (outputs, parities)
    """

    fundamental: float
    input_rms: float
    input_share: float
    runs: tuple[str, ...]
    realisations: int
    periods: int
    kinds: NDArray[np.str_]
    by_line: Mapping[str, Values]
    pooled: Mapping[str, Array]


def _level(
    group: list[list[_Spectrum]], rows: Sequence[int], given: Sequence[int] | None
) -> _Level:
    runs = [run for alike in group for run in alike]
    orders = min(run.coefficients.shape[1] for run in runs)
    power = np.mean([np.abs(run.coefficients[0, :orders]) ** 2 for run in runs], axis=0)
    noise = np.mean([run.variance(0)[:orders] for run in runs], axis=0)
    others = np.unique(np.concatenate([run.others for run in runs]))
    loud = excited_orders(np.sqrt(power), np.sqrt(noise))
    excited = runs[0].excited if given is not None else loud
    excited = excited[(excited < orders) & ~np.isin(excited, others)]
    highest = int(excited[-1])
    shown = min(orders - 1, max(REACH * highest, highest + BEYOND))
    kinds = line_kinds(shown, excited, others)
    found = [_Answer(group, row, kinds).found() for row in rows]
    by_line = {name: np.stack([one[name][1:] for one, _ in found]) for name in found[0][0]}
    by_line["input_amplitude"] = np.sqrt(power[1 : shown + 1])
    by_line["input_noise"] = np.sqrt(noise[1 : shown + 1])
    return _Level(
        fundamental=float(np.mean([run.record.frequency for run in runs])),
        input_rms=float(np.sqrt(0.5 * np.sum(power[excited]))),
        input_share=_share(power[: shown + 1], noise[: shown + 1], kinds),
        runs=tuple(run.record.label for run in runs),
        realisations=len(group),
        periods=min(run.record.periods for run in runs),
        kinds=kinds[1:],
        by_line=by_line,
        pooled={name: np.array([one[name] for _, one in found]) for name in found[0][1]},
    )


def _share(power: Array, noise: Array, kinds: NDArray[np.str_]) -> float:
    """Amplitude of an input at detection lines over that at excited lines; NaN without such."""
    lines = np.isin(kinds, PARITIES) & within_band(kinds)
    if not lines.any():
        return float("nan")
    excess = np.mean(power[lines] - np.nan_to_num(noise[lines]))
    return float(np.sqrt(max(excess, 0.0) / np.mean(power[kinds == EXCITED])))


def within_band(kinds: NDArray[np.str_]) -> Flags:
    """Lines by which a level is judged: of a multisine those from its first to its last excited.

    Only there the part of the input is known and removed.

    Parameters
    ----------
    kinds : ndarray of str, shape (L,)
        Ascending by frequency.
    """
    excited, place = np.flatnonzero(kinds == EXCITED), np.arange(kinds.size)
    if excited.size < FEWEST_LINES:
        return np.asarray(kinds != "")
    return np.asarray((place >= excited[0]) & (place <= excited[-1]))


@dataclass(frozen=True)
class _Answer:
    """What one output of a level shows.

    Parameters
    ----------
    group : list
        Realisations, each a list of runs.
    row : int
        Of the output among the channels.
    kinds : ndarray of str, shape (L + 1,)
        Of the orders from 0 on.
    """

    group: list[list[_Spectrum]]
    row: int
    kinds: NDArray[np.str_]

    @property
    def runs(self) -> list[_Spectrum]:
        """All runs of the level."""
        return [run for alike in self.group for run in alike]

    @cached_property
    def excited(self) -> Integers:
        """Orders that are excited."""
        return np.flatnonzero(self.kinds == EXCITED)

    @cached_property
    def realisations(self) -> ComplexArray:
        """Response by realisation at the excited lines, shape (M, E)."""

        def ratio(run: _Spectrum) -> ComplexArray:
            found = run.coefficients[:, self.excited]
            return cast(ComplexArray, found[self.row] / found[0])

        return np.array([np.mean([ratio(run) for run in alike], axis=0) for alike in self.group])

    @cached_property
    def response(self) -> ComplexArray:
        """Mean response, shape (L + 1,); between excited lines interpolated, zero beyond them."""
        orders, mean = np.arange(self.kinds.size), np.mean(self.realisations, axis=0)
        return cast(ComplexArray, np.interp(orders, self.excited, mean, left=0.0, right=0.0))

    def noise(self, run: _Spectrum) -> Array:
        """Variance of ``Y - G U`` of a run by noise, shape (L + 1,)."""
        whole = np.zeros(run.coefficients.shape[1], dtype=complex)
        whole[: self.kinds.size] = self.response
        return run.variance(self.row, whole)

    def found(self) -> tuple[dict[str, Values], dict[str, Array]]:
        """Values by line, from order 0 on, and those of all lines of a kind together."""
        approximation, stochastic = self._at_excited_lines()
        amplitude, noise, by_line = self._by_line()
        return {**approximation, **by_line}, {**stochastic, **self._detected(amplitude, noise)}

    def _at_excited_lines(self) -> tuple[dict[str, Values], dict[str, Array]]:
        """The best linear approximation with its variances, and the stochastic distortion."""
        count, lines = len(self.group), self.excited
        u = np.mean([np.abs(run.coefficients[0, lines]) ** 2 for run in self.runs], axis=0)
        # A realisation is the mean of its runs.
        parts = [
            (
                run,
                self.noise(run)[lines] / np.abs(run.coefficients[0, lines]) ** 2 / len(alike) ** 2,
            )
            for alike in self.group
            for run in alike
        ]
        noise = np.sum([variance for _, variance in parts], axis=0) / count**2
        total = np.full(lines.size, np.nan)
        if count > 1:
            away = np.abs(self.realisations - self.response[lines]) ** 2
            total = away.sum(axis=0) / (count * (count - 1))
        free = _joint([(np.sum(u * part), self._freedom(run, lines)) for run, part in parts])
        expected = u * count * noise
        measured = np.sum(u * count * total)
        pooled = {
            "stochastic": np.sqrt(0.5 * measured),
            "stochastic_noise": np.sqrt(0.5 * expected.sum()),
            "stochastic_p": _chance(measured, expected, 2.0 * (count - 1), free),
        }
        by_line: dict[str, Values] = {
            "response": self._on_lines(self.response[lines]),
            "noise_sd": self._on_lines(np.sqrt(noise)),
            "total_sd": self._on_lines(np.sqrt(total)),
            "distortion_sd": self._on_lines(np.sqrt(np.maximum(count * (total - noise), 0.0))),
        }
        return by_line, pooled

    def _by_line(self) -> tuple[Array, Array, dict[str, Values]]:
        """Power of the output at all lines by run, that of its noise, and what is shown of both."""
        size, excited = self.kinds.size, self.kinds == EXCITED
        ours = np.where(excited, 0.0, self.response)
        linear = np.array([ours * run.coefficients[0, :size] for run in self.runs])
        output = np.array([run.coefficients[self.row, :size] for run in self.runs])
        power = np.abs(output - linear) ** 2
        noise = np.array(
            [
                np.where(excited, run.variance(self.row)[:size], self.noise(run)[:size])
                for run in self.runs
            ]
        )
        bins = np.sum([run.bins[:size] for run in self.runs], axis=0)
        p = _survival(power.mean(axis=0), noise.mean(axis=0), 2.0 * len(self.runs), 2.0 * bins)
        return power, noise, {
            "output_amplitude": np.sqrt(power.mean(axis=0)),
            "output_noise": np.sqrt(noise.mean(axis=0)),
            "input_part": np.sqrt(np.mean(np.abs(linear) ** 2, axis=0)),
            "p_value": np.where(np.isin(self.kinds, PARITIES), p, np.nan),
        }  # fmt: skip

    def _detected(self, power: Array, noise: Array) -> dict[str, Array]:
        """Distortion at all detection lines of a kind together."""
        inside = within_band(self.kinds)
        found = np.full((3, len(PARITIES)), np.nan)
        for k, parity in enumerate(PARITIES):
            lines = np.flatnonzero((self.kinds == parity) & inside)
            if not lines.size:
                continue
            expected = noise[:, lines].ravel()
            free = _joint(
                [
                    (own[lines].sum(), self._freedom(run, lines))
                    for run, own in zip(self.runs, noise, strict=True)
                ]
            )
            measured = power[:, lines].sum()
            mean = 0.5 / len(self.runs)
            found[:, k] = (
                np.sqrt(mean * measured),
                np.sqrt(mean * expected.sum()),
                _chance(measured, expected, 2.0, free),
            )
        return dict(zip(("distortion", "distortion_noise", "distortion_p"), found, strict=True))

    def _noise_of_ratio(self, run: _Spectrum) -> Array:
        """Variance of the response by noise, from one run, at the excited lines."""
        power = np.abs(run.coefficients[0, self.excited]) ** 2
        return cast(Array, self.noise(run)[self.excited] / power)

    def _freedom(self, run: _Spectrum, lines: Integers) -> float:
        return run.freedom(self.noise(run), lines)

    def _on_lines(self, values: Values) -> Values:
        """Values at the excited lines, and NaN at all other orders."""
        spread = np.full(self.kinds.size, np.nan, dtype=values.dtype)
        spread[self.excited] = values
        return spread


def _joint(parts: Sequence[tuple[float, float]]) -> float:
    """Degrees of freedom of a sum of independent variances, each with its own."""
    values = np.array(parts)
    if not np.all(values[:, 1] > 0) or not values[:, 0].any():
        return 0.0
    return float(values[:, 0].sum() ** 2 / np.sum(values[:, 0] ** 2 / values[:, 1]))


def _chance(measured: float, expected: Array, each: float, free: float) -> float:
    """Probability of a sum of powers as large by noise alone.

    Parameters
    ----------
    measured : float
        The sum.
    expected : ndarray, shape (n,)
        What noise makes of each power.
    each : float
        Degrees of freedom of each power.
    free : float
        Those of the sum of ``expected``.
    """
    whole = float(np.sum(expected**2))
    own = each * float(expected.sum()) ** 2 / whole if whole > 0 else 0.0
    return float(_survival(np.array(measured), np.array(expected.sum()), own, np.array(free)))


def _survival(measured: Array, expected: Array, each: float, free: Array) -> Array:
    """Survival function of the ratio of two powers; NaN where either has no degrees of freedom."""
    known = (each > 0) & (free > 0) & np.isfinite(measured) & (expected > 0)
    ratio = np.divide(measured, expected, out=np.zeros_like(measured), where=known)
    p = distributions.f.sf(ratio, max(each, 1.0), np.where(known, free, 1.0))
    return np.where(known, p, np.nan)


_ABOUT = {
    "response": "best linear approximation",
    "noise_sd": "standard deviation of the response by noise",
    "total_sd": "standard deviation of the response by noise and stochastic distortion",
    "distortion_sd": "standard deviation of the stochastic distortion of one realisation",
    "output_amplitude": "amplitude of the output, rms over runs",
    "output_noise": "standard deviation of that amplitude by noise",
    "input_part": "amplitude removed as the response to the input's own distortion",
    "p_value": "probability of so large an amplitude by noise alone",
    "input_amplitude": "amplitude of the input, rms over runs",
    "input_noise": "standard deviation of that amplitude by noise",
    "distortion": "rms of the output at all detection lines of a kind",
    "distortion_noise": "rms of its noise there",
    "distortion_p": "probability of so large an output there by noise alone",
    "stochastic": "rms scatter between realisations, at all excited lines",
    "stochastic_noise": "rms of its part by noise",
    "stochastic_p": "probability of so large a scatter by noise alone",
}
_RATIOS = ("response", "noise_sd", "total_sd", "distortion_sd")
_CHANCES = ("p_value", "distortion_p", "stochastic_p")


def _dataset(
    levels: Sequence[_Level],
    drive: str,
    outputs: Sequence[str],
    units: Mapping[str, str],
    left_out: Mapping[str, str],
) -> xr.Dataset:
    """Levels side by side; shorter ones are padded."""
    longest = max(level.kinds.size for level in levels)
    order = np.arange(1, longest + 1)
    kinds = np.array([np.pad(lev.kinds, (0, longest - lev.kinds.size)) for lev in levels])
    frequency = np.array([level.fundamental * order for level in levels])
    rows = (LEVEL, LINE)
    found = {
        schema.FREQUENCY: variable(
            rows, np.where(kinds == "", np.nan, frequency), "frequency of a line", "Hz"
        ),
        KIND: variable(rows, kinds, "what a line is", ""),
    }
    for name in levels[0].by_line:
        values = np.stack([_padded(level.by_line[name], longest) for level in levels], axis=-2)
        found[name] = variable(
            (schema.OUTPUT, *rows)[-values.ndim :],
            values,
            _ABOUT[name],
            _unit(name, outputs, drive, units),
        )
    for name in levels[0].pooled:
        values = np.stack([level.pooled[name] for level in levels], axis=1)
        dims = (schema.OUTPUT, LEVEL, PARITY)[: values.ndim]
        found[name] = variable(dims, values, _ABOUT[name], _unit(name, outputs, drive, units))
    coords = {
        schema.OUTPUT: list(outputs),
        "order": (LINE, order),
        PARITY: list(PARITIES),
        "output_unit": (schema.OUTPUT, [units[name] for name in outputs]),
        "fundamental": variable((LEVEL,), [one.fundamental for one in levels], "frequency", "Hz"),
        "input_rms": variable(
            (LEVEL,), [one.input_rms for one in levels], "rms of the excited lines", units[drive]
        ),
        "input_share": variable(
            (LEVEL,),
            [one.input_share for one in levels],
            "amplitude of the input at detection lines over that at excited lines",
            "1",
        ),
        "realisations": (LEVEL, [level.realisations for level in levels]),
        schema.PERIODS: (LEVEL, [level.periods for level in levels]),
        schema.RUNS: (LEVEL, [json.dumps(level.runs, ensure_ascii=False) for level in levels]),
    }
    return xr.Dataset(found, coords, {"drive": drive, "left_out": json.dumps(dict(left_out))})


def _padded(values: Values, longest: int) -> Values:
    more = [(0, 0)] * (values.ndim - 1) + [(0, longest - values.shape[-1])]
    return np.pad(values, more, constant_values=np.nan)


def _unit(name: str, outputs: Sequence[str], drive: str, units: Mapping[str, str]) -> str:
    """SI unit of a variable; empty where outputs have several, of which ``output_unit`` tells."""
    if name in _CHANCES:
        return "1"
    if name.startswith("input_a") or name == "input_noise":
        return units[drive]
    own = {units[output] for output in outputs}
    if len(own) > 1:
        return ""
    return ratio_unit(own.pop(), units[drive]) if name in _RATIOS else own.pop()


def ratio_unit(output: str, drive: str) -> str:
    """SI unit of a response."""
    if output == drive:
        return "1"
    if drive in ("", "1"):
        return output
    return f"{output or 1}/({drive})" if re.search(r"\W", drive) else f"{output or 1}/{drive}"


def stored(data: xr.Dataset) -> xr.Dataset:
    """The same with real numbers only, as files of results hold them.

    Parameters
    ----------
    data : Dataset
        Of :func:`frequency_response`.
    """
    response = data["response"]
    parts = np.stack([response.values.real, response.values.imag], axis=-1)
    dims = (*map(str, response.dims), schema.PART)
    return data.assign(response=(dims, parts, response.attrs)).assign_coords(
        {schema.PART: ["real", "imaginary"]}
    )
