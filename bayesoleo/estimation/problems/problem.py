"""The contract between whatever can be fitted and whatever fits it.

Estimators and samplers see a :class:`Problem`: names, priors, and the residuals ``e = y -
yhat(theta)`` of ``s`` output channels in ``N`` runs. They never see a model, so that a closed
formula and a campaign of measured runs are estimated by the same code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from bayesoleo._types import Array, Bool, Flags, Float, Int, Integers
from bayesoleo.model.priors import Prior
from bayesoleo.solvers.status import Status


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
        Of each run's periodic solution, where there are such; its eigenvalues are the Floquet
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
        Values of :class:`~bayesoleo.solvers.status.Status`.
    """

    sum_of_squares: Float[Array, "vectors runs outputs"]
    status: Int[Integers, " vectors"]


def jumps_of(problem: Problem) -> Int[Integers, " runs"]:
    """Solutions so far that left their branch, by run, shape (N,); zeros where none are counted."""
    return np.asarray(getattr(problem, "branch_jumps", np.zeros(len(problem.runs), np.int64)))


class Named(Protocol):
    """Something with unknowns that have names."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the unknowns."""


def measured_of(problem: Named) -> Bool[Flags, " unknowns"]:
    """Which unknowns have a prior that is a measurement, shape (l,).

    These are nuisance parameters and constants known to a tolerance: what is known of them counts
    in every estimator. A problem names them in ``nuisances``.
    """
    nuisances = getattr(problem, "nuisances", frozenset[str]())
    return np.array([name in nuisances for name in problem.names], dtype=bool)


class Problem(Protocol):
    """Something with ``l`` unknowns, ``N`` runs and ``s`` outputs that can be fitted."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns; one that varies by run reads ``name[run]``."""

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
