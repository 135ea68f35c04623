"""SciPy's optimisers behind the interface of the estimators, for comparison.

They use the same scaled unknowns and the same objective, with ``v`` eliminated. Least-squares
methods update ``v`` between solves, the others at every evaluation. Where the objective has a
prior, they maximise with it, as BE does.

The success that an optimiser reports is checked. A line search that meets vectors which cannot be
evaluated may stop on a slope and report that the objective no longer changes; such a point is no
optimum, and its status is ``NO_CONVERGENCE``.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np
from scipy.optimize import OptimizeResult, least_squares, minimize

from bayesoleo._parallel import single_blas_thread
from bayesoleo._types import Array
from bayesoleo.error_models._independent import output_counts
from bayesoleo.errors import InputError
from bayesoleo.estimation._iteration import Iteration, Outcome
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.estimation._objectives import Objective, log_prior
from bayesoleo.estimation._problem import EstimationProblem, Evaluation
from bayesoleo.solvers._orbit import Status

#: How they are asked for.
PREFIX = "scipy:"
MOST_ITERATIONS = 1000
LEAST_SQUARES = ("trf", "dogbox", "lm")
MINIMISERS = (
    "Nelder-Mead", "Powell", "CG", "BFGS", "Newton-CG", "L-BFGS-B", "TNC", "COBYLA", "COBYQA",
    "SLSQP", "trust-constr",
)  # fmt: skip
_DERIVATIVES = ("CG", "BFGS", "Newton-CG", "L-BFGS-B", "TNC", "SLSQP", "trust-constr")
_BOUNDED = ("Nelder-Mead", "Powell", "L-BFGS-B", "TNC", "COBYLA", "COBYQA", "SLSQP", "trust-constr")
# Times that the variances are staged anew between least-squares solves.
_STAGES = 50
# SciPy refuses tolerances below rounding.
_FINEST = 1e-15
# What a vector that cannot be evaluated is worth to a minimiser, which needs a finite number.
_REFUSED = 1e30
# A point is an optimum if the Gauss-Newton step from it is shorter than one posterior standard
# deviation, or than this part of the unknowns: where the fit is exact, the standard deviation is
# round-off. Both are far above what any of the optimisers' own tolerances leave.
_ONE_SD, _NO_STEP = 1.0, 1e-4
# Scaled distance to a bound below which an unknown lies on it.
_ON_BOUND = 1e-8


def run_scipy(
    problem: EstimationProblem,
    name: str,
    start: Array,
    objective: Objective,
    *,
    tolerance: float,
    max_iterations: int,
    bias_corrected: bool = False,
) -> Outcome:
    """Estimate by one of SciPy's optimisers.

    Parameters
    ----------
    problem : EstimationProblem
    name : str
        Of :data:`LEAST_SQUARES` or :data:`MINIMISERS`, without the prefix.
    start : ndarray, shape (l,)
    objective : Objective
    tolerance : float
        Relative; passed on as whatever the optimiser calls its tolerances.
    max_iterations : int
    bias_corrected : bool, optional

    Returns
    -------
    Outcome
        Its history holds the evaluations that improved the objective.

    Raises
    ------
    InputError
        If there is no such optimiser.
    """
    if name not in (*LEAST_SQUARES, *MINIMISERS):
        raise InputError(
            "SciPy has no such optimiser",
            key="method",
            value=PREFIX + name,
            hint=f"use {PREFIX} and one of {', '.join((*LEAST_SQUARES, *MINIMISERS))}",
        )
    search = _Search(problem, objective, start, bias_corrected)
    tolerance = max(tolerance, _FINEST)
    with single_blas_thread():
        if not search.begin():
            return search.outcome(search.status)
        try:
            if name in LEAST_SQUARES:
                found = search.by_least_squares(name, tolerance, max_iterations)
            else:
                found = search.by_minimiser(name, tolerance, max_iterations)
        except (ValueError, np.linalg.LinAlgError):  # a vector that cannot be evaluated
            return search.outcome(Status.NOT_FINITE)
    converged = found and search.at_optimum()
    return search.outcome(Status.CONVERGED if converged else Status.NO_CONVERGENCE)


class _Search:
    """Evaluations by scaled unknowns ``z``, counted from the start, and the best of them."""

    def __init__(
        self, problem: EstimationProblem, objective: Objective, start: Array, bias_corrected: bool
    ) -> None:
        self.problem, self.errors, self.prior = problem, objective.errors, objective.prior
        self.scale = PriorScale.of(problem.priors, problem.names)
        self.counts, self.start = output_counts(problem.counts), start
        self.bias_corrected = bias_corrected
        self.evaluations, self.status = 0, Status.CONVERGED
        self.failures: Counter[str] = Counter()
        self.history: list[Iteration] = []
        self.at = np.full(start.size, np.nan)
        self.here: Evaluation | None = None
        self.best: Evaluation | None = None
        self.theta = start

    def look(self, z: Array) -> Evaluation:
        """Evaluation at scaled unknowns; asked for function and derivatives, it is made once."""
        if self.here is None or not np.array_equal(z, self.at):
            self.at, self.evaluations = np.array(z), self.evaluations + 1
            self.here = self.problem.evaluate(self.scale.moved(self.start, z))
            if not self.here.status.ok:
                self.failures[self.here.status.name.lower()] += 1
            self.keep(self.here, self.scale.moved(self.start, z))
        return self.here

    def keep(self, evaluation: Evaluation, theta: Array) -> None:
        """Remember the point if it is the best so far."""
        self.status = evaluation.status
        height = self.height(evaluation, theta)
        if np.isfinite(height) and (not self.history or height > self.history[-1].objective):
            variance = self.staged(evaluation)
            self.theta, self.best = theta, evaluation
            self.history.append(Iteration(len(self.history), theta, variance, height, 0))

    def staged(self, evaluation: Evaluation) -> Array:
        """Covariance of the errors that is best at these residuals."""
        moments = self.errors.moments(evaluation)
        return self.errors.stage(moments, self.counts, self.start.size, self.bias_corrected)

    def height(self, evaluation: Evaluation, theta: Array) -> float:
        """Objective with ``v`` staged."""
        if not evaluation.status.ok:
            return -np.inf
        moments = self.errors.moments(evaluation)
        if not np.isfinite(moments).all():
            return -np.inf
        value = self.errors.log_likelihood(moments, self.staged(evaluation), self.counts)
        return value + log_prior(self.problem.priors, theta) if self.prior else value

    def begin(self) -> bool:
        """Whether the start can be evaluated."""
        self.look(np.zeros(self.start.size))
        return bool(self.history)

    def bounds(self) -> tuple[Array, Array]:
        """Limits of the scaled unknowns."""
        down, up = self.scale.room(self.start)
        free = self.scale.logarithmic
        return np.where(free, -np.inf, -down), np.where(free, np.inf, up)

    def by_least_squares(self, name: str, tolerance: float, most: int) -> bool:
        """Alternate between solving with ``v`` held and staging it, until nothing moves."""
        z = np.zeros(self.start.size)
        options: dict[str, Any] = {"xtol": tolerance, "ftol": tolerance, "gtol": tolerance}
        if name != "lm":
            options["bounds"] = self.bounds()
        for _ in range(_STAGES):
            variance = self.staged(self.look(z))
            found: OptimizeResult = least_squares(
                lambda z, v=variance: self.rows(z, v)[1],
                z,
                jac=lambda z, v=variance: -self.rows(z, v)[0],
                method=name,
                x_scale="jac",
                max_nfev=most,
                **options,
            )
            z = found.x
            if not found.success:
                return False
            if np.allclose(self.staged(self.look(z)), variance, rtol=tolerance, atol=0):
                return True
        return False

    def rows(self, z: Array, variance: Array) -> tuple[Array, Array]:
        """Whitened sensitivities and residuals, with the prior's below them."""
        evaluation, theta = self.look(z), self.scale.moved(self.start, z)
        unit = self.scale.unit(theta)
        if not evaluation.status.ok:
            return np.full((z.size, z.size), np.nan), np.full(z.size, np.nan)
        jacobian, residual = self.errors.rows(evaluation, unit, variance)
        # A compressed residual has as many rows as there are unknowns, and one more for what no
        # step removes: the sum of squares is all there.
        if not self.prior:
            return jacobian, residual
        pull = np.linalg.solve(self.scale.root.T, self.scale.slope(theta))
        return np.vstack((jacobian, self.scale.root)), np.concatenate((residual, pull))

    def by_minimiser(self, name: str, tolerance: float, most: int) -> bool:
        """Minimise the negative objective."""
        options: dict[str, Any] = {"jac": self.slope} if name in _DERIVATIVES else {}
        if name in _BOUNDED:
            options["bounds"] = np.column_stack(self.bounds())
        found = minimize(
            self.depth,
            np.zeros(self.start.size),
            method=name,
            tol=tolerance,
            options={"maxfun" if name == "TNC" else "maxiter": most * self.effort(name)},
            **options,
        )
        return bool(found.success)

    def effort(self, name: str) -> int:
        """Iterations of a method without derivatives are single evaluations."""
        return 1 if name in _DERIVATIVES else 20 * self.start.size

    def depth(self, z: Array) -> float:
        """Negative objective."""
        height = self.height(self.look(z), self.scale.moved(self.start, z))
        return -height if np.isfinite(height) else _REFUSED

    def slope(self, z: Array) -> Array:
        """Its derivatives; those of the eliminated ``v`` vanish."""
        evaluation, theta = self.look(z), self.scale.moved(self.start, z)
        if not evaluation.status.ok:
            return np.zeros(z.size)
        weighted = self.errors.weighted(evaluation.residual, self.staged(evaluation))
        parts = [j.T @ w for j, w in zip(evaluation.sensitivity, weighted, strict=True)]
        slope = self.scale.unit(theta) * np.sum(parts, axis=0)
        return -(slope + self.scale.slope(theta)) if self.prior else -slope

    def at_optimum(self) -> bool:
        """Whether the best point is a stationary one, by the Gauss-Newton step from it."""
        evaluation = self.best
        if evaluation is None:
            return False
        unit, down_up = self.scale.unit(self.theta), self.scale.room(self.theta)
        jacobian, residual = self.errors.rows(evaluation, unit, self.staged(evaluation))
        if self.prior:
            pull = np.linalg.solve(self.scale.root.T, self.scale.slope(self.theta))
            jacobian = np.vstack((jacobian, self.scale.root))
            residual = np.concatenate((residual, pull))
        down, up = (~self.scale.logarithmic & (room < _ON_BOUND) for room in down_up)
        uphill = jacobian.T @ residual
        free = ~((down & (uphill < 0)) | (up & (uphill > 0)))
        if not free.any():
            return True
        step = np.linalg.lstsq(jacobian[:, free], residual, rcond=1e-12)[0]
        if np.linalg.norm(jacobian[:, free] @ step) < _ONE_SD:
            return True
        size = np.abs(self.theta[free]) + self.scale.spread[free] * _NO_STEP
        return bool((np.abs(unit[free] * step) < _NO_STEP * size).all())

    def outcome(self, status: Status) -> Outcome:
        """What the loop of the other estimators would return."""
        assert self.here is not None
        evaluation = self.here if self.best is None else self.best
        return Outcome(
            self.theta, evaluation, status, tuple(self.history), self.evaluations, np.nan,
            dict(self.failures),
        )  # fmt: skip
