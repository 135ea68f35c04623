"""Parametric bootstrap: new data from a problem's prediction at given parameters, with new noise.

Noise of measured inputs is drawn anew as well: the data come from the true inputs, and the
estimator sees noisy ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, cast

import numpy as np

from bayesoleo._types import Array, Integers
from bayesoleo.errors import InputError
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._least_squares import BatchProblem
from bayesoleo.estimation._problem import EstimationProblem, Evaluation, Misfit, SameData
from bayesoleo.model._priors import Prior
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Harmonics, Record
from bayesoleo.prediction._run_errors import input_columns
from bayesoleo.solvers._orbit import Status


@dataclass(frozen=True)
class NoiseBlock:
    """Samples whose noise is correlated among themselves at most: those of one run.

    Parameters
    ----------
    sensitivity : ndarray, shape (n, l)
        Derivatives of the prediction, all outputs one after the other.
    output : ndarray of int, shape (n,)
        Output that each sample belongs to.
    sd : ndarray, shape (n,)
        Standard deviation of its independent noise.
    columns : ndarray, shape (n, k)
        What one standard deviation of each of ``k`` common sources of noise does to it: those of
        the measured inputs.
    """

    sensitivity: Array
    output: Integers
    sd: Array
    columns: Array


class DataSource(Protocol):
    """Makes replications of an experiment."""

    def draw(self, rng: np.random.Generator) -> EstimationProblem:
        """The same problem with new data."""

    @property
    def batch(self) -> BatchProblem | None:
        """The problem, where only its outputs are drawn anew and many data sets fit at once."""

    def outputs(self, rng: np.random.Generator) -> tuple[Array, ...]:
        """New measured samples of each output, runs one after the other; only with a batch."""

    def blocks(self) -> list[NoiseBlock]:
        """The noise of the data and the sensitivities at the true parameters."""


def data_source(
    problem: EstimationProblem,
    theta: Array,
    variance: Array | None = None,
    *,
    input_noise: bool = True,
) -> DataSource:
    """Where new data for a problem come from.

    Parameters
    ----------
    problem : EstimationProblem
        Its measured outputs do not enter, only when and at what inputs they were measured.
    theta : ndarray, shape (l,)
        True parameters.
    variance : ndarray, shape (s,), optional
        Noise variance of each output. Of a campaign it is by default what each run's record says.
    input_noise : bool, optional
        Whether measured inputs get new noise; there are none outside a campaign.

    Raises
    ------
    InputError
        If the problem cannot be evaluated at ``theta``, or the variance is missing.
    """
    if isinstance(problem, CampaignProblem):
        return CampaignSource(problem, theta, variance, input_noise)
    if variance is None:
        raise InputError(
            "the noise of the outputs is not known",
            key="variance",
            hint="pass one variance per output, for example that of an estimate",
        )
    return ResidualSource(problem, theta, variance)


class ResidualSource:
    """Replications of any problem, by way of its residuals.

    With data ``yhat(theta*) + noise`` the residual at ``theta`` is ``e(theta) - e(theta*) +
    noise``, so that the data themselves are not needed.
    """

    def __init__(self, problem: EstimationProblem, theta: Array, variance: Array) -> None:
        self.problem = problem
        self.truth = _checked(problem.evaluate(np.array(theta, dtype=float)))
        self.sd = np.sqrt(_one_each(variance, problem.outputs))

    @property
    def batch(self) -> BatchProblem | None:
        return self.problem if isinstance(self.problem, BatchProblem) else None

    def outputs(self, rng: np.random.Generator) -> tuple[Array, ...]:
        assert self.batch is not None
        pairs = zip(self.batch.data, self._shift(rng), strict=True)
        return tuple(np.asarray(y + shift, dtype=float) for y, shift in pairs)

    def draw(self, rng: np.random.Generator) -> EstimationProblem:
        return Shifted(self.problem, self._shift(rng))

    def _shift(self, rng: np.random.Generator) -> tuple[Array, ...]:
        pairs = zip(self.sd, self.truth.residual, strict=True)
        return tuple(sd * rng.standard_normal(e.size) - e for sd, e in pairs)

    def blocks(self) -> list[NoiseBlock]:
        sizes = [e.size for e in self.truth.residual]
        return [
            NoiseBlock(
                sensitivity=np.concatenate(self.truth.sensitivity),
                output=np.repeat(np.arange(len(sizes)), sizes),
                sd=np.repeat(self.sd, sizes),
                columns=np.zeros((sum(sizes), 0)),
            )
        ]


class Shifted(SameData):
    """A problem whose measured outputs are moved by a known amount.

    Parameters
    ----------
    problem : EstimationProblem
    shift : tuple of ndarray, each shape (n_b,)
        Added to the measured samples of each output.
    """

    def __init__(self, problem: EstimationProblem, shift: tuple[Array, ...]) -> None:
        super().__init__(problem)
        self.shift = shift

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return self.problem.names

    @property
    def priors(self) -> tuple[Prior, ...]:
        """Prior of each unknown."""
        return self.problem.priors

    @property
    def nuisances(self) -> frozenset[str]:
        """Unknowns whose prior is a measurement."""
        return frozenset(getattr(self.problem, "nuisances", ()))

    @property
    def start(self) -> Array:
        """Where an estimate starts, shape (l,)."""
        return self.problem.start

    def evaluate(self, theta: Array) -> Evaluation:
        """Residuals and sensitivities at one vector, shape (l,)."""
        found = self.problem.evaluate(theta)
        moved = tuple(e + d for e, d in zip(found.residual, self.shift, strict=True))
        return replace(found, residual=moved)

    def misfit(self, theta: Array) -> Misfit:
        """Sums of squares at many vectors, shape (L, l)."""
        vectors = np.atleast_2d(np.asarray(theta, dtype=float))
        counts = np.asarray(self.counts)
        sums = np.full((len(vectors), *counts.shape), np.nan)
        status = np.zeros(len(vectors), dtype=np.int64)
        for row, vector in enumerate(vectors):
            found = self.evaluate(vector)
            status[row] = found.status
            if found.status.ok:
                for b, residual in enumerate(found.residual):
                    parts = np.split(residual, np.cumsum(counts[:-1, b]))
                    sums[row, :, b] = [float(part @ part) for part in parts]
        return Misfit(sums, status)


class CampaignSource:
    """Replications of a campaign: new noise on its outputs and on the harmonics of its inputs.

    The frequency of each run is taken as known.
    """

    def __init__(
        self, problem: CampaignProblem, theta: Array, variance: Array | None, input_noise: bool
    ) -> None:
        self.problem, self.input_noise = problem, input_noise
        self.theta = np.array(theta, dtype=float)
        _checked(problem.evaluate(self.theta))
        predictor = problem.predictor
        known = set(predictor.model.inputs) & set(problem.outputs)
        if known:
            raise InputError("a channel is both input and output", key=", ".join(sorted(known)))
        transient = [record.label for record in predictor.records if not record.periodic]
        if input_noise and transient:
            raise InputError(
                "new noise is not drawn for the input of a transient",
                run=transient[0],
                key="input_noise",
                hint="use input_noise=False, or periodic runs only",
            )
        names = predictor.layout.names
        self.free = np.array([names.index(name) for name in problem.names], dtype=np.int64)
        self.truth = predictor.predict(problem.full(self.theta[None])[0])
        self.sd = np.array(
            [[record.signal_noise[name] for name in problem.outputs] for record in self.records]
        )
        if variance is not None:
            self.sd[:] = np.sqrt(_one_each(variance, problem.outputs))
        if not np.isfinite(self.sd).all():
            raise InputError(
                "the noise of an output is unknown", key="variance", hint="give its variance"
            )

    @property
    def records(self) -> Sequence[Record]:
        """The runs as measured."""
        return self.problem.predictor.records

    @property
    def batch(self) -> BatchProblem | None:
        """Only with true inputs: noisy ones differ from one data set to the next."""
        if self.input_noise:
            return None
        self.problem.freeze(self.theta)
        return self.problem

    def outputs(self, rng: np.random.Generator) -> tuple[Array, ...]:
        drawn = [self._outputs(r, rng) for r in range(len(self.records))]
        drawn = [self.problem.kept(r, run) for r, run in enumerate(drawn)]
        return tuple(np.concatenate([run[b] for run in drawn]) for b in range(self.sd.shape[1]))

    def _outputs(self, r: int, rng: np.random.Generator) -> Array:
        """New samples of one run, shape (s, n)."""
        y = self.truth[r].y
        return cast(Array, y + self.sd[r][:, None] * rng.standard_normal(y.shape))

    def draw(self, rng: np.random.Generator) -> EstimationProblem:
        old = self.problem.predictor
        records = [self._record(r, rng) for r in range(len(self.records))]
        predictor = Predictor(
            old.model,
            records,
            steps=old.steps,
            scheme=old.scheme,
            solver=old.solver,
            backend=old.backend,
            jobs=1,
        )
        for fresh, run in zip(predictor.runs, old.runs, strict=True):
            fresh.anchor, fresh.motions = run.anchor, run.known_motions()
        full = self.problem.full(self.theta[None])[0]
        return CampaignProblem(predictor, self.free, full)

    def _record(self, r: int, rng: np.random.Generator) -> Record:
        record = self.records[r]
        drawn = dict(zip(self.problem.outputs, self._outputs(r, rng), strict=True))
        harmonics = dict(record.harmonics)
        if self.input_noise:
            for name in self.problem.predictor.model.inputs:
                if name in record.harmonics:
                    harmonics[name] = _noisy(record.harmonics[name], rng)
        return replace(record, samples={**record.samples, **drawn}, harmonics=harmonics)

    def blocks(self) -> list[NoiseBlock]:
        predictor, full = self.problem.predictor, self.problem.full(self.theta[None])
        blocks = []
        for r, run in enumerate(predictor.runs):
            ny, samples = self.truth[r].y.shape
            p = predictor.constants(full, r)[0]
            columns = input_columns(run, p) if self.input_noise else np.zeros((ny, 0, samples))
            columns = self.problem.kept(r, columns)
            kept = self.problem.kept(r, self.truth[r].sensitivity[:, self.free])
            sensitivity, samples = np.moveaxis(kept, 1, 2), kept.shape[2]
            blocks.append(
                NoiseBlock(
                    sensitivity=sensitivity.reshape(ny * samples, -1),
                    output=np.repeat(np.arange(ny), samples),
                    sd=np.repeat(self.sd[r], samples),
                    columns=np.moveaxis(columns, 1, 2).reshape(ny * samples, -1),
                )
            )
        return blocks


def _noisy(harmonics: Harmonics, rng: np.random.Generator) -> Harmonics:
    """Coefficients with new noise; that of order 0 is real."""
    sd = np.sqrt(harmonics.variances)
    real, imaginary = rng.standard_normal((2, sd.size))
    noise = sd * (real + 1j * np.where(harmonics.orders == 0, 0.0, imaginary))
    return replace(harmonics, coefficients=harmonics.coefficients + noise)


def _checked(evaluation: Evaluation) -> Evaluation:
    if evaluation.status is not Status.CONVERGED:
        raise InputError(
            f"no data can be made: {evaluation.status.message}",
            key="theta",
            hint="give parameters at which the model can be solved",
        )
    return evaluation


def _one_each(variance: Array, outputs: Sequence[str]) -> Array:
    values = np.array(variance, dtype=float)
    if values.shape != (len(outputs),) or not (values >= 0).all():
        raise InputError(
            "variance must be one number per output, not negative",
            key="variance",
            value=values.tolist(),
            hint=f"the outputs are {', '.join(outputs)}",
        )
    return values
