"""Estimates from each run alone, and the runs and parameters among which they can be compared.

Parameters of the specimen should be the same in every run. Scatter beyond their uncertainty, or a
trend with frequency or position, is evidence of physics that the model lacks (Verbeek 1993,
sections 2.3 and 6.2). :func:`~bayesoleo.estimation.between_runs` measures it. Only runs and
parameters that are determined by enough of each other are compared.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from bayesoleo import _schema as schema
from bayesoleo._parallel import thread_map
from bayesoleo._types import Array, Flags
from bayesoleo.errors import InputError
from bayesoleo.estimation._estimate import estimate
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.estimation._problem import EstimationProblem

Residuals = tuple[Array, ...]
_MIXED = "unit of each parameter"
#: A run does not determine a parameter if its data alone leave a standard deviation a thousand
#: times that of the prior: its weight in a mean over runs would be a millionth.
UNDETERMINED = 1e-6
#: Smallest eigenvalue of a matrix of correlations, a parameter, that rounding can be told from.
SINGULAR = 10 * float(np.finfo(float).eps)


def estimate_each(
    problems: Mapping[str, EstimationProblem],
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
    problems : mapping of str to EstimationProblem
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

    def work(item: tuple[str, EstimationProblem]) -> tuple[PointEstimate, Residuals]:
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
    """First of the estimates, all of which must have the same unknowns."""
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


@dataclass(frozen=True)
class Comparable:
    """Parameters and runs of per-run estimates that can be compared.

    Parameters
    ----------
    runs : ndarray of bool, shape (N,)
    parameters : ndarray of bool, shape (l,)
    left_out : tuple of str
        The others, each with the reason.
    """

    runs: Flags
    parameters: Flags
    left_out: tuple[str, ...]


def comparable(each: xr.Dataset) -> Comparable:
    """Parameters that most runs determine, and the runs that determine all of those.

    Parameters
    ----------
    each : xarray.Dataset
        From :func:`~bayesoleo.estimation.estimate_each`.
    """
    good = each["status"].values == "converged"
    names = each[schema.PARAMETER].values.astype(str)
    runs = each[schema.RUN].values.astype(str)
    covariances = each["covariance_likelihood"].values
    determined = _determined(each)
    # A run without a finite covariance determines no parameter separately.
    regular = good & np.isfinite(np.diagonal(covariances, axis1=1, axis2=2)).any(axis=1)
    kept = 2 * determined[regular].sum(axis=0) > regular.sum()
    usable = regular & determined[:, kept].all(axis=1)
    usable[usable] = [_is_definite(S) for S in covariances[usable][:, kept][:, :, kept]]
    held = str(each.attrs.get("held", "")).split(", ")
    left_out = _left_out(names, runs, good, regular, determined, kept, usable, held)
    return Comparable(usable, kept, left_out)


def _determined(each: xr.Dataset) -> Flags:
    """Whether each run's data determine each parameter, shape (N, l)."""
    alone, with_prior = (
        np.diagonal(each[name].values, axis1=1, axis2=2)
        for name in ("covariance_likelihood", schema.COVARIANCE)
    )
    possible = np.isfinite(alone) & (alone > 0)
    # Without a finite covariance under the prior there is nothing to compare with.
    compared = np.isfinite(with_prior) & (with_prior > 0)
    return possible & ~(compared & (with_prior < UNDETERMINED * np.where(possible, alone, 1.0)))


def check_definite(run: str, covariance: Array, names: Sequence[str]) -> None:
    """Raise where a covariance is singular, naming the parameters responsible."""
    if _is_definite(covariance):
        return
    variance = np.diag(covariance)
    lacking = [n for n, v in zip(names, variance, strict=True) if not (np.isfinite(v) and v > 0)]
    raise InputError(
        "the covariance of this run's estimate is not positive definite",
        run=run,
        key=", ".join(lacking or names),
        hint="leave the run or the parameter out",
    )


def _is_definite(covariance: Array) -> bool:
    """Whether a covariance is positive definite, in the units of its own standard deviations."""
    variance = np.diag(covariance)
    if not (variance.size and np.isfinite(covariance).all() and (variance > 0).all()):
        return False
    sd = np.sqrt(variance)
    return bool(np.linalg.eigvalsh(covariance / np.outer(sd, sd))[0] > SINGULAR * sd.size)


def _left_out(
    names: NDArray[np.str_],
    runs: NDArray[np.str_],
    good: Flags,
    regular: Flags,
    determined: Flags,
    kept: Flags,
    usable: Flags,
    held: Sequence[str],
) -> tuple[str, ...]:
    """Parameters and runs that are not compared, with the reason for each."""
    said = []
    for k in np.flatnonzero(~kept) if regular.any() else ():
        if names[k] in held:
            said.append(f"parameter {names[k]}, held: a constant known to a tolerance")
            continue
        where = ", ".join(runs[regular & ~determined[:, k]])
        said.append(f"parameter {names[k]}, not determined by run {where}")
    for n in np.flatnonzero(~usable):
        lacking = ", ".join(names[kept & ~determined[n]])
        if not good[n]:
            said.append(f"run {runs[n]}, did not converge")
        elif regular[n] and lacking:
            said.append(f"run {runs[n]}, does not determine {lacking}")
        elif kept.any() or not regular[n]:
            said.append(f"run {runs[n]}, does not tell {', '.join(names)} apart")
    return tuple(said)
