"""Periodic solution as every solver returns it, and the status with which a solver ends."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from bayesoleo._types import Array, Complex, ComplexArray, Float, Int, Integers


class Status(IntEnum):
    """Outcome of a solve, an estimate or one evaluation of a log density."""

    CONVERGED = 0
    INADMISSIBLE = 1
    NO_CONVERGENCE = 2
    SINGULAR = 3
    NOT_FINITE = 4
    OUT_OF_BOUNDS = 5
    TOLERANCE_NOT_MET = 6
    NO_ERROR_ESTIMATE = 7

    @property
    def message(self) -> str:
        """One sentence for a person."""
        return _MESSAGES[self]

    @property
    def ok(self) -> bool:
        """Whether the result may be used."""
        return self is Status.CONVERGED

    @property
    def solved(self) -> bool:
        """Whether there is a solution at all, be its error too large or not known."""
        return self in (Status.CONVERGED, Status.TOLERANCE_NOT_MET, Status.NO_ERROR_ESTIMATE)


_MESSAGES = {
    Status.CONVERGED: "converged",
    Status.INADMISSIBLE: "the solution leaves the model's admissible region",
    Status.NO_CONVERGENCE: "the iteration did not converge",
    Status.SINGULAR: "the linearised equations are singular",
    Status.NOT_FINITE: "a residual or a derivative is not finite",
    Status.OUT_OF_BOUNDS: "a parameter lies outside its prior's support",
    Status.TOLERANCE_NOT_MET: "the error stays above the tolerance on the finest mesh allowed",
    Status.NO_ERROR_ESTIMATE: "the iteration converged, but its error could not be estimated",
}


def first_failure(status: Int[Integers, "vectors runs"]) -> Int[Integers, " vectors"]:
    """Of each vector the first status that is not ``CONVERGED``, shape (L,), of those of its runs,
    shape (L, N)."""
    if not status.shape[1]:
        return np.full(len(status), int(Status.CONVERGED))
    first = (status != Status.CONVERGED).argmax(axis=1)
    return np.asarray(status[np.arange(len(status)), first])


def count(statuses: Iterable[int] | ArrayLike) -> dict[str, int]:
    """Number of outcomes by name, only those that occur.

    Parameters
    ----------
    statuses : array_like of int
        Values of :class:`Status`.

    Returns
    -------
    dict of str to int
        Lower-case member name to number of occurrences.
    """
    values, numbers = np.unique(np.asarray(statuses, dtype=int), return_counts=True)
    return {Status(v).name.lower(): int(n) for v, n in zip(values, numbers, strict=True)}


def added(counts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Sum of several counts by name."""
    return dict(sum((Counter(dict(item)) for item in counts), start=Counter()))


def counted(failures: Mapping[str, int]) -> str:
    """Counts for a person, as ``3 inadmissible, 1 no convergence``; empty where there are none."""
    return ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in failures.items() if n)


@dataclass(frozen=True, eq=False)
class Orbit:
    """A closed motion of one parameter vector.

    Parameters
    ----------
    phases : ndarray, shape (n,)
        Where the states are, in cycles from 0 to below 1; the first is 0.
    states : ndarray, shape (n, D)
        Value, and velocity of a second-order dof, of each dof in turn; SI.
    period : float
        Seconds.
    monodromy : ndarray, shape (D, D)
        Derivative of the state after a period by the state before; NaN where it is not known.
    status : Status
        How the solver ended; unless it is ``solved`` the states are only where it stopped.
    error : float
        Estimated largest error of a state over that state's swing, or of the time of a kink in
        cycles; NaN where there is no estimate.
    evaluations : int
        How often the equations were evaluated, counted by points in time.
    """

    phases: Float[Array, " points"]
    states: Float[Array, "points states"]
    period: float
    monodromy: Float[Array, "states states"]
    status: Status
    error: float
    evaluations: int

    @cached_property
    def multipliers(self) -> Complex[ComplexArray, " states"]:
        """Floquet multipliers, largest first, shape (D,); NaN where they are not known."""
        return floquet_multipliers(self.monodromy)

    @property
    def stable(self) -> bool:
        """Whether every disturbance dies out: all multipliers inside the unit circle.

        False where they are not known. An autonomous system's own multiplier of one makes it False:
        compare the others.
        """
        return bool(np.all(np.abs(self.multipliers) < 1.0))


def floquet_multipliers(
    monodromy: Float[Array, "states states"],
) -> Complex[ComplexArray, " states"]:
    """Eigenvalues of a monodromy matrix ``(D, D)``, largest first; NaN if it is not finite."""
    if not np.isfinite(monodromy).all():
        return np.full(monodromy.shape[0], complex(np.nan))
    values = np.linalg.eigvals(monodromy).astype(np.complex128)
    return values[np.argsort(-np.abs(values), kind="stable")]
