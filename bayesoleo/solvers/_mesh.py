"""Meshes of unequal steps over a period or a transient, and collocation methods.

Nodes, weights and interpolation polynomials of a method are computed, not tabulated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.polynomial import Polynomial, legendre

from bayesoleo._compiled import jit
from bayesoleo._types import Array, Float, Integers
from bayesoleo.errors import InputError

#: Neighbouring steps differ by this factor at most. If other parameters move a kink (a velocity
#: that changes sign under dry friction) away from its fine steps, the step that it reaches is no
#: longer than a fixed part of the distance moved.
GRADING = 1.5
#: Part of an input's range by which a step may miss it between the points where it is seen.
INPUT_TOLERANCE = 1e-3


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

    @property
    def polynomials(self) -> Array:
        """Coefficients of the stages' Lagrange polynomials, by stage and power, shape (s, s)."""
        return np.ascontiguousarray(_coefficients(tuple(self.c))[0].T)

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
        found = [np.empty((np.size(position), self.stages)) for _ in range(3)]
        for table, coefficients in zip(found, _coefficients(tuple(self.c)), strict=True):
            _evaluate(np.asarray(position, float), coefficients, table)
        return found[0], found[1], found[2]


@jit
def _evaluate(x: Array, coefficients: Array, values: Array) -> None:
    """Polynomials (degree + 1, s) at ``x (N,)``, shape (N, s), by Horner's scheme."""
    for i in range(x.size):
        for j in range(coefficients.shape[1]):
            value = coefficients[-1, j]
            for k in range(coefficients.shape[0] - 2, -1, -1):
                value = coefficients[k, j] + value * x[i]
            values[i, j] = value


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


def graded(mesh: Mesh, ratio: float = GRADING) -> Mesh:
    """Cut steps until neighbours differ by a factor, or by thrice that where pieces meet.

    Parameters
    ----------
    mesh : Mesh
    ratio : float
        The factor, above one.
    """
    lengths = np.diff(mesh.edges)
    # How long pieces have become at the end of each step from those on its left, and may be at its
    # beginning to shrink to those on its right.
    left, right = lengths.copy(), lengths.copy()
    for n in range(1, lengths.size):
        left[n] = min(left[n], ratio * left[n - 1] + (ratio - 1) * lengths[n])
    for n in range(lengths.size - 2, -1, -1):
        right[n] = min(right[n], ratio * right[n + 1] + (ratio - 1) * lengths[n])
    edges = [0.0]
    for n, length in enumerate(lengths):
        before = left[n - 1] if n > 0 else length
        after = right[n + 1] if n + 1 < lengths.size else length
        edges += _cut(mesh.edges[n], length, before, after, ratio)
    edges[-1] = 1.0
    return Mesh(np.array(edges))


def _cut(left: float, length: float, before: float, after: float, ratio: float) -> list[float]:
    """Right edges of the pieces of one step, that grow from both of its neighbours."""
    first, last = min(length, ratio * before), min(length, ratio * after)
    if length <= min(first, last) * (1 + 1e-12):
        return [left + length]
    position, pieces = 0.0, []
    while position < length * (1 - 1e-12):
        # No piece longer than the geometric growth from either end allows at its place.
        ahead = length - position
        piece = min(first + (ratio - 1) * position, (last + (ratio - 1) * ahead) / ratio)
        pieces.append(min(piece, ahead))
        position += pieces[-1]
    if len(pieces) > 1 and pieces[-1] < 0.5 * pieces[-2]:
        merged = 0.5 * (pieces[-1] + pieces[-2])
        pieces[-2:] = [merged, merged]
    return [*(left + np.cumsum(pieces[:-1])), left + length]


def halved(mesh: Mesh, times: int = 1) -> Mesh:
    """Cut every step into two, so many times."""
    edges = mesh.edges
    for _ in range(times):
        middle = 0.5 * (edges[:-1] + edges[1:])
        edges = np.sort(np.concatenate([edges, middle]))
    return Mesh(edges)


def joined(mesh: Mesh, times: int = 1) -> Mesh:
    """Join every two neighbouring steps, so many times; the last is alone where they are odd."""
    edges = mesh.edges
    for _ in range(times):
        edges = np.append(edges[:-1:2], 1.0)
    return Mesh(edges)


def resolving(
    mesh: Mesh,
    inputs: Callable[[Array], Array],
    method: Tableau,
    shortest: float,
    tolerance: float = INPUT_TOLERANCE,
) -> Mesh:
    """Halve the steps in which the inputs are no polynomial through what the method sees of them.

    Parameters
    ----------
    mesh : Mesh
    inputs : callable
        Rows of inputs ``(nu, N)`` at parts of the time ``(N,)``.
    method : Tableau
        Its stages are where inputs are seen.
    shortest : float
        Steps below twice this part of the time are not cut.
    tolerance : float
        Largest distance between them, over each row's range.
    """
    between = np.linspace(0.0, 1.0, 2 * method.stages + 1)
    weights = method.weights(between)[0]
    for _ in range(64):
        edges, count = mesh.edges, mesh.steps
        seen = inputs(mesh.points(method.c))
        if seen.shape[0] == 0:
            return mesh
        true = inputs(mesh.points(between))
        span = np.ptp(true, axis=1)[:, None, None]
        follows = seen.reshape(-1, count, method.stages) @ weights.T
        missed = np.abs(true.reshape(-1, count, between.size) - follows).max(axis=2)
        cut = (missed > tolerance * span[:, :, 0]).any(axis=0) & (np.diff(edges) >= 2 * shortest)
        if not cut.any():
            return mesh
        middle = 0.5 * (edges[:-1] + edges[1:])[cut]
        mesh = Mesh(np.sort(np.concatenate([edges, middle])))
    return mesh
