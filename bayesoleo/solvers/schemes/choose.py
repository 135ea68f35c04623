"""Discretisation schemes by name."""

from __future__ import annotations

from bayesoleo.errors import InputError
from bayesoleo.solvers.schemes.backward import BackwardDifferences
from bayesoleo.solvers.schemes.central import COMBINATIONS, Differences
from bayesoleo.solvers.schemes.collocation import Collocation
from bayesoleo.solvers.schemes.mesh import Mesh
from bayesoleo.solvers.schemes.scheme import Scheme
from bayesoleo.solvers.schemes.tableau import tableau

#: Three-stage Radau IIA: order five, and stiff components (steep friction) decay instead of
#: ringing.
DEFAULT_SCHEME = "radau3"
#: Solvers of periodic motions: all unknowns of a period at once on equal steps, the same on a mesh
#: with error control, shooting, shooting with derivatives on a mesh of its steps, and shooting with
#: SciPy's LSODA.
COLLOCATION = "collocation"
SOLVERS = (COLLOCATION, "adaptive", "shooting", "hybrid", "library")


def scheme(name: str, orders: tuple[int, ...], mesh: Mesh | None = None) -> Scheme:
    """A scheme for dofs of the given orders.

    Parameters
    ----------
    name : str
        ``radau2``, ``radau3``, ``gauss2``, ``gauss3``, or ``thesis`` for second-order backward
        differences; ``central`` and its combinations
        (:mod:`~bayesoleo.solvers.schemes.central`) to see why they were not chosen. Gauss points do
        not damp what is infinitely stiff: not for a dof ruled by an algebraic equation (a drive
        through a compliance of zero).
    orders : tuple of int
        Order of each dof.
    mesh : Mesh, optional
        Steps of different lengths, for collocation only.

    Raises
    ------
    InputError
        If there is no such scheme, or if it cannot have steps of different lengths.
    """
    if name != "thesis" and name not in COMBINATIONS:
        return Collocation(tableau(name), orders, mesh)
    if mesh is not None:
        raise InputError("differences need equal steps", value=name, hint="use radau3 or gauss3")
    return BackwardDifferences(orders) if name == "thesis" else Differences(orders, name)
