"""Each run estimated on its own: what a model's parameters would be if that run were all there is.

Parameters that describe the specimen should come out alike from every run; what scatters beyond its
uncertainty, or follows frequency or position, is the trace of physics that the model lacks (Verbeek
1993, sections 2.3 and 6.2). :func:`~bayesoleo.estimation.between_runs` says how much.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation.estimators.estimate import estimate
from bayesoleo.estimation.estimators.point import PointEstimate
from bayesoleo.estimation.problems.problem import Problem
from bayesoleo.parallel import thread_map

Residuals = tuple[Array, ...]
_MIXED = "unit of each parameter"


def estimate_each(
    problems: Mapping[str, Problem],
    method: str = "mbe",
    *,
    units: Sequence[str] | None = None,
    jobs: int | None = 1,
    tolerance: float = 1e-6,
    max_iterations: int = 50,
    progress: Callable[[str, PointEstimate], None] | None = None,
) -> xr.Dataset:
    """Estimate the same unknowns from each of several runs.

    Parameters
    ----------
    problems : mapping of str to Problem
        By the run's label; all with the same unknowns and outputs.
    method : str, optional
        See :func:`~bayesoleo.estimation.estimate`.
    units : sequence of str, length l, optional
        Units of the unknowns.
    jobs : int, optional
        Threads over runs; None for all cores. The default leaves the threads to the problems.
    tolerance, max_iterations
        As in :func:`~bayesoleo.estimation.estimate`.
    progress : callable, optional
        Called with the label and the estimate of each run that is done.

    Returns
    -------
    xarray.Dataset
        See :func:`by_run_dataset`.

    Raises
    ------
    InputError
        If there is no run, or the runs' unknowns differ.
    """

    def work(item: tuple[str, Problem]) -> tuple[PointEstimate, Residuals]:
        label, problem = item
        point = estimate(problem, method, tolerance=tolerance, max_iterations=max_iterations)
        if progress is not None:
            progress(label, point)
        return point, problem.evaluate(point.theta).residual

    done = thread_map(work, problems.items(), jobs)
    points = {label: point for label, (point, _) in zip(problems, done, strict=True)}
    residuals = {label: residual for label, (_, residual) in zip(problems, done, strict=True)}
    return by_run_dataset(points, residuals, units)


def by_run_dataset(
    points: Mapping[str, PointEstimate],
    residuals: Mapping[str, Residuals],
    units: Sequence[str] | None = None,
) -> xr.Dataset:
    """Arrange the estimates of several runs as labelled arrays.

    Parameters
    ----------
    points : mapping of str to PointEstimate
        By run, all of the same unknowns.
    residuals : mapping of str to tuple of ndarray
        At the estimate, by run; one array an output, SI.
    units : sequence of str, length l, optional
        Units of the unknowns.

    Returns
    -------
    xarray.Dataset
        ``estimate`` and ``sd`` (run, parameter), ``covariance`` and ``covariance_likelihood`` (run,
        parameter, parameter_column), the latter without the prior; ``rms``, ``largest`` and
        ``residual_mean`` (run, output) of the residual; ``status``, ``on_limit`` (unknowns on a
        limit of their prior's support), ``iterations``, ``halvings`` (run); ``unit`` (parameter).
        The attribute ``held`` names constants known to a tolerance, which MBE holds: ``covariance``
        carries their uncertainty, which all runs share, ``covariance_likelihood`` does not. The
        estimate of a run that failed stays where it stopped: select with ``status ==
        "converged"``.

    Raises
    ------
    InputError
        If there is no run, or the runs' unknowns differ.
    """
    first = _alike(points)
    estimates = list(points.values())
    rows, run = (schema.RUN, schema.PARAMETER), (schema.RUN,)
    square = (schema.RUN, schema.PARAMETER, schema.PARAMETER_COLUMN)
    labels = [""] * len(first.names) if units is None else list(units)

    def stacked(name: str) -> Array:
        return np.stack([getattr(point, name) for point in estimates])

    return xr.Dataset(
        {
            schema.ESTIMATE: (rows, stacked("theta"), _about("estimate from one run", _MIXED)),
            schema.SD: (rows, stacked("sd"), _about("linearised standard deviation", _MIXED)),
            schema.COVARIANCE: (square, stacked("covariance"), _about("with the prior", "")),
            "covariance_likelihood": (
                square,
                stacked("covariance_likelihood"),
                _about("without the prior", ""),
            ),
            **_residual_variables([residuals[label] for label in points]),
            "on_limit": (run, [", ".join(point.on_limit) for point in estimates]),
            "status": (run, [point.status.name.lower() for point in estimates]),
            "iterations": (run, [point.iterations for point in estimates]),
            "halvings": (run, [point.halvings for point in estimates]),
            schema.UNIT: ((schema.PARAMETER,), np.array(labels, dtype=object)),
        },
        coords={
            schema.RUN: list(points),
            schema.PARAMETER: list(first.names),
            schema.PARAMETER_COLUMN: list(first.names),
            schema.OUTPUT: list(first.outputs),
        },
        attrs={"method": first.method, "held": ", ".join(first.known)},
    )


def _alike(points: Mapping[str, PointEstimate]) -> PointEstimate:
    """The first of the estimates, all of which must be of the same unknowns."""
    if not points:
        raise InputError("no run to estimate from", hint="give one problem a run")
    first = next(iter(points.values()))
    for label, point in points.items():
        if point.names != first.names or point.outputs != first.outputs:
            raise InputError(
                "this run has other unknowns or outputs than the first one",
                run=label,
                value=(*point.names, *point.outputs),
                hint=f"the first has {', '.join((*first.names, *first.outputs))}",
            )
    return first


def _about(name: str, unit: str) -> dict[str, str]:
    return {schema.LONG_NAME: name, schema.UNITS: unit}


def _residual_variables(residuals: Sequence[Residuals]) -> dict[str, tuple[Any, ...]]:
    dims, unit = (schema.RUN, schema.OUTPUT), "SI unit of each output"

    def each(function: Callable[[Array], float]) -> Array:
        return np.array([[function(column) for column in run] for run in residuals])

    return {
        schema.RMS: (
            dims,
            each(lambda e: float(np.sqrt(np.mean(e**2)))),
            _about("root mean square of the residual", unit),
        ),
        "largest": (
            dims,
            each(lambda e: float(np.max(np.abs(e)))),
            _about("largest absolute residual", unit),
        ),
        "residual_mean": (dims, each(lambda e: float(np.mean(e))), _about("mean residual", unit)),
    }
