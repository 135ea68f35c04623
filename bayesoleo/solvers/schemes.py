"""Discretisation schemes by name."""

from __future__ import annotations

from bayesoleo.solvers.backward import BackwardDifferences
from bayesoleo.solvers.collocation import Collocation
from bayesoleo.solvers.periodic import Scheme
from bayesoleo.solvers.tableau import tableau

#: Three-stage Radau IIA: order five, and stiff components (steep friction) decay instead of
#: ringing.
DEFAULT_SCHEME = "radau3"


def scheme(name: str, orders: tuple[int, ...]) -> Scheme:
    """A scheme for dofs of the given orders.

    Parameters
    ----------
    name : str
        ``radau2``, ``radau3``, ``gauss2``, ``gauss3``, or ``thesis`` for second-order backward
        differences. Gauss points do not damp what is infinitely stiff: not for a dof ruled by an
        algebraic equation (a drive through a compliance of zero).
    orders : tuple of int
        Order of each dof.

    Raises
    ------
    InputError
        If there is no such scheme.
    """
    return BackwardDifferences(orders) if name == "thesis" else Collocation(tableau(name), orders)
