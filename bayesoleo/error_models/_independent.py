"""Errors that are independent between outputs, each output with quantities of its own.

Independent errors have one variance for each output, one for all, or one for each output and run.

References
----------
Verbeek (1993), eqs. 2.29-2.32 and 2.35, and 3.17 and 3.18 for the variances that maximise them.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from bayesoleo import _schema as schema
from bayesoleo._types import Array, Integers
from bayesoleo.error_models._base import (
    ErrorModel,
    Frame,
    ProfiledErrorModel,
    Quantity,
    Residuals,
    RunSamples,
    log_mean_squares,
    normal_blocks,
)
from bayesoleo.error_models._fitting import LinearisedResidual, climb
from bayesoleo.errors import InputError
from bayesoleo.model._priors import LogNormal

#: Starting coordinates of a share in the search for its most likely value: a fifth, a half, and
#: nine tenths.
_SHARES = (-0.85, 0.0, 1.3)
#: Prior spread of the logarithms of variances between runs: 0.3 within a factor of e for one
#: standard deviation, from equal runs to noise that differs threefold.
_SPREAD_PRIOR = LogNormal(0.3, 1.0)
_LOG_2_PI = float(np.log(2 * np.pi))
# A model that reproduces its data exactly has no residual variance; its logarithm must stay finite.
_SMALLEST_VARIANCE = 1e-150


class ByOutput(ErrorModel):
    """White and coloured noise for each output: total variance, coloured share, and a length.

    Output ``b`` has three quantities: ``ln v_b``, the normal quantile of the share, and the
    logarithm of the length. The first is not a coordinate itself. Samples determine the innovation
    variance, given the samples before, far better than the total variance, because a record holds
    few correlation lengths of the coloured part. The coordinate is the logarithm of the innovation
    variance. Its difference from ``ln v_b`` depends on the other coordinates alone, so that
    densities over both are equal.
    """

    data_points = "one period of one run, given the periods before it"
    #: Rough standard deviations of the logit of a share and of a logarithm of a length.
    _SHARE_SD, _LENGTH_SD = 0.3, 0.3

    def __init__(self, frame: Frame) -> None:
        super().__init__(frame)
        frame.sampled()

    @abstractmethod
    def of_output(self, run: int, residual: Array, eta: Array) -> Array:
        """Log-likelihood, shape (L,), of one output's residuals (L, n).

        ``eta`` (L, 3) holds ``ln v``, the share's quantile and the logarithm of the length.
        """

    @abstractmethod
    def blocks_of_output(self, run: int, residual: Array, eta: Array, starts: Integers) -> Array:
        """Log density of blocks of one output, each given those before it, shape (L, B)."""

    @abstractmethod
    def products_of_output(self, run: int, columns: Array, eta: Array) -> Array:
        """``C V^-1 C'``, shape (k, k), of one output's rows (k, n); eta (3,)."""

    @abstractmethod
    def log_new(self, share: Array, log_length: Array) -> Array:
        """Logarithm of the innovation variance over the total variance, shape (W,)."""

    def _places(self, b: int) -> list[int]:
        s = len(self.frame.outputs)
        return [b, s + b, 2 * s + b]

    def _part(self, eta: Array, b: int) -> Array:
        """``ln v``, quantile of the share and logarithm of the length, (W, 3), from coordinates."""
        part = np.ascontiguousarray(eta[:, self._places(b)])
        part[:, 0] -= self.log_new(
            np.ascontiguousarray(part[:, 1]), np.ascontiguousarray(part[:, 2])
        )
        return part

    def _direct(self, eta: Array, sign: int) -> Array:
        """Direct quantities from coordinates (sign -1), or back (+1)."""
        out = np.array(eta, dtype=float)
        for b in range(len(self.frame.outputs)):
            first, share, length = (np.ascontiguousarray(out[:, k]) for k in self._places(b))
            out[:, b] = first + sign * self.log_new(share, length)
        return out

    def natural(self, eta: Array) -> Array:
        return super().natural(self._direct(eta, -1))

    def coordinates(self, natural: Array) -> Array:
        return self._direct(super().coordinates(natural), 1)

    def log_prior(self, eta: Array) -> Array:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return super().log_prior(self._direct(eta, -1))

    def of_run(self, run: int, residual: Array, eta: Array) -> Array:
        total = np.zeros(len(eta))
        for b in range(len(self.frame.outputs)):
            row = np.ascontiguousarray(residual[:, b])
            total += self.of_output(run, row, self._part(eta, b))
        return total

    def blocks_of_run(self, run: int, residual: Array, eta: Array, starts: Integers) -> Array:
        parts = [
            self.blocks_of_output(
                run, np.ascontiguousarray(residual[:, b]), self._part(eta, b), starts
            )
            for b in range(len(self.frame.outputs))
        ]
        return np.stack(parts, axis=1)

    def products(self, run: int, columns: Sequence[Array], eta: Array) -> Array:
        parts = [
            self.products_of_output(run, np.ascontiguousarray(rows), self._part(eta[None], b)[0])
            for b, rows in enumerate(columns)
        ]
        return np.asarray(sum(parts))

    @abstractmethod
    def draw_coloured(self, length: Array, samples: RunSamples, rng: np.random.Generator) -> Array:
        """Draw the coloured part, of unit variance, shape (W, n); length (W,)."""

    def draw(
        self,
        natural: Array,
        run: str,
        samples: RunSamples,
        rng: np.random.Generator,
        common: Array | None = None,
    ) -> Array:
        out = super().draw(natural, run, samples, rng)
        for b, sd in enumerate(np.sqrt(self.variance(natural, run)).T):
            _, share, length = (natural[:, k] for k in self._places(b))
            out[:, b] *= np.sqrt(1 - share)[:, None]
            out[:, b] += (sd * np.sqrt(share))[:, None] * self.draw_coloured(length, samples, rng)
        return out

    def start(self, residuals: Sequence[Array]) -> Array:
        s, sizes = len(self.frame.outputs), log_mean_squares(residuals)
        eta = np.empty(len(self.quantities))
        for b in range(s):
            quantities = [self.quantities[k] for k in self._places(b)]
            prior = quantities[2].prior
            assert prior is not None
            middle = float(np.log(prior.mean))

            def height(trial: Array, b: int = b, quantities: list[Quantity] = quantities) -> Array:
                total = np.zeros(len(trial))
                for k, quantity in enumerate(quantities):
                    total += quantity.log_prior(np.ascontiguousarray(trial[:, k]))
                for run, e in enumerate(residuals):
                    total += self.of_output(run, np.repeat(e[None, b], len(trial), axis=0), trial)
                return total

            guesses = [np.array([sizes[b], share, middle]) for share in _SHARES]
            eta[self._places(b)] = climb(height, guesses)
        return cast(Array, self._direct(eta[None], 1)[0])

    def scales(self) -> Array:
        s, sd = len(self.frame.outputs), super().scales()
        sd[s : 2 * s], sd[2 * s :] = self._SHARE_SD, self._LENGTH_SD
        return sd


def sums_of_squares(evaluation: Residuals) -> Array:
    """Diagonal ``M_bb`` of the moment matrix, shape (s,), in squared units of the outputs."""
    with np.errstate(over="ignore"):  # a trial step far out; the loop refuses what is not finite
        return np.array([float(np.sum(residual * residual)) for residual in evaluation.residual])


def output_counts(counts: Integers) -> Integers:
    """Number of samples of each output over all runs, shape (s,), from counts of shape (N, s)."""
    return np.asarray(counts, dtype=np.int64).sum(axis=0)


def staged_variance(
    sums: Array, counts: Integers, unknowns: int = 0, *, bias_corrected: bool = False
) -> Array:
    """Variance of each output that maximises the objective at fixed parameters.

    Parameters
    ----------
    sums : ndarray, shape (s,)
        Sums of squared residuals.
    counts : ndarray of int, shape (s,)
        Number of samples.
    unknowns : int, optional
        Number of estimated parameters, l.
    bias_corrected : bool, optional
        Divide by ``n - l/s`` instead of ``n``.

    Returns
    -------
    ndarray, shape (s,)

    Raises
    ------
    InputError
        If an output has too few samples for the correction.

    References
    ----------
    Verbeek (1993), eq. 3.17, and eq. 3.18 with the correction.
    """
    degrees = counts - unknowns / len(counts) if bias_corrected else counts.astype(float)
    if (degrees <= 0).any():
        raise InputError(
            "an output has too few samples for its variance",
            value=counts.tolist(),
            hint="use more samples or fewer unknowns",
        )
    return np.maximum(sums / degrees, _SMALLEST_VARIANCE)


def log_likelihood(sums: Array, variance: Array, counts: Integers) -> float:
    """Logarithm of the likelihood (Verbeek 1993, eqs. 2.31-2.32).

    Parameters
    ----------
    sums, variance : ndarray, shape (s,)
        Sums of squared residuals and error variances.
    counts : ndarray of int, shape (s,)
        Number of samples.

    Returns
    -------
    float
        ``-1/2 sum_b (n_b ln v_b + M_bb / v_b)``.
    """
    with np.errstate(over="ignore"):  # a trial step far out, next to a fit without residuals
        return float(-0.5 * np.sum(counts * np.log(variance) + sums / variance))


def log_likelihood_by_run(
    sum_of_squares: Array, counts: Integers | Array, log_variance: Array
) -> Array:
    """Normalised log-likelihood of every run.

    Parameters
    ----------
    sum_of_squares : ndarray, shape (L, N, s)
        Sums of squared residuals by parameter vector, run and output.
    counts : ndarray, shape (N, s)
        Number of samples by run and output; of a power of the likelihood, the effective number.
    log_variance : ndarray, shape (L, s)
        Natural logarithm of each output's error variance.

    Returns
    -------
    ndarray, shape (L, N)
        ``-1/2 sum_b [n_b (ln 2 pi + ln v_b) + M_bb / v_b]`` of each run.

    References
    ----------
    Verbeek (1993), eq. 2.29 without the prior; the constant is added so that models with other data
    compare.
    """
    vectors, runs, outputs = sum_of_squares.shape
    total = np.zeros((vectors, runs))
    # Outputs are added one after the other: a reduction by NumPy may change its order with the
    # number of rows.
    for b in range(outputs):
        log_v = np.ascontiguousarray(log_variance[:, b])
        precision = np.exp(-log_v)
        total -= 0.5 * counts[:, b] * (np.log(2 * np.pi) + log_v)[:, None]
        total -= 0.5 * sum_of_squares[:, :, b] * precision[:, None]
    return total


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

    def blocks_of_run(self, run: int, residual: Array, eta: Array, starts: Integers) -> Array:
        log_sd = 0.5 * eta
        return normal_blocks(residual * np.exp(-log_sd)[:, :, None], log_sd, starts)

    def products(self, run: int, columns: Sequence[Array], eta: Array) -> Array:
        return np.asarray(
            sum(c @ c.T * np.exp(-log_v) for c, log_v in zip(columns, eta, strict=True))
        )

    def start(self, residuals: Sequence[Array]) -> Array:
        return log_mean_squares(residuals)


@dataclass(frozen=True)
class ProfiledIndependentErrors(ProfiledErrorModel):
    """One variance for each output, shared by all runs (eqs. 2.29-2.30, the thesis's standard)."""

    def moments(self, evaluation: Residuals) -> Array:
        return sums_of_squares(evaluation)

    def stage(self, moments: Array, counts: Integers, unknowns: int, bias_corrected: bool) -> Array:
        return staged_variance(moments, counts, unknowns, bias_corrected=bias_corrected)

    def log_likelihood(self, moments: Array, covariance: Array, counts: Integers) -> float:
        return log_likelihood(moments, covariance, counts)

    def rows(self, evaluation: Residuals, unit: Array, covariance: Array) -> tuple[Array, Array]:
        return LinearisedResidual.of(evaluation, unit).whitened(covariance)

    def weighted(self, residual: Sequence[Array], covariance: Array) -> tuple[Array, ...]:
        return tuple(e / v for e, v in zip(residual, covariance, strict=True))

    def eliminated(
        self, evaluation: Residuals, unit: Array, covariance: Array, counts: Integers
    ) -> Array:
        cross = _cross(evaluation, unit) / covariance[:, None]
        return np.asarray(2 * (cross / counts[:, None]).T @ cross)


@dataclass(frozen=True)
class ProfiledCommonErrors(ProfiledIndependentErrors):
    """One variance for everything: it minimises the unweighted sum of squares (eq. 2.35)."""

    def stage(self, moments: Array, counts: Integers, unknowns: int, bias_corrected: bool) -> Array:
        total, number = moments.sum(keepdims=True), counts.sum(keepdims=True)
        variance = staged_variance(total, number, unknowns, bias_corrected=bias_corrected)
        return np.repeat(variance, len(moments))

    def eliminated(
        self, evaluation: Residuals, unit: Array, covariance: Array, counts: Integers
    ) -> Array:
        cross = _cross(evaluation, unit).sum(axis=0) / covariance[0]
        return 2 * np.outer(cross, cross) / counts.sum()


def _cross(evaluation: Residuals, unit: Array) -> Array:
    """``J'e`` of each output, (s, l)."""
    pairs = zip(evaluation.sensitivity, evaluation.residual, strict=True)
    return np.stack([unit * (j.T @ e) for j, e in pairs])


class PerRunErrors(ErrorModel):
    """One variance for each output and run; their logarithms are normal about a common mean.

    The prior is flat in the mean and log-normal about 0.3 in the scatter ``spread_log_variance``.
    With unrelated variances the density of a left-out run would be undefined, and with it
    every cross-validation by run.

    References
    ----------
    Verbeek (1993), eq. 2.25 with ``V`` diagonal and constant in a run.
    """

    word, by_sums = "per-run", True

    def __init__(self, frame: Frame) -> None:
        super().__init__(frame)
        runs, outputs = frame.counts.shape
        # Positions of the runs' own variances among the coordinates.
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

    def blocks_of_run(self, run: int, residual: Array, eta: Array, starts: Integers) -> Array:
        log_sd = 0.5 * eta[:, self._own[run]]
        return normal_blocks(residual * np.exp(-log_sd)[:, :, None], log_sd, starts)

    def products(self, run: int, columns: Sequence[Array], eta: Array) -> Array:
        own = eta[self._own[run]]
        return np.asarray(
            sum(c @ c.T * np.exp(-log_v) for c, log_v in zip(columns, own, strict=True))
        )

    def start(self, residuals: Sequence[Array]) -> Array:
        own = np.array([log_mean_squares([e]) for e in residuals])
        scatter = np.log(np.maximum(own.std(axis=0), 0.1))
        return np.concatenate([own.mean(axis=0), scatter, own.ravel()])

    def scales(self) -> Array:
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
        self,
        natural: Array,
        run: str,
        samples: RunSamples,
        rng: np.random.Generator,
        common: Array | None = None,
    ) -> Array:
        white = super().draw(natural, run, samples, rng)
        if run in self.frame.runs:
            return white
        # The variance of a new run follows the scatter of the others.
        outputs = len(self.frame.outputs)
        scatter = natural[:, outputs : 2 * outputs] * rng.standard_normal((len(natural), outputs))
        return np.exp(0.5 * scatter)[:, :, None] * white
