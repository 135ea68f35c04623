"""How a numerical solution ended: the member's message says it, its value counts it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike


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
