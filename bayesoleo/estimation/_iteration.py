"""The iteration that all estimators share, with step lengths and history.

One iteration estimates the variances, takes a step, and halves the step if it does not improve the
merit.

Linear equations that lack the second derivatives of the residual can overshoot or undershoot in
every step, each improving the merit only a little. Two successive steps along one line give the
factor by which to lengthen or shorten the next.

References
----------
Verbeek (1993), section 3.3; step halving is his "monitoring tool" and should rarely act. Aitken
(1926), "On Bernoulli's numerical solution of algebraic equations" (the factor).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from bayesoleo._parallel import single_blas_thread
from bayesoleo._types import Array, Float, Integers
from bayesoleo.error_models._independent import output_counts
from bayesoleo.estimation._bayesian_estimators import Step
from bayesoleo.estimation._damping import Damping
from bayesoleo.estimation._least_squares import PriorScale, WhitenedEquations, is_cut
from bayesoleo.estimation._objectives import Objective, log_prior, newton_equations
from bayesoleo.estimation._problem import EstimationProblem, Evaluation, residuals_first
from bayesoleo.solvers._orbit import Status

# A step that reverses more than this part of the last one overshoots. Equations that lack the
# residual's second derivatives can do so in every step, each lowering the merit a little.
_OVERSHOOT = 0.3
# Below one standard deviation the equations are nearly linear, so that a smaller part suffices;
# steps that reverse less than this gain a digit in each iteration anyway.
_OVERSHOOT_NEAR = 0.1
# After this number of successive steps along one line, each longer than this part of the one
# before, steps are lengthened, up to this factor: the same equations can also undershoot.
_STEADY = 4
_LONGEST = 10.0
# Cosine from which two steps count as one line; otherwise the overshoot is unknown.
_ON_ONE_LINE = 0.9
# 2**-30 of a step is negligible.
_MAX_HALVINGS = 30
# A step is halved so often before it is damped: most need no more, and that costs no equations.
_HALVED_FIRST = 2
# Rounding of the merit function for each sample: smaller increases are ignored.
_ROUNDING = 1e-13
# Where not even a sixteenth of a step helps, or none: an expected gain of the log density below
# this means nothing in statistics (0.0014 sd), but may lie below the noise of a solver's tolerance.
_NEGLIGIBLE_GAIN = 1e-6
_MANY_HALVINGS = 4
# Where no step helps at all, an estimate this near to its optimum, in standard deviations, has
# converged as far as it was asked to: an integrator with its own steps leaves a scatter of 3e-4 in
# the objective, within which an optimum is known to 0.025.
_IN_NOISE = 0.03
# Distance to the fixed point, in standard deviations, up to which a small step means convergence.
_NEAR = 0.1
# This number of successive idle iterations - slow, and with no gain left - means convergence.
_IDLE = 3
# Nothing is left where the optimum is nearer than so many tolerances, in standard deviations: who
# asks for certified digits gets them, if slowly.
_IDLE_STEPS = 1e3
# A logarithm of which the data leave more than this part of the prior's sd may have no optimum: the
# likelihood levels off on the way to zero or infinity, and an estimator that follows it never ends.
# What then lies nearer to the level than _NEAR is on it.
_FLAT = 0.9
_LEVEL = 0.5 * _NEAR**2


@dataclass(frozen=True)
class Iteration:
    """State at the end of one iteration.

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
    """Outcome of the loop: the last point, its evaluation and the history.

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
        Failed evaluations, by the lower-case name of their status.
    """

    theta: Float[Array, " unknowns"]
    evaluation: Evaluation
    status: Status
    history: tuple[Iteration, ...]
    evaluations: int
    distance: float
    failures: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Pace:
    """Comparison of a step with the one before, by which it is shortened or lengthened.

    Near the fixed point the error along one line shrinks from ``e`` to ``(1 - s k) e``, where ``s``
    is the part of the proposed step that was taken and ``k`` the part of the error that a whole one
    removes. Two proposals on that line determine ``k``, and the part ``1/k`` removes all of it
    (Aitken's process, 1926). It is used at once where steps reverse, and with limits where they
    undershoot.

    Parameters
    ----------
    taken : ndarray, shape (l,)
        The last step, in scaled unknowns.
    part : float
        Part of the proposal that was taken.
    idle : int
        Iterations in a row that were slow and gained nothing.
    slow : bool
        The present proposal is not much shorter than the last step.
    steady : int
        Successive steps that undershot along one line.
    wanted : float
        Part of the present proposal to take, by default one.
    """

    taken: Array | None = None
    part: float = 1.0
    idle: int = 0
    slow: bool = False
    steady: int = 0
    wanted: float = 1.0

    def look(self, proposal: Array, rows: Array) -> Pace:
        """Compare a proposal with the last step in the metric ``rows' rows``."""
        if self.taken is None:
            return self
        new, old = rows @ proposal, rows @ self.taken
        lengths = float(np.linalg.norm(new)), float(np.linalg.norm(old))
        if min(lengths) == 0:
            return replace(self, slow=False, steady=0, wanted=1.0)
        cosine = float(new @ old) / (lengths[0] * lengths[1])
        ratio = lengths[0] / lengths[1]
        reach = 1 / self.part - float(np.sign(cosine)) * ratio
        on_line = abs(cosine) >= _ON_ONE_LINE
        creeps = on_line and 0 < reach < 1 - _OVERSHOOT
        steady = self.steady + 1 if creeps else 0
        wanted = 1.0
        overshoot = _OVERSHOOT_NEAR if max(lengths) < 1 else _OVERSHOOT
        if on_line and reach > 1 + overshoot:
            wanted = 1 / reach
        elif steady >= _STEADY:
            wanted = min(1 / reach, _LONGEST)
        return replace(self, slow=ratio > _OVERSHOOT, steady=steady, wanted=wanted)

    def after(self, taken: Array, part: float, idle: bool) -> Pace:
        """Pace after a step of this part of its proposal, which gained or did not."""
        return Pace(taken, part, self.idle + 1 if idle and self.slow else 0, steady=self.steady)


def iterate(
    problem: EstimationProblem,
    step: Step[Any],
    start: Array,
    objective: Objective,
    *,
    tolerance: float,
    max_iterations: int,
    resolution: float = 0.0,
    bias_corrected: bool = False,
    progress: Callable[[Iteration], None] | None = None,
) -> Outcome:
    """Repeat a step until it is small.

    Parameters
    ----------
    problem : EstimationProblem
    step : Step
        The estimator.
    start : ndarray, shape (l,)
        Inside the priors' support.
    objective : Objective
        Objective to maximise.
    tolerance : float
        Converged when every unknown's step is below this part of its value, or of its linearised
        standard deviation where that is larger.
    max_iterations : int
    resolution : float, optional
        Converged also where a step is shorter than this many standard deviations, all unknowns
        together.
    bias_corrected : bool, optional
        Stage the variances with eq. 3.18 instead of 3.17.
    progress : callable, optional
        Called with each :class:`Iteration`.

    Returns
    -------
    Outcome
        Ends on the last point that improved, so never on a worse one than the start.
    """
    loop = _Loop(problem, step, objective, bias_corrected, progress)
    with single_blas_thread():
        loop.move(loop.look(np.array(start, dtype=float)), 0)
        status = loop.point.status
        if status.ok:
            try:
                status = loop.run(tolerance, max_iterations, resolution)
            except np.linalg.LinAlgError:
                status = Status.SINGULAR
    return Outcome(
        theta=loop.point.theta,
        evaluation=loop.point.evaluation,
        status=status,
        history=tuple(loop.history),
        evaluations=loop.evaluations,
        distance=loop.distance,
        failures=dict(loop.failures),
    )


@dataclass(frozen=True)
class _Point:
    theta: Array
    evaluation: Evaluation
    moments: Array

    @property
    def status(self) -> Status:
        if self.evaluation.status.ok and not np.isfinite(self.moments).all():
            return Status.NOT_FINITE
        return self.evaluation.status


class _Loop:
    """The iteration's current point and history; lives inside :func:`iterate` only."""

    def __init__(
        self,
        problem: EstimationProblem,
        step: Step[Any],
        objective: Objective,
        bias_corrected: bool,
        progress: Callable[[Iteration], None] | None,
    ) -> None:
        self.problem, self.step, self.objective = problem, step, objective
        self.bias_corrected, self.progress = bias_corrected, progress
        self.counts: Integers = output_counts(problem.counts)
        self.scale = PriorScale.of(problem.priors, problem.names)
        self.state = step.begin(self.scale.root)
        self.damping = Damping(np.zeros(len(self.scale.sd)))
        self.history: list[Iteration] = []
        self.evaluations, self.distance = 0, np.nan
        self.failures: Counter[str] = Counter()
        self.point: _Point

    def look(self, theta: Array) -> _Point:
        return self.counted(self.point_of(theta, self.problem.evaluate(theta)))

    def look_first(self, theta: Array, variance: Array, least: float) -> _Point:
        """A point as of :meth:`look`; without sensitivities where its residuals already show that
        it fails or its merit is below the least."""
        found = residuals_first(self.problem, theta)
        if found is not None:
            point = self.point_of(theta, found)
            if not (point.status.ok and self.merit(point, variance) >= least):
                return self.counted(point)
        return self.look(theta)

    def point_of(self, theta: Array, evaluation: Evaluation) -> _Point:
        point = _Point(theta, evaluation, np.array([np.nan]))
        if evaluation.status.ok:
            with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused
                point = _Point(theta, evaluation, self.objective.errors.moments(evaluation))
        return point

    def counted(self, point: _Point) -> _Point:
        """A point, counted among the evaluations and the failures."""
        self.evaluations += 1
        if not point.status.ok:
            self.failures[point.status.name.lower()] += 1
        return point

    def move(self, point: _Point, halvings: int) -> None:
        """Make a point the current one, and a line of the history."""
        self.point = point
        if not point.status.ok:
            return
        variance = self.variance()
        objective = self.merit(point, variance)
        number = len(self.history)
        iteration = Iteration(number, point.theta, variance, objective, halvings)
        self.history.append(iteration)
        if self.progress is not None:
            self.progress(iteration)

    def run(self, tolerance: float, max_iterations: int, resolution: float) -> Status:
        """Iterate until a step is small and the fixed point near, or nothing helps."""
        pace = Pace()
        for _ in range(max_iterations):
            variance = self.variance()
            equations = self.equations(variance)
            if not np.isfinite(equations.jacobian).all():
                return Status.NOT_FINITE
            self.state = self.step.prepare(self.state, equations)
            weight = self.step.rows(self.state, equations.jacobian)
            whole = proposal = equations.solve(weight)
            if self.step.damped:
                self.damping = self.damping.at(equations, weight)
                proposal = self.damping.shortened(whole, equations, weight)
            if proposal is whole:
                pace = pace.look(proposal, np.vstack((equations.jacobian, weight)))
            else:
                pace = Pace()  # damped steps do not compare
            part = self.part_of(proposal, pace, equations)
            small = self.is_small(max(part, 1.0) * whole, equations, tolerance, resolution)
            before = self.point
            trial, halvings, taken = self.shorten(
                part * proposal, weight, equations, variance, resolution
            )
            if halvings >= _MANY_HALVINGS:
                gain = 0.5 * float(proposal @ equations.gradient)
                small = small or gain <= _NEGLIGIBLE_GAIN
            if trial is before and resolution > 0.0 and not self.step.locks:
                # No step helps where solutions are known to less than what it would gain.
                small = small or equations.distance() <= _IN_NOISE
            if trial.status.ok and trial is not before:
                self.move(trial, halvings)
            elif not small:
                return Status.NO_CONVERGENCE if trial.status.ok else trial.status
            won = self.merit(self.point, variance) - self.merit(before, variance)
            pace = pace.after(taken, part * 0.5**halvings, self.is_idle(won, equations, tolerance))
            if small or pace.idle >= _IDLE:
                self.distance = self.equations(self.variance()).distance()
                if self.distance <= _NEAR:
                    return Status.CONVERGED
                if self.step.locks or self.point is before:
                    return Status.NO_CONVERGENCE
            expected = equations.expected_gain(taken)
            ratio = won / expected if expected > 0 else 1.0
            self.state = self.step.accept(self.state, equations.jacobian, ratio, taken)
            self.damping = self.damping.accepted(taken, ratio)
        return Status.NO_CONVERGENCE

    def part_of(self, proposal: Array, pace: Pace, equations: WhitenedEquations) -> float:
        """Part of a proposal to take; above one only well inside the support."""
        if pace.wanted <= 1:
            return pace.wanted
        if self.step.locks or is_cut(pace.wanted * proposal, equations.room):
            return 1.0  # an estimator that locks up takes ever shorter steps by design
        return pace.wanted

    def shorten(
        self,
        proposal: Array,
        weight: Array,
        equations: WhitenedEquations,
        variance: Array,
        resolution: float,
    ) -> tuple[_Point, int, Array]:
        """First point along ever shorter steps that is not worse than the current one.

        With the number of halvings and the step that led there. If there is none, or none before
        steps are shorter than what is to be resolved: the last point that failed, or the current
        one.
        """
        merit = self.merit(self.point, variance) - _ROUNDING * float(self.counts.sum())
        trial = self.point
        for halvings in range(_MAX_HALVINGS + 1):
            moved = self.scale.moved(self.point.theta, proposal)
            trial = self.look_first(moved, variance, merit)
            if trial.status.ok and self.merit(trial, variance) >= merit:
                return trial, halvings, proposal
            if np.linalg.norm(equations.jacobian @ proposal) < resolution:
                break  # at a jump of the model no step helps, however short
            softer = self.step.refuse(self.state, proposal)
            if softer is None and self.step.damped and halvings >= _HALVED_FIRST:
                self.damping = self.damping.refused(proposal)
                proposal = self.damping.shortened(proposal, equations, weight)
            elif softer is None:
                proposal = proposal / 2
            else:
                self.state = self.step.prepare(softer, equations)
                proposal = equations.solve(self.step.rows(self.state, equations.jacobian))
        return (self.point if trial.status.ok else trial), _MAX_HALVINGS, proposal

    @property
    def pulls(self) -> bool:
        """Whether the prior keeps its declared centre and counts in the objective."""
        return self.step.fixed_prior and self.objective.prior

    def variance(self) -> Array:
        """Staged covariance of the errors at the current point."""
        unknowns = len(self.scale.sd)
        return self.objective.errors.stage(
            self.point.moments, self.counts, unknowns, self.bias_corrected
        )

    def merit(self, point: _Point, variance: Array) -> float:
        """Objective with ``v`` held; the prior counts only where it is fixed at its centre."""
        value = self.objective.errors.log_likelihood(point.moments, variance, self.counts)
        if self.pulls:
            value += log_prior(self.scale.priors, point.theta)
        return value

    def equations(self, variance: Array) -> WhitenedEquations:
        """Linear equations at the current point, with ``v`` held."""
        theta, errors = self.point.theta, self.objective.errors
        rows = errors.rows(self.point.evaluation, self.scale.unit(theta), variance)
        slope = self.scale.slope(theta) if self.pulls else np.zeros(theta.size)
        # a matrix has its entries' size on its diagonal
        sizes = np.diag(variance) if variance.ndim == 2 else variance
        noise = float(np.exp(0.5 * np.mean(np.log(sizes))))
        place = theta / self.scale.unit(theta)
        equations = WhitenedEquations(
            *rows, slope, self.scale.room(theta), self.scale.root, place, noise
        )
        if not self.step.second_order:
            return equations
        self.evaluations += 2 * theta.size
        return newton_equations(
            self.problem,
            errors,
            self.scale,
            theta,
            self.point.evaluation,
            variance,
            equations,
            prior=self.pulls,
        )

    def is_small(
        self, proposal: Array, equations: WhitenedEquations, tolerance: float, resolution: float
    ) -> bool:
        if is_cut(proposal, equations.room):
            return False
        if not self.step.locks and equations.distance() <= resolution:
            return True
        if self.step.limits_length:  # a short step is then no sign of convergence
            own = equations.solve(equations.root)
            proposal = np.where(np.abs(own) > np.abs(proposal), own, proposal)
        unit = self.scale.unit(self.point.theta)
        least = np.maximum(np.abs(self.point.theta), unit * equations.sd())
        return bool(np.all(np.abs(unit * proposal) <= tolerance * least))

    def is_idle(self, won: float, equations: WhitenedEquations, tolerance: float) -> bool:
        """Whether an iteration gained nothing, and the linearisation predicts no further gain."""
        nothing = min(_NEGLIGIBLE_GAIN, 0.5 * (_IDLE_STEPS * tolerance) ** 2)
        rows = equations.root
        if not self.step.fixed_prior:
            # A prior that only scales the steps must not hide the distance to the optimum.
            flat = self.scale.logarithmic & (equations.sd() > _FLAT)
            rows = rows[flat]
            nothing = _LEVEL if flat.any() else nothing
        return won <= nothing and equations.expected_gain(equations.solve(rows)) <= nothing
