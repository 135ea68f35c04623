"""What the errors of the outputs have in common, and what is eliminated of it in each iteration.

Every model says three things of residuals ``e``: which covariance ``V`` maximises the objective at
fixed parameters (the staged elimination), how likely they are given one, and which rows of a
least-squares problem they make when whitened by it.

References
----------
Verbeek (1993), eqs. 2.25-2.35 for the models, 3.17 and 3.18 for the staging; Bard (1974),
*Nonlinear Parameter Estimation*, section 4-9, for the determinant criterion.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular

from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation.objectives.diagonal import (
    log_likelihood,
    staged_variance,
    sums_of_squares,
)
from bayesoleo.estimation.objectives.linearise import Linearised, triangle
from bayesoleo.estimation.problems.problem import Evaluation

Counts = NDArray[np.int64]

# A covariance of outputs that repeat each other is singular; this part of its trace keeps it apart.
_RIDGE = 1e-14


@dataclass(frozen=True)
class ErrorModel(ABC):
    """Covariance of the ``s`` outputs' errors. ``V`` is kept as (s,) where it is diagonal."""

    def check(self, counts: Counts) -> None:
        """Raise an :class:`InputError` if samples by run and output, (N, s), do not suit."""
        return

    @abstractmethod
    def moments(self, evaluation: Evaluation) -> Array:
        """What the likelihood knows of the residuals."""

    @abstractmethod
    def stage(self, moments: Array, counts: Counts, unknowns: int, bias_corrected: bool) -> Array:
        """``V`` that maximises the objective at fixed parameters, (s,) or (s, s)."""

    @abstractmethod
    def log_likelihood(self, moments: Array, covariance: Array, counts: Counts) -> float:
        """Logarithm of the likelihood with ``V`` held."""

    @abstractmethod
    def rows(self, evaluation: Evaluation, unit: Array, covariance: Array) -> tuple[Array, Array]:
        """Whitened rows ``J`` (k, l) in unknowns of size ``unit``, and ``e`` (k,)."""

    @abstractmethod
    def weighted(self, residual: Sequence[Array], covariance: Array) -> tuple[Array, ...]:
        """``V^-1 e`` of each output."""

    def eliminated(
        self, evaluation: Evaluation, unit: Array, covariance: Array, counts: Counts
    ) -> Array:
        """What eliminating ``V`` takes from the Hessian, (l, l): ``H_tv H_vv^-1 H_vt``.

        References
        ----------
        Verbeek (1993), Appendix A.
        """
        return np.zeros((unit.size, unit.size))


@dataclass(frozen=True)
class DiagonalErrors(ErrorModel):
    """One variance for each output, shared by all runs (eqs. 2.29-2.30, the thesis's standard)."""

    def moments(self, evaluation: Evaluation) -> Array:
        return sums_of_squares(evaluation)

    def stage(self, moments: Array, counts: Counts, unknowns: int, bias_corrected: bool) -> Array:
        return staged_variance(moments, counts, unknowns, bias_corrected=bias_corrected)

    def log_likelihood(self, moments: Array, covariance: Array, counts: Counts) -> float:
        return log_likelihood(moments, covariance, counts)

    def rows(self, evaluation: Evaluation, unit: Array, covariance: Array) -> tuple[Array, Array]:
        return Linearised.of(evaluation, unit).whitened(covariance)

    def weighted(self, residual: Sequence[Array], covariance: Array) -> tuple[Array, ...]:
        return tuple(e / v for e, v in zip(residual, covariance, strict=True))

    def eliminated(
        self, evaluation: Evaluation, unit: Array, covariance: Array, counts: Counts
    ) -> Array:
        cross = _cross(evaluation, unit) / covariance[:, None]
        return np.asarray(2 * (cross / counts[:, None]).T @ cross)


@dataclass(frozen=True)
class CommonErrors(DiagonalErrors):
    """One variance for everything: where it is largest, so is the unweighted sum (eq. 2.35)."""

    def stage(self, moments: Array, counts: Counts, unknowns: int, bias_corrected: bool) -> Array:
        total, number = moments.sum(keepdims=True), counts.sum(keepdims=True)
        variance = staged_variance(total, number, unknowns, bias_corrected=bias_corrected)
        return np.repeat(variance, len(moments))

    def eliminated(
        self, evaluation: Evaluation, unit: Array, covariance: Array, counts: Counts
    ) -> Array:
        cross = _cross(evaluation, unit).sum(axis=0) / covariance[0]
        return 2 * np.outer(cross, cross) / counts.sum()


@dataclass(frozen=True)
class FullErrors(ErrorModel):
    """One full covariance for all samples: the determinant criterion (eqs. 2.27-2.28)."""

    def check(self, counts: Counts) -> None:
        if (counts != counts[:, :1]).any():
            raise InputError(
                "a covariance between outputs needs them at the same samples",
                key="objective",
                value=counts.tolist(),
                hint='use objective="diagonal"',
            )

    def moments(self, evaluation: Evaluation) -> Array:
        residual = np.stack(evaluation.residual)
        return residual @ residual.T

    def stage(self, moments: Array, counts: Counts, unknowns: int, bias_corrected: bool) -> Array:
        floor = np.diag(
            staged_variance(np.diag(moments), counts, unknowns, bias_corrected=bias_corrected)
        )
        degrees = counts[0] - unknowns / len(counts) if bias_corrected else counts[0]
        return cast(Array, moments / degrees + _RIDGE * floor)

    def log_likelihood(self, moments: Array, covariance: Array, counts: Counts) -> float:
        determinant = np.linalg.slogdet(covariance)[1]
        return float(
            -0.5 * (counts[0] * determinant + np.trace(np.linalg.solve(covariance, moments)))
        )

    def rows(self, evaluation: Evaluation, unit: Array, covariance: Array) -> tuple[Array, Array]:
        # One factor of all outputs side by side holds their products with each other as well.
        columns = zip(evaluation.sensitivity, evaluation.residual, strict=True)
        factor = triangle(np.column_stack([part for j, e in columns for part in (j * unit, e)]))
        outputs, width = len(covariance), unit.size + 1
        blocks = factor.reshape(len(factor), outputs, width).swapaxes(0, 1)
        stacked = triangle(np.einsum("ab,bkw->akw", _root(covariance), blocks).reshape(-1, width))
        return stacked[:, :-1], stacked[:, -1]

    def weighted(self, residual: Sequence[Array], covariance: Array) -> tuple[Array, ...]:
        return tuple(np.linalg.solve(covariance, np.stack(residual)))

    def eliminated(
        self, evaluation: Evaluation, unit: Array, covariance: Array, counts: Counts
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


def _cross(evaluation: Evaluation, unit: Array) -> Array:
    """``J'e`` of each output, (s, l)."""
    pairs = zip(evaluation.sensitivity, evaluation.residual, strict=True)
    return np.stack([unit * (j.T @ e) for j, e in pairs])


@dataclass(frozen=True, eq=False)
class GivenErrors(ErrorModel):
    """Known covariances, one for each sample or one for all (eqs. 2.25 and 2.33).

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

    def check(self, counts: Counts) -> None:
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

    def moments(self, evaluation: Evaluation) -> Array:
        white = self._whiten([e[:, None] for e in evaluation.residual])
        return np.array([float(np.sum(white * white))])

    def stage(self, moments: Array, counts: Counts, unknowns: int, bias_corrected: bool) -> Array:
        if isinstance(self.roots, tuple):
            return np.array([float(np.mean(r**-2.0)) for r in self.roots])
        lower = np.linalg.inv(self.roots)
        return np.asarray((lower @ lower.swapaxes(1, 2)).mean(axis=0))

    def log_likelihood(self, moments: Array, covariance: Array, counts: Counts) -> float:
        if isinstance(self.roots, tuple):
            logs = sum(
                float(np.log(r).sum()) * (n / r.size)
                for r, n in zip(self.roots, counts, strict=True)
            )
        else:
            diagonal = np.einsum("nkk->nk", self.roots)
            logs = float(np.log(diagonal).sum()) * counts[0] / len(self.roots)
        return float(logs - 0.5 * moments[0])

    def rows(self, evaluation: Evaluation, unit: Array, covariance: Array) -> tuple[Array, Array]:
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
