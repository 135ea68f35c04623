"""A problem with some of its unknowns held: the sections that profiles and regions are made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.estimation.problems.problem import Evaluation, Misfit, Problem, jumps_of, measured_of
from bayesoleo.model.correlated import Correlated, JointNormal, joint_groups
from bayesoleo.model.priors import Prior


class Held:
    """The same problem in fewer unknowns.

    Parameters
    ----------
    problem : Problem
    theta : ndarray, shape (l,)
        All unknowns; those that stay free start from here.
    held : sequence of int
        Which keep their value.
    """

    def __init__(self, problem: Problem, theta: Array, held: Sequence[int]) -> None:
        self.problem, self.full_start = problem, np.array(theta, dtype=float)
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

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self.problem.outputs

    @property
    def runs(self) -> tuple[str, ...]:
        """Labels of the runs."""
        return self.problem.runs

    @property
    def counts(self) -> NDArray[np.int64]:
        """Number of samples, shape (N, s)."""
        return self.problem.counts

    def _given(self, held: Sequence[int]) -> list[Prior]:
        """Priors of all unknowns; a joint one of free unknowns is that given the held ones."""
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
        """Fix where a campaign's solver starts from; nothing to do for other problems."""
        freeze = getattr(self.problem, "freeze", None)
        if freeze is not None:
            freeze(self.full(np.asarray(theta, dtype=float)))

    def evaluate(self, theta: Array) -> Evaluation:
        """Residuals and sensitivities at one vector of the free unknowns."""
        found = self.problem.evaluate(self.full(np.asarray(theta, dtype=float)))
        return replace(found, sensitivity=tuple(s[:, self.free] for s in found.sensitivity))

    @property
    def branch_jumps(self) -> NDArray[np.int64]:
        """Solutions so far that left their branch, by run, shape (N,)."""
        return jumps_of(self.problem)

    def misfit(self, theta: Array) -> Misfit:
        """Sums of squares at many vectors of the free unknowns."""
        return self.problem.misfit(self.full(np.atleast_2d(np.asarray(theta, dtype=float))))


def _conditional(
    joint: JointNormal, free: Sequence[int], known: Sequence[int], values: Array
) -> JointNormal:
    """Some parameters of a joint prior, given others."""
    mean, covariance = np.array(joint.mean), np.array(joint.covariance)
    gain = np.linalg.solve(covariance[np.ix_(known, known)], covariance[np.ix_(known, free)]).T
    return JointNormal.of(
        [joint.names[k] for k in free],
        mean[free] + gain @ (values - mean[known]),
        covariance[np.ix_(free, free)] - gain @ covariance[np.ix_(known, free)],
        [(joint.low[k], joint.high[k]) for k in free],
    )
