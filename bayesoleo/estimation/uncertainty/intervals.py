"""Intervals of an estimate: by linearisation, and over a set of experiments."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy import stats

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation.estimators.point import PointEstimate
from bayesoleo.estimation.objectives.curvature import (
    curvature,
    inverse_scaled,
    noise_of_gradient,
    prior_precision,
)
from bayesoleo.estimation.problems.problem import Problem, measured_of
from bayesoleo.estimation.shown import LabelledResult, columns

Form = Literal["posterior", "propagated"]
Distribution = Literal["t", "normal"]
_MIXED = "unit of each parameter"


def linearised_covariance(
    problem: Problem,
    point: PointEstimate,
    form: Form = "propagated",
    *,
    prior: bool = True,
    exact: bool = False,
) -> Array:
    """Covariance of ``phi = (theta, v)`` by linearisation, shape (l + s, l + s).

    Parameters
    ----------
    problem : Problem
    point : PointEstimate
        An optimum of the objective.
    form : {"propagated", "posterior"}, optional
        ``H^-1 [sum Phi_phi,y V Phi_phi,y'] H^-1``, the scatter of the estimate over experiments
        (eq. 2.41), or ``H^-1``, the width of the posterior; the latter's block of the parameters is
        near ``[A + diag(w)^-1]^-1``. Without a prior they agree up to the cross terms of ``v``.
    prior : bool, optional
        Whether the objective contains the prior; not for a maximum-likelihood estimate, which MBE
        ends in. That of a nuisance parameter or of a constant known to a tolerance always counts:
        it is a measurement, and scatters over experiments like the data.
    exact : bool, optional
        Take second derivatives of the residual into account.

    References
    ----------
    Verbeek (1993), eqs. 2.36-2.41 and Appendix A.
    """
    if form not in ("posterior", "propagated"):
        raise InputError(
            "unknown form of the covariance",
            key="form",
            value=form,
            hint="use 'propagated' or 'posterior'",
        )
    matrix = curvature(problem, point.theta, point.variance, prior=prior, exact=exact)
    measured, size = _measured_precision(problem, point.theta), point.theta.size
    if not prior:
        matrix[:size, :size] += measured
    inverse = inverse_scaled(matrix)
    if form == "posterior":
        return inverse
    noise = noise_of_gradient(problem, point.theta, point.variance)
    noise[:size, :size] += measured
    return inverse @ noise @ inverse


def _measured_precision(problem: Problem, theta: Array) -> Array:
    """Precision of what was measured beside the data, shape (l, l)."""
    measured = measured_of(problem)
    precision = prior_precision(problem.priors, theta)
    return np.where(np.outer(measured, measured), precision, 0.0)


def linearised_intervals(
    problem: Problem,
    point: PointEstimate,
    form: Form = "propagated",
    *,
    level: float = 0.95,
    prior: bool = True,
    exact: bool = False,
) -> LabelledResult:
    """Two-sided normal intervals of the parameters and the error variances.

    Parameters are those of :func:`linearised_covariance`; ``level`` is the coverage.

    Returns
    -------
    LabelledResult
        ``estimate``, ``sd``, ``low``, ``high`` over ``parameter``, in which a variance appears as
        ``variance[output]``, and ``covariance``.
    """
    _check_level(level)
    covariance = linearised_covariance(problem, point, form, prior=prior, exact=exact)
    names = [*point.names, *(f"variance[{output}]" for output in point.outputs)]
    values = np.concatenate((point.theta, point.variance))
    half = stats.norm.isf((1 - level) / 2) * np.sqrt(np.diag(covariance))
    data = _dataset(names, values, covariance, half)
    data.attrs = {"form": form, "level": level, "prior": int(prior), "exact": int(exact)}
    return LabelledResult(data, intervals_text(data))


def over_experiments(
    estimates: Sequence[PointEstimate] | ArrayLike,
    names: Sequence[str] | None = None,
    *,
    level: float = 0.95,
    distribution: Distribution = "t",
    of: Literal["mean", "experiment"] = "mean",
) -> LabelledResult:
    """Mean, covariance and intervals over the estimates of several experiments.

    The thesis's choice: what the model leaves out differs from run to run, and shows here.

    Parameters
    ----------
    estimates : sequence of PointEstimate, or array_like of shape (N, l)
        One a run; those that did not converge are left out and counted.
    names : sequence of str, length l, optional
        Of the parameters, for an array.
    level : float, optional
        Coverage.
    distribution : {"t", "normal"}, optional
        Student's t with ``N - 1`` degrees of freedom, or the normal distribution.
    of : {"mean", "experiment"}, optional
        Interval of the mean, which narrows with the square root of N, or of one more experiment.

    Returns
    -------
    LabelledResult
        ``estimate`` (the mean), ``sd`` (of one experiment), ``low``, ``high`` and ``covariance``.

    References
    ----------
    Verbeek (1993), eqs. 2.18-2.20 and 2.42.
    """
    _check_level(level)
    table, labels, failed = _table(estimates, names)
    count = len(table)
    if count < 2:
        raise InputError(
            "scatter needs two experiments or more", value=count, hint="estimate more runs"
        )
    if distribution not in ("t", "normal") or of not in ("mean", "experiment"):
        raise InputError(
            "unknown kind of interval",
            value=(distribution, of),
            hint="distribution is 't' or 'normal', of is 'mean' or 'experiment'",
        )
    mean, covariance = table.mean(axis=0), np.atleast_2d(np.cov(table, rowvar=False))
    tail = (1 - level) / 2
    factor = stats.t.isf(tail, count - 1) if distribution == "t" else stats.norm.isf(tail)
    share = 1 / count if of == "mean" else 1 + 1 / count
    half = factor * np.sqrt(share * np.diag(covariance))
    data = _dataset(labels, mean, covariance, half)
    data.attrs = {
        "experiments": count,
        "failed": failed,
        "level": level,
        "distribution": distribution,
        "of": of,
    }
    return LabelledResult(data, intervals_text(data))


def _table(
    estimates: Sequence[PointEstimate] | ArrayLike, names: Sequence[str] | None
) -> tuple[Array, list[str], int]:
    if isinstance(estimates, Sequence) and estimates and isinstance(estimates[0], PointEstimate):
        points = [point for point in estimates if isinstance(point, PointEstimate)]
        good = [point for point in points if point.status.ok]
        if len({point.names for point in points}) > 1:
            raise InputError("the estimates are of different parameters", key="estimates")
        table = np.array([point.theta for point in good]).reshape(len(good), -1)
        return table, list(points[0].names), len(points) - len(good)
    table = np.array(estimates, dtype=float)
    if table.ndim != 2:
        raise InputError(
            "estimates must be one row a run", key="estimates", value=table.shape,
            hint="give an array of shape (runs, parameters)",
        )  # fmt: skip
    good_rows = np.isfinite(table).all(axis=1)
    labels = [f"theta{k + 1}" for k in range(table.shape[1])] if names is None else list(names)
    if len(labels) != table.shape[1]:
        raise InputError("names must have one entry per column", key="names", value=labels)
    return table[good_rows], labels, int((~good_rows).sum())


def _check_level(level: float) -> None:
    if not 0 < level < 1:
        raise InputError("level must lie between 0 and 1", key="level", value=level)


def _dataset(names: list[str], values: Array, covariance: Array, half: Array) -> xr.Dataset:
    def variable(numbers: Array, text: str) -> xr.Variable:
        return xr.Variable(
            (schema.PARAMETER,), numbers, {schema.LONG_NAME: text, schema.UNITS: _MIXED}
        )

    square = (schema.PARAMETER, schema.PARAMETER_COLUMN)
    words = {schema.LONG_NAME: "covariance", schema.UNITS: "product of the parameters' units"}
    return xr.Dataset(
        {
            schema.ESTIMATE: variable(values, "estimate"),
            schema.SD: variable(np.sqrt(np.diag(covariance)), "standard deviation"),
            "low": variable(values - half, "lower end of the interval"),
            "high": variable(values + half, "upper end of the interval"),
            schema.COVARIANCE: xr.Variable(square, covariance, words),
        },
        coords={schema.PARAMETER: names, schema.PARAMETER_COLUMN: names},
    )


def intervals_text(data: xr.Dataset) -> str:
    """Estimate, standard deviation and interval, one line a parameter."""
    level = f"{100 * float(data.attrs['level']):.3g} %"
    head = ["parameter", "estimate", "sd", f"low {level}", "high"]
    keys = (schema.ESTIMATE, schema.SD, "low", "high")
    rows = [
        [str(name), *(f"{float(data[key][k]):.{3 if key == schema.SD else 6}g}" for key in keys)]
        for k, name in enumerate(data[schema.PARAMETER].values)
    ]
    return columns(head, rows)
