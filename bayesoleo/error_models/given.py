"""Errors of known covariance: point estimates weighted by what was measured beforehand.

References
----------
Verbeek (1993), eqs. 2.25 and 2.33.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array
from bayesoleo.error_models.base import Counts, ProfiledErrorModel, Residuals
from bayesoleo.error_models.linearise import triangle
from bayesoleo.errors import InputError


@dataclass(frozen=True, eq=False)
class GivenErrors(ProfiledErrorModel):
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

    def moments(self, evaluation: Residuals) -> Array:
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
