"""Fits of an assembled model to runs.

A fit is the MBE, then the posterior mode, on a mesh fine enough not to influence them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from bayesoleo._types import Array
from bayesoleo.discovery._mesh_error import (
    UNKNOWN_MESH,
    begin_with,
    can_be_coarser,
    can_be_joined,
    mesh_shift,
    shows,
)
from bayesoleo.discovery._numerics import Numerics, problem_on
from bayesoleo.discovery._other_starts import doubtful, from_other_starts, likeliest
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.errors import number_of
from bayesoleo.estimation._bayesian_estimators import method as step_of
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._estimate import estimate, polish
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.model._model import Model
from bayesoleo.prediction._mesh_steps import (
    COARSEST,
    MOST_COMPARED,
    MOST_STEPS,
    WHOLE,
    coarsest_steps,
    fineness,
    first_steps,
    steps_for,
    whole_steps,
)
from bayesoleo.prediction._predictor import Predictor, RunPrediction
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._stability import Stability
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._schemes import COLLOCATION

#: What is said of a mesh that did not do, or of which nothing is known.
TOO_COARSE = (
    "the mesh is too coarse: {} steps leave an error that moves a parameter by {:.2g} of its"
    " standard deviations, where at most {:g} are allowed; the motion's own estimated error is {}"
    " of its swing. Estimates and intervals are not those of the equations: allow more steps"
    " (--steps), or make the model less steep"
)
UNKNOWN_SHIFT = (
    "the error of the mesh of {} steps could not be estimated: nothing is known of what it does to"
    " the estimates"
)
#: An estimate ends where the optimum is nearer than this many posterior standard deviations; its
#: iterations gain a digit each, and what is below no figure shows.
RESOLUTION = 1e-3
#: The same of a model that is only compared with others. Twice its log likelihood is then short of
#: the best by 0.01, or by one where iterations gain a tenth each: as much as the steps of its mesh
#: may change. In effects of a measured pendulum half of all iterations gained less than that.
COMPARED = 0.1
#: Iterations of MBE on all steps after a mode on fewer, and of BE where that was not reached: MBE
#: creeps where the data leave an unknown open.
MORE = 10


@dataclass(frozen=True)
class ModelFit:
    """A fitted model.

    Parameters
    ----------
    model : Model
        Driven.
    problem : CampaignProblem
        Over the runs that were fitted.
    mbe, point : PointEstimate
        The estimate by MBE, or by the method asked for, and the posterior's mode reached from it.
    predictions : list of RunPrediction
        At the mode, with sensitivities, one a fitted run.
    steps : int
        Steps of the mesh.
    numerics : Numerics
        As asked for.
    shift : float
        Largest movement of a parameter by halving the mesh's steps, or by what lies between their
        points, in posterior standard deviations; NaN where it is not known.
    motion_error : float
        Estimated largest error of a fitted run's motion over its swing; NaN where it is not known.
    mesh_error : ndarray, shape (runs, outputs)
        Root mean square of what a finer mesh changes of the predictions, SI; NaN where it is not
        known.
    """

    model: Model
    problem: CampaignProblem
    mbe: PointEstimate
    point: PointEstimate
    predictions: list[RunPrediction]
    steps: int
    numerics: Numerics
    shift: float
    motion_error: float = float("nan")
    mesh_error: Array = field(default_factory=lambda: np.full((1, 1), np.nan))

    @property
    def doubts(self) -> list[str]:
        """Where the estimate is that of the steps rather than of the equations."""
        if not self.model.dofs:
            return []
        if not np.isfinite(self.shift):
            return [UNKNOWN_SHIFT.format(self.steps)]
        largest = self.policy.mesh_shift
        if self.shift > largest:
            least = f"{self.motion_error:.1g}" if np.isfinite(self.motion_error) else "unknown"
            return [TOO_COARSE.format(self.steps, self.shift, largest, least)]
        return []

    @property
    def policy(self) -> SearchPolicy:
        """By which it is judged."""
        return self.numerics.policy

    @property
    def predictor(self) -> Predictor:
        """Of the fitted runs."""
        return self.problem.predictor

    @property
    def records(self) -> tuple[Record, ...]:
        """The fitted runs."""
        return self.predictor.records

    @property
    def fineness(self) -> int:
        """How finely transients are cut on this mesh."""
        return fineness(self.model, self.records, self.steps)

    def steps_for(self, records: Sequence[Record]) -> int:
        """Steps of other runs on a mesh as fine as this one."""
        return steps_for(self.model, self.records, self.steps, records)

    @property
    def all_periodic(self) -> bool:
        """Whether no fitted run is a transient."""
        return all(record.periodic for record in self.records)

    def apart(self) -> ModelFit:
        """The same with solvers of its own: they stay at this estimate, wherever the others go."""
        predictor = copy(self.predictor)
        predictor.runs = [copy(run) for run in self.predictor.runs]
        return replace(self, problem=CampaignProblem(predictor))

    @property
    def stability(self) -> Stability | None:
        """Of the fitted runs' periodic solutions, jumps on the way to both points included."""
        return self.point.following(self.mbe).stability

    @property
    def values(self) -> dict[str, float]:
        """Estimates by unknown."""
        return dict(zip(self.problem.names, map(float, self.point.theta), strict=True))

    @property
    def shared(self) -> dict[str, float]:
        """Estimates of the parameters that all runs have in common."""
        return {name: value for name, value in self.values.items() if name in self.model.parameters}


def fit_model(
    model: Model,
    records: Sequence[Record],
    numerics: Numerics,
    *,
    start: Array | None = None,
    tolerance: float = 1e-6,
    max_iterations: int = 50,
    resolution: float = RESOLUTION,
    share: Predictor | None = None,
    check_mesh: bool = True,
    damped: bool = False,
    method: str = "mbe",
    progress: Callable[[str], None] | None = None,
) -> ModelFit:
    """Estimate a model's parameters from runs.

    Parameters
    ----------
    model : Model
        Driven.
    records : sequence of Record
        Runs, periodic or transient.
    numerics : Numerics
        Scheme, steps, threads.
    start : ndarray, shape (l,) or (m, l), optional
        Where to start; by default at the nominal values, and from draws of the priors as well where
        these lead to an estimate that the priors hardly allow. Of several starts, that lead from
        far away to one whose motion is known, the likeliest is taken, solved from the last of them.
    tolerance : float
        Relative step at which the estimators stop.
    max_iterations : int
        Of each estimator.
    resolution : float
        Distance to the optimum, in posterior standard deviations, at which they stop as well.
    share : Predictor, optional
        Of the same runs; what does not depend on the model is taken from it.
    check_mesh : bool
        Whether to find out what halving the steps would move. Of a model that is only compared
        with others on one mesh nobody asks that, and it costs as much as a third of the estimate.
    damped : bool
        Whether steps that halving does not help are damped. An effect's amplitude and its shape may
        make up for each other, which makes a curved valley of the likelihood.
    method : str
        Estimator that leads to the posterior's mode, as in :func:`bayesoleo.estimation.estimate`.
    progress : callable, optional
        Told what is being done.

    Returns
    -------
    ModelFit
        Its ``point.status`` says whether to trust it.

    References
    ----------
    Verbeek (1993), eqs. 3.17, 3.19 and 3.23.
    """
    callback = progress or (lambda _: None)
    begun = start if start is not None and start.ndim == 1 else None
    limits = {
        "tolerance": tolerance, "max_iterations": max_iterations, "resolution": resolution
    }  # fmt: skip
    problem, few = _begun(model, records, numerics, share), max_iterations
    if check_mesh and start is not None and _has_fewer_steps(problem):
        rough = problem_on(model, records, numerics, _rough_steps(problem), share)
        found = _look(rough, start, method, damped, limits, numerics.policy)
        start = start if found is None else found.theta
        few = few if found is None else min(max_iterations, MORE)
        if found is not None and not found.status.ok:
            limits["max_iterations"] = few
    while True:
        for run in problem.predictor.runs:
            # Nobody is told on which branch a model stands that is only compared with others, and
            # to follow a branch takes as long as to solve.
            run.watched = check_mesh
        mbe, point = _estimated(
            problem, start, method, damped, limits, numerics.policy, callback, few
        )
        problem.freeze(point.theta)
        predictions = problem.predictor.predict(problem.full(point.theta[None])[0])
        mesh = _error_of_mesh(problem, point, predictions, numerics, check_mesh)
        shift, error, change, seen = mesh
        lost = _lost(mbe, point)
        # The mode begins with the estimate, and that on a finer mesh with the last: what is told
        # is where all began.
        begun = mbe.start if begun is None else begun
        steps = problem.predictor.steps
        moved = shift > numerics.policy.mesh_shift
        if not _wants_finer(problem, point, predictions, numerics, moved, seen, check_mesh, lost):
            mbe, point = replace(mbe, start=begun), replace(point, start=begun)
            return ModelFit(
                model, problem, mbe, point, predictions, steps, numerics, shift, error, change
            )
        # One-step collocation gains more than a factor of four by halving, so one look ahead
        # usually suffices.
        start = start if lost else point.theta
        share = problem.predictor if can_be_coarser(problem) or not check_mesh else share
        before = problem.predictor
        problem = problem_on(model, records, numerics, 2 * steps, share)
        if not check_mesh:
            begin_with(problem.predictor, before)


def _has_fewer_steps(problem: CampaignProblem) -> bool:
    """Whether an estimate may begin on fewer steps than it needs to end. Those of records so long
    that inputs choose their steps do so anyway."""
    predictor, steps = problem.predictor, problem.predictor.steps
    if not predictor.model.dofs or any(run.is_long for run in predictor.runs):
        return False
    periodic = [record.periodic for record in predictor.records]
    if not any(periodic):
        return True
    return all(periodic) and predictor.solver == COLLOCATION and _rough_steps(problem) < steps


def _rough_steps(problem: CampaignProblem) -> int:
    """Steps for a first look."""
    predictor = problem.predictor
    return 2 * coarsest_steps(predictor.records, predictor.steps)


def _look(
    rough: CampaignProblem,
    start: Array,
    method: str,
    damped: bool,
    limits: dict[str, float],
    policy: SearchPolicy,
) -> PointEstimate | None:
    """The mode from a start on fewer steps, from where it is near; None where it was lost. Most
    iterations then take a part of their time."""
    for run in rough.predictor.runs:
        run.watched = False
    _, point = _estimated(rough, start, method, damped, limits, policy, lambda _: None)
    return point if point.status in (Status.CONVERGED, Status.NO_CONVERGENCE) else None


def _estimated(
    problem: CampaignProblem,
    start: Array | None,
    method: str,
    damped: bool,
    limits: dict[str, float],
    policy: SearchPolicy,
    callback: Callable[[str], None],
    few: int | None = None,
) -> tuple[PointEstimate, PointEstimate]:
    """The estimate by a method, in a few iterations where it began with a mode, and the mode, on
    one mesh; parameters as of :func:`fit_model`."""
    several = start is not None and start.ndim == 2
    first = likeliest(problem, start) if start is not None and several else start
    unknowns = number_of(len(problem.names), "unknown")
    callback(f"{method.upper()}, {unknowns}, {problem.predictor.steps} steps")
    step = replace(step_of(method), damped=True) if damped else method
    most = limits if few is None else limits | {"max_iterations": few}
    mbe = estimate(problem, step, start=first, **most)  # type: ignore[arg-type]
    callback("posterior mode")
    mode = replace(step_of("be"), damped=damped)
    point = polish(problem, mbe, method=mode, **limits)  # type: ignore[arg-type]
    if start is None and doubtful(problem, point, policy):
        callback("the estimate stands where the priors hardly allow it: other starts")
        mbe, point = from_other_starts(problem, mbe, point, policy=policy, **limits)  # type: ignore[arg-type]
    return mbe, point


def _lost(mbe: PointEstimate, point: PointEstimate) -> bool:
    """Whether an estimate ended, or lost its way, where a solution was not found.

    One that its limit of iterations ended has no need of other steps, and what it reached is nearer
    than where it began.
    """
    ended_by_limit = point.status is Status.NO_CONVERGENCE
    return not point.status.ok and bool(not ended_by_limit or mbe.failures or point.failures)


def _error_of_mesh(
    problem: CampaignProblem,
    point: PointEstimate,
    predictions: list[RunPrediction],
    numerics: Numerics,
    check: bool,
) -> tuple[float, float, Array, float]:
    """As :func:`_mesh_shift` gives it, if it is asked for; none where there is no mesh."""
    if not problem.predictor.model.dofs:
        return 0.0, 0.0, np.zeros((1, 1)), 0.0
    return mesh_shift(problem, point, predictions, numerics.policy) if check else UNKNOWN_MESH


def _wants_finer(
    problem: CampaignProblem,
    point: PointEstimate,
    predictions: list[RunPrediction],
    numerics: Numerics,
    moved: bool,
    seen: float,
    check: bool,
    lost: bool,
) -> bool:
    """Whether an estimate is to be repeated on half the steps.

    That of a model that stands for itself until it moves no more; of long transients also until no
    difference shows in what the model leaves (``seen``). Of a model that is only compared with
    others this is all that is asked, and the steps that an integrator chose are fine enough.
    """
    steps, long = problem.predictor.steps, can_be_coarser(problem)
    whole = whole_steps(problem.predictor.model, problem.predictor.records)
    fewer = steps < whole and (long or can_be_joined(problem))
    if fewer and lost and (long or point.status is not Status.NO_CONVERGENCE):
        return True  # steps may be so long that no solution is found, or lost on the way
    if not check:
        # Where iterations ended the estimate, finer steps than an integrator's give it only more.
        most = MOST_COMPARED if long and point.status.ok else whole
        return (long or fewer) and steps < most and shows(problem, point, predictions, numerics)
    if long and not np.isfinite(seen):
        moved = steps < WHOLE
    elif long and steps < MOST_COMPARED:
        moved = moved or seen > numerics.policy.unseen
    return moved and numerics.steps is None and 2 * steps <= MOST_STEPS


def _begun(
    model: Model, records: Sequence[Record], numerics: Numerics, share: Predictor | None
) -> CampaignProblem:
    """The problem on the first mesh: of long records the coarsest, since an estimate is repeated on
    finer ones until it no longer moves."""
    steps = numerics.steps or first_steps(model, records)
    problem = problem_on(model, records, numerics, steps, share)
    if numerics.steps or not all(run.can_be_coarser for run in problem.predictor.runs):
        return problem
    return problem_on(model, records, numerics, COARSEST, problem.predictor)
