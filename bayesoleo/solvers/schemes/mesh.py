"""Meshes of steps of different lengths over a period, or over the time of a transient."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array, Float
from bayesoleo.errors import InputError


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

    def locate(self, phase: Array) -> tuple[NDArray[np.int64], Array]:
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
