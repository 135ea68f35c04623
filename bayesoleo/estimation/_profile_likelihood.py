"""Log-likelihood ratio and profile likelihood.

The log-likelihood ratio is the loss of the objective relative to the estimate. The error variances
follow the parameters, ``v_b = M_bb / n_b``, so that it is a ratio of the likelihood profiled over
``v`` (Verbeek 1993, eq. 3.17 in 2.29).

The profile likelihood maximises over all unknowns but one, which is held at given values. Where the
model is linear in the unknowns, the profile is a parabola and its limits are those of
linearisation. A flat side shows that the data do not bound the unknown there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import xarray as xr
from scipy.interpolate import PchipInterpolator

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._schema import LabelledResult, columns
from bayesoleo._types import Array, Float
from bayesoleo.error_models._independent import output_counts, staged_variance
from bayesoleo.errors import InputError, check_level, check_names
from bayesoleo.estimation._estimate import estimate
from bayesoleo.estimation._intervals import supported_ends
from bayesoleo.estimation._objectives import log_prior
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.estimation._problem import EstimationProblem, Held, measured_of

Kind = Literal["likelihood", "posterior"]
# A profile that has not reached the limit after this many linearised standard deviations is open.
_FARTHEST = 50.0
# Steps of the signed root of the fall; and how far beyond the limit the profile is followed.
_PART, _BEYOND = 0.34, 1.15
_MOST_POINTS = 40
# Part of the way to a limit of the support: a density may be zero on it.
_TO_THE_END = 0.999
Stop = tuple[float, float, Array]


class LogLikelihoodRatio:
    """Fall of the objective from an estimate, positive away from it.

    Parameters
    ----------
    problem : EstimationProblem
    point : PointEstimate
        An optimum of the objective.
    kind : {"likelihood", "posterior"}
        Whether the prior counts. By default it does where the point is the Bayesian estimator's.
    """

    def __init__(
        self, problem: EstimationProblem, point: PointEstimate, kind: Kind | None = None
    ) -> None:
        self.problem, self.point = problem, point
        self.kind: Kind = kind or ("posterior" if point.method == "be" else "likelihood")
        if self.kind not in ("likelihood", "posterior"):
            raise InputError(
                "unknown kind", key="kind", value=kind, hint="use 'likelihood' or 'posterior'"
            )
        measured = measured_of(problem)
        if self.kind == "likelihood" and measured.any():
            known = [
                name for name, is_known in zip(problem.names, measured, strict=True) if is_known
            ]
            raise InputError(
                f"the likelihood forgets what is known of {', '.join(known)}", key="kind",
                value=self.kind, hint="use kind='posterior' with an estimate by 'be'",
            )  # fmt: skip
        if tuple(point.names) != tuple(problem.names):
            raise InputError("the estimate is of another problem", value=point.names)
        self.counts = output_counts(problem.counts)
        freeze = getattr(problem, "freeze", None)
        if freeze is not None:
            freeze(point.theta)
        self.top = float(self._height(point.theta[None])[0])
        if not np.isfinite(self.top):
            raise InputError(
                "cannot be evaluated at the estimate", value=point.theta.tolist(),
                hint="give an estimate that converged",
            )  # fmt: skip

    def _height(self, theta: Array) -> Array:
        """Objective with its own variances at vectors (L, l); minus infinity where it fails."""
        sums = self.problem.misfit(theta).sum_of_squares.sum(axis=1)
        height = np.full(len(theta), -np.inf)
        for row in np.flatnonzero(np.isfinite(sums).all(axis=1)):
            variance = staged_variance(sums[row], self.counts)
            height[row] = -0.5 * float(np.sum(self.counts * np.log(variance)))
            if self.kind == "posterior":
                height[row] += log_prior(self.problem.priors, theta[row])
        return height

    def __call__(self, theta: Array) -> Array:
        """Fall at vectors (L, l), shape (L,); infinite outside the support or where it fails."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        inside = np.array([self._supported(row) for row in theta])
        fall = np.full(len(theta), np.inf)
        if inside.any():
            fall[inside] = self.top - self._height(theta[inside])
        return fall

    def _supported(self, theta: Array) -> bool:
        limits = [prior.support for prior in self.problem.priors]
        return all(low <= t <= high for t, (low, high) in zip(theta, limits, strict=True))

    def profiled(self, theta: Array, held: Sequence[int]) -> tuple[float, Array]:
        """Least fall with some unknowns held, and where it is, shape (l,).

        Parameters
        ----------
        theta : ndarray, shape (l,)
            The held values, and where the others start.
        held : sequence of int
            Which are held.
        """
        theta = np.array(theta, dtype=float)
        if not self._supported(theta):
            return np.inf, theta
        if len(held) == len(theta):
            return float(self._fresh(theta)), theta
        section = Held(self.problem, theta, held)
        method = "be" if self.kind == "posterior" else "mbe"
        found = estimate(section, method, tolerance=1e-5)
        if not found.status.ok:  # the predicted start was poor; try the estimate itself
            again = estimate(section, method, tolerance=1e-5, start=self.point.theta[section.free])
            # An unconverged point still lies in the section and bounds the least fall.
            objectives = np.nan_to_num([found.objective, again.objective], nan=-np.inf)
            found = again if objectives[1] > objectives[0] or again.status.ok else found
        whole = section.full(found.theta)
        if not np.isfinite(found.objective):
            return np.inf, theta
        return float(self._fresh(whole)), whole

    def _fresh(self, theta: Array) -> float:
        """Fall at one vector, solved from the solver's present state."""
        evaluation = self.problem.evaluate(theta)
        if not evaluation.status.ok:
            return np.inf
        sums = np.array([float(e @ e) for e in evaluation.residual])
        height = -0.5 * float(np.sum(self.counts * np.log(staged_variance(sums, self.counts))))
        if self.kind == "posterior":
            height += log_prior(self.problem.priors, theta)
        return self.top - height


def profile(
    problem: EstimationProblem,
    point: PointEstimate,
    names: Sequence[str] | None = None,
    *,
    kind: Kind | None = None,
    level: float = 0.95,
    progress: Callable[[str], None] | None = None,
) -> LabelledResult:
    """Profile the objective along each unknown, all others re-estimated.

    Parameters
    ----------
    problem : EstimationProblem
    point : PointEstimate
        An optimum: of the likelihood (MBE) or of the posterior (BE, ``polish``).
    names : sequence of str, optional
        Unknowns to profile; by default all.
    kind : {"likelihood", "posterior"}, optional
        Whether the prior counts; by default what ``point`` is an optimum of.
    level : float, optional
        Coverage of the limits: where twice the fall is the chi-square quantile with one degree of
        freedom.
    progress : callable, optional
        Told the name of each unknown before its turn.

    Returns
    -------
    LabelledResult
        ``value``, ``fall`` ``(parameter, point)``; ``path(parameter, point, unknown)``, where the
        others went; ``low``, ``high``, ``linear_low``, ``linear_high`` ``(parameter)``. A limit is
        infinite where the profile stays below it for 50 standard deviations or to the end of the
        prior's support.

    References
    ----------
    Verbeek (1993), eq. 2.43 with one unknown; Bates and Watts (1988), section 6.1.
    """
    check_level(level)
    chosen: Sequence[str] = problem.names if names is None else names
    check_names(chosen, problem.names, "names", example=f'write ["{problem.names[0]}"]')
    chosen = list(chosen)
    drop = LogLikelihoodRatio(problem, point, kind)
    limit = float(np.sqrt(distributions.chi2.isf(1 - level, 1)))
    covariance = point.covariance if drop.kind == "posterior" else point.covariance_likelihood
    lines = []
    for name in chosen:
        if progress is not None:
            progress(name)
        # The covariance with the prior foresees steps: without it a direction that the data leave
        # open would throw the others out of sight.
        lines.append(ProfileLine.follow(drop, problem.names.index(name), limit, point.covariance))
    problem.evaluate(point.theta)
    data = _dataset(problem, point, chosen, lines, limit, covariance)
    data.attrs = {"kind": drop.kind, "level": level}
    return LabelledResult(data, profile_text(data))


@dataclass(frozen=True)
class ProfileLine:
    """A profile.

    Parameters
    ----------
    values, falls : ndarray, shape (m,)
        Held values in rising order, and the least fall of the objective at each.
    paths : ndarray, shape (m, l)
        All unknowns there.
    low, high : float
        Where the fall reaches the limit; infinite where it does not.
    """

    values: Float[Array, " points"]
    falls: Float[Array, " points"]
    paths: Float[Array, "points unknowns"]
    low: float
    high: float

    @classmethod
    def follow(
        cls, drop: LogLikelihoodRatio, index: int, limit: float, covariance: Array
    ) -> ProfileLine:
        """Profile one unknown until the root of twice the fall exceeds a limit, or to its end.

        Parameters
        ----------
        drop : LogLikelihoodRatio
        index : int
            Of the unknown.
        limit : float
            Root of twice the fall.
        covariance : ndarray, shape (l, l)
            By linearisation and with the prior; it foresees steps.
        """
        theta = drop.point.theta
        here = (float(theta[index]), 0.0, theta)
        below, above = (
            _refined(drop, index, here, _side(drop, index, sign, limit, covariance), limit)
            for sign in (-1.0, 1.0)
        )
        points = [*reversed(below), here, *above]
        return cls(
            values=np.array([p[0] for p in points]),
            falls=np.array([p[1] for p in points]),
            paths=np.array([p[2] for p in points]),
            low=_crossing([here, *below], limit, -np.inf),
            high=_crossing([here, *above], limit, np.inf),
        )


def _side(
    drop: LogLikelihoodRatio, index: int, sign: float, limit: float, covariance: Array
) -> list[Stop]:
    """Follow a profile to one side, in about equal steps of the root of its fall."""
    theta = drop.point.theta.copy()
    variance = covariance[index, index]
    sd = float(np.sqrt(variance)) if variance > 0 else float(drop.problem.priors[index].sd)
    # To first order the others move along the covariance's column.
    slope = covariance[:, index] / variance if variance > 0 else np.eye(len(theta))[index]
    stops: list[Stop] = []
    step, value, root = _PART * limit * sd, float(theta[index]), 0.0
    low, high = drop.problem.priors[index].support
    while len(stops) < _MOST_POINTS and abs(value - drop.point.theta[index]) < _FARTHEST * sd:
        new = value + sign * step
        last = not low < new < high
        if last:
            new = value + _TO_THE_END * ((low if sign < 0 else high) - value)
        fall, found = drop.profiled(
            _inside(drop, theta + slope * (new - value), index, new), [index]
        )
        if not np.isfinite(fall):
            step *= 0.5
            if step < 1e-3 * sd:
                break
            continue
        fall = max(fall, 0.0)
        gained = np.sqrt(2 * fall) - root
        taken, value, root, theta = abs(new - value), new, float(np.sqrt(2 * fall)), found
        stops.append((value, fall, found))
        if root > _BEYOND * limit or last:
            break
        # Equal steps of the root, never more than twice the last.
        pace = gained / taken if gained > 0 else 0.0
        step = min(2 * taken, _PART * limit / pace) if pace > 0 else 2 * taken
    return stops


def _refined(
    drop: LogLikelihoodRatio, index: int, here: Stop, stops: list[Stop], limit: float
) -> list[Stop]:
    """Add one stop to a side, at the limit interpolated from the others."""
    place = _crossing([here, *stops], limit, np.nan)
    if np.isnan(place):
        return stops
    next_to = min(range(len(stops)), key=lambda k: abs(stops[k][0] - place))
    start = stops[next_to][2].copy()
    start[index] = place
    fall, found = drop.profiled(start, [index])
    if not np.isfinite(fall) or any(stop[0] == place for stop in stops):
        return stops
    whole = [*stops, (place, max(fall, 0.0), found)]
    return sorted(whole, key=lambda stop: abs(stop[0] - here[0]))


def _inside(drop: LogLikelihoodRatio, theta: Array, index: int, value: float) -> Array:
    """Start of the other unknowns, kept within their support."""
    start = theta.copy()
    start[index] = value
    for k, prior in enumerate(drop.problem.priors):
        low, high = prior.support
        if k != index and not low < start[k] < high:
            start[k] = drop.point.theta[k]
    return start


def _crossing(stops: Sequence[Stop], limit: float, missing: float) -> float:
    """Value at which the root of the fall reaches the limit."""
    roots = np.sqrt(2 * np.array([stop[1] for stop in stops]))
    values = np.array([stop[0] for stop in stops])
    beyond = np.flatnonzero(roots >= limit)
    if beyond.size == 0:
        return missing
    end = int(beyond[0]) + 1
    rising = np.maximum.accumulate(roots[:end])
    keep = np.concatenate(([True], np.diff(rising) > 0))
    if keep.sum() < 2:
        return missing
    return float(PchipInterpolator(rising[keep], values[:end][keep])(limit))


def _dataset(
    problem: EstimationProblem,
    point: PointEstimate,
    names: list[str],
    lines: Sequence[ProfileLine],
    limit: float,
    covariance: Array,
) -> xr.Dataset:
    longest = max(len(line.values) for line in lines)
    shape = (len(names), longest)
    value, fall = np.full(shape, np.nan), np.full(shape, np.nan)
    path = np.full((*shape, len(problem.names)), np.nan)
    for k, line in enumerate(lines):
        size = len(line.values)
        value[k, :size], fall[k, :size], path[k, :size] = line.values, line.falls, line.paths
    index = [problem.names.index(name) for name in names]
    half = limit * np.sqrt(np.diag(covariance)[index])
    centre = point.theta[index]
    linear = supported_ends([problem.priors[k] for k in index], centre, half)
    mixed = "unit of each parameter"
    by_parameter = {
        schema.ESTIMATE: (centre, "estimate"),
        "low": (np.array([line.low for line in lines]), "lower limit of the profile"),
        "high": (np.array([line.high for line in lines]), "upper limit of the profile"),
        "linear_low": (linear[0], "lower limit by linearisation"),
        "linear_high": (linear[1], "upper limit by linearisation"),
    }
    rows = (schema.PARAMETER, "point")
    attributes = {schema.LONG_NAME: "held value", schema.UNITS: mixed}
    return xr.Dataset(
        {
            "value": xr.Variable(rows, value, attributes),
            "fall": xr.Variable(
                rows, fall, {schema.LONG_NAME: "fall of the objective", schema.UNITS: "1"}
            ),
            "path": xr.Variable(
                (*rows, "unknown"), path, {schema.LONG_NAME: "all unknowns", schema.UNITS: mixed}
            ),
            **{
                key: xr.Variable(
                    (schema.PARAMETER,), numbers, {schema.LONG_NAME: text, schema.UNITS: mixed}
                )
                for key, (numbers, text) in by_parameter.items()
            },
        },
        coords={schema.PARAMETER: names, "unknown": list(problem.names)},
    )


def profile_text(data: xr.Dataset) -> str:
    """Limits by profile and by linearisation, one line a parameter."""
    level = f"{100 * float(data.attrs['level']):.3g} %"
    head = ["parameter", "estimate", f"low {level}", "high", "linear low", "linear high"]
    keys = (schema.ESTIMATE, "low", "high", "linear_low", "linear_high")
    rows = [
        [str(name), *(_limit(float(data[key][k])) for key in keys)]
        for k, name in enumerate(data[schema.PARAMETER].values)
    ]
    return columns(head, rows)


def _limit(value: float) -> str:
    return f"{value:.6g}" if np.isfinite(value) else "open"
