"""Point estimate: values, covariance and history, as labelled arrays and as text."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from html import escape
from typing import Any

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._schema import variable
from bayesoleo._types import Array, Float, Int, Integers
from bayesoleo.errors import InputError, number_of
from bayesoleo.prediction._stability import Stability
from bayesoleo.solvers._orbit import Status, added, counted

#: Notes on estimates whose standard deviations are not reliable.
EXACT = (
    "{} is fitted to the rounding of its samples: there is no noise to estimate, and standard "
    "deviations mean nothing"
)
SILENT = "the data say nothing of {}"
UNDETERMINED = "the data do not determine {}, at most combinations of these (see principal_axes)"
FROM_PRIOR = ": what is known beyond is the prior's"
KNOWN = "held at the declared value, known to a tolerance that the covariance carries: {}"
NO_SD = ": there is no standard deviation"
_MOST_NAMES = 8
_MIXED = "unit of each parameter"


@dataclass(frozen=True, eq=False, repr=False)
class PointEstimate:
    """Result of an estimator.

    Parameters
    ----------
    names : tuple of str, length l
    outputs : tuple of str, length s
    theta : ndarray, shape (l,)
        The estimate, in the parameters' units.
    variance : ndarray, shape (s,)
        Error variances staged at the estimate (Verbeek 1993, eq. 3.17 or 3.18).
    covariance : ndarray, shape (l, l)
        Linearised with the prior's variances, ``[A + diag(w)^-1]^-1``; NaN after a failed start.
        Where the prior is log-normal, ``w`` is that of the logarithm times the squared estimate.
    covariance_likelihood : ndarray, shape (l, l)
        Linearised without the prior, ``A^-1``; NaN for the unknowns that the data do not determine.
    method : str
    status : Status
        ``NO_CONVERGENCE`` also where the steps became small away from the fixed point.
    iterations : int
        Steps taken, including the last, small one.
    halvings : int
        Number of halvings over all iterations.
    evaluations : int
        Calls of ``problem.evaluate``.
    objective : float
        The method's own objective at the estimate: eq. 2.29 for BE, 2.31 for the others.
    distance : float
        Linearised distance to the method's fixed point, in standard deviations; NaN if the steps
        never became small.
    start : ndarray, shape (l,)
    history : ndarray, shape (iterations + 1, l)
    history_variance : ndarray, shape (iterations + 1, s)
    history_objective : ndarray, shape (iterations + 1,)
    history_halvings : ndarray of int, shape (iterations + 1,)
    on_limit : tuple of str
        Unknowns that lie on a limit of their prior's support.
    objective_name : str
        Objective that was maximised, one of :data:`bayesoleo.estimation.OBJECTIVES`.
    error_covariance : ndarray, shape (s, s), optional
        Covariance of the outputs' errors; diagonal unless the objective has correlated errors.
    failures : mapping of str to int
        Trial points that could not be evaluated, by the lower-case name of their
        :class:`~bayesoleo.solvers.Status`: steps towards them were halved.
    stability : Stability, optional
        Floquet multipliers of each run's periodic solution at the estimate, and how often one
        jumped to another branch during the iteration; None without periodic solutions.
    exact : tuple of str
        Outputs that are fitted to the rounding of their samples.
    known : tuple of str
        Unknowns that were held because the method disregards their prior; their uncertainty is
        carried into the covariance.
    remarks : tuple of str
        What else is to be said, such as why an error model was chosen.
    """

    names: tuple[str, ...]
    outputs: tuple[str, ...]
    theta: Float[Array, " unknowns"]
    variance: Float[Array, " outputs"]
    covariance: Float[Array, "unknowns unknowns"]
    covariance_likelihood: Float[Array, "unknowns unknowns"]
    method: str
    status: Status
    iterations: int
    halvings: int
    evaluations: int
    objective: float
    distance: float
    start: Float[Array, " unknowns"]
    history: Float[Array, "iterates unknowns"] = field(repr=False)
    history_variance: Float[Array, "iterates outputs"] = field(repr=False)
    history_objective: Float[Array, " iterates"] = field(repr=False)
    history_halvings: Int[Integers, " iterates"] = field(repr=False)
    on_limit: tuple[str, ...] = ()
    objective_name: str = "diagonal"
    error_covariance: Float[Array, "outputs outputs"] | None = field(default=None, repr=False)
    failures: Mapping[str, int] = field(default_factory=dict)
    stability: Stability | None = field(default=None, repr=False)
    exact: tuple[str, ...] = ()
    known: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    @property
    def sd(self) -> Array:
        """Linearised standard deviations, shape (l,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def branch_jumps(self) -> int:
        """How often a periodic solution jumped to another branch between neighbouring trials."""
        return 0 if self.stability is None else self.stability.branch_jumps

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Unknowns that the data alone do not determine; none after a failed start."""
        open_ones = np.isnan(np.diag(self.covariance_likelihood)) & (len(self.history) > 0)
        pairs = zip(self.names, open_ones, strict=True)
        return tuple(name for name, is_open in pairs if is_open and name not in self.known)

    @property
    def doubts(self) -> list[str]:
        """Notes on standard deviations that are not reliable."""
        found = [EXACT.format(", ".join(self.exact))] if self.exact else []
        if self.undetermined:
            text = SILENT if len(self.undetermined) == 1 else UNDETERMINED
            text += FROM_PRIOR if np.isfinite(self.sd).all() else NO_SD
            found.append(text.format(_listed(self.undetermined)))
        return found

    @property
    def notes(self) -> list[str]:
        """Notes on the estimate's solutions, such as an unstable one, and on its standard
        deviations."""
        held = [KNOWN.format(_listed(self.known))] if self.known else []
        stable = [] if self.stability is None else self.stability.notes()
        return [*stable, *self.doubts, *held, *self.remarks]

    def __getitem__(self, name: str) -> float:
        return float(self.theta[self.names.index(name)])

    def following(self, first: PointEstimate | None) -> PointEstimate:
        """Copy that includes the branch jumps of the estimate from which it was polished."""
        if first is None or first.stability is None or self.stability is None:
            return self
        jumps = self.stability.jumps + first.stability.jumps
        changes = self.stability.only_changed + first.stability.only_changed
        return replace(self, stability=self.stability.with_jumps(jumps, changes))

    def __str__(self) -> str:

        return as_text(self)

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>{self.to_dataset()._repr_html_()}"

    def to_dataset(self, **options: Any) -> xr.Dataset:
        """Labelled arrays; see :func:`bayesoleo.estimation.to_dataset`."""

        return to_dataset(self, **options)


def _listed(names: tuple[str, ...]) -> str:
    """Names in a sentence; only the first ones of many."""
    rest = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {rest} more" if rest > 0 else "")


def to_dataset(
    point: PointEstimate,
    *,
    mbe: PointEstimate | None = None,
    units: Sequence[str] | None = None,
) -> xr.Dataset:
    """Arrange an estimate as the group ``point`` of a result.

    Parameters
    ----------
    point : PointEstimate
        The estimate, usually the posterior's mode.
    mbe : PointEstimate, optional
        The estimate that ``point`` was polished from; its iterations come first in the history. By
        default ``point`` itself, where that is MBE's.
    units : sequence of str, length l, optional
        Units of the parameters.

    Returns
    -------
    xarray.Dataset
        ``start``, ``mbe``, ``estimate``, ``sd``, ``unit`` (parameter); ``covariance`` (parameter,
        parameter_column); ``variance`` (output); ``history`` (iteration, parameter) and
        ``objective`` (iteration) with the coordinate ``method`` (iteration). Where there are
        periodic solutions: ``floquet`` (run, multiplier, part), ``stable`` and ``branch_jumps``
        (run).

    Raises
    ------
    InputError
        If the number of units or the parameters of ``mbe`` do not fit.
    """
    if mbe is not None and mbe.names != point.names:
        raise InputError("mbe has other parameters", key="mbe", value=mbe.names)
    if units is not None and len(units) != len(point.names):
        raise InputError("units must have one entry per parameter", key="units", value=list(units))
    stages = [point] if mbe is None else [mbe, point]
    point = point.following(mbe)
    answers = {} if point.stability is None else _stability(point.stability)
    dataset = xr.Dataset(
        {**_parameters(point, mbe, units), **_spread(point), **_history(stages), **answers},
        coords={
            schema.PARAMETER: list(point.names),
            schema.PARAMETER_COLUMN: list(point.names),
            schema.OUTPUT: list(point.outputs),
        },
    )
    dataset.attrs = {
        "status": point.status.name.lower(),
        "status_message": point.status.message,
        "method": point.method,
        "iterations": sum(stage.iterations for stage in stages),
        "halvings": sum(stage.halvings for stage in stages),
        "evaluations": sum(stage.evaluations for stage in stages),
        "failures": json.dumps(added(stage.failures for stage in stages)),
        "on_limit": ", ".join(point.on_limit),
        "branch_jumps": point.branch_jumps,
        "notes": json.dumps(point.notes, ensure_ascii=False),
    }
    if point.stability is not None:
        dataset = dataset.assign_coords(
            {schema.RUN: list(point.stability.runs), schema.PART: ["real", "imaginary"]}
        )
    return dataset.assign_coords(method=(schema.ITERATION, _methods(stages)))


def _parameters(
    point: PointEstimate, mbe: PointEstimate | None, units: Sequence[str] | None
) -> dict[str, xr.Variable]:
    dims = (schema.PARAMETER,)
    start = point.start if mbe is None else mbe.start
    robust = point if mbe is None and point.method == "mbe" else mbe
    is_mbe = robust is not None and robust.method == "mbe"
    reached = robust.theta if robust is not None and is_mbe else np.full(len(point.names), np.nan)
    labels = [""] * len(point.names) if units is None else list(units)
    return {
        schema.START: variable(dims, start, "start of the estimate", _MIXED),
        schema.MBE: variable(dims, reached, "modified Bayesian estimate", _MIXED),
        schema.ESTIMATE: variable(dims, point.theta, "estimate", _MIXED),
        schema.SD: variable(dims, point.sd, "linearised standard deviation", _MIXED),
        schema.UNIT: variable(dims, np.array(labels, dtype=object), "unit of the parameter", ""),
    }


def _spread(point: PointEstimate) -> dict[str, xr.Variable]:
    square = (schema.PARAMETER, schema.PARAMETER_COLUMN)
    covariance = variable(
        square, point.covariance, "linearised covariance", "product of the parameters' units"
    )
    variance = variable(
        (schema.OUTPUT,), point.variance, "error variance", "square of the output's SI unit"
    )
    return {schema.COVARIANCE: covariance, schema.VARIANCE: variance}


def _stability(found: Stability) -> dict[str, xr.Variable]:
    """Multipliers of each run's periodic solution; netCDF has no complex numbers."""
    parts = np.stack([found.multipliers.real, found.multipliers.imag], axis=-1)
    dims = (schema.RUN, schema.MULTIPLIER, schema.PART)
    stable = np.where(found.unstable < 0, -1, found.unstable == 0).astype(np.int8)
    meaning = {"flag_values": [-1, 0, 1], "flag_meanings": "unknown unstable stable"}
    variables = {
        schema.FLOQUET: variable(dims, parts, "Floquet multipliers, largest first", "1"),
        schema.STABLE: variable((schema.RUN,), stable, "whether the solution is stable", "1"),
        schema.BRANCH_JUMPS: variable(
            (schema.RUN,), found.jumps, "jumps of the solution to another branch", "1"
        ),
    }
    variables[schema.STABLE].attrs |= meaning
    return variables


def _history(stages: Sequence[PointEstimate]) -> dict[str, xr.Variable]:
    theta = np.concatenate([stage.history for stage in stages])
    objective = np.concatenate([stage.history_objective for stage in stages])
    dims = (schema.ITERATION, schema.PARAMETER)
    return {
        schema.HISTORY: variable(dims, theta, "parameters by iteration", _MIXED),
        schema.OBJECTIVE: variable(
            (schema.ITERATION,), objective, "objective of the method by iteration", "1"
        ),
    }


def _methods(stages: Sequence[PointEstimate]) -> np.ndarray:
    names = [stage.method for stage in stages for _ in stage.history_objective]
    return np.array(names, dtype=object)


def as_text(point: PointEstimate) -> str:
    """One line for each parameter, and a last one for the outcome."""
    width = max([9, *(len(name) for name in point.names)])
    lines = [f"{'parameter':<{width}}  {'start':>12}  {'estimate':>12}  {'sd':>9}"]
    rows = zip(point.names, point.start, point.theta, point.sd, strict=True)
    lines += [f"{n:<{width}}  {s:>12.6g}  {t:>12.6g}  {d:>9.2g}" for n, s, t, d in rows]
    for output, variance in zip(point.outputs, point.variance, strict=True):
        lines.append(f"{output}: residual standard deviation {np.sqrt(variance):.4g}")
    steps = f"{number_of(point.iterations, 'iteration')}, {number_of(point.halvings, 'halving')}"
    lines.append(f"{point.method}: {point.status.message}; {steps}")
    if any(point.failures.values()):
        lines.append(f"trials that failed: {counted(point.failures)}")
    if point.on_limit:
        lines.append(f"on a limit of their prior: {', '.join(point.on_limit)}")
    lines += point.notes
    return "\n".join(lines)
