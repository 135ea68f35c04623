"""Unknowns turned so that a fit's outputs tell each of them apart from all others.

Two unknowns that act alike, as the stiffnesses of two springs side by side, have products that
differ by rounding alone: squares of what the data tell of their sum stand where what the prior
tells of their difference is lost. Turned first, each product keeps its digits.

References
----------
Higham (2002), *Accuracy and Stability of Numerical Algorithms*, sections 10.1 (graded matrices) and
20.4 (normal equations).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._types import Array
from bayesoleo.error_models._catalogue_evidence import Linearised
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.estimation._problem import Evaluation


@dataclass(frozen=True)
class PrincipalUnknowns:
    """Unknowns about an estimate, in units of their priors' deviations, and turned.

    Parameters
    ----------
    turn : ndarray, shape (l, l)
        Columns are the directions, those first that are known best.
    sensitivity : tuple of ndarray, shape (n, l)
        Of each output to a step along each of them.
    precision : ndarray, shape (l, l)
        Of the prior.
    pull : ndarray, shape (l,)
        Precision times prior mean less estimate.
    """

    turn: Array
    sensitivity: tuple[Array, ...]
    precision: Array
    pull: Array

    @classmethod
    def of(
        cls, found: Evaluation, scale: PriorScale, theta: Array, noise: Sequence[float] | Array
    ) -> PrincipalUnknowns:
        """Of what was evaluated at an estimate; the outputs' noise makes them comparable."""
        pull, precision = scale.quadratic(theta)
        scaled = [j * scale.sd for j in found.sensitivity]
        table = np.vstack([j / sigma for j, sigma in zip(scaled, noise, strict=True)])
        both = np.vstack([np.linalg.qr(table, mode="r"), np.linalg.cholesky(precision).T])
        turn = np.linalg.svd(both)[2].T
        length = np.linalg.norm(table @ turn, axis=0)
        # What is left of a direction that no output shows is rounding of the others.
        rounding = 10 * len(turn) * np.finfo(float).eps * length.max(initial=0.0)
        seen = turn * (length > rounding)
        return cls(turn, tuple(j @ seen for j in scaled), turn.T @ precision @ turn, pull @ turn)

    def back(self, found: Linearised) -> Linearised:
        """The same posterior in the unknowns themselves, in units of their priors' deviations."""
        return replace(
            found,
            shift=self.turn @ found.shift,
            covariance=self._spread(found.covariance),
            groups=tuple((w, self.turn @ m, self._spread(c)) for w, m, c in found.groups),
        )

    def _spread(self, covariance: Array) -> Array:
        half = self.turn @ covariance @ self.turn.T
        # Rounding leaves no product symmetric.
        return 0.5 * (half + half.T)
