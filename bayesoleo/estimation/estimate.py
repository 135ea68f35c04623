"""Entry points: estimate the unknowns of a problem, and move on to the posterior's mode."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from bayesoleo.errors import InputError
from bayesoleo.estimation.bounded import on_limit
from bayesoleo.estimation.iterate import Iteration, Outcome, iterate
from bayesoleo.estimation.linearise import Linearised, inverse_gram
from bayesoleo.estimation.objectives import output_counts, staged_variance, sums_of_squares
from bayesoleo.estimation.point import PointEstimate
from bayesoleo.estimation.problem import Array, Problem
from bayesoleo.estimation.scaling import PriorScale
from bayesoleo.estimation.steps import Step
from bayesoleo.estimation.steps import method as find_method

Progress = Callable[[Iteration], None]


def estimate(
    problem: Problem,
    method: str | Step = "mbe",
    *,
    start: ArrayLike | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 50,
    resolution: float = 0.0,
    bias_corrected: bool = False,
    progress: Progress | None = None,
) -> PointEstimate:
    """Estimate the unknowns of a problem.

    Parameters
    ----------
    problem : Problem
        What is fitted.
    method : str or Step, optional
        ``"be"``, ``"mve"``, ``"mmve"``, ``"mbe"``, ``"gauss-newton"`` or
        ``"levenberg-marquardt"``. All but the first end in the maximum-likelihood point, for which
        the priors only scale the steps; ``"be"`` ends in a mode of the posterior. Unknowns with a
        log-normal prior are stepped in their logarithm, but the mode is that of the density per
        unit of the unknown itself.
    start : array_like, shape (l,), optional
        By default the problem's own.
    tolerance : float, optional
        Relative step: converged when every step is below this part of the unknown, or of its
        linearised standard deviation where that is larger.
    max_iterations : int, optional
    resolution : float, optional
        Converged also where the optimum is nearer than this many standard deviations: what is
        below, the data cannot tell. Zero asks for digits alone.
    bias_corrected : bool, optional
        Divide the sums of squares by ``n - l/s`` instead of ``n``.
    progress : callable, optional
        Called with each :class:`~bayesoleo.estimation.Iteration`.

    Returns
    -------
    PointEstimate
        A numerical failure is its ``status``, never an exception.

    Raises
    ------
    InputError
        If the start does not fit, lies outside a prior's support, or the method is unknown.

    References
    ----------
    Verbeek (1993), sections 3.2 and 3.3, eqs. 3.17-3.23.
    """
    step = find_method(method)
    scale = PriorScale.of(problem.priors, problem.names)
    begin = checked_start(problem, scale, problem.start if start is None else start)
    outcome = iterate(
        problem,
        step,
        begin,
        tolerance=tolerance,
        max_iterations=max_iterations,
        resolution=resolution,
        bias_corrected=bias_corrected,
        progress=progress,
    )
    return _summarise(problem, scale, step, begin, outcome, bias_corrected)


def polish(
    problem: Problem,
    point: PointEstimate,
    *,
    tolerance: float = 1e-6,
    max_iterations: int = 50,
    resolution: float = 0.0,
    progress: Progress | None = None,
) -> PointEstimate:
    """Move from an estimate, usually MBE's, to the posterior's mode by the Bayesian estimator.

    The staged variance maximises the objective at fixed parameters, so the fixed point is the joint
    mode in the parameters and the variances.

    Parameters
    ----------
    problem : Problem
    point : PointEstimate
        Where to begin.
    tolerance, max_iterations, resolution, progress
        As in :func:`estimate`.

    Returns
    -------
    PointEstimate
    """
    return estimate(
        problem,
        "be",
        start=point.theta,
        tolerance=tolerance,
        max_iterations=max_iterations,
        resolution=resolution,
        progress=progress,
    )


def checked_start(problem: Problem, scale: PriorScale, start: ArrayLike) -> Array:
    """The start as an array, or an :class:`InputError` that names what does not fit."""
    theta = np.array(start, dtype=float)
    if theta.shape != scale.mean.shape or not np.isfinite(theta).all():
        raise InputError(
            "start must be one finite number per unknown",
            key="start",
            value=theta.tolist(),
            hint=f"the unknowns are {', '.join(problem.names)}",
        )
    inside = scale.inside(theta)
    columns = (problem.names, theta, scale.low, scale.high, inside)
    for name, value, low, high, fits in zip(*columns, strict=True):
        if not fits:
            raise InputError(
                "start lies outside the prior's support",
                key=name,
                value=float(value),
                hint=f"use a value between {low:g} and {high:g}",
            )
    return theta


def _summarise(
    problem: Problem,
    scale: PriorScale,
    step: Step,
    start: Array,
    outcome: Outcome,
    bias_corrected: bool,
) -> PointEstimate:
    unknowns, outputs = len(problem.names), len(problem.outputs)
    variance = np.full(outputs, np.nan)
    covariance = likelihood = np.full((unknowns, unknowns), np.nan)
    history = outcome.history
    if history:
        sums, counts = sums_of_squares(outcome.evaluation), output_counts(problem.counts)
        variance = staged_variance(sums, counts, unknowns, bias_corrected=bias_corrected)
        unit = scale.unit(outcome.theta)
        rows = Linearised.of(outcome.evaluation, unit).whitened(variance)[0]
        units = np.outer(unit, unit)
        covariance = units * inverse_gram(np.vstack((rows, scale.root)))
        likelihood = units * inverse_gram(rows)
    held = on_limit(scale.room(outcome.theta))
    return PointEstimate(
        names=tuple(problem.names),
        outputs=tuple(problem.outputs),
        theta=outcome.theta,
        variance=variance,
        covariance=covariance,
        covariance_likelihood=likelihood,
        method=step.name,
        status=outcome.status,
        iterations=max(len(history) - 1, 0),
        halvings=sum(line.halvings for line in history),
        evaluations=outcome.evaluations,
        objective=history[-1].objective if history else np.nan,
        distance=outcome.distance,
        start=start,
        history=np.array([line.theta for line in history]).reshape(len(history), unknowns),
        history_variance=np.array([line.variance for line in history]).reshape(
            len(history), outputs
        ),
        history_objective=np.array([line.objective for line in history]),
        history_halvings=np.array([line.halvings for line in history], dtype=np.int64),
        on_limit=tuple(name for name, at in zip(problem.names, held, strict=True) if at),
    )
