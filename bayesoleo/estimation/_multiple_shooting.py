"""Parameter estimates from chaotic and other transient records by multiple shooting.

A chaotic motion is sensitive to its initial state: after some Lyapunov times it is no longer a
usable function of the initial state and the parameters. A fit of these alone (single shooting)
has countless local minima. Multiple shooting gives each short segment of the record an initial
state of its own, takes first guesses of these states from the measurement, and imposes continuity
only on the solution. The linearised problem is solved for all states by one banded elimination, so
that the step of the parameters and their covariance come from a small matrix.

References
----------
Baake, E., Baake, M., Bock, H. G. and Briggs, K. M. (1992). Fitting ordinary differential equations
to chaotic data. Physical Review A 45, 5524-5529. Verbeek (1993), section 4.4.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bayesoleo._types import Array, Float
from bayesoleo.error_models._fitting import inverse_gram
from bayesoleo.errors import InputError
from bayesoleo.estimation._estimate import checked_start
from bayesoleo.estimation._least_squares import PriorScale, on_limit
from bayesoleo.estimation._multiple_shooting_iteration import ShootingOutcome, iterate, joined
from bayesoleo.estimation._multiple_shooting_step import PRIORS, Local, ShootingProblem
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.model._model import Model
from bayesoleo.prediction._records import Record
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._schemes import DEFAULT_SCHEME

#: A mesh is fine enough when halving its steps moves no estimate by more of its standard deviation.
LARGEST_SHIFT = 0.1
MOST_REFINEMENTS = 4


@dataclass(frozen=True, eq=False)
class EstimatedTrajectory:
    """The motion that an estimate found for one record.

    Parameters
    ----------
    label : str
        Of the record.
    time : ndarray, shape (n + 1,)
        Nodes of the mesh in seconds, as the record counts them.
    states : ndarray, shape (n + 1, D)
        Value, and velocity of a second-order dof, of each dof in turn; SI.
    initial_sd : ndarray, shape (D,)
        Standard deviations of the first state.
    outputs : tuple of str
        Those that were measured.
    predicted, residual : ndarray, shape (ny, N)
        At the samples; measured less predicted.
    gap : float
        Largest jump between a step's end and the next node, over the spread of that component.
    names : tuple of str, length D
        Of the states: ``x``, or ``dot(x)`` for the velocity of a second-order dof.
    """

    label: str
    time: Float[Array, " nodes"]
    states: Float[Array, "nodes states"]
    initial_sd: Float[Array, " states"]
    outputs: tuple[str, ...]
    predicted: Float[Array, "outputs samples"]
    residual: Float[Array, "outputs samples"]
    gap: float
    names: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ShootingEstimate:
    """Result of :func:`multiple_shooting`.

    Parameters
    ----------
    point : PointEstimate
        Parameters, covariance and history. ``halvings`` counts the steps that were shortened.
    trajectories : tuple of EstimatedTrajectory
        One for each record.
    steps : tuple of int
        Of each record's mesh.
    shift : float
        Largest change of a parameter by the last refinement of the mesh, in its standard
        deviations; NaN where the mesh was not refined.
    """

    point: PointEstimate
    trajectories: tuple[EstimatedTrajectory, ...] = field(repr=False)
    steps: tuple[int, ...]
    shift: float

    @property
    def status(self) -> Status:
        """How the iteration ended."""
        return self.point.status

    @property
    def doubt(self) -> str:
        """Where the estimate may be that of the steps, in a sentence; empty where it is not."""
        if np.isnan(self.shift):
            return "the mesh was not refined: nothing is known of what its steps do to the estimate"
        if self.shift <= LARGEST_SHIFT:
            return ""
        return (
            f"the mesh is too coarse: its last refinement moved a parameter by {self.shift:.2g} of"
            f" its standard deviations, where {LARGEST_SHIFT:g} are allowed"
        )

    def __str__(self) -> str:
        return "\n".join(filter(None, [str(self.point), self.doubt]))


def multiple_shooting(
    model: Model,
    records: Sequence[Record],
    method: str = "mbe",
    *,
    start: ArrayLike | None = None,
    steps: int | None = None,
    interval: float = 0.0,
    scheme: str = DEFAULT_SCHEME,
    backend: str = "numba",
    tolerance: float = 1e-6,
    max_iterations: int = 50,
) -> ShootingEstimate:
    """Estimate parameters from transient records, chaotic ones included.

    Shooting states start on the smoothed samples where a dof is measured itself, and at the
    declared guess of the dof otherwise; a single measured component can do. All initial states are
    estimated along with the parameters.

    Parameters
    ----------
    model : Model
    records : sequence of Record
        Reduced runs of a campaign, or arrays through
        :func:`~bayesoleo.prediction.transient_record`. Some of the model's outputs do.
    method : {"mbe", "be", "gauss-newton"}
        As in :func:`~bayesoleo.estimation.estimate`; ``"be"`` ends in the posterior's mode, the
        others in the maximum-likelihood point, for which what is known of constants with a
        tolerance counts like data.
    start : array_like, shape (l,), optional
        Of the unknowns; by default their nominal values.
    steps : int, optional
        Steps of each record's mesh. By default one between every two samples, halved until no
        parameter moves by more than a tenth of its standard deviation.
    interval : float, optional
        Shortest time between shooting nodes, s. By default every step begins at one, which
        converges from farthest; infinity means single shooting.
    scheme : str, optional
        A collocation scheme.
    backend : {"numba", "numpy"}, optional
    tolerance : float, optional
        Relative step of the parameters at which the iteration ends.
    max_iterations : int, optional

    Returns
    -------
    ShootingEstimate
        A numerical failure is its ``status``, never an exception.

    Raises
    ------
    InputError
        If the start, the method or a record cannot be used.

    References
    ----------
    Bock (1987), generalised Gauss-Newton under constraints; Deuflhard, P. (2011), Newton Methods
    for Nonlinear Problems, section 3.3, for the damping.

    Examples
    --------
    >>> from bayesoleo.estimation import multiple_shooting
    >>> from bayesoleo.prediction import transient_record
    >>> from bayesoleo.systems import system
    >>> time = np.linspace(0.0, 2.0, 41)
    >>> model = system("linear_oscillator").with_values({"mass": 1.0})
    >>> samples = {"displacement": np.exp(-0.25 * time) * np.cos(9.997 * time), "force": 0 * time}
    >>> record = transient_record("decay", time, samples)
    >>> found = multiple_shooting(model, [record], backend="numpy")
    >>> found.status.message, round(found.point["stiffness"], 1)
    ('converged', 100.0)
    """
    if method not in PRIORS:
        raise InputError(
            "multiple shooting has no such estimator",
            key="method",
            value=method,
            hint=f"use {', '.join(PRIORS)}",
        )
    meshes = [record.time.size - 1 if steps is None else steps for record in records]
    problem = ShootingProblem.of(model, records, meshes, interval, scheme, backend)
    scale = PriorScale.of(problem.priors, problem.names)
    given = problem.layout.start(model) if start is None else start
    begin = checked_start(problem.names, scale, given)
    x = [run.start(problem.constants(begin, r)) for r, run in enumerate(problem.runs)]
    options: dict[str, Any] = {"tolerance": tolerance, "max_iterations": max_iterations}
    outcome = iterate(problem, method, begin, x, None, **options)
    shift = np.nan
    for _ in range(MOST_REFINEMENTS if steps is None and outcome.status.ok else 0):
        meshes = [2 * n for n in meshes]
        finer = ShootingProblem.of(model, records, meshes, interval, scheme, backend)
        again = _again(problem, finer, method, outcome, options)
        shift = _shift(outcome, again)
        problem, outcome = finer, again
        if not outcome.status.ok or shift <= LARGEST_SHIFT:
            break
    return _summary(problem, method, begin, outcome, shift)


def _again(
    problem: ShootingProblem,
    finer: ShootingProblem,
    prior: str,
    outcome: ShootingOutcome,
    options: Mapping[str, Any],
) -> ShootingOutcome:
    """Go on from an outcome on a finer mesh."""
    pairs = zip(problem.runs, finer.runs, outcome.x, strict=True)
    x = [coarse.moved_to(fine, x) for coarse, fine, x in pairs]
    return joined(outcome, iterate(finer, prior, outcome.theta, x, outcome.variance, **options))


def _shift(outcome: ShootingOutcome, again: ShootingOutcome) -> float:
    if again.local is None:
        return np.nan
    sd = np.sqrt(np.diag(_covariances(again.local)[0]))
    return float(np.max(np.abs(again.theta - outcome.theta) / sd, initial=0.0))


def _covariances(local: Local) -> tuple[Array, Array]:
    """Covariance of the parameters ``(l, l)`` with the prior and without."""
    units = np.outer(local.unit, local.unit)
    with_prior = np.vstack((local.jacobian, local.scale.root))
    return units * inverse_gram(with_prior), units * inverse_gram(local.jacobian)


def _summary(
    problem: ShootingProblem, method: str, start: Array, outcome: ShootingOutcome, shift: float
) -> ShootingEstimate:
    unknowns, history = len(problem.names), outcome.history
    covariance = likelihood = np.full((unknowns, unknowns), np.nan)
    on: tuple[str, ...] = ()
    if outcome.local is not None:
        covariance, likelihood = _covariances(outcome.local)
        held = on_limit(outcome.local.scale.room(outcome.theta))
        on = tuple(name for name, at in zip(problem.names, held, strict=True) if at)
    point = PointEstimate(
        names=problem.names,
        outputs=problem.outputs,
        theta=outcome.theta,
        variance=outcome.variance,
        covariance=covariance,
        covariance_likelihood=likelihood,
        method=method,
        status=outcome.status,
        iterations=max(len(history) - 1, 0),
        halvings=sum(line.damped for line in history),
        evaluations=len(history),
        objective=history[-1].objective if history else np.nan,
        distance=0.0 if outcome.status.ok else np.nan,
        start=start,
        history=np.array([line.theta for line in history]).reshape(-1, unknowns),
        history_variance=np.array([line.variance for line in history]).reshape(
            -1, len(problem.outputs)
        ),
        history_objective=np.array([line.objective for line in history]),
        history_halvings=np.array([line.damped for line in history], dtype=np.int64),
        on_limit=on,
    )
    trajectories = tuple(
        _trajectory(problem, outcome, r, covariance) for r in range(len(problem.runs))
    )
    return ShootingEstimate(
        point, trajectories, tuple(run.segments.steps for run in problem.runs), shift
    )


def _trajectory(
    problem: ShootingProblem, outcome: ShootingOutcome, r: int, covariance: Array
) -> EstimatedTrajectory:
    run, x, D = problem.runs[r], outcome.x[r], problem.runs[r].state_size
    predicted = run.predict(x, problem.constants(outcome.theta, r))
    states = np.concatenate([x[:, :D], run.segments.ends(x[..., None])[-1:, :, 0]])
    spread = np.maximum(states.std(axis=0), np.finfo(float).tiny)
    own, derived = problem.layout.columns[r], run.kernels.derived
    sd = np.full(D, np.nan)
    if outcome.local is not None:
        sd = outcome.local.normal[r].initial_sd(covariance[np.ix_(own, own)])
    return EstimatedTrajectory(
        label=run.record.label,
        time=run.record.time[0] + run.segments.length * np.arange(len(states)),
        states=states,
        initial_sd=sd,
        outputs=run.outputs,
        predicted=predicted,
        residual=run.measured - predicted,
        gap=float(np.max(np.abs(run.segments.gaps(x)) / spread, initial=0.0)),
        names=tuple(
            name if k == 0 else f"dot({name})"
            for name, order in zip(derived.dofs, derived.orders, strict=True)
            for k in range(order)
        ),
    )
