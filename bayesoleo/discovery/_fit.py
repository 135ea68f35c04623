"""Fits of an assembled model to runs, with masks and checks from other starts.

A fit is the MBE, then the posterior mode, on a mesh fine enough not to influence them. Masked
samples have no weight; they are interpolated where whole periods are needed.

The equations of several resonances or contacts have several solutions, and the nominal values may
lie next to a wrong one. A wrong solution usually lies at a limit of a prior's support, or where the
priors have almost no mass. Only then is the time for other starts well spent.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
from scipy import stats

from bayesoleo._parallel import thread_map
from bayesoleo._types import Array
from bayesoleo.data._noise import PeriodicAverage
from bayesoleo.data._sample_quality import bridged
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.errors import number_of
from bayesoleo.estimation._bayesian_estimators import method as step_of
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._estimate import estimate, polish
from bayesoleo.estimation._least_squares import PriorScale
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
from bayesoleo.prediction._run_errors import motion_error, outputs_of
from bayesoleo.prediction._stability import Stability
from bayesoleo.prediction._transient_run import SETTLED
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._schemes import COLLOCATION, DEFAULT_SCHEME

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
#: Shift, error of the motion and of the outputs of a mesh of which nothing is known, and what a
#: finer one does to the sum of squares.
UNKNOWN_MESH = (float("nan"), float("nan"), np.full((1, 1), np.nan), float("nan"))
#: Error of a motion over its swing below which its estimate resolves nothing more.
RESOLVED = 1e-3
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
#: Starts of one estimate, each farther from the present one, that are worse than the best before
#: the others are not looked at.
GIVEN_UP = 2
#: Part of the shift that the steps of an estimate may cause, for those of a density.
SAMPLED = 0.1


def weights(record: Record) -> Array:
    """One for every sample that counts, zero for the others, shape (N,)."""
    return np.ones(record.time.size) if record.kept is None else record.kept.astype(float)


def counted(record: Record) -> int:
    """Number of samples that count."""
    return record.time.size if record.kept is None else int(record.kept.sum())


def without_masked(record: Record, residual: Array) -> Array:
    """A residual with what the other samples say where it does not count, shape (N,).

    Of a periodic run that is the average over its other periods: least squares on all harmonics
    then is that of the samples that count. Of a transient it is a straight line.
    """
    if record.kept is None or not np.isfinite(residual).all():
        return residual
    cycles = (record.time[-1] - record.time[0]) / (record.time.size - 1) * record.frequency
    step = float(cycles) if record.periodic else None
    return cast(Array, bridged(residual[None], ~record.kept, step)[0])


def of_those_counted(record: Record, average: PeriodicAverage) -> PeriodicAverage:
    """The average of a bridged residual, its noise that of the samples which count.

    What was bridged lies on the average: it adds nothing to the squares, and nothing is known by
    it.
    """
    if record.kept is None:
        return average
    count, all_ = counted(record), average.samples
    sigma = average.sigma * np.sqrt((all_ - average.number) / (count - average.number))
    noise = float(sigma * np.sqrt(average.number / count))
    return replace(average, sigma=float(sigma), noise=noise, samples=count)


def doubtful(problem: CampaignProblem, point: PointEstimate, policy: SearchPolicy) -> bool:
    """Whether an estimate stands where its priors hardly allow it, or did not converge."""
    if point.on_limit or not point.status.ok:
        return True
    scale = PriorScale.of(problem.priors, problem.names)
    with np.errstate(invalid="ignore", divide="ignore"):
        away = np.where(
            scale.logarithmic, np.log(point.theta / scale.mean), point.theta - scale.mean
        )
    return bool(np.any(np.abs(away / scale.spread) > stats.norm.isf(policy.doubtful_prior / 2)))


def from_other_starts(
    problem: CampaignProblem,
    mbe: PointEstimate,
    point: PointEstimate,
    *,
    tolerance: float,
    max_iterations: int,
    resolution: float,
    policy: SearchPolicy,
) -> tuple[PointEstimate, PointEstimate]:
    """The best of an estimate and those from starts drawn from the priors.

    The search ends with the first answer that is better and that the priors allow.

    Parameters
    ----------
    problem : CampaignProblem
    mbe, point : PointEstimate
        MBE's estimate from the declared start, and the mode reached from it.
    tolerance, max_iterations, resolution
        As in :func:`~bayesoleo.estimation.estimate`.
    policy : SearchPolicy

    Returns
    -------
    mbe, point : PointEstimate
        Those that were given, where no other start leads to a mode that is clearly more likely.
    """
    options = {"tolerance": tolerance, "max_iterations": max_iterations, "resolution": resolution}
    least = policy.better_optimum
    for start in promising(problem, problem.start, policy):
        first = estimate(problem, "mbe", start=start, **options)  # type: ignore[arg-type]
        if not first.status.ok:
            continue
        found = polish(problem, first, **options)  # type: ignore[arg-type]
        if found.status.ok and (not point.status.ok or found.objective > point.objective + least):
            mbe, point = first, found
            if not doubtful(problem, point, policy):
                break
    return mbe, point


def promising(problem: CampaignProblem, theta: Array, policy: SearchPolicy) -> list[Array]:
    """The most likely of many draws from the priors.

    Parameters
    ----------
    problem : CampaignProblem
        Its solver starts from where it stands.
    theta : ndarray, shape (l,)
        Where unknowns of single runs stay.
    policy : SearchPolicy
        How many are drawn and kept.

    Returns
    -------
    list of ndarray, shape (l,)
        Those that could not be solved are left out.
    """
    rng, shared = np.random.default_rng(0), problem.predictor.model.parameters
    draws = np.repeat(np.asarray(theta, dtype=float)[None], policy.prior_draws, axis=0)
    for k, (name, prior) in enumerate(zip(problem.names, problem.priors, strict=True)):
        if name in shared:
            draws[:, k] = prior.sample(rng, policy.prior_draws)
    cost = _cost(problem, draws)
    order = np.argsort(cost)[: policy.prior_starts]
    return [draws[k] for k in order if np.isfinite(cost[k])]


@dataclass(frozen=True)
class Numerics:
    """How models are solved.

    Parameters
    ----------
    scheme : str
        Discretisation.
    solver : str
        Of periodic runs, see :func:`~bayesoleo.prediction.periodic_orbit`.
    steps : int or None
        Steps of the mesh; ``None`` refines until the estimate no longer moves.
    jobs : int or None
        Threads.
    backend : str
        ``numba`` or ``numpy``.
    scheduler : str or None
        Other processes or machines for fits that do not depend on each other: ``local:4``, or the
        address of a Dask scheduler.
    policy : SearchPolicy
        By which fits are judged and compared.
    """

    scheme: str = DEFAULT_SCHEME
    steps: int | None = None
    jobs: int | None = None
    backend: str = "numba"
    scheduler: str | None = None
    solver: str = COLLOCATION
    policy: SearchPolicy = SearchPolicy()


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
        rough = _problem(model, records, numerics, _rough_steps(problem), share)
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
        share = problem.predictor if _can_be_coarser(problem) or not check_mesh else share
        before = problem.predictor
        problem = _problem(model, records, numerics, 2 * steps, share)
        if not check_mesh:
            _begin_with(problem.predictor, before)


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
    first = _likeliest(problem, start) if start is not None and several else start
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


def _can_be_coarser(problem: CampaignProblem) -> bool:
    """Whether any run is so long that its steps may be joined."""
    return any(run.can_be_coarser for run in problem.predictor.runs)


def _can_be_joined(problem: CampaignProblem) -> bool:
    """Whether a comparison may do with fewer steps than were chosen for any run."""
    return any(run.can_be_joined for run in problem.predictor.runs)


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
    return _mesh_shift(problem, point, predictions, numerics.policy) if check else UNKNOWN_MESH


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
    steps, long = problem.predictor.steps, _can_be_coarser(problem)
    whole = whole_steps(problem.predictor.model, problem.predictor.records)
    fewer = steps < whole and (long or _can_be_joined(problem))
    if fewer and lost and (long or point.status is not Status.NO_CONVERGENCE):
        return True  # steps may be so long that no solution is found, or lost on the way
    if not check:
        # Where iterations ended the estimate, finer steps than an integrator's give it only more.
        most = MOST_COMPARED if long and point.status.ok else whole
        return (long or fewer) and steps < most and _shows(problem, point, predictions, numerics)
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
    problem = _problem(model, records, numerics, steps, share)
    if numerics.steps or not all(run.can_be_coarser for run in problem.predictor.runs):
        return problem
    return _problem(model, records, numerics, COARSEST, problem.predictor)


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
    either = _can_be_coarser(fit.problem) or _can_be_joined(fit.problem)
    if not (_may_be_coarser(fit) and either):
        return fit
    theta, known = fit.point.theta, [run.y for run in fit.predictions]
    steps = coarsest_steps(fit.records, fit.steps)
    while steps < fit.steps:
        problem = _problem(fit.model, fit.records, fit.numerics, steps, fit.predictor)
        _begin_with(problem.predictor, fit.predictor)
        if problem.freeze(theta) is Status.CONVERGED:
            found = problem.predictor.predict(problem.full(theta[None])[0])
            squares = _squares(problem, found, known, fit.point)
            if do(_shift(problem, fit.point, found, known), squares):
                return replace(fit, problem=problem, predictions=found, steps=steps)
        steps *= 2
    return fit


def _begin_with(predictor: Predictor, known: Predictor) -> None:
    """Start periodic runs from the motions of others of the same model, which are on their branch;
    transients do so by themselves."""
    for run, other in zip(predictor.runs, known.runs, strict=True):
        if run.record.periodic:
            run.motions, run.watched = other.known_motions(), other.watched


def _shows(
    problem: CampaignProblem,
    point: PointEstimate,
    predictions: list[RunPrediction],
    numerics: Numerics,
) -> bool:
    """Whether half the steps would visibly change what a model leaves."""
    if not all(run.status.ok for run in predictions):
        return False
    halved = _halved(problem, point)
    if halved is None:  # where a force sets in, the solution is lost on one mesh and not on another
        return True
    return _squares(problem, predictions, halved, point) > numerics.policy.unseen


def _squares(
    problem: CampaignProblem,
    predictions: list[RunPrediction],
    others: list[Array],
    point: PointEstimate,
) -> float:
    """Largest change of the sum of squares by better predictions, over the variances of what is
    left: ``d.d + |2 r.d|`` of their changes ``d`` and residuals ``r``."""
    squares, along = 0.0, 0.0
    # An integrator's steps, and those of a period, are finer than what long ones are halved to.
    settled = SETTLED if _can_be_coarser(problem) else 0.0
    for record, run, here, other in zip(
        problem.predictor.records, problem.predictor.runs, predictions, others, strict=True
    ):
        own = changed_squares(run.measured, here.y, other, point.variance, weights(record), settled)
        squares, along = squares + own[0], along + own[1]
    return squares + abs(along)


def changed_squares(
    measured: Array,
    here: Array,
    other: Array,
    variance: Array,
    weight: Array,
    settled: float = SETTLED,
) -> tuple[float, float]:
    """``d.d`` and ``2 r.d`` of a change ``d`` of outputs to residuals ``r``, over variances.

    Parameters
    ----------
    measured, here, other : ndarray, shape (ny, N)
        Measured outputs, those predicted, and those that they change to.
    variance : ndarray, shape (ny,)
        Of what a model leaves.
    weight : ndarray, shape (N,)
        One for samples that count, zero for others.
    settled : float
        Root mean square of a change, over the size of an output, that is not seen.
    """
    counts = weight > 0
    if not counts.any():
        return 0.0, 0.0
    measured, here, other = (values[:, counts] for values in (measured, here, other))
    squares = np.mean((other - here) ** 2, axis=1)
    products = np.sum((measured - other) * (other - here), axis=1)
    shown = products * _is_shown(measured, squares, settled)
    along = float(np.sum(2.0 * shown / np.maximum(variance, 1e-300)))
    return visible(measured, squares, variance, settled), along


def visible(measured: Array, squares: Array, variance: Array, settled: float = SETTLED) -> float:
    """Sum of squares of a change of outputs, over the variances ``(ny,)`` of what a model leaves.

    Where it leaves next to nothing, what has settled shows no more.

    Parameters
    ----------
    measured : ndarray, shape (ny, N)
    squares : ndarray, shape (ny,)
        Mean squares of the change.
    variance : ndarray, shape (ny,)
    settled : float
        As of :func:`changed_squares`.
    """
    shown = squares * _is_shown(measured, squares, settled)
    return float(np.sum(shown / np.maximum(variance, 1e-300)) * measured.shape[1])


def _is_shown(measured: Array, squares: Array, settled: float) -> Array:
    """One for outputs whose mean squared change ``(ny,)`` is more than what has settled, else
    zero."""
    return (squares > settled**2 * np.var(measured, axis=1)).astype(float)


def _likeliest(problem: CampaignProblem, starts: Array) -> Array:
    """Of starts ``(m, l)`` the one that makes the data most likely; the first where that cannot be
    told.

    They lead from far away to the last, where the motion is known. Those beyond a few that are
    worse than the best so far are not looked at: a motion far from what it is solved from takes ten
    times as long, and the farther the less likely it is.
    """
    if problem.freeze(starts[-1]) is not Status.CONVERGED:
        return cast(Array, starts[0])
    best, least, worse = 0, np.inf, 0
    for k in reversed(range(len(starts))):
        (cost,) = _cost(problem, starts[k : k + 1])
        if cost < least:
            best, least, worse = k, float(cost), 0
        else:
            worse += int(np.isfinite(least))
        if worse == GIVEN_UP:
            break
    return cast(Array, starts[best])


def _cost(problem: CampaignProblem, vectors: Array) -> Array:
    """Twice the negative logarithm of the likelihood, variances eliminated, of vectors ``(L, l)``;
    infinite for those that could not be solved.

    They lie far apart: a motion of another branch is as good as any, and no jump of the estimate.
    """
    with problem.unwatched():
        sums = problem.misfit(vectors).sum_of_squares.sum(axis=1)
    counts = problem.counts.sum(axis=0)
    cost = np.sum(counts * np.log(np.maximum(sums, 1e-300)), axis=1)
    return np.where(np.isfinite(cost), cost, np.inf)


def _problem(
    model: Model, records: Sequence[Record], numerics: Numerics, steps: int, share: Predictor | None
) -> CampaignProblem:
    predictor = Predictor(
        model,
        records,
        steps=steps,
        scheme=numerics.scheme,
        solver=numerics.solver,
        backend=numerics.backend,
        jobs=numerics.jobs,
        share=share,
    )
    return CampaignProblem(predictor)


def _mesh_shift(
    problem: CampaignProblem,
    point: PointEstimate,
    predictions: list[RunPrediction],
    policy: SearchPolicy,
) -> tuple[float, float, Array, float]:
    """Shift of the estimate that the discretisation causes, in standard deviations, the largest
    error of a motion over its swing, what a finer mesh changes of each output of each run, and of
    the sum of squares."""
    coarse = problem.predictor
    halved = _halved(problem, point)
    if halved is None:
        return UNKNOWN_MESH
    shift = _shift(problem, point, predictions, halved)
    found = thread_map(lambda run: motion_error(run, RESOLVED), coarse.runs, coarse.jobs)
    error = float(np.max([one.error for one in found]))  # NaN where one is not known
    better = [outputs_of(run, one) for run, one in zip(coarse.runs, found, strict=True)]
    known = [y for y in better if y is not None and np.isfinite(y).all()]
    if len(known) < len(better):
        changes = _squares(problem, predictions, halved, point)
        return shift, error, _change(predictions, halved), changes
    missed = _shift(problem, point, predictions, known)
    clearly = missed > max(policy.missed_factor * shift, policy.mesh_shift)
    changes = _squares(problem, predictions, known, point)
    return (missed if clearly else shift), error, _change(predictions, known), changes


def _change(predictions: list[RunPrediction], better: list[Array]) -> Array:
    """Root mean square of the difference, shape (runs, outputs)."""
    pairs = zip(predictions, better, strict=True)
    return np.array([np.sqrt(np.mean((y - run.y) ** 2, axis=1)) for run, y in pairs])


def _halved(problem: CampaignProblem, point: PointEstimate) -> list[Array] | None:
    """Outputs ``(ny, N)`` of every run on half the steps; None where one has no solution."""
    coarse = problem.predictor
    theta = problem.full(point.theta[None])[0]
    fine = Predictor(
        coarse.model,
        coarse.records,
        steps=2 * coarse.steps,
        scheme=coarse.scheme,
        solver=coarse.solver,
        backend=coarse.backend,
        jobs=coarse.jobs,
        share=coarse,
    )
    _begin_with(fine, coarse)
    found = fine.solved_anew(theta)
    if any(samples.status[0] != Status.CONVERGED.value for samples in found):
        return None
    return [samples.y[0] for samples in found]


def _shift(
    problem: CampaignProblem,
    point: PointEstimate,
    predictions: list[RunPrediction],
    better: list[Array],
) -> float:
    """Largest shift ``(J' W J)^-1 J' W delta`` over its standard deviation, by better outputs."""
    names = problem.predictor.layout.names
    gradient = np.zeros(len(names))
    for run, y in zip(predictions, better, strict=True):
        gradient += np.einsum("ylN,yN->l", run.sensitivity, (y - run.y) / point.variance[:, None])
    free = np.array([names.index(name) for name in problem.names])
    return float(np.max(np.abs(point.covariance @ gradient[free]) / point.sd, initial=0.0))
