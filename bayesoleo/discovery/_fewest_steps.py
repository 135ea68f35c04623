"""The fewest steps that change nothing that is seen, for comparisons and for densities."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from bayesoleo._types import Array
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._mesh_error import (
    begin_with,
    can_be_coarser,
    can_be_joined,
    shift_by,
    squares_of_change,
)
from bayesoleo.discovery._numerics import problem_on
from bayesoleo.prediction._mesh_steps import coarsest_steps
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._schemes import COLLOCATION

#: Part of the shift that the steps of an estimate may cause, for those of a density.
SAMPLED = 0.1


def for_comparison(fit: ModelFit) -> ModelFit:
    """A fit on the coarsest mesh that shows no difference, to score and refit candidates on.

    A comparison needs no higher accuracy than what it decides on. What a coarser mesh changes of
    the outputs, and of the sum of squares through the residual, may not be more than one variance
    of what the model leaves, over all samples together. That holds at this estimate: an effect that
    explains ``a`` such variances and has the same error of the mesh explains at most
    ``2 sqrt(a) + 1`` more or less there, which is little of what is far from a limit. The estimate
    of a candidate asks again, and is repeated on finer steps where these show.

    Parameters
    ----------
    fit : ModelFit

    Returns
    -------
    ModelFit
        The same estimate; itself where no run can be solved in fewer steps.
    """
    if not fit.model.dofs:  # what candidates begin with
        steps = min(fit.steps, coarsest_steps(fit.records, fit.steps))
        long = fit.all_periodic or any(run.is_long for run in fit.predictor.runs)
        return replace(fit, steps=steps) if long and _may_be_coarser(fit) else fit
    return _on_fewest_steps(fit, lambda _, squares: squares <= fit.policy.unseen)


def for_sampling(fit: ModelFit, effective: Array | None = None) -> ModelFit:
    """A fit on the coarsest mesh that leaves the posterior where it is.

    A density is computed some ten thousand times. Steps that move no parameter by a tenth of what
    those of the estimate may, a hundredth of its standard deviation, move the posterior by less
    than the draws of any sampler tell, and change the likelihood of the estimate by nothing that is
    seen.

    Parameters
    ----------
    fit : ModelFit
    effective : ndarray, shape (N, s), optional
        Number of samples that count, of each run and output, where the density takes its
        likelihood to that power: what the samples tell is then less, and its deviations wider.

    Returns
    -------
    ModelFit
        The same estimate; itself where steps were asked for, or no run can be solved in fewer.
    """
    if fit.numerics.steps is not None or not fit.model.dofs:
        return fit
    counts = np.maximum(fit.problem.counts, 1)
    told = 1.0 if effective is None else float(np.max(np.maximum(effective, 1.0) / counts))
    most, unseen = SAMPLED * fit.policy.mesh_shift / np.sqrt(told), fit.policy.unseen / told
    found = _on_fewest_steps(fit, lambda shift, squares: shift <= most and squares <= unseen)
    # What an error model was told of this estimate holds on fewer steps too.
    own, known = found.problem, fit.problem
    own.signatures, own.effective, own.stretch = known.signatures, known.effective, known.stretch
    return found


def _may_be_coarser(fit: ModelFit) -> bool:
    """Whether there are meshes to compare: none where runs of both kinds share one, or a solver
    chooses its own."""
    periodic = [record.periodic for record in fit.records]
    return not any(periodic) or (all(periodic) and fit.numerics.solver == COLLOCATION)


def _on_fewest_steps(fit: ModelFit, do: Callable[[float, float], bool]) -> ModelFit:
    """A fit on the fewest steps that do, by the shift of parameters and the change of the sum of
    squares from those that it has; itself where none do."""
    either = can_be_coarser(fit.problem) or can_be_joined(fit.problem)
    if not (_may_be_coarser(fit) and either):
        return fit
    theta, known = fit.point.theta, [run.y for run in fit.predictions]
    steps = coarsest_steps(fit.records, fit.steps)
    while steps < fit.steps:
        problem = problem_on(fit.model, fit.records, fit.numerics, steps, fit.predictor)
        begin_with(problem.predictor, fit.predictor)
        if problem.freeze(theta) is Status.CONVERGED:
            found = problem.predictor.predict(problem.full(theta[None])[0])
            squares = squares_of_change(problem, found, known, fit.point)
            if do(shift_by(problem, fit.point, found, known), squares):
                return replace(fit, problem=problem, predictions=found, steps=steps)
        steps *= 2
    return fit
