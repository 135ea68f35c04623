"""Map of the unknowns about an estimate, by which a likelihood gets another width."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array, Float
from bayesoleo.model._priors import Transforms

#: Least variance over that of independent errors that is believed in any direction.
LEAST = 1e-4


@dataclass(frozen=True)
class Stretch:
    """Map of unknowns about an estimate.

    Parameters
    ----------
    transforms : Transforms
        To coordinates without bounds.
    centre : ndarray, shape (l,)
        The estimate in these.
    matrix : ndarray, shape (l, l)
        ``K`` in these.
    """

    transforms: Transforms
    centre: Float[Array, " unknowns"]
    matrix: Float[Array, "unknowns unknowns"]

    @classmethod
    def of(cls, transforms: Transforms, theta: Array, stated: Array, covariance: Array) -> Stretch:
        """The stretch that makes one covariance of an estimate another one.

        Parameters
        ----------
        transforms : Transforms
        theta : ndarray, shape (l,)
            The estimate.
        stated, covariance : ndarray, shape (l, l)
            What the likelihood and the priors say of it, and what is to be said.
        """
        centre = transforms.unbounded(theta[None])[0]
        slope = transforms.derivative(centre[None])[0]
        root, back = _roots(stated / np.outer(slope, slope))
        ratio, axes = np.linalg.eigh(back @ (covariance / np.outer(slope, slope)) @ back.T)
        matrix = root @ (axes / np.sqrt(np.maximum(ratio, LEAST))) @ axes.T @ back
        return cls(transforms, centre, matrix)

    def __call__(self, theta: Float[Array, "rows unknowns"]) -> Float[Array, "rows unknowns"]:
        """Where independent errors have the density, shape (L, l), that is sought at theta."""
        away = self.transforms.unbounded(theta) - self.centre
        moved = np.repeat(self.centre[None], len(theta), axis=0)
        # Column by column: a product of matrices rounds a row differently beside other rows.
        for k, column in enumerate(self.matrix.T):
            moved += np.ascontiguousarray(away[:, k])[:, None] * column
        return self.transforms.natural(moved)

    def slope(self, theta: Float[Array, " unknowns"]) -> Float[Array, "unknowns unknowns"]:
        """Derivatives of that place with respect to theta, shape (l, l)."""
        u = self.transforms.unbounded(theta[None])
        moved = self.transforms.unbounded(self(theta[None]))
        before, after = (self.transforms.derivative(at)[0] for at in (u, moved))
        return np.asarray(after[:, None] * self.matrix / before)


def _roots(covariance: Array) -> tuple[Array, Array]:
    """Symmetric root of a covariance, and its inverse, by correlations: units differ widely."""
    sd = np.sqrt(np.diag(covariance))
    values, axes = np.linalg.eigh(covariance / np.outer(sd, sd))
    size = np.sqrt(np.maximum(values, 1e-14 * values[-1]))
    return sd[:, None] * (axes * size) @ axes.T, (axes / size) @ axes.T / sd
