r"""One covariance over the outputs, the same for every sample: estimated in full, or given.

The estimated covariance is ``V = D R D`` with variances ``D^2``, whose prior is flat in their
logarithms, and a correlation matrix ``R`` with a uniform prior over all correlation matrices. The
coordinates of ``R`` are :math:`\operatorname{artanh}` of canonical partial correlations: any real
values give a valid ``R``. A given covariance weights point estimates by noise that was measured
beforehand.

References
----------
Verbeek (1993), eqs. 2.25, 2.27-2.28 and 2.33. Lewandowski, Kurowicka and Joe (2009), "Generating
random correlation matrices based on vines and extended onion method", *Journal of Multivariate
Analysis* 100, sections 2 and 3 (uniform is their :math:`\eta = 1`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import betaln

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
from bayesoleo.error_models._fitting import triangle
from bayesoleo.error_models._independent import staged_variance
from bayesoleo.errors import InputError

_LOG_2_PI = float(np.log(2 * np.pi))
# Largest correlation of a start, so that its coordinate is finite.
_MOST = 0.999
# Ridge, as part of the trace: the covariance of linearly dependent outputs is singular.
_RIDGE = 1e-14


def _check_same_samples(counts: Integers, key: str, instead: str) -> None:
    """Raise an :class:`InputError` unless all outputs of a run have as many samples, (N, s)."""
    if (counts != counts[:, :1]).any():
        raise InputError(
            "a covariance between outputs needs them at the same samples",
            key=key,
            value=counts.tolist(),
            hint=f'use {key}="{instead}"',
        )


class FullErrors(ErrorModel):
    """Outputs of one sample are correlated, samples are independent."""

    word = "full"
    data_points = "one period of one run; an output given the outputs before it"

    def __init__(self, frame: Frame) -> None:
        super().__init__(frame)
        frame.sampled()
        if len(frame.outputs) < 2:
            raise InputError(
                "a covariance over outputs needs two of them",
                key="error_model",
                value=self.word,
                hint='use error_model="independent"',
            )
        _check_same_samples(frame.counts, "error_model", "independent")
        self._pairs = [(i, j) for i in range(len(frame.outputs)) for j in range(i)]

    def _declare(self) -> tuple[Quantity, ...]:
        outputs = self.frame.outputs
        correlations = tuple(
            Quantity(
                schema.correlation(outputs[j], outputs[i]),
                -1.0,
                1.0,
                long_name=f"correlation of the errors of {outputs[j]} and {outputs[i]}",
            )
            for i in range(len(outputs))
            for j in range(i)
        )
        return (*self.frame.log_variances(), *correlations)

    def _factor(self, eta: Array) -> Array:
        """Cholesky factors of correlation matrices, shape (W, s, s), from coordinates (W, m)."""
        s = len(self.frame.outputs)
        factor = np.zeros((len(eta), s, s))
        factor[:, 0, 0] = 1.0
        left = np.ones((len(eta), s))
        for k, (i, j) in enumerate(self._pairs):
            partial = np.tanh(np.ascontiguousarray(eta[:, s + k]))
            factor[:, i, j] = partial * np.sqrt(left[:, i])
            left[:, i] *= (1 - partial) * (1 + partial)
            factor[:, i, i] = np.sqrt(left[:, i])
        return factor

    def natural(self, eta: Array) -> Array:
        factor, s = self._factor(eta), len(self.frame.outputs)
        out = np.array(eta, dtype=float)
        for k, (i, j) in enumerate(self._pairs):
            out[:, s + k] = sum(factor[:, i, c] * factor[:, j, c] for c in range(j + 1))
        return out

    def coordinates(self, natural: Array) -> Array:
        out, s = np.array(natural, dtype=float), len(self.frame.outputs)
        for row in out:
            matrix = np.eye(s)
            for k, (i, j) in enumerate(self._pairs):
                matrix[i, j] = matrix[j, i] = row[s + k]
            factor = np.linalg.cholesky(matrix)
            for k, (i, j) in enumerate(self._pairs):
                rest = np.sqrt(1.0 - np.sum(factor[i, :j] ** 2))
                row[s + k] = np.arctanh(factor[i, j] / rest)
        return out

    def log_prior(self, eta: Array) -> Array:
        s = len(self.frame.outputs)
        total = np.zeros(len(eta))
        for k, quantity in enumerate(self.quantities[:s]):
            total += quantity.log_prior(np.ascontiguousarray(eta[:, k]))
        for k, (_, j) in enumerate(self._pairs):
            # A partial correlation given j others is 2 B - 1 with B ~ Beta(a, a).
            a = 1.0 + 0.5 * (s - 2 - j)
            z = np.ascontiguousarray(eta[:, s + k])
            log_rest = 2.0 * (np.log(2.0) - np.logaddexp(z, -z))  # ln(1 - tanh(z)^2)
            total += a * log_rest - (2 * a - 1) * np.log(2.0) - betaln(a, a)
        return total

    def sample_prior(self, rng: np.random.Generator, size: int) -> dict[str, Array]:
        s = len(self.frame.outputs)
        found = super().sample_prior(rng, size)
        eta = np.zeros((size, len(self.quantities)))
        for k, (_, j) in enumerate(self._pairs):
            a = 1.0 + 0.5 * (s - 2 - j)
            eta[:, s + k] = np.arctanh(2 * rng.beta(a, a, size) - 1)
        natural = self.natural(eta)
        return found | {name: natural[:, s + k] for k, name in enumerate(self.names[s:])}

    def of_run(self, run: int, residual: Array, eta: Array) -> Array:
        s, count = len(self.frame.outputs), residual.shape[2]
        factor, sd = self._factor(eta), np.exp(0.5 * np.ascontiguousarray(eta[:, :s]))
        total = np.full(len(eta), -0.5 * s * count * _LOG_2_PI)
        white = np.empty_like(residual)
        for i in range(s):
            row = residual[:, i] / sd[:, i, None]
            for j in range(i):
                row -= factor[:, i, j, None] * white[:, j]
            white[:, i] = row / factor[:, i, i, None]
            total -= count * np.log(sd[:, i] * factor[:, i, i])
            for lane, row_of_lane in enumerate(white[:, i]):
                total[lane] -= 0.5 * np.sum(row_of_lane * row_of_lane)
        return total

    def blocks_of_run(self, run: int, residual: Array, eta: Array, starts: Integers) -> Array:
        s = len(self.frame.outputs)
        factor, sd = self._factor(eta), np.exp(0.5 * eta[:, :s])
        white = np.linalg.solve(factor, residual / sd[:, :, None])
        log_sd = np.log(sd * np.einsum("lss->ls", factor))
        return normal_blocks(white, log_sd, starts)

    def products(self, run: int, columns: Sequence[Array], eta: Array) -> Array:
        s = len(self.frame.outputs)
        root = np.exp(0.5 * eta[:s])[:, None] * self._factor(eta[None])[0]
        inverse = np.linalg.inv(root)
        white = np.einsum("ab,bkn->akn", inverse, np.stack(columns))
        return np.asarray(np.einsum("akn,aln->kl", white, white))

    def draw(
        self,
        natural: Array,
        run: str,
        samples: RunSamples,
        rng: np.random.Generator,
        common: Array | None = None,
    ) -> Array:
        white = super().draw(natural, run, samples, rng)
        sd = np.sqrt(self.variance(natural, run))[:, :, None]
        return np.asarray(sd * (self._factor(self.coordinates(natural)) @ (white / sd)))

    def start(self, residuals: Sequence[Array]) -> Array:
        every = np.concatenate(residuals, axis=1)
        moments = every @ every.T
        sd = np.sqrt(np.maximum(np.diag(moments), np.finfo(float).tiny))
        correlation = _MOST * moments / np.outer(sd, sd)
        natural = [correlation[i, j] for i, j in self._pairs]
        start = np.concatenate([log_mean_squares(residuals), natural])
        return cast(Array, self.coordinates(start[None])[0])

    def scales(self) -> Array:
        sd = super().scales()
        sd[len(self.frame.outputs) :] = 1.0 / np.sqrt(self.frame.counts[:, 0].sum())
        return sd


@dataclass(frozen=True)
class ProfiledFullErrors(ProfiledErrorModel):
    """One full covariance for all samples: the determinant criterion (eqs. 2.27-2.28)."""

    def check(self, counts: Integers) -> None:
        _check_same_samples(counts, "objective", "diagonal")

    def moments(self, evaluation: Residuals) -> Array:
        residual = np.stack(evaluation.residual)
        return residual @ residual.T

    def stage(self, moments: Array, counts: Integers, unknowns: int, bias_corrected: bool) -> Array:
        floor = np.diag(
            staged_variance(np.diag(moments), counts, unknowns, bias_corrected=bias_corrected)
        )
        degrees = counts[0] - unknowns / len(counts) if bias_corrected else counts[0]
        return np.asarray(moments / degrees + _RIDGE * floor)

    def log_likelihood(self, moments: Array, covariance: Array, counts: Integers) -> float:
        determinant = np.linalg.slogdet(covariance)[1]
        return float(
            -0.5 * (counts[0] * determinant + np.trace(np.linalg.solve(covariance, moments)))
        )

    def rows(self, evaluation: Residuals, unit: Array, covariance: Array) -> tuple[Array, Array]:
        # One factor of all outputs side by side also holds their cross products.
        columns = zip(evaluation.sensitivity, evaluation.residual, strict=True)
        factor = triangle(np.column_stack([part for j, e in columns for part in (j * unit, e)]))
        outputs, width = len(covariance), unit.size + 1
        blocks = factor.reshape(len(factor), outputs, width).swapaxes(0, 1)
        stacked = triangle(np.einsum("ab,bkw->akw", _root(covariance), blocks).reshape(-1, width))
        return stacked[:, :-1], stacked[:, -1]

    def weighted(self, residual: Sequence[Array], covariance: Array) -> tuple[Array, ...]:
        return tuple(np.linalg.solve(covariance, np.stack(residual)))

    def eliminated(
        self, evaluation: Residuals, unit: Array, covariance: Array, counts: Integers
    ) -> Array:
        root = _root(covariance)
        residual = root @ np.stack(evaluation.residual)
        sensitivity = np.einsum("ab,bnk->ank", root, np.stack(evaluation.sensitivity) * unit)
        slope = np.einsum("ank,bn->kab", sensitivity, residual)
        slope = slope + slope.swapaxes(1, 2)
        return np.asarray(np.einsum("kab,jab->kj", slope, slope) / (2 * counts[0]))


def _root(covariance: Array) -> Array:
    """``L^-1`` with ``V = L L'``."""
    lower = np.linalg.cholesky(covariance)
    return np.asarray(solve_triangular(lower, np.eye(len(lower)), lower=True))


@dataclass(frozen=True, eq=False)
class GivenErrors(ProfiledErrorModel):
    """Given covariances, one for each sample or one for all (eqs. 2.25 and 2.33).

    Parameters
    ----------
    roots : ndarray, shape (n, s, s) or (1, s, s), or tuple over outputs of (n_b,) or (1,)
        ``L^-1`` with ``V = L L'``; reciprocal standard deviations where outputs are independent.
    """

    roots: Array | tuple[Array, ...]

    @classmethod
    def of(cls, covariance: object, outputs: int) -> GivenErrors:
        """From variances (s,) or by sample, or covariances (s, s) or (n, s, s).

        Raises
        ------
        InputError
            If the shape is none of these, or a covariance is not positive definite.
        """
        if isinstance(covariance, Sequence) and len(covariance) == outputs:
            parts = [np.atleast_1d(np.asarray(part, dtype=float)) for part in covariance]
            if all(part.ndim == 1 and part.size > 0 for part in parts) and (
                outputs == 1 or any(part.size != outputs for part in parts)
            ):
                return cls(tuple(_reciprocal(part) for part in parts))
        values = np.asarray(covariance, dtype=float)
        if values.shape == (outputs,):
            return cls(tuple(_reciprocal(np.atleast_1d(value)) for value in values))
        if values.ndim in (2, 3) and values.shape[-2:] == (outputs, outputs):
            matrices = values.reshape(-1, outputs, outputs)
            try:
                return cls(np.linalg.inv(np.linalg.cholesky(matrices)))
            except np.linalg.LinAlgError:
                raise InputError(
                    "error covariance must be positive definite", key="error_covariance"
                ) from None
        raise InputError(
            "error covariance does not fit the outputs",
            key="error_covariance",
            value=values.shape,
            hint=f"give {outputs} variances, one array of them for each output, or matrices "
            f"({outputs}, {outputs}), one or one for each sample",
        )

    def check(self, counts: Integers) -> None:
        sizes = counts.sum(axis=0)
        if isinstance(self.roots, tuple):
            fits = all(r.size in (1, n) for r, n in zip(self.roots, sizes, strict=True))
        else:
            fits = len(self.roots) in (1, int(sizes[0])) and len(set(sizes.tolist())) == 1
        if not fits:
            raise InputError(
                "error covariance by sample must cover every sample",
                key="error_covariance",
                hint=f"the outputs have {sizes.tolist()} samples, runs one after the other",
            )

    def _whiten(self, columns: Sequence[Array]) -> Array:
        """Whitened rows, one under the other, of columns (n_b, w) of each output."""
        if isinstance(self.roots, tuple):
            return np.vstack([r[:, None] * c for r, c in zip(self.roots, columns, strict=True)])
        stacked = np.stack(columns, axis=1)
        return np.asarray((self.roots @ stacked).reshape(-1, stacked.shape[-1]))

    def moments(self, evaluation: Residuals) -> Array:
        white = self._whiten([e[:, None] for e in evaluation.residual])
        return np.array([float(np.sum(white * white))])

    def stage(self, moments: Array, counts: Integers, unknowns: int, bias_corrected: bool) -> Array:
        if isinstance(self.roots, tuple):
            return np.array([float(np.mean(r**-2.0)) for r in self.roots])
        lower = np.linalg.inv(self.roots)
        return np.asarray((lower @ lower.swapaxes(1, 2)).mean(axis=0))

    def log_likelihood(self, moments: Array, covariance: Array, counts: Integers) -> float:
        if isinstance(self.roots, tuple):
            logs = sum(
                float(np.log(r).sum()) * (n / r.size)
                for r, n in zip(self.roots, counts, strict=True)
            )
        else:
            diagonal = np.einsum("nkk->nk", self.roots)
            logs = float(np.log(diagonal).sum()) * counts[0] / len(self.roots)
        return float(logs - 0.5 * moments[0])

    def rows(self, evaluation: Residuals, unit: Array, covariance: Array) -> tuple[Array, Array]:
        pairs = zip(evaluation.sensitivity, evaluation.residual, strict=True)
        factor = triangle(self._whiten([np.column_stack((j * unit, e)) for j, e in pairs]))
        return factor[:, :-1], factor[:, -1]

    def weighted(self, residual: Sequence[Array], covariance: Array) -> tuple[Array, ...]:
        if isinstance(self.roots, tuple):
            return tuple(r**2 * e for r, e in zip(self.roots, residual, strict=True))
        white = self.roots @ np.stack(residual, axis=1)[..., None]
        return tuple((self.roots.swapaxes(1, 2) @ white)[..., 0].T)


def _reciprocal(variance: Array) -> Array:
    if not (np.isfinite(variance).all() and (variance > 0).all()):
        raise InputError(
            "error variances must be positive and finite",
            key="error_covariance",
            value=float(np.min(variance)),
        )
    return 1 / np.sqrt(variance)
