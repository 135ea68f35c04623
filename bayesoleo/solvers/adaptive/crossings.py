"""Where along a motion the equations have kinks: zeros of switching functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize.elementwise import find_root

from bayesoleo._types import Array
from bayesoleo.solvers.schemes.mesh import Mesh

#: Positions in a step at which signs are compared.
POSITIONS = np.arange(6) / 6.0
#: A function that stays this close to zero, over its largest size, is zero but for round-off.
LEAST = 1e-13
#: Crossings this close, in cycles, are one.
APART = 1e-14


@dataclass(frozen=True, eq=False)
class Crossings:
    """Zeros of switching functions in a period.

    Parameters
    ----------
    phases : ndarray, shape (K,)
        Cycles, ascending, from 0 to below 1.
    labels : tuple of tuple of (int, bool)
        Of each: which functions, and whether they rise.
    first : tuple of bool
        Whether each function is positive at the beginning of the period.
    """

    phases: Array
    labels: tuple[tuple[tuple[int, bool], ...], ...]
    first: tuple[bool, ...]

    def modes(self, phase: Array) -> Array:
        """One where a function is positive, else zero, at phases ``(N,)``: shape (ns, N)."""
        table = np.repeat(np.array(self.first, dtype=float)[:, None], phase.size, axis=1)
        for crossing, label in zip(self.phases, self.labels, strict=True):
            for which, rises in label:
                table[which, phase > crossing] = float(rises)
        return table

    def alike(self, other: Crossings) -> bool:
        """Whether the same functions cross zero in the same order."""
        return self.labels == other.labels and self.first == other.first


def find_crossings(values: Callable[[Array], Array], mesh: Mesh) -> Crossings:
    """Zeros of switching functions along a motion.

    Parameters
    ----------
    values : callable
        Phases (N,) to functions, shape (ns, N).
    mesh : Mesh
        On which the motion is smooth but for kinks.

    Returns
    -------
    Crossings
    """
    phases = np.append(mesh.points(POSITIONS), 1.0)
    table = values(phases)
    found: list[tuple[float, tuple[int, bool]]] = []
    first = []
    for k, row in enumerate(table):
        signs = _signs(row)
        first.append(bool(signs[0] > 0))
        for i in np.flatnonzero(signs[:-1] != signs[1:]):
            root = _root(values, k, phases[i], phases[i + 1])
            found.append((root, (k, bool(signs[i + 1] > 0))))
    found.sort(key=lambda item: item[0])
    groups: list[tuple[float, list[tuple[int, bool]]]] = []
    for phase, label in found:
        if groups and phase - groups[-1][0] <= APART:
            groups[-1][1].append(label)
        else:
            groups.append((phase, [label]))
    labels = tuple(tuple(group) for _, group in groups)
    return Crossings(np.array([phase for phase, _ in groups]), labels, tuple(first))


def _signs(row: Array) -> Array:
    """Signs around the period; zeros, and what is zero but for round-off, have their neighbour's.

    The end of the period is its beginning.
    """
    signs = np.sign(np.where(np.abs(row) <= LEAST * np.abs(row).max(), 0.0, row))
    some = np.flatnonzero(signs)
    if some.size == 0:
        return np.ones(row.size)
    signs[0] = signs[some[0]] if signs[0] == 0 else signs[0]
    signs[-1] = signs[0]
    index = np.where(signs != 0, np.arange(signs.size), 0)
    return signs[np.maximum.accumulate(index)]


def _root(values: Callable[[Array], Array], k: int, low: float, high: float) -> float:
    ends = np.array([low, high])
    at = values(ends)[k]
    if at[0] * at[1] >= 0.0:
        # The sign of an end that is zero but for round-off is its neighbour's: the zero is there.
        return float(ends[np.argmin(np.abs(at))]) % 1.0
    result = find_root(lambda phase: values(phase)[k], (ends[:1], ends[1:]))
    return float(result.x[0]) % 1.0
