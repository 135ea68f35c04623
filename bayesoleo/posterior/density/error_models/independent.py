"""Independent errors: one variance for each output, or one for each output and run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.estimation.problems.residuals import RunSamples
from bayesoleo.model.priors import LogNormal
from bayesoleo.posterior.density.error_models.base import (
    ErrorModel,
    Frame,
    Quantity,
    log_mean_squares,
)
from bayesoleo.posterior.density.likelihood import log_likelihood_by_run

#: How much logarithms of variances differ between runs: e-fold a standard deviation either way of
#: 0.3, which reaches from runs that are alike to one whose noise is three times another's.
_SPREAD_PRIOR = LogNormal(0.3, 1.0)
_LOG_2_PI = float(np.log(2 * np.pi))


class IndependentErrors(ErrorModel):
    """One variance for each output, shared by all runs; flat in its logarithm.

    References
    ----------
    Verbeek (1993), eqs. 2.29-2.30.
    """

    word, by_sums = "independent", True

    def _declare(self) -> tuple[Quantity, ...]:
        return self.frame.log_variances()

    def of_sums(self, sums: Array, eta: Array) -> Array:
        return log_likelihood_by_run(sums, self.frame.counts, eta)

    def products(self, run: int, columns: Sequence[Array], eta: Array) -> Array:
        return np.asarray(
            sum(c @ c.T * np.exp(-log_v) for c, log_v in zip(columns, eta, strict=True))
        )

    def start(self, residuals: Sequence[Array]) -> Array:
        return log_mean_squares(residuals)


class PerRunErrors(ErrorModel):
    """One variance for each output and run; their logarithms are normal about a common mean.

    The mean is flat, and the scatter ``spread_log_variance`` is log-normal about 0.3. A variance of
    each run's own without anything in common would leave the density of a run that was left out
    undefined, and with it every comparison by leaving runs out.

    References
    ----------
    Verbeek (1993), eq. 2.25 with ``V`` diagonal and constant in a run.
    """

    word, by_sums = "per-run", True

    def __init__(self, frame: Frame) -> None:
        super().__init__(frame)
        runs, outputs = frame.counts.shape
        # Place of each run's own among the coordinates.
        self._own = 2 * outputs + np.arange(runs * outputs).reshape(runs, outputs)

    def _declare(self) -> tuple[Quantity, ...]:
        outputs = self.frame.outputs
        spreads = tuple(
            Quantity(
                schema.spread(schema.log_variance(output)),
                0.0,
                prior=_SPREAD_PRIOR,
                long_name=f"scatter between runs of the logarithm of {output}'s variance",
            )
            for output in outputs
        )
        own = tuple(
            Quantity(
                schema.by_run(schema.log_variance(output), run),
                unit="ln(({})^2)",
                long_name=f"logarithm of the error variance of {output} in run {run}",
            )
            for run in self.frame.runs
            for output in outputs
        )
        return (*self.frame.log_variances(), *spreads, *own)

    def log_prior(self, eta: Array) -> Array:
        total = super().log_prior(eta)
        outputs = len(self.frame.outputs)
        for b in range(outputs):
            mean, log_s = np.ascontiguousarray(eta[:, b]), np.ascontiguousarray(eta[:, outputs + b])
            precision = np.exp(-log_s)
            for column in self._own[:, b]:
                with np.errstate(over="ignore"):
                    scaled = (eta[:, column] - mean) * precision
                    total -= 0.5 * scaled * scaled + log_s + 0.5 * _LOG_2_PI
        return total

    def of_sums(self, sums: Array, eta: Array) -> Array:
        total = np.empty(sums.shape[:2])
        for run, own in enumerate(self._own):
            total[:, run] = log_likelihood_by_run(
                sums[:, run : run + 1], self.frame.counts[run : run + 1], eta[:, own]
            )[:, 0]
        return total

    def products(self, run: int, columns: Sequence[Array], eta: Array) -> Array:
        own = eta[self._own[run]]
        return np.asarray(
            sum(c @ c.T * np.exp(-log_v) for c, log_v in zip(columns, own, strict=True))
        )

    def start(self, residuals: Sequence[Array]) -> Array:
        own = np.array([log_mean_squares([e]) for e in residuals])
        scatter = np.log(np.maximum(own.std(axis=0), 0.1))
        return np.concatenate([own.mean(axis=0), scatter, own.ravel()])

    def spread(self) -> Array:
        runs = len(self.frame.runs)
        outputs = len(self.frame.outputs)
        return np.concatenate(
            [
                np.full(outputs, 0.3 / np.sqrt(runs)),
                np.full(outputs, np.sqrt(0.5 / runs)),
                np.sqrt(2.0 / self.frame.counts).ravel(),
            ]
        )

    def variance(self, natural: Array, run: str) -> Array:
        if run not in self.frame.runs:
            return super().variance(natural, run)
        return np.exp(natural[:, self._own[self.frame.runs.index(run)]])

    def draw(
        self, natural: Array, run: str, samples: RunSamples, rng: np.random.Generator
    ) -> Array:
        white = super().draw(natural, run, samples, rng)
        if run in self.frame.runs:
            return white
        # Nothing is known of a new run's variance but how much others scatter.
        outputs = len(self.frame.outputs)
        scatter = natural[:, outputs : 2 * outputs] * rng.standard_normal((len(natural), outputs))
        return np.exp(0.5 * scatter)[:, :, None] * white
