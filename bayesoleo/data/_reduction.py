"""Reduction of a campaign to records: frequency, settled periods, harmonics, noise.

A record is mapped to a regular grid of one period for solvers and figures. The thesis maps one
period by linear interpolation (Verbeek 1993, appendix B). The band-limited map uses all periods at
once: a least-squares fit of the harmonics that the samples determine, evaluated on the grid. It
adds no error to a signal without higher harmonics.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import numpy as np

from bayesoleo._parallel import single_blas_thread, thread_map
from bayesoleo._types import Array
from bayesoleo.data._campaign import CampaignData
from bayesoleo.data._fourier import HarmonicBasis
from bayesoleo.data._harmonics import significant_harmonics, within_bandwidth
from bayesoleo.data._held_inputs import between_samples, held_harmonics
from bayesoleo.data._noise import (
    average_on,
    jumps,
    noise_beside_jumps,
    periodic_average,
    scatter_about_levels,
)
from bayesoleo.data._quiet_channels import with_quiet_channels
from bayesoleo.data._residual_time_shift import Frequency, find_frequency
from bayesoleo.data._run_samples import Run
from bayesoleo.data._sample_quality import (
    bridged,
    masked,
    sample_count,
    settled_start,
    step_of,
    whole_periods,
)
from bayesoleo.errors import CampaignError, InputError, choose
from bayesoleo.prediction._band_limited import Smoothed, band_limited_channels, sample_noise
from bayesoleo.prediction._records import Harmonics, Record

Method = Literal["band-limited", "linear"]

#: Differences between samples of a command tell its noise up to this part of its deviation.
MOST_NOISE = 0.3


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


@dataclass(frozen=True)
class ReducedCampaign:
    """A campaign with its runs reduced to records.

    Parameters
    ----------
    campaign : CampaignData
        What was loaded.
    records : tuple of Record
        One a run, in the campaign's order.
    """

    campaign: CampaignData
    records: tuple[Record, ...]

    def record(self, label: str) -> Record:
        """The record of a run.

        Parameters
        ----------
        label : str
            The run's label.

        Raises
        ------
        CampaignError
            If there is none, with those there are.
        """
        for record in self.records:
            if record.label == label:
                return record
        raise CampaignError(
            "no such run", run=label, hint=choose(label, [r.label for r in self.records])
        )


def reduce_campaign(
    campaign: CampaignData, jobs: int | None = None, progress: bool | float = False
) -> ReducedCampaign:
    """Reduce all runs of a campaign.

    Parameters
    ----------
    campaign : CampaignData
        From :func:`load_campaign`.
    jobs : int, optional
        Threads; by default the cores this process may use.
    progress : bool or float
        Show a progress bar, at once or after so many seconds.

    Returns
    -------
    ReducedCampaign
        One record a run.

    Raises
    ------
    CampaignError
        If a run does not repeat near its declared frequency, or holds fewer than two periods.
    """
    if not progress:
        records = tuple(thread_map(reduce_run, campaign.runs, jobs))
        return ReducedCampaign(campaign, with_quiet_channels(records))
    from tqdm.auto import tqdm

    delay = 0.0 if progress is True else progress
    with tqdm(total=len(campaign.runs), desc="reduce", unit="run", delay=delay) as bar:

        def reduce_and_count(run: Run) -> Record:
            record = reduce_run(run)
            bar.update()
            return record

        records = tuple(thread_map(reduce_and_count, campaign.runs, jobs))
    return ReducedCampaign(campaign, with_quiet_channels(records))


@single_blas_thread()  # matrices are small: threads take longer to meet than to work
def reduce_run(run: Run) -> Record:
    """Reduce one run.

    Periodic: the frequency is refined, leading periods that have not settled are left out, and the
    last whole periods are kept.

    Parameters
    ----------
    run : Run
        From a loaded campaign.

    Returns
    -------
    Record
        Raw samples over whole periods with harmonics and noise, SI.

    Raises
    ------
    CampaignError
        If the run does not repeat near its declared frequency, or holds fewer than two periods.
    """
    if run.frequency is None:
        return _transient(run)
    names, values = list(run.samples), np.array(list(run.samples.values()))
    away = masked(run.time, run.mask)
    try:
        found, first, dropped = _settle(bridged(values, away), run.time_step, run.frequency)
        if away.any():
            # Only now is it known what the masked samples have to be bridged with.
            values = bridged(values, away, found.value * run.time_step)
            found, first, dropped = _settle(values, run.time_step, found.value)
    except CampaignError as error:
        raise CampaignError(
            error.problem,
            file=run.file,
            run=run.label,
            key=error.key,
            value=error.value,
            hint=error.hint,
        ) from error
    time = run.time[first:]
    step = found.value * run.time_step
    basis = HarmonicBasis(time.size, step)
    kept = {name: channel[first:] for name, channel in zip(names, values, strict=True)}
    # Bridged samples have no noise.
    noisy = 1.0 / np.sqrt(1.0 - away[first:].sum() / (time.size - basis.size))
    return _record(
        run,
        time,
        {name: values[first:] for name, values in run.samples.items()},
        frequency=found.value,
        frequency_sd=found.sd,
        periods=int(np.floor(time.size * step + 0.5)),
        harmonics={
            name: _as_input(run, name, significant_harmonics(basis, channel), found.value)
            for name, channel in kept.items()
        },
        signal_noise={
            name: noisy * average_on(basis, channel).sigma for name, channel in kept.items()
        },
        dropped_periods=dropped,
        kept=~away[first:] if away[first:].any() else None,
    )


def _as_input(run: Run, name: str, item: Harmonics, frequency: float) -> Harmonics:
    """Harmonics by which a channel acts."""
    found = within_bandwidth(item, frequency, run.bandwidths.get(name))
    return held_harmonics(found, frequency, run.time_step) if name in run.held else found


def _settle(values: Array, time_step: float, nominal: float) -> tuple[Frequency, int, int]:
    """Frequency, first sample to keep, and number of unsettled periods left out before it."""
    found = find_frequency(values, time_step, nominal)
    samples = values.shape[1]
    if whole_periods(samples, found.value * time_step) < 2:
        raise CampaignError(
            f"fewer than two periods of {1.0 / found.value:.6g} s in {samples * time_step:.6g} s",
            key="frequency",
            value=nominal,
            hint="record two periods or more",
        )
    first, dropped = settled_start(values, found.value * time_step)
    if dropped:
        # The periods left out had pulled on the frequency.
        found = find_frequency(values[:, first:], time_step, found.value)
        periods = whole_periods(samples, found.value * time_step) - dropped
        first = max(0, samples - sample_count(periods, found.value * time_step))
    return found, first, dropped


def _record(run: Run, time: Array, samples: Mapping[str, Array], **reduced: Any) -> Record:
    return Record(
        label=run.label,
        group=run.group,
        role=run.role,
        kind=run.kind,
        # Writable copies: kernels would compile once more for read-only arrays.
        time=np.array(time),
        samples={name: np.array(values) for name, values in samples.items()},
        conditions=run.conditions,
        condition_sd=run.condition_sd,
        **reduced,
    )


def _transient(run: Run) -> Record:
    step, away = run.time_step, masked(run.time, run.mask)
    whole = bridged(np.array(list(run.samples.values())), away)
    noise = {
        name: _transient_noise(x[~away], sample_noise(values, step), name in run.held)
        for (name, x), values in zip(run.samples.items(), whole, strict=True)
    }
    curves = band_limited_channels(
        {
            name: between_samples(values) if name in run.held else np.array(values)
            for name, values in zip(run.samples, whole, strict=True)
        },
        step,
        {name: step_of(x[~away]) for name, x in run.samples.items()},
        run.bandwidths,
    )
    return _record(
        run,
        run.time,
        run.samples,
        frequency=float("nan"),
        frequency_sd=float("nan"),
        periods=0,
        harmonics={},
        signal_noise=noise,
        smoothed={
            name: _with_noise(curve, run.samples[name][~away], noise[name])
            for name, curve in curves.items()
        },
        kept=~away if away.any() else None,
    )


def _with_noise(curve: Smoothed, values: Array, noise: float) -> Smoothed:
    """A curve that jumps, with its noise: its spectrum has no floor that would tell it."""
    if not (curve.noise == 0.0 and noise > 0.0 and jumps(values).any()):
        return curve
    derivatives = tuple(
        replace(one, noise=noise) if one.noise == 0.0 else one for one in curve.derivatives
    )
    return replace(curve, noise=noise, derivatives=derivatives)


def _transient_noise(values: Array, floor: float, held: bool) -> float:
    """Standard deviation of a transient's sample; not a number where nothing tells it.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Samples that count.
    floor : float
        By the lowest part of the spectrum.
    held : bool
        Whether a controller holds the channel from one sample to the next: what changes at every
        sample is then its command, and differences say nothing of noise.
    """
    found = min(noise_beside_jumps(values), floor, scatter_about_levels(values))
    smooth = found <= MOST_NOISE * float(np.std(values))
    return found if smooth or not held or jumps(values).any() else float("nan")
