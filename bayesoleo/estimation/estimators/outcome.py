"""The way of an estimator, and how it ended."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from bayesoleo._types import Array, Float
from bayesoleo.estimation.problems.problem import Evaluation
from bayesoleo.solvers.status import Status


@dataclass(frozen=True)
class Iteration:
    """Where one iteration ended.

    Parameters
    ----------
    number : int
        Zero at the start.
    theta : ndarray, shape (l,)
    variance : ndarray, shape (s,) or (s, s)
        Staged at ``theta``; a matrix where the objective estimates one.
    objective : float
        The method's own objective at both.
    halvings : int
        Of the step that led here.
    """

    number: int
    theta: Float[Array, " unknowns"]
    variance: Float[Array, " outputs"] | Float[Array, "outputs outputs"]
    objective: float
    halvings: int


@dataclass(frozen=True)
class Outcome:
    """How the loop ended: the last point, its evaluation and the way there.

    Parameters
    ----------
    theta : ndarray, shape (l,)
    evaluation : Evaluation
    status : Status
    history : tuple of Iteration
        Empty if the start could not be evaluated.
    evaluations : int
    distance : float
        To the method's fixed point by the last linearisation, in standard deviations.
    failures : mapping of str to int
        Evaluations that came to nothing, by the lower-case name of their status.
    """

    theta: Float[Array, " unknowns"]
    evaluation: Evaluation
    status: Status
    history: tuple[Iteration, ...]
    evaluations: int
    distance: float
    failures: Mapping[str, int] = field(default_factory=dict)
