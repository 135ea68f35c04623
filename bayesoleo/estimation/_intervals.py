"""Covariances and intervals of an estimate, by linearisation and over a set of experiments.

The linearised covariance propagates noise of a known variance to the estimate. Its matrices are
formed with columns of unit length, because physical parameters range over twelve decades. At a
mode, the same curvature gives the Gaussian approximation of the joint posterior of parameters and
log variances.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._schema import LabelledResult, columns
from bayesoleo._types import Array
from bayesoleo.error_models._fitting import LinearisedResidual, inverse_gram
from bayesoleo.error_models._independent import output_counts, staged_variance, sums_of_squares
from bayesoleo.errors import InputError, check_level
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.estimation._objectives import (
    curvature,
    inverse_scaled,
    noise_of_gradient,
    prior_precision,
)
from bayesoleo.estimation._parametric_bootstrap import NoiseBlock
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.estimation._problem import EstimationProblem, measured_of
from bayesoleo.model._priors import LogNormal, LogUniform, Prior

Form = Literal["posterior", "propagated"]
Distribution = Literal["t", "normal"]
_MIXED = "unit of each parameter"


def cramer_rao(blocks: Sequence[NoiseBlock]) -> Array:
    """Least covariance that an unbiased estimator can have, shape (l, l); NaN where singular.

    The information is ``sum J' S^-1 J`` with ``S = diag(sd**2) + C C'`` the covariance of the noise
    of a run, in which ``C`` comes from the measured inputs.

    Parameters
    ----------
    blocks : sequence of NoiseBlock
        Independent of each other.

    References
    ----------
    Rao (1945); Verbeek (1993), section 2.3.
    """
    length = _length(blocks)
    information = np.zeros((length.size, length.size))
    for block in blocks:
        rows = block.sensitivity / length / block.sd[:, None]
        common = block.columns / block.sd[:, None]
        # Woodbury: the noise that a run's samples share takes its own directions out.
        shared = np.eye(common.shape[1]) + common.T @ common
        cross = common.T @ rows
        information += rows.T @ rows - cross.T @ np.linalg.solve(shared, cross)
    return _inverse(information) / np.outer(length, length)


def propagated(
    blocks: Sequence[NoiseBlock], variance: Array, precision: Array | None = None
) -> Array:
    """Covariance of a weighted least-squares estimate under the noise that there is, shape (l, l).

    ``H^-1 [sum J' W S W J] H^-1`` with ``W`` the estimator's weights and ``H = sum J' W J`` plus
    the precision: the noise of the data propagated to the estimate. It equals the
    Cramér-Rao bound where ``W = S^-1`` and no prior pulls.

    Parameters
    ----------
    blocks : sequence of NoiseBlock
    variance : ndarray, shape (s,)
        Error variances by which the estimator weights the outputs.
    precision : ndarray, shape (l, l), optional
        Of the prior, where it counts.

    References
    ----------
    Verbeek (1993), eqs. 2.36-2.41.
    """
    length = _length(blocks)
    normal = np.zeros((length.size, length.size))
    noise = np.zeros_like(normal)
    for block in blocks:
        rows = block.sensitivity / length
        weighted = rows / variance[block.output][:, None]
        normal += rows.T @ weighted
        own = weighted * block.sd[:, None]
        common = weighted.T @ block.columns
        noise += own.T @ own + common @ common.T
    if precision is not None:
        normal += precision / np.outer(length, length)
    inverse = _inverse(normal)
    return inverse @ noise @ inverse / np.outer(length, length)


def _length(blocks: Sequence[NoiseBlock]) -> Array:
    """Length of each column of the sensitivities over all blocks, shape (l,)."""
    squares = [np.sum(block.sensitivity**2, axis=0) for block in blocks]
    length = np.sqrt(np.sum(squares, axis=0))
    return np.where(length > 0, length, 1.0)


def _inverse(matrix: Array) -> Array:
    values, vectors = np.linalg.eigh(matrix)
    if values.size == 0 or values[0] <= np.finfo(float).eps * values.size * values[-1]:
        return np.full_like(matrix, np.nan)
    return (vectors / values) @ vectors.T


def mode_covariance(problem: EstimationProblem, theta: Array) -> Array:
    """Covariance of ``(theta, log v)`` by linearisation at a mode of ``Phi_B``.

    The blocks of the inverse are ``A + diag(w)^-1`` for the parameters, ``n_b / 2`` for the log
    variances and ``-sum(e_theta e) / v_b`` between them; these last vanish at the
    maximum-likelihood point of one output, not at a mode.

    Parameters
    ----------
    problem : EstimationProblem
    theta : ndarray, shape (l,)
        A mode, from :func:`~bayesoleo.estimation.polish`.

    Returns
    -------
    ndarray, shape (l + s, l + s)
        In the units of the parameters and without unit for the log variances; NaN where the
        problem cannot be evaluated. Where the cross terms make the inverse indefinite, as happens
        away from a mode, they are left out.

    References
    ----------
    Verbeek (1993), Appendix A, in ``log v`` and with Gauss-Newton's second derivatives.
    """
    theta = np.array(theta, dtype=float)
    unknowns, outputs = theta.size, len(problem.outputs)
    evaluation = problem.evaluate(theta)
    if not evaluation.status.ok:
        return np.full((unknowns + outputs, unknowns + outputs), np.nan)
    scale = PriorScale.of(problem.priors, problem.names)
    counts = output_counts(problem.counts)
    variance = staged_variance(sums_of_squares(evaluation), counts)
    chain = scale.unit(theta)
    rows = LinearisedResidual.of(evaluation, chain).whitened(variance)[0]
    covariance = inverse_gram(np.vstack((rows, scale.root)))
    cross = np.column_stack(
        [
            chain * (sensitivity.T @ residual) / v
            for sensitivity, residual, v in zip(
                evaluation.sensitivity, evaluation.residual, variance, strict=True
            )
        ]
    )
    joint = _block_inverse(covariance, cross, counts / 2)
    unit = np.concatenate((chain, np.ones(outputs)))
    return joint * np.outer(unit, unit)


def _block_inverse(covariance: Array, cross: Array, diagonal: Array) -> Array:
    """Inverse of ``[[covariance^-1, cross], [cross', diag(diagonal)]]`` by its Schur complement."""
    schur = np.diag(diagonal) - cross.T @ covariance @ cross
    if np.linalg.eigvalsh(schur)[0] <= 0:
        schur, cross = np.diag(diagonal), np.zeros_like(cross)
    lower = np.linalg.inv(schur)
    gain = covariance @ cross
    upper = covariance + gain @ lower @ gain.T
    return np.block([[upper, -gain @ lower], [-lower @ gain.T, lower]])


def linearised_covariance(
    problem: EstimationProblem,
    point: PointEstimate,
    form: Form = "propagated",
    *,
    prior: bool = True,
    exact: bool = False,
) -> Array:
    """Covariance of ``phi = (theta, v)`` by linearisation, shape (l + s, l + s).

    Parameters
    ----------
    problem : EstimationProblem
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


def _measured_precision(problem: EstimationProblem, theta: Array) -> Array:
    """Precision of what was measured beside the data, shape (l, l)."""
    measured = measured_of(problem)
    precision = prior_precision(problem.priors, theta)
    return np.where(np.outer(measured, measured), precision, 0.0)


def linearised_intervals(
    problem: EstimationProblem,
    point: PointEstimate,
    form: Form = "propagated",
    *,
    level: float = 0.95,
    prior: bool = True,
    exact: bool = False,
) -> LabelledResult:
    """Two-sided normal intervals of the parameters and the error variances.

    Parameters are those of :func:`linearised_covariance`; ``level`` is the coverage. Intervals of
    error variances, and of parameters with a log-normal or log-uniform prior, are normal in the
    logarithm; all end at the limits of their prior's support.

    Returns
    -------
    LabelledResult
        ``estimate``, ``sd``, ``low``, ``high`` over ``parameter``, in which a variance appears as
        ``variance[output]``, and ``covariance``.
    """
    check_level(level)
    covariance = linearised_covariance(problem, point, form, prior=prior, exact=exact)
    names = [*point.names, *(f"variance[{output}]" for output in point.outputs)]
    values = np.concatenate((point.theta, point.variance))
    half = distributions.norm.isf((1 - level) / 2) * np.sqrt(np.diag(covariance))
    size = point.theta.size
    shared = supported_ends(problem.priors, point.theta, half[:size])
    positive = point.variance * np.exp(np.outer([-1.0, 1.0], half[size:] / point.variance))
    low, high = np.concatenate((shared, positive), axis=1)
    data = _dataset(names, values, covariance, low, high)
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
    check_level(level)
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
    factor = (
        distributions.t.isf(tail, count - 1)
        if distribution == "t"
        else distributions.norm.isf(tail)
    )
    share = 1 / count if of == "mean" else 1 + 1 / count
    half = factor * np.sqrt(share * np.diag(covariance))
    data = _dataset(labels, mean, covariance, mean - half, mean + half)
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


#: Half width of an interval, over its estimate, up to which it may be normal in the logarithm. A
#: small estimate with a wide interval says how large a parameter is at most, and its logarithm next
#: to nothing.
SHORT = 0.5


def supported_ends(priors: Sequence[Prior], theta: Array, half: Array) -> Array:
    """Lower and upper ends of normal intervals of parameters within their supports, shape (2, l).

    Parameters
    ----------
    priors : sequence of Prior, length l
        Where one is log-normal or log-uniform, and the interval is short beside the estimate, it is
        normal in the logarithm.
    theta : ndarray, shape (l,)
        Estimates.
    half : ndarray, shape (l,)
        Half widths, in units of the parameters.
    """
    ends = theta + np.outer([-1.0, 1.0], half)
    for k, prior in enumerate(priors):
        if isinstance(prior, LogNormal | LogUniform) and half[k] <= SHORT * theta[k]:
            ends[:, k] = theta[k] * np.exp(np.array([-1.0, 1.0]) * half[k] / theta[k])
        ends[:, k] = np.clip(ends[:, k], *prior.support)
    return ends


def _dataset(
    names: list[str], values: Array, covariance: Array, low: Array, high: Array
) -> xr.Dataset:
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
            "low": variable(low, "lower end of the interval"),
            "high": variable(high, "upper end of the interval"),
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
