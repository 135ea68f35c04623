"""A point estimate as labelled arrays and as text."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
import xarray as xr

from bayesoleo import schema
from bayesoleo.errors import InputError
from bayesoleo.estimation.estimators.point import PointEstimate
from bayesoleo.prediction.stability import Stability
from bayesoleo.solvers.status import added, counted

_MIXED = "unit of each parameter"


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


def _variable(dims: tuple[str, ...], values: object, name: str, unit: str) -> xr.Variable:
    return xr.Variable(dims, values, {"long_name": name, "units": unit})


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
        schema.START: _variable(dims, start, "start of the estimate", _MIXED),
        schema.MBE: _variable(dims, reached, "modified Bayesian estimate", _MIXED),
        schema.ESTIMATE: _variable(dims, point.theta, "estimate", _MIXED),
        schema.SD: _variable(dims, point.sd, "linearised standard deviation", _MIXED),
        schema.UNIT: _variable(dims, np.array(labels, dtype=object), "unit of the parameter", ""),
    }


def _spread(point: PointEstimate) -> dict[str, xr.Variable]:
    square = (schema.PARAMETER, schema.PARAMETER_COLUMN)
    covariance = _variable(
        square, point.covariance, "linearised covariance", "product of the parameters' units"
    )
    variance = _variable(
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
        schema.FLOQUET: _variable(dims, parts, "Floquet multipliers, largest first", "1"),
        schema.STABLE: _variable((schema.RUN,), stable, "whether the solution is stable", "1"),
        schema.BRANCH_JUMPS: _variable(
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
        schema.HISTORY: _variable(dims, theta, "parameters by iteration", _MIXED),
        schema.OBJECTIVE: _variable(
            (schema.ITERATION,), objective, "objective of the method by iteration", "1"
        ),
    }


def _methods(stages: Sequence[PointEstimate]) -> np.ndarray:
    names = [stage.method for stage in stages for _ in stage.history_objective]
    return np.array(names, dtype=object)


def as_text(point: PointEstimate) -> str:
    """One line a parameter and a last one for how it ended."""
    width = max([9, *(len(name) for name in point.names)])
    lines = [f"{'parameter':<{width}}  {'start':>12}  {'estimate':>12}  {'sd':>9}"]
    rows = zip(point.names, point.start, point.theta, point.sd, strict=True)
    lines += [f"{n:<{width}}  {s:>12.6g}  {t:>12.6g}  {d:>9.2g}" for n, s, t, d in rows]
    for output, variance in zip(point.outputs, point.variance, strict=True):
        lines.append(f"{output}: residual standard deviation {np.sqrt(variance):.4g}")
    steps = f"{point.iterations} iterations, {point.halvings} halvings"
    lines.append(f"{point.method}: {point.status.message}; {steps}")
    if any(point.failures.values()):
        lines.append(f"trials that failed: {counted(point.failures)}")
    if point.on_limit:
        lines.append(f"on a limit of their prior: {', '.join(point.on_limit)}")
    lines += point.notes
    return "\n".join(lines)
