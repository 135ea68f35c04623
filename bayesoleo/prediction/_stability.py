"""Stability of predicted motions, and jumps between branches.

A nonlinear model may respond to one input in several ways. Newton's method finds one response and
says nothing of the others. A small change of the parameters can move it to another branch, and it
finds unstable motions, on which no rig could stay, as readily as stable ones. Both are detected
from quantities that a solve returns anyway.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from bayesoleo._compiled import cached
from bayesoleo._types import Array, Complex, ComplexArray, Flags, Int, Integers
from bayesoleo.solvers._orbit import floquet_multipliers

__all__ = ["Stability", "count_unstable"]

#: Nodes of a period at which two motions are compared: another branch differs at most of them.
COMPARED = 16
#: A correction of a linear prediction is taken for a jump if it exceeds the predicted move, and
#: this part of the swing.
LARGE = 0.1
#: A component whose swing is below this part of its size stands still; it only has round-off.
STILL = 1e-9
#: How far outside the unit circle a multiplier must lie to count: an undamped motion's lie on it
#: but for the errors of the mesh.
MARGIN = 1e-6
#: Errors of eigenvalues over the largest one: rounding of a product of a period's steps.
ROUNDING = 1e-13
#: Real multipliers below this are called close to a doubling of the period.
NEAR = -0.9
#: Findings, with a place for the runs and the multiplier of each.
DOUBLED = (
    "the periodic solution of {} is unstable and its period doubles (multiplier below -1): a rig"
    " answers in twice the period; if the record does, declare half its frequency for the run"
)
NEARLY_DOUBLED = (
    "the periodic solution of {} is close to where its period doubles (multiplier -1): an estimate"
    " may have settled there because the record repeats in twice the period only"
)
SECOND_FREQUENCY = (
    "the periodic solution of {} is unstable: a rig answers with a second frequency beside the"
    " input's"
)
ELSEWHERE = (
    "the periodic solution of {} is unstable (multiplier above 1): a rig leaves it for another"
    " answer to the same input"
)
JUMPED = (
    "branch jumps: the periodic solution of {} went to another branch between neighbouring"
    " parameters (how often in brackets): the model has several answers to this input, and a fit"
    " may follow the wrong one"
)
CHANGED = (
    "the periodic solution of {} changed its stability between neighbouring parameters (how often"
    " in brackets), with no jump to another branch: some of the parameters tried have an unstable"
    " motion, on which no rig stays. A nonlinear model then has other answers to this input; a"
    " linear one, which is unstable where a damping is negative, has none"
)


@cached()
def jumps(
    x0: Array, x_p: Array, swing: Array, nodes: Integers, change: Array, x: Array, found: Flags
) -> None:
    """Lane by lane, whether solutions ``x (L, n, w)`` are off their prediction by more than it
    moved and more than a part of the swing ``(D,)``; ``x0 (n, w)`` and ``x_p (na, n, w)`` predict.
    """
    for lane in range(x.shape[0]):
        found[lane] = False
        for j in range(swing.size):
            moved, corrected = 0.0, 0.0
            for m in nodes:
                step = 0.0
                for k in range(x_p.shape[0]):
                    step += change[lane, k] * x_p[k, m, j]
                moved = max(moved, abs(step))
                corrected = max(corrected, abs(x[lane, m, j] - x0[m, j] - step))
            if corrected > moved and corrected > LARGE * swing[j]:
                found[lane] = True


def is_jump(here: Array, ahead: Array, x: Array, swing: Array, nodes: Integers) -> bool:
    """The same for one solution ``x (n, w)``, predicted as ``ahead`` from ``here``."""
    columns = (nodes, slice(0, swing.size))
    moved = np.abs(ahead - here)[columns].max(axis=0)
    corrected = np.abs(x - ahead)[columns].max(axis=0)
    return bool(np.any((corrected > moved) & (corrected > LARGE * swing)))


def swings(x: Array, states: int) -> Array:
    """Largest less least value of a motion's states ``(n, D)``, infinite where one stands still."""
    columns = x[:, :states]
    swing = np.ptp(columns, axis=0)
    return np.where(swing > STILL * np.abs(columns).max(axis=0), swing, np.inf)


def compared(n: int) -> Integers:
    """Nodes of a mesh of ``n`` steps that are looked at."""
    return np.unique(np.arange(COMPARED) * n // COMPARED)


def count_unstable(multipliers: ComplexArray) -> Integers:
    """Number of multipliers ``(..., D)`` outside the unit circle, -1 where they are not known.

    Beside a huge one the others are known to its rounding only; what is not known to lie outside
    is not counted.
    """
    known = np.isfinite(multipliers).all(axis=-1) & (multipliers.shape[-1] > 0)
    sizes = np.where(known[..., None], np.abs(multipliers), 0.0)
    margin = MARGIN + ROUNDING * sizes.max(axis=-1, keepdims=True, initial=0.0)
    return np.where(known, np.sum(sizes > 1.0 + margin, axis=-1), -1)


def unstable_of(monodromy: Array) -> Integers:
    """The same from monodromy matrices ``(L, D, D)``."""
    known = np.isfinite(monodromy).all(axis=(1, 2))
    values = np.linalg.eigvals(np.where(known[:, None, None], monodromy, 0.0))
    return np.where(known, count_unstable(values.astype(np.complex128)), -1)


@dataclass(frozen=True, eq=False)
class Stability:
    """The periodic solutions of an estimate's runs.

    Parameters
    ----------
    runs : tuple of str
        Labels of the ``N`` runs.
    multipliers : ndarray of complex, shape (N, D)
        Floquet multipliers of each run's solution, largest first: by how much a small disturbance
        grows in a period. NaN for a transient; ``D`` is zero for a model without dofs.
    jumps : ndarray of int, shape (N,)
        How often a run's solution left its branch, or changed the number of multipliers outside the
        unit circle, between parameters that followed each other.
    changes : ndarray of int, shape (N,), optional
        How many of these changed that number only; by default none.
    """

    runs: tuple[str, ...]
    multipliers: Complex[ComplexArray, "runs states"]
    jumps: Int[Integers, " runs"]
    changes: Int[Integers, " runs"] | None = None

    @classmethod
    def of(
        cls,
        runs: Sequence[str],
        monodromies: Sequence[Array | None],
        jumps: Integers,
        changes: Integers | None = None,
    ) -> Stability:
        """From the monodromy matrix ``(D, D)`` of each run, where there is one."""
        size = max((m.shape[0] for m in monodromies if m is not None), default=0)
        table = np.full((len(runs), size), complex(np.nan, np.nan))
        for row, matrix in zip(table, monodromies, strict=True):
            if matrix is not None:
                row[:] = floquet_multipliers(matrix)
        return cls(tuple(runs), table, jumps, changes)

    @property
    def unstable(self) -> Integers:
        """Number of multipliers outside the unit circle by run, -1 where they are not known."""
        return count_unstable(self.multipliers)

    @property
    def branch_jumps(self) -> int:
        """Jumps of all runs."""
        return int(self.jumps.sum())

    @property
    def only_changed(self) -> Integers:
        """Jumps of each run at which the number of unstable multipliers changed only."""
        return np.zeros_like(self.jumps) if self.changes is None else self.changes

    def with_jumps(self, jumps: Integers, changes: Integers) -> Stability:
        """Copy with a given number of jumps, and of those that changed the stability only."""
        return replace(self, jumps=jumps, changes=changes)

    def as_plain(self) -> dict[str, dict[str, Any]]:
        """Values by run for JSON: multipliers as real and imaginary part; None if unknown."""
        return {
            run: {
                "multipliers": [[float(m.real), float(m.imag)] for m in row] if count >= 0 else [],
                "stable": bool(count == 0) if count >= 0 else None,
                "branch_jumps": int(jumps),
            }
            for run, row, count, jumps in zip(
                self.runs, self.multipliers, self.unstable, self.jumps, strict=True
            )
        }

    def together(self, other: Stability) -> Stability:
        """These runs and others, of one model."""
        rows = np.full((len(other.runs), self.multipliers.shape[1]), complex(np.nan, np.nan))
        if other.multipliers.size:
            rows[:] = other.multipliers
        return Stability(
            self.runs + other.runs,
            np.concatenate([self.multipliers, rows]),
            np.concatenate([self.jumps, other.jumps]),
            np.concatenate([self.only_changed, other.only_changed]),
        )

    def notes(self) -> list[str]:
        """Notes for a reader, one sentence each; empty where all runs are stable."""
        found: dict[str, list[str]] = {}
        for run, row, count in zip(self.runs, self.multipliers, self.unstable, strict=True):
            what = _finding(row, int(count))
            if what:
                found.setdefault(what, []).append(f"{run} ({_spelled(_telling(row))})")
        notes = [what.format(_runs(runs)) for what, runs in found.items()]
        changes = self.only_changed
        for text, numbers in ((JUMPED, self.jumps - changes), (CHANGED, changes)):
            counts = zip(self.runs, numbers, strict=True)
            runs = [f"{run} ({number})" for run, number in counts if number]
            if runs:
                notes.append(text.format(_runs(runs)))
        return notes


def _telling(multipliers: ComplexArray) -> complex:
    """The least of the real ones where that is the nearest to -1, else the largest."""
    least = multipliers[np.argmin(multipliers.real)]
    near = least.imag == 0 and least.real < NEAR and np.abs(multipliers[0]) <= 1.0 + MARGIN
    return complex(least if near else multipliers[0])


def _finding(multipliers: ComplexArray, unstable: int) -> str:
    """Behaviour of a rig where the solution is unstable or nearly so."""
    if unstable < 0:
        return ""
    value = _telling(multipliers)
    if not unstable:
        return NEARLY_DOUBLED if value.imag == 0 and value.real < NEAR else ""
    if value.imag:
        return SECOND_FREQUENCY
    return DOUBLED if value.real < 0 else ELSEWHERE


def _spelled(multiplier: complex) -> str:
    if multiplier.imag:
        return f"{multiplier.real:.3g} ± {abs(multiplier.imag):.3g}i"
    return f"{multiplier.real:.4g}"


def _runs(labels: Sequence[str]) -> str:
    return f"{'run' if len(labels) == 1 else 'runs'} {', '.join(labels)}"
