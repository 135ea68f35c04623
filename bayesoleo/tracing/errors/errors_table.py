"""The error of a prediction, held against the noise: by run and output, and by role."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesoleo.data import PeriodicAverage, periodic_average
from bayesoleo.data.local_average import LocalAverage, local_average
from bayesoleo.data.noise_spectrum import NoiseSpectrum, noise_spectrum
from bayesoleo.data.resolution import rounding_in_average
from bayesoleo.parallel import thread_map
from bayesoleo.prediction.input_noise import input_columns
from bayesoleo.prediction.records import Record
from bayesoleo.tracing.errors.holdout import Prediction
from bayesoleo.tracing.fitting.masked import counted, of_those_counted, weights, without_masked

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RunError:
    """Error of one output in one run.

    Parameters
    ----------
    run, role, output : str
        Where.
    rms : float
        Root mean square over the raw samples, SI.
    average : PeriodicAverage or LocalAverage
        The residual averaged over the recorded periods; of a transient, over neighbouring samples.
    input_noise : float
        Part of the noise that comes from the input, SI.
    spectrum : NoiseSpectrum or None
        Of the noise that does not repeat; ``None`` for a transient.
    rounding : float
        Part of the noise that comes from rounding to coarse steps and repeats in every period, SI.
    """

    run: str
    role: str
    output: str
    rms: float
    average: PeriodicAverage | LocalAverage
    input_noise: float
    spectrum: NoiseSpectrum | None = None
    rounding: float = 0.0

    @property
    def repeating(self) -> float:
        """Root mean square of the averaged residual."""
        return self.average.repeating

    @property
    def noise(self) -> float:
        """Standard error of that average, the input's noise and repeated rounding included."""
        own = self.average.noise if self.spectrum is None else self.spectrum.noise
        return float(np.sqrt(own**2 + self.input_noise**2 + self.rounding**2))

    @property
    def sigma(self) -> float:
        """Noise of a single sample, with what repeats as large as many periods would average it."""
        periods = self.average.samples / max(self.average.number, 1)
        return float(np.hypot(self.average.sigma, self.rounding * np.sqrt(periods)))

    @property
    def coefficients(self) -> float:
        """Degrees of freedom of the averaged residual, were it noise."""
        return self.average.number if self.spectrum is None else self.spectrum.coefficients

    @property
    def free(self) -> float:
        """Degrees of freedom that its noise was measured with."""
        if self.spectrum is None:
            return self.average.samples - self.average.number
        return self.spectrum.free

    @property
    def ratio(self) -> float:
        """``repeating / noise``: one where nothing is missing."""
        return self.repeating / self.noise


@dataclass(frozen=True)
class ErrorTable:
    """Errors of all runs and outputs."""

    entries: tuple[RunError, ...]

    def at(self, output: str, run: str) -> RunError:
        """Error of one output in one run."""
        return next(e for e in self.entries if e.output == output and e.run == run)

    @property
    def outputs(self) -> tuple[str, ...]:
        """Outputs in their order."""
        return tuple(dict.fromkeys(entry.output for entry in self.entries))

    def worst_ratio(self, role: str | None = None) -> float:
        """Largest ratio over outputs of the ratio pooled over runs of a role."""
        roles = {entry.role for entry in self.entries} if role is None else {role}
        ratios = [self.pooled(r, o)["ratio_to_noise"] for r in roles for o in self.outputs]
        return float(np.max(ratios))  # not the built-in: a run that could not be solved must show

    def pooled(self, role: str, output: str) -> dict[str, float]:
        """Root mean squares over the runs of a role: ``rms``, ``repeating``, ``ratio_to_noise``."""
        chosen = [e for e in self.entries if e.role == role and e.output == output]

        def mean(values: Sequence[float]) -> float:
            return float(np.sqrt(np.mean(np.square(values))))

        return {
            "rms": mean([e.rms for e in chosen]),
            "repeating": mean([e.repeating for e in chosen]),
            "ratio_to_noise": mean([e.ratio for e in chosen]),
        }

    def by_run(self) -> dict[str, dict[str, dict[str, Any]]]:
        """As in the summary: output, run, then role, rms, repeating, noise and ratio."""
        table: dict[str, dict[str, dict[str, Any]]] = {output: {} for output in self.outputs}
        for e in self.entries:
            table[e.output][e.run] = {
                "role": e.role,
                "rms": e.rms,
                "repeating": e.repeating,
                "noise": e.noise,
                "ratio_to_noise": e.ratio,
            }
        return table

    def by_role(self) -> dict[str, dict[str, dict[str, float]]]:
        """As in the summary: role, output, then rms, repeating and ratio."""
        roles = dict.fromkeys(entry.role for entry in self.entries)
        return {
            role: {output: self.pooled(role, output) for output in self.outputs} for role in roles
        }


def error_table(
    predictions: Sequence[Prediction], roles: Mapping[str, str], *, jobs: int | None = None
) -> ErrorTable:
    """Compare predictions with what was measured.

    Parameters
    ----------
    predictions : sequence of Prediction
        One a run.
    roles : mapping of str to str
        Role of each run by label.
    jobs : int, optional
        Threads.

    Returns
    -------
    ErrorTable
    """
    rows = thread_map(lambda prediction: _of_run(prediction, roles), predictions, jobs)
    return ErrorTable(tuple(entry for row in rows for entry in row))


def _of_run(prediction: Prediction, roles: Mapping[str, str]) -> list[RunError]:
    record, predictor = prediction.record, prediction.predictor
    columns = input_columns(predictor.runs[0], predictor.constants(prediction.vector[None], 0)[0])
    spread = np.sqrt(np.mean(np.sum(columns**2, axis=1), axis=1))
    entries = []
    for b, output in enumerate(predictor.outputs):
        measured = record.samples[output] - prediction.y[b]
        residual = without_masked(record, measured)
        average = _average(record, residual)
        rms = float(np.sqrt(np.mean(measured[weights(record) > 0] ** 2)))
        entries.append(
            RunError(
                record.label,
                roles[record.label],
                output,
                rms,
                average,
                float(spread[b]),
                _spectrum(record, residual, average),
                rounding_in_average(record, output),
            )
        )
    return entries


def _spectrum(
    record: Record, residual: Array, average: PeriodicAverage | LocalAverage
) -> NoiseSpectrum | None:
    if not record.periodic or not np.isfinite(residual).all():
        return None
    # What was bridged does not scatter: as much as is missing has to be made up for.
    part = counted(record) / record.time.size
    return noise_spectrum((residual - average.values) / part, record.periods)


def _average(record: Record, residual: Array) -> PeriodicAverage | LocalAverage:
    if not record.periodic:
        return local_average(residual)
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    return of_those_counted(record, periodic_average(residual, step, record.frequency))
