"""Moving a period's phases along with the kinks in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array
from bayesoleo.solvers.adaptive.crossings import Crossings
from bayesoleo.solvers.schemes.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Warp:
    """A rising map of the period onto itself, linear between given phases and their images.

    Parameters
    ----------
    source, image : ndarray, shape (K + 2,)
        From 0 to 1.
    """

    source: Array
    image: Array

    def forward(self, phase: Array) -> Array:
        """Images of phases from 0 to 1."""
        return np.interp(phase, self.source, self.image)

    def back(self, phase: Array) -> Array:
        """Phases of which these, from 0 to 1, are images."""
        return np.interp(phase, self.image, self.source)

    def mesh(self, mesh: Mesh) -> Mesh:
        """A mesh whose steps move along."""
        return Mesh(self.forward(mesh.edges))


#: Part of a stretch between kinks that remains at least.
LEAST = 0.1

SAME = Warp(np.array([0.0, 1.0]), np.array([0.0, 1.0]))


def warp_between(before: Crossings | None, after: Crossings | None) -> Warp:
    """The map from one set of kinks to another; the identity unless they are the same kinks."""
    if before is None or after is None or not before.alike(after):
        return SAME
    return Warp(*(np.concatenate([[0.0], c.phases, [1.0]]) for c in (before, after)))


def extrapolate(before: Crossings | None, now: Crossings | None, amount: float) -> Warp:
    """The map from the present kinks to the next ones.

    Parameters
    ----------
    before, now : Crossings
        Of two solutions on the way.
    amount : float
        Length of the next step over that of the last.

    Returns
    -------
    Warp
        The shortest stretch between two kinks goes on in geometric proportion, as the duration of a
        contact does with its stiffness; the others change in proportion to it, so that they settle
        where it vanishes.
    """
    last = warp_between(before, now)
    if last is SAME:
        return SAME
    old, new = np.diff(last.source), np.diff(last.image)
    k = int(np.argmin(new))
    change = new[k] * ((new[k] / old[k]) ** amount - 1.0)
    if new[k] != old[k]:
        amount = change / (new[k] - old[k])
    lengths = np.maximum(new + amount * (new - old), LEAST * new)
    lengths[k] = new[k] + change
    image = np.concatenate([[0.0], np.cumsum(lengths / lengths.sum())])
    image[-1] = 1.0
    return Warp(last.image, image)
