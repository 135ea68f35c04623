"""Generalised Gauss-Newton iteration of multiple shooting, for parameters and all states together.

Steps are damped by the natural monotonicity test. It measures the distance of a trial point from
the solution by the linearisation at the present point, in units of the unknowns, so that residuals,
gaps and equations need no relative weights.

Continuity is imposed gradually. At the start a gap between steps is a residual with the variance of
the initial gaps. Every full step divides that variance by ten, until gaps must close. Early
iterations thus keep the states near the samples and fit parameters to the rates of change, which is
nearly linear and converges from far. The final motion solves the model.

References
----------
Bock (1987); Deuflhard, P. (2011). Newton Methods for Nonlinear Problems, algorithm NLEQ-ERR.
Ye, J. et al. (2015). Improved variational methods in statistical data assimilation. Nonlinear
Processes in Geophysics 22, 205-213, for tightening the constraints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._types import Array, Float
from bayesoleo.error_models._independent import log_likelihood
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.estimation._multiple_shooting_step import Change, Local, ShootingProblem
from bayesoleo.estimation._objectives import log_prior
from bayesoleo.estimation._problem import measured_of
from bayesoleo.prediction._segments import LinearRun
from bayesoleo.solvers._orbit import Status

#: Part of a step below which damping gives up.
SMALLEST_PART = 1e-4
#: Size of a step from which the variances are staged anew: before, the residuals are those of a
#: start that follows the samples.
NEAR = 0.1
#: Where steps are as small as this, round-off may keep them from shrinking in every iteration.
TINY = 1e-5
#: Where nothing says how large a parameter is, no step of it is small.
LEAST_NORM = 1e-100
#: How a full step shrinks the variance that gaps are allowed, and the part of the first from which
#: they must close.
TIGHTER = 0.1
TIGHT = 1e-6
#: Relative change of states and of variances at which the iteration may end.
STATE_TOLERANCE = 1e-6
VARIANCE_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class ShootingIteration:
    """A line of the history: point, variances, objective, and how often its step was shortened."""

    theta: Array
    variance: Array
    objective: float
    damped: int


@dataclass(frozen=True, eq=False)
class ShootingOutcome:
    """Where the iteration ended.

    Parameters
    ----------
    theta : ndarray, shape (l,)
    x : tuple of ndarray, shape (n, w) each
        Unknowns of each run's steps.
    variance : ndarray, shape (s,)
    status : Status
    history : tuple of ShootingIteration
        Empty if the start could not be evaluated.
    local : Local, optional
        Of the last point that was linearised.
    """

    theta: Float[Array, " unknowns"]
    x: tuple[Float[Array, "_steps _width"], ...]
    variance: Float[Array, " outputs"]
    status: Status
    history: tuple[ShootingIteration, ...]
    local: Local | None


def iterate(
    problem: ShootingProblem,
    prior: str,
    theta: Array,
    x: Sequence[Array],
    variance: Array | None,
    *,
    tolerance: float,
    max_iterations: int,
) -> ShootingOutcome:
    """Iterate until the steps are small.

    Parameters
    ----------
    problem : ShootingProblem
    prior : str
        What the prior does, of :data:`PRIORS`.
    theta : ndarray, shape (l,)
    x : sequence of ndarray, shape (n, w) each
        Unknowns of each run's steps.
    variance : ndarray, shape (s,), optional
        To begin with; by default what the records suggest.
    tolerance : float
        Relative step of the parameters.
    max_iterations : int

    Returns
    -------
    ShootingOutcome
    """
    return _ShootingLoop(problem, prior, theta, tuple(x), variance).run(tolerance, max_iterations)


class _ShootingLoop:
    """The present point; lives inside :func:`iterate` only."""

    def __init__(
        self,
        problem: ShootingProblem,
        prior: str,
        theta: Array,
        x: tuple[Array, ...],
        variance: Array | None,
    ) -> None:
        self.problem, self.prior = problem, prior
        self.scale = PriorScale.of(problem.priors, problem.names)
        self.theta, self.x = theta, x
        self.staged = variance is not None
        self.variance = problem.first_variance() if variance is None else variance
        self.history: list[ShootingIteration] = []
        self.local: Local | None = None
        self.before: tuple[Change, Change, float] | None = None
        self.damped = 0
        self.pulled = np.flatnonzero(measured_of(problem) | (prior == "be"))
        # Variances from an earlier fit mean a start that is continuous already.
        self.slack = 1.0 if variance is None else 0.0
        self.first_gaps: Array | None = None

    def run(self, tolerance: float, max_iterations: int) -> ShootingOutcome:
        status = self._restored(self.theta, self.x)
        for _ in range(max_iterations if status.ok else 0):
            self._record()
            status = self._linearise()
            if not status.ok:
                return self._outcome(status)
            assert self.local is not None
            change = self.local.step()
            spread = self._spread(change)
            small = self._is_small(change, spread, tolerance)
            if small and self.slack == 0 and self.staged and not self._stage():
                self._take(change, 1.0)
                self._record()
                return self._outcome(Status.CONVERGED)
            if not self._advance(change, spread):
                return self._outcome(self.refused)
            if self.slack > 0:
                self._tighten()
            elif change.size(spread) < NEAR:
                self._stage()
        return self._outcome(Status.NO_CONVERGENCE if status.ok else status)

    # -- one iteration ------------------------------------------------------------------------

    def _linearise(self) -> Status:
        linear = []
        for r, run in enumerate(self.problem.runs):
            item = run.linearise(self.x[r], self.problem.constants(self.theta, r))
            if item is None:
                return Status.NOT_FINITE
            if not item.steps.admissible:
                return Status.INADMISSIBLE
            linear.append(item)
        self.local = Local.of(
            self.problem,
            self.scale,
            self.prior,
            self.theta,
            linear,
            self.variance,
            _spread(self._states()),
            self._allowed(linear),
        )
        return Status.SINGULAR if self.local is None else Status.CONVERGED

    def _allowed(self, linear: Sequence[LinearRun]) -> Array:
        """Variances ``(D,)`` that gaps are allowed."""
        if self.first_gaps is None:
            gaps = [
                item.gap[self.problem.between_intervals(r)] ** 2 for r, item in enumerate(linear)
            ]
            between = np.concatenate(gaps)
            self.first_gaps = between.mean(axis=0) if len(between) else between.sum(axis=0)
            self.slack = self.slack if len(between) else 0.0
        return self.slack * self.first_gaps

    def _states(self) -> Array:
        D = self.problem.runs[0].state_size
        return np.concatenate([x[:, :D] for x in self.x])

    def _spread(self, change: Change) -> Array:
        """Units ``(D,)`` in which sizes are measured: the motion's swing, before or after."""
        states = self._states()
        return np.maximum(_spread(states), _spread(states + np.concatenate(change.states)))

    def _is_small(self, change: Change, spread: Array, tolerance: float) -> bool:
        assert self.local is not None
        rows = np.vstack((self.local.jacobian, self.local.weight))
        sd = self.local.unit / np.maximum(np.linalg.norm(rows, axis=0), LEAST_NORM)
        steps = np.abs(self.local.unit * change.scaled)
        near = max(np.abs(states / spread).max() for states in change.states) < STATE_TOLERANCE
        return bool(near and np.all(steps <= tolerance * np.maximum(np.abs(self.theta), sd)))

    def _advance(self, change: Change, spread: Array) -> bool:
        """Take the step, or the part of it from which the solution looks nearer."""
        assert self.local is not None
        size = change.size(spread)
        part = self._predicted(change, spread)
        self.refused = Status.NO_CONVERGENCE
        while part >= SMALLEST_PART:
            theta = self.scale.moved(self.theta, part * change.scaled)
            x = self.local.moved(self.x, change, part)
            status, x = self._integrated(theta, x)
            onward = self.local.onward(theta, x, part * change.scaled) if status.ok else None
            if onward is not None:
                left = onward.size(spread)
                bend = onward.minus(change, 1.0 - part).size(spread)
                allowed = 0.5 * size * part**2 / bend if bend > 0 else 1.0
                if left < size or size < TINY:
                    self.theta, self.x = theta, x
                    self.before = (change, onward, part)
                    self.damped += part < 1.0
                    return True
                part = min(allowed, 0.5 * part)
            else:
                self.refused = Status.INADMISSIBLE if status.ok else status
                part *= 0.5
        return False

    def _predicted(self, change: Change, spread: Array) -> float:
        """How much of a step the curvature met by the last one allows."""
        if self.before is None:
            return 1.0
        last, onward, part = self.before
        bend = onward.minus(change, 1.0).size(spread) * change.size(spread)
        allowed = part * last.size(spread) * onward.size(spread) / bend if bend > 0 else 1.0
        return float(np.clip(allowed, SMALLEST_PART, 1.0))

    def _take(self, change: Change, part: float) -> None:
        assert self.local is not None
        self.x = self.local.moved(self.x, change, part)
        self.theta = self.scale.moved(self.theta, part * change.scaled)

    def _integrated(self, theta: Array, x: tuple[Array, ...]) -> tuple[Status, tuple[Array, ...]]:
        """Motions through the inner nodes of intervals of several steps."""
        done = []
        for r, (run, length) in enumerate(
            zip(self.problem.runs, self.problem.steps_per_interval, strict=True)
        ):
            moved, ok = x[r], True
            if length > 1:
                moved, ok = run.segments.integrate(x[r], self.problem.constants(theta, r), length)
            if not ok:
                return Status.NOT_FINITE, x
            done.append(moved)
        return Status.CONVERGED, tuple(done)

    def _restored(self, theta: Array, x: tuple[Array, ...]) -> Status:
        status, self.x = self._integrated(theta, x)
        return status

    def _tighten(self) -> None:
        assert self.before is not None
        if self.before[2] == 1.0:
            self.slack = TIGHTER * self.slack if self.slack > TIGHT else 0.0

    def _stage(self) -> bool:
        """Set the variances from the residuals; whether they changed by more than a little."""
        new = self.problem.staged(self.problem.sums(self.theta, self.x))
        changed = bool(np.any(np.abs(new / self.variance - 1.0) > VARIANCE_TOLERANCE))
        self.variance, self.staged = new, True
        return changed

    # -- keeping the books --------------------------------------------------------------------

    def _record(self) -> None:
        sums = self.problem.sums(self.theta, self.x)
        objective = log_likelihood(sums, self.variance, self.problem.counts)
        pulled = self.pulled
        if pulled.any():
            priors = [self.problem.priors[k] for k in pulled]
            objective += log_prior(priors, self.theta[pulled])
        self.history.append(ShootingIteration(self.theta, self.variance, objective, self.damped))
        self.damped = 0

    def _outcome(self, status: Status) -> ShootingOutcome:
        return ShootingOutcome(
            self.theta, self.x, self.variance, status, tuple(self.history), self.local
        )


def _spread(states: Array) -> Array:
    """Root mean square deviation ``(D,)`` of states ``(n, D)``; of what rests, its size, or one."""
    spread, size = states.std(axis=0), np.abs(states).max(axis=0)
    resting = spread <= 1e-12 * size
    return np.where(resting, np.where(size > 0, size, 1.0), spread)


def joined(first: ShootingOutcome, second: ShootingOutcome) -> ShootingOutcome:
    """The second outcome with the history of both; it began where the first ended."""
    return replace(second, history=first.history + second.history[1:])
