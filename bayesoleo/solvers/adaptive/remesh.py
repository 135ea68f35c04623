"""The next mesh: as many steps as a tolerance needs, each with the same share of the error."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from bayesoleo._types import Array
from bayesoleo.solvers.adaptive.crossings import Crossings
from bayesoleo.solvers.adaptive.warp import warp_between
from bayesoleo.solvers.schemes.mesh import Mesh

#: Part of the tolerance that is aimed at.
SAFETY = 0.3
#: Shortest and longest new step over the old one.
SHORTEST, LONGEST = 1.0 / 4.0, 4.0
#: How fast lengths of steps may change along the period.
GROWTH = 1.0
#: Steps between two kinks.
LEAST_STEPS = 2


@dataclass(frozen=True, eq=False)
class MeshError:
    """Errors over the states' sizes.

    Parameters
    ----------
    own : ndarray, shape (n,)
        What arises inside each step.
    largest : float
        Largest error anywhere.
    """

    own: Array
    largest: float


def remesh(
    mesh: Mesh,
    misfit: MeshError,
    tolerance: float,
    before: Crossings | None,
    after: Crossings | None,
    order: int,
    max_steps: int,
) -> tuple[Mesh, bool]:
    """Place the steps anew.

    Parameters
    ----------
    mesh : Mesh
        The present one, with ``n`` steps.
    misfit : MeshError
        Its errors.
    tolerance : float
        Largest error wanted.
    before, after : Crossings, optional
        Kinks on which edges stand, and on which they shall stand.
    order : int
        Power of its length with which the error of a step falls.
    max_steps : int
        No more than these.

    Returns
    -------
    mesh : Mesh
    enough : bool
        Whether the steps were not limited by their number.
    """
    wanted = _wanted_lengths(mesh, misfit, tolerance, order)
    # Steps move along with the kinks between which they stand.
    edges = warp_between(before, after).forward(mesh.edges)
    number = np.concatenate([[0.0], np.cumsum(np.diff(mesh.edges) / wanted)])
    most = number[-1]
    if most > max_steps:
        number *= max_steps / most
    ends = np.unique(np.concatenate([[0.0], [] if after is None else after.phases, [1.0]]))
    pieces = []
    for low, high in pairwise(ends):
        first, last = np.interp([low, high], edges, number)
        count = max(LEAST_STEPS, int(np.ceil(last - first)))
        inside = np.interp(np.linspace(first, last, count + 1)[1:-1], number, edges)
        pieces.append(np.concatenate([[low], inside]))
    return Mesh(np.unique(np.append(np.concatenate(pieces), 1.0))), most <= max_steps


def _wanted_lengths(mesh: Mesh, misfit: MeshError, tolerance: float, order: int) -> Array:
    """Length of a step around each present one, in cycles, shape (n,)."""
    lengths = np.diff(mesh.edges)
    # What the closure makes of a step's error is measured: it multiplies all of them alike.
    target = SAFETY * tolerance * min(1.0, misfit.own.max() / max(misfit.largest, 1e-300))
    # No pass makes the largest error smaller than this. To ask more of other steps is in vain: what
    # they show may be but the response to that largest one.
    target = max(target, misfit.own.max() * SHORTEST**order)
    factor = (target / np.maximum(misfit.own, 1e-300)) ** (1.0 / order)
    wanted = lengths * np.clip(factor, SHORTEST, LONGEST)
    return _graded(0.5 * (mesh.edges[:-1] + mesh.edges[1:]), wanted)


def _graded(phase: Array, wanted: Array) -> Array:
    """Lengths that grow no faster than allowed on both sides of each phase, around the period."""
    rise = GROWTH * np.concatenate([phase - 1.0, phase, phase + 1.0])
    around = np.tile(wanted, 3)
    ahead = np.minimum.accumulate(around - rise) + rise
    behind = np.minimum.accumulate((around + rise)[::-1])[::-1] - rise
    return np.minimum(ahead, behind)[wanted.size : 2 * wanted.size]
