"""The problem protocol: the interface between the data with their model and the estimators.

Estimators and samplers see an :class:`EstimationProblem`: names, priors, and the residuals
``e = y - yhat(theta)`` of ``s`` output channels in ``N`` runs. They never see a model, so that a
closed formula and a campaign of measured runs are estimated by the same code. Error models that use
the order of samples need problems that also return residuals sample by sample. Profiles and regions
use sections of a problem, in which some unknowns are held.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from dataclasses import dataclass, replace
from typing import Protocol, cast, runtime_checkable

import numpy as np

from bayesoleo._types import Array, Bool, Flags, Float, Int, Integers
from bayesoleo.error_models._base import RunSamples
from bayesoleo.model._correlated_priors import Correlated, JointNormal, joint_groups
from bayesoleo.model._priors import Prior
from bayesoleo.solvers._orbit import Status


@dataclass(frozen=True)
class Evaluation:
    """Residuals and sensitivities at one parameter vector.

    Parameters
    ----------
    residual : tuple of ndarray, each shape (n_b,)
        ``y - yhat`` of each output channel, runs one after the other, in the channel's SI unit.
    sensitivity : tuple of ndarray, each shape (n_b, l)
        Derivatives of the prediction ``yhat`` with respect to the ``l`` unknowns (so the residual's
        are its negative).
    status : Status
        Unless it is ``CONVERGED`` the arrays hold NaN.
    monodromy : tuple of ndarray or None
        Monodromy matrix of each run's periodic solution, if any; its eigenvalues are the Floquet
        multipliers.
    """

    residual: tuple[Float[Array, " _samples"], ...]
    sensitivity: tuple[Float[Array, "_samples unknowns"], ...]
    status: Status
    monodromy: tuple[Float[Array, "states states"] | None, ...] = ()


@dataclass(frozen=True)
class Misfit:
    """Sums of squared residuals at many parameter vectors.

    Parameters
    ----------
    sum_of_squares : ndarray, shape (L, N, s)
        By parameter vector, run and output; NaN where the vector failed.
    status : ndarray of int, shape (L,)
        Values of :class:`~bayesoleo.solvers.Status`.
    """

    sum_of_squares: Float[Array, "vectors runs outputs"]
    status: Int[Integers, " vectors"]


def residuals_first(
    problem: EstimationProblem, theta: Float[Array, " unknowns"]
) -> Evaluation | None:
    """Residuals at one vector without sensitivities, where a problem gives them for far less; a
    step that does not improve them needs no more."""
    first = getattr(problem, "residuals_first", None)
    return None if first is None else cast("Evaluation | None", first(theta))


def anchored_evaluation(problem: EstimationProblem, theta: Float[Array, " unknowns"]) -> Evaluation:
    """Residuals and sensitivities at one vector that depend on that vector alone, as a misfit does.

    Parameters
    ----------
    problem : EstimationProblem
        A campaign's starts each solution from its anchor, which stays; others have none.
    theta : ndarray, shape (l,)
    """
    found = getattr(problem, "evaluate_anchored", problem.evaluate)
    return cast("Evaluation", found(theta))


def for_thread[P: EstimationProblem](problem: P) -> P:
    """A problem that may be evaluated while others of its kind are, in one thread."""
    copied = getattr(problem, "for_thread", None)
    return problem if copied is None else cast("P", copied())


def jumps_of(problem: EstimationProblem) -> Int[Integers, " runs"]:
    """Number of solutions that left their branch, by run, shape (N,); zeros where not counted."""
    return np.asarray(getattr(problem, "branch_jumps", np.zeros(len(problem.runs), np.int64)))


def stability_changes_of(problem: EstimationProblem) -> Int[Integers, " runs"]:
    """Those of them that changed the stability only, shape (N,); zeros where not counted."""
    none = np.zeros(len(problem.runs), np.int64)
    return np.asarray(getattr(problem, "stability_changes", none))


def unwatched(problem: object) -> AbstractContextManager[None]:
    """Only compare solutions meanwhile, where a problem does more.

    Parameters
    ----------
    problem : EstimationProblem or Density
        A campaign's counts the solutions that left their branch, and far from the anchor that takes
        longer than the solutions. It also seeks motions where an elimination has to exchange rows,
        which may take a hundred times as long: meanwhile it gives such vectors up where a run has
        many steps, or on a path from the anchor.
    """
    found: AbstractContextManager[None] = getattr(problem, "unwatched", nullcontext)()
    return found


def undisturbed(problem: object) -> AbstractContextManager[None]:
    """Evaluate a problem elsewhere meanwhile; afterwards it is as it was.

    Parameters
    ----------
    problem : EstimationProblem
        A campaign's starts each solution from the last one, and may come back to another branch.
    """
    found: AbstractContextManager[None] = getattr(problem, "undisturbed", nullcontext)()
    return found


class Named(Protocol):
    """A problem with named unknowns."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""


def measured_of(problem: Named) -> Bool[Flags, " unknowns"]:
    """Which unknowns have a prior that is a measurement, shape (l,).

    These are nuisance parameters and constants known to a tolerance, whose prior counts in every
    estimator. A problem names them in ``nuisances``.
    """
    nuisances = getattr(problem, "nuisances", frozenset[str]())
    return np.array([name in nuisances for name in problem.names], dtype=bool)


class EstimationProblem(Protocol):
    """A problem with ``l`` unknowns, ``N`` runs and ``s`` outputs that can be fitted."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns; one that varies by run is ``name[run]``."""

    @property
    def priors(self) -> tuple[Prior, ...]:
        """Prior of each unknown."""

    @property
    def start(self) -> Float[Array, " unknowns"]:
        """Where an estimate starts, shape (l,)."""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the output channels."""

    @property
    def runs(self) -> tuple[str, ...]:
        """Labels of the runs."""

    @property
    def counts(self) -> Int[Integers, "runs outputs"]:
        """Number of samples by run and output, shape (N, s)."""

    def evaluate(self, theta: Float[Array, " unknowns"]) -> Evaluation:
        """Residuals and sensitivities at one vector, shape (l,)."""

    def misfit(self, theta: Float[Array, "vectors unknowns"]) -> Misfit:
        """Sums of squares at many vectors, shape (L, l).

        Each depends on its own vector alone, bit for bit.
        """


@runtime_checkable
class ResidualProblem(EstimationProblem, Protocol):
    """A problem that gives its residuals."""

    @property
    def samples(self) -> tuple[RunSamples, ...]:
        """When the samples of each run were taken, length N."""

    def residuals(
        self, theta: Float[Array, "vectors unknowns"], run: int
    ) -> tuple[Float[Array, "vectors outputs samples"], Int[Integers, " vectors"]]:
        """Residuals (L, s, n) of one run at vectors (L, l), and statuses (L,).

        Each depends on its own vector alone, bit for bit.
        """


class SameData:
    """A problem made of another one with the same outputs, runs and numbers of samples."""

    def __init__(self, problem: EstimationProblem) -> None:
        self.problem = problem

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.problem.outputs

    @property
    def runs(self) -> tuple[str, ...]:
        """Labels of the runs."""
        return self.problem.runs

    @property
    def counts(self) -> Integers:
        """Number of samples, shape (N, s)."""
        return self.problem.counts


class Held(SameData):
    """A problem with some of its unknowns held.

    Parameters
    ----------
    problem : EstimationProblem
    theta : ndarray, shape (l,)
        All unknowns; the free ones start from here.
    held : sequence of int
        Positions of the unknowns that keep their value.
    """

    def __init__(self, problem: EstimationProblem, theta: Array, held: Sequence[int]) -> None:
        super().__init__(problem)
        self.full_start = np.array(theta, dtype=float)
        self.free = np.setdiff1d(np.arange(len(problem.names)), np.asarray(held, dtype=int))
        self.priors: tuple[Prior, ...] = tuple(self._given(held)[k] for k in self.free)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the free unknowns."""
        return tuple(self.problem.names[k] for k in self.free)

    @property
    def nuisances(self) -> frozenset[str]:
        """Free unknowns whose prior is a measurement."""
        pairs = zip(self.problem.names, measured_of(self.problem), strict=True)
        return frozenset({name for name, measured in pairs if measured} & set(self.names))

    @property
    def start(self) -> Array:
        """Where an estimate starts, in the free unknowns."""
        return cast(Array, self.full_start[self.free])

    def _given(self, held: Sequence[int]) -> list[Prior]:
        """Priors of all unknowns; a joint prior is conditional on its held parameters."""
        priors = list(self.problem.priors)
        for joint, positions, members in joint_groups(priors):
            free = [k for k, position in enumerate(positions) if position not in held]
            if not free or len(free) == len(positions):
                continue
            known = [k for k in range(len(positions)) if k not in free]
            values = self.full_start[[positions[k] for k in known]]
            chosen = [members[k] for k in free], [members[k] for k in known]
            given = _conditional(joint, *chosen, values)
            for k in free:
                priors[positions[k]] = Correlated(joint.names[members[k]], given)
        return priors

    def full(self, theta: Array) -> Array:
        """All unknowns, shape (..., l), from the free ones."""
        whole = np.broadcast_to(self.full_start, (*theta.shape[:-1], self.full_start.size)).copy()
        whole[..., self.free] = theta
        return whole

    def freeze(self, theta: Array) -> None:
        """Fix the anchors of a campaign's solver; other problems have none."""
        freeze = getattr(self.problem, "freeze", None)
        if freeze is not None:
            freeze(self.full(np.asarray(theta, dtype=float)))

    def evaluate(self, theta: Array) -> Evaluation:
        """Residuals and sensitivities at one vector of the free unknowns."""
        found = self.problem.evaluate(self.full(np.asarray(theta, dtype=float)))
        return replace(found, sensitivity=tuple(s[:, self.free] for s in found.sensitivity))

    def evaluate_anchored(self, theta: Array) -> Evaluation:
        """The same from the anchor, see :func:`anchored_evaluation`."""
        found = anchored_evaluation(self.problem, self.full(np.asarray(theta, dtype=float)))
        return replace(found, sensitivity=tuple(s[:, self.free] for s in found.sensitivity))

    def for_thread(self) -> Held:
        """A copy that other threads leave alone, see :func:`for_thread`."""
        other = copy(self)
        other.problem = for_thread(self.problem)
        return other

    def residuals_first(self, theta: Array) -> Evaluation | None:
        """Residuals without sensitivities, see :func:`residuals_first`."""
        return residuals_first(self.problem, self.full(np.asarray(theta, dtype=float)))

    @property
    def branch_jumps(self) -> Integers:
        """Solutions so far that left their branch, by run, shape (N,)."""
        return jumps_of(self.problem)

    @property
    def stability_changes(self) -> Integers:
        """Those of them that changed the stability only, shape (N,)."""
        return stability_changes_of(self.problem)

    def unwatched(self) -> AbstractContextManager[None]:
        """Only compare solutions meanwhile."""
        return unwatched(self.problem)

    def misfit(self, theta: Array) -> Misfit:
        """Sums of squares at many vectors of the free unknowns."""
        return self.problem.misfit(self.full(np.atleast_2d(np.asarray(theta, dtype=float))))


def _conditional(
    joint: JointNormal, free: Sequence[int], known: Sequence[int], values: Array
) -> JointNormal:
    """Joint prior of some parameters, conditional on others."""
    mean, covariance = np.array(joint.mean), np.array(joint.covariance)
    gain = np.linalg.solve(covariance[np.ix_(known, known)], covariance[np.ix_(known, free)]).T
    return JointNormal.of(
        [joint.names[k] for k in free],
        mean[free] + gain @ (values - mean[known]),
        covariance[np.ix_(free, free)] - gain @ covariance[np.ix_(known, free)],
        [(joint.low[k], joint.high[k]) for k in free],
    )
