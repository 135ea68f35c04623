"""Meshes of unequal steps over a period or a transient, and collocation methods.

Nodes, weights and interpolation polynomials of a method are computed, not tabulated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial import Polynomial, legendre
from numpy.polynomial.polynomial import polyval

from bayesoleo._types import Array, Float, Integers
from bayesoleo.errors import InputError


@dataclass(frozen=True)
class Tableau:
    """A one-step collocation method with ``s`` stages on the unit step.

    Parameters
    ----------
    name : str
        ``radau3``, for instance.
    order : int
        Order of the error at the nodes.
    c : ndarray, shape (s,)
        Stage positions.
    a : ndarray, shape (s, s)
        Integrals of the Lagrange polynomials from 0 to ``c[i]``.
    b : ndarray, shape (s,)
        Their integrals over the step.
    """

    name: str
    order: int
    c: Float[Array, " stages"]
    a: Float[Array, "stages stages"]
    b: Float[Array, " stages"]

    @property
    def stages(self) -> int:
        """Number of stages."""
        return self.c.size

    def weights(self, position: Array) -> tuple[Array, Array, Array]:
        """Lagrange polynomials of the stages and their first and second integrals from 0.

        Parameters
        ----------
        position : ndarray, shape (N,)
            Positions in the unit step.

        Returns
        -------
        tuple of three ndarray, each shape (N, s)
            They turn stage values of the highest derivative into that derivative, the one below and
            the one below that.
        """
        tables = [np.asarray(polyval(position, c).T, float) for c in _coefficients(tuple(self.c))]
        return tables[0], tables[1], tables[2]


@cache
def _coefficients(c: tuple[float, ...]) -> list[Array]:
    """Coefficients of the Lagrange polynomials and of their integrals, (degree + 1, s) each."""
    polynomials = _lagrange(np.array(c))
    columns = [[(p.integ(k) if k else p).coef for p in polynomials] for k in range(3)]
    return [np.array(column, dtype=float).T.copy() for column in columns]


def _lagrange(c: Array) -> list[Polynomial]:
    polynomials = []
    for i, own in enumerate(c):
        others = np.delete(c, i)
        polynomials.append(Polynomial.fromroots(others) / float(np.prod(own - others)))
    return polynomials


def _from_nodes(name: str, order: int, c: Array) -> Tableau:
    integrals = [p.integ() for p in _lagrange(c)]
    a = np.array([[integral(ci) for integral in integrals] for ci in c])
    b = np.array([integral(1.0) for integral in integrals])
    return Tableau(name, order, c, a, b)


def _radau_nodes(stages: int) -> Array:
    """Zeros of P_s - P_{s-1} on [-1, 1], which include 1 (Hairer and Wanner 1996, section IV.5)."""
    coefficients = np.zeros(stages + 1)
    coefficients[stages], coefficients[stages - 1] = 1.0, -1.0
    nodes = np.sort((np.real(legendre.legroots(coefficients)) + 1.0) / 2.0)
    nodes[-1] = 1.0  # exact by construction; the root finder leaves 1e-16
    return nodes


@cache
def tableau(name: str) -> Tableau:
    """A collocation method by name: ``radau2``, ``radau3``, ``gauss2`` or ``gauss3``.

    ``radau5`` is for integration, whose steps can be long.

    Raises
    ------
    InputError
        If there is no such method.

    References
    ----------
    Hairer, E. and Wanner, G. (1996). Solving Ordinary Differential Equations II, 2nd ed., section
    IV.5.
    """
    family, stages = name[:-1], name[-1:]
    if name != "radau5" and (stages not in ("2", "3") or family not in ("radau", "gauss")):
        raise InputError(
            "unknown scheme", value=name, hint="use radau2, radau3, gauss2, gauss3 or thesis"
        )
    s = int(stages)
    if family == "radau":
        return _from_nodes(name, 2 * s - 1, _radau_nodes(s))
    return _from_nodes(name, 2 * s, (legendre.leggauss(s)[0] + 1.0) / 2.0)


@dataclass(frozen=True, eq=False)
class Mesh:
    """Steps between given phases.

    Parameters
    ----------
    edges : ndarray, shape (n + 1,)
        Where steps begin and end, in cycles (or parts of a transient's time), from 0 to 1.

    Raises
    ------
    InputError
        If the edges do not rise from 0 to 1.
    """

    edges: Float[Array, " edges"]

    def __post_init__(self) -> None:
        edges = np.asarray(self.edges, dtype=np.float64)
        rising = edges.ndim == 1 and edges.size > 1 and bool(np.all(np.diff(edges) > 0.0))
        if not rising or edges[0] != 0.0 or edges[-1] != 1.0:
            raise InputError(
                "the edges of a mesh must rise from 0 to 1",
                value=edges if edges.size <= 8 else f"{edges.size} edges",
                hint="divide times by the period: edges = [0.0, 0.2, 0.3, 1.0]",
            )
        object.__setattr__(self, "edges", edges)

    @property
    def steps(self) -> int:
        """Number n of steps."""
        return self.edges.size - 1

    @property
    def relative(self) -> Array:
        """Lengths of the steps over their mean, shape (n,)."""
        return np.diff(self.edges) * self.steps

    def points(self, c: Array) -> Array:
        """Phases at the positions ``c (s,)`` inside every step, shape (n s,)."""
        return (self.edges[:-1, None] + np.diff(self.edges)[:, None] * c).ravel()

    def locate(self, phase: Array) -> tuple[Integers, Array]:
        """Step and position in it, from 0 to 1, of phases between 0 and 1."""
        index = np.searchsorted(self.edges, phase, side="right") - 1
        index = np.clip(index, 0, self.steps - 1)
        return index, (phase - self.edges[index]) / (self.edges[index + 1] - self.edges[index])

    def halved(self) -> Mesh:
        """Every step cut into two equal ones."""
        middle = 0.5 * (self.edges[:-1] + self.edges[1:])
        return Mesh(np.sort(np.concatenate([self.edges, middle])))


def equidistant(n: int) -> Mesh:
    """``n`` steps of one length."""
    return Mesh(np.arange(n + 1) / n)
