"""Indifference regions: parameters that fit as well as the estimate, within a loss ``epsilon``.

Regions are computed in two ways: exactly, by following the objective along rays from the estimate,
and by its second-order Taylor expansion, as ellipses. Where the two differ, intervals from a
covariance are misleading.

The contour in one plane of two parameters follows the valley of the objective. For given values of
the first parameter, the second is minimised over, and the limits are then searched to both sides of
that minimum. A valley may therefore bend, as for a product of two parameters; rays from the
estimate would leave it at the first bend.

References
----------
Verbeek (1993), eqs. 2.43-2.45.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import cast

import numpy as np
import xarray as xr
from scipy.interpolate import PchipInterpolator

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._schema import LabelledResult
from bayesoleo._types import Array, Integers
from bayesoleo.errors import InputError, check_level, check_names
from bayesoleo.estimation._identifiability import axes_text, over_variances, principal_axes
from bayesoleo.estimation._objectives import curvature, inverse_scaled
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.estimation._problem import EstimationProblem, Held
from bayesoleo.estimation._profile_likelihood import Kind, LogLikelihoodRatio, ProfileLine

# In units of the radius that the second-order expansion foresees.
_FARTHEST = 30.0
_GROW = 1.6
_ITERATIONS = 40
# Relative to the level; contours are looked at, or compared with intervals of two digits.
_TOLERANCE = 1e-3
# Least curvature, as part of the prior's: ellipses stay finite without information from data.
_LEAST_CURVATURE = 1e-4
# How far an open region is drawn, in standard deviations of the prior.
_OPEN_REACH = 4.0
CONDITIONAL, PROFILED = "conditional", "profiled"


def first_crossing(function: Callable[[Array, Integers], Array], rays: int, level: float) -> Array:
    """Radius on each ray, in units of the expected one; infinite where the level is not reached.

    Parameters
    ----------
    function : callable
        ``function(radius, index)`` for radii ``(m,)`` on the rays ``index (m,)``: shape (m,), zero
        at radius zero, near ``level * radius**2`` where the expansion holds; may be infinite.
    rays : int
    level : float

    Returns
    -------
    ndarray, shape (rays,)
    """
    low, high = np.zeros(rays), np.full(rays, np.inf)
    root_low = np.zeros(rays)
    radius, done = np.ones(rays), np.zeros(rays, dtype=bool)
    for _ in range(_ITERATIONS):
        work = np.flatnonzero(~done)
        if work.size == 0:
            break
        value = np.maximum(function(radius[work], work), 0.0)
        root = np.sqrt(value / level)  # nearly proportional to the radius
        close = np.abs(root - 1) <= 0.5 * _TOLERANCE
        done[work[close]] = True
        below = root < 1
        for k, r, under in zip(work, root, below, strict=True):
            if done[k]:
                continue
            if under:
                low[k], root_low[k] = radius[k], r
            else:
                high[k] = radius[k]
            radius[k] = _next(low[k], high[k], radius[k], r, root_low[k])
            # Between a finite value and a failure the edge is found to a thousandth.
            if high[k] - low[k] <= _TOLERANCE * max(low[k], 1e-6) or low[k] >= _FARTHEST:
                done[k] = True
                radius[k] = low[k] if low[k] < _FARTHEST else np.inf
    return radius


def _next(low: float, high: float, radius: float, root: float, root_low: float) -> float:
    if not np.isfinite(high):
        aim = radius / root if root > 0 else np.inf
        return float(min(max(aim, 1.05 * radius), _GROW * radius))
    if not np.isfinite(root) or root == 0:
        return 0.5 * (low + high)
    # Beyond the level, between the lower end and here; below it, as a proportion.
    between = low + (radius - low) * (1 - root_low) / (root - root_low) if root >= 1 else 0.0
    aim = between if root >= 1 else radius / root
    margin = 0.02 * (high - low)
    inside = low + margin < aim < high - margin
    return float(aim if inside else 0.5 * (low + high))


@dataclass(frozen=True)
class Plane:
    """A plane of two parameters; the others keep their estimates, or follow.

    Parameters
    ----------
    drop : LogLikelihoodRatio
        Over the two, or over all parameters.
    pair : tuple of int
        The two, among those of ``drop``.
    block : ndarray, shape (2, 2)
        Curvature in the plane.
    covariance : ndarray, shape (l, l)
        Inverse curvature in the unknowns of ``drop``, with the prior's.
    """

    drop: LogLikelihoodRatio
    pair: tuple[int, int]
    block: Array
    covariance: Array

    @classmethod
    def of(
        cls, drop: LogLikelihoodRatio, matrix: Array, pair: tuple[int, int], profiled: bool
    ) -> Plane:
        """A plane through the estimate.

        Parameters
        ----------
        drop : LogLikelihoodRatio
            Over all parameters.
        matrix : ndarray, shape (l, l)
            Curvature of the objective.
        pair : tuple of int
        profiled : bool
            Whether the other parameters are estimated again at every point.
        """
        index = list(pair)
        others = [k for k in range(len(matrix)) if k not in pair]
        block = matrix[np.ix_(index, index)]
        if profiled and others:
            cross = matrix[np.ix_(index, others)]
            with np.errstate(invalid="ignore"):
                shadow = block - cross @ inverse_scaled(matrix[np.ix_(others, others)]) @ cross.T
            block = shadow if np.isfinite(shadow).all() else block
            return cls(drop, pair, block, _foresight(drop, matrix))
        point, order = drop.point, sorted(index)
        section = Held(drop.problem, point.theta, others)
        inside = replace(point, names=section.names, theta=point.theta[order])
        own = LogLikelihoodRatio(section, inside, drop.kind)
        return cls(
            drop=own,
            pair=(order.index(pair[0]), order.index(pair[1])),
            block=block,
            covariance=_foresight(own, matrix[np.ix_(order, order)]),
        )

    @property
    def centre(self) -> Array:
        """The estimate, shape (2,)."""
        return self.drop.point.theta[list(self.pair)]

    @property
    def spread(self) -> Array:
        """Standard deviations of the two priors, shape (2,)."""
        return np.array([self.drop.problem.priors[k].sd for k in self.pair])

    def ellipse(self, epsilon: float, points: int) -> Array:
        """``1/2 d' H d = epsilon`` (Verbeek 1993, eq. 2.44), shape (points, 2)."""
        scaled = 0.5 * (self.block + self.block.T) * np.outer(self.spread, self.spread)
        values, vectors = np.linalg.eigh(scaled)
        half = np.sqrt(2 * epsilon / np.maximum(values, _LEAST_CURVATURE))
        turn = 2 * np.pi * np.arange(points) / points
        circle = np.stack((np.cos(turn), np.sin(turn)))
        return cast(
            Array, self.centre + (self.spread[:, None] * (vectors @ (half[:, None] * circle))).T
        )

    def half_widths(self, epsilon: float) -> Array:
        """How far the ellipse reaches in either parameter, shape (2,)."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(2 * epsilon * np.diag(inverse_scaled(self.block)))

    def contour(self, epsilon: float, points: int) -> Array:
        """``Phi* - Phi = epsilon`` (Verbeek 1993, eq. 2.43), shape (points, 2), in its order.

        From the lowest value of the first parameter along one wall to the highest and back along
        the other; an end that is open is infinite.
        """
        line = ProfileLine.follow(
            self.drop, self.pair[0], float(np.sqrt(2 * epsilon)), self.covariance
        )
        low, high, is_open = self._reach(line)
        nodes = points // 2
        # Dense towards the ends, where an ellipse turns back.
        x = low + (high - low) * 0.5 * (1 - np.cos(np.pi * np.arange(nodes) / (nodes - 1)))
        floor, fall = self._floor(line, x)
        y = floor[:, self.pair[1]]
        up, down = (self._wall(floor, fall, epsilon, sign) for sign in (1.0, -1.0))
        upper, lower = np.stack((x, y + up), axis=1), np.stack((x, y - down), axis=1)
        for end, unbounded in zip((0, -1), is_open, strict=True):
            if unbounded:
                upper[end] = lower[end] = np.inf
        return np.concatenate((upper, lower[::-1]))

    def _reach(self, line: ProfileLine) -> tuple[float, float, tuple[bool, bool]]:
        """Ends of the region, or of its drawn part, in the first parameter; whether it goes on."""
        centre, most = self.centre[0], _OPEN_REACH * self.spread[0]
        ends, is_open = [], []
        support = self.drop.problem.priors[self.pair[0]].support
        for limit, last, edge in zip(
            (line.low, line.high), line.values[[0, -1]], support, strict=True
        ):
            at_edge = bool(np.isfinite(edge) and abs(last - edge) <= 0.01 * abs(centre - edge))
            drawn = float(np.clip(last, centre - most, centre + most))
            ends.append(float(limit) if np.isfinite(limit) else drawn)
            is_open.append(not np.isfinite(limit) and not (at_edge and drawn == last))
        return ends[0], ends[1], (is_open[0], is_open[1])

    def _floor(self, line: ProfileLine, x: Array) -> tuple[Array, Array]:
        """All unknowns along the valley's floor, shape (nodes, l), and the falls there.

        The line knows the floor at its own points; between them a narrow valley may bend away from
        any interpolation.
        """
        floor = np.repeat(line.paths[:1], len(x), axis=0)
        if len(line.values) > 1:
            inside = np.clip(x, line.values[0], line.values[-1])
            floor = PchipInterpolator(line.values, line.paths, axis=0)(inside)
        fall = np.empty(len(x))
        for k, value in enumerate(x):
            floor[k, self.pair[0]] = value
            fall[k], floor[k] = self.drop.profiled(floor[k], [self.pair[0]])
        freeze = getattr(self.drop.problem, "freeze", None)
        if freeze is not None:
            freeze(self.drop.point.theta)
        return floor, fall

    def _wall(self, floor: Array, fall: Array, epsilon: float, sign: float) -> Array:
        """Distance in the second parameter from the floor to the level, shape (nodes,)."""
        second = self.pair[1]
        rest = np.maximum(epsilon - fall, 1e-12 * epsilon)
        curvature = max(self.block[1, 1], _LEAST_CURVATURE / self.spread[1] ** 2)
        expected = np.sqrt(2 * rest / curvature)

        def climb(radius: Array, index: Integers) -> Array:
            theta = floor[index].copy()
            theta[:, second] += sign * radius * expected[index]
            return (self._falls(theta) - fall[index]) / rest[index]

        return cast(Array, first_crossing(climb, len(floor), 1.0) * expected)

    def _falls(self, theta: Array) -> Array:
        """Fall at points of the plane; the other parameters start from where they stand."""
        if len(self.drop.problem.names) == 2:
            return self.drop(theta)
        return np.array([self.drop.profiled(row, self.pair)[0] for row in theta])


def _foresight(drop: LogLikelihoodRatio, matrix: Array) -> Array:
    """Inverse curvature including the prior, which predicts steps without data."""
    precision = np.array([prior.sd**-2 for prior in drop.problem.priors])
    return inverse_scaled(matrix + np.diag(precision))


def indifference(
    problem: EstimationProblem,
    point: PointEstimate,
    pairs: Sequence[tuple[str, str]] | None = None,
    *,
    kind: Kind | None = None,
    level: float = 0.95,
    epsilon: float | None = None,
    sections: Sequence[str] = (CONDITIONAL, PROFILED),
    points: int = 48,
    exact: bool = False,
    progress: Callable[[str], None] | None = None,
) -> LabelledResult:
    """Contours of the indifference region in planes of two parameters, and its principal axes.

    Parameters
    ----------
    problem : EstimationProblem
    point : PointEstimate
        An optimum: of the likelihood (MBE) or of the posterior (BE, ``polish``).
    pairs : sequence of tuple of str, optional
        Planes; by default all pairs.
    kind : {"likelihood", "posterior"}, optional
        Whether the prior counts; by default what ``point`` is an optimum of.
    level : float, optional
        ``epsilon`` is half the chi-square quantile with two degrees of freedom at this level, so
        that a profiled contour is the region of that confidence for its two parameters.
    epsilon : float, optional
        The fall of the objective, instead.
    sections : sequence of str, optional
        ``"conditional"``: the other parameters keep their estimates; ``"profiled"``: they are
        estimated again at every point, so that the contour is the region's shadow. With two
        parameters both are the same, and only the first is made.
    points : int, optional
        Of a contour, an even number.
    exact : bool, optional
        Ellipses and axes with second derivatives of the residual, instead of as Gauss and Newton.
    progress : callable, optional
        Told each plane before its turn.

    Returns
    -------
    LabelledResult
        The group ``indifference``: ``contour`` and ``ellipse`` ``(section, pair, point, side)``
        with ``name(pair, side)`` and ``half_width(section,
        pair, side)``; what :func:`~bayesoleo.estimation.principal_axes` gives; the
        estimate. Where a contour stays open its end is infinite.

    Raises
    ------
    InputError
        If a name is unknown or there are fewer than two parameters.
    """
    chosen = _pairs(problem, pairs)
    if epsilon is None:
        check_level(level)
        epsilon = 0.5 * float(distributions.chi2.isf(1 - level, 2))
    if not epsilon > 0 or points < 8 or points % 2:
        hint = "epsilon must be positive, points an even number from eight"
        raise InputError("no contour can be drawn", value=(epsilon, points), hint=hint)
    kinds = _sections(sections, len(problem.names))
    drop = LogLikelihoodRatio(problem, point, kind)
    whole = curvature(
        problem, point.theta, point.variance, prior=drop.kind == "posterior", exact=exact
    )
    matrix = over_variances(whole, len(problem.names))
    shape = (len(kinds), len(chosen), points, 2)
    contour, ellipse = np.full(shape, np.nan), np.full(shape, np.nan)
    half = np.full((*shape[:2], 2), np.nan)
    for k, pair in enumerate(chosen):
        for s, section in enumerate(kinds):
            if progress is not None:
                progress(f"{section}: {' and '.join(problem.names[i] for i in pair)}")
            plane = Plane.of(drop, matrix, pair, section == PROFILED)
            ellipse[s, k] = plane.ellipse(epsilon, points)
            half[s, k] = plane.half_widths(epsilon)
            contour[s, k] = plane.contour(epsilon, points)
    problem.evaluate(point.theta)
    axes = principal_axes(problem, point, exact=exact)
    data = _dataset(problem, point, chosen, kinds, (contour, ellipse, half)).merge(axes.data)
    data.attrs = {**axes.data.attrs, "kind": drop.kind, "epsilon": epsilon}
    return LabelledResult(data, indifference_text(data))


def _pairs(
    problem: EstimationProblem, pairs: Sequence[tuple[str, str]] | None
) -> list[tuple[int, int]]:
    names = list(problem.names)
    if len(names) < 2:
        raise InputError(
            "a region needs two parameters or more", value=len(names), hint="use profile instead"
        )
    if pairs is None:
        return list(combinations(range(len(names)), 2))
    example = f'write [("{names[0]}", "{names[1]}")]'
    for pair in pairs:
        if isinstance(pair, str) or len(pair) != 2:
            raise InputError("is not a list of pairs", key="pairs", value=pairs, hint=example)
        check_names(pair, names, "pairs", example=example)
    return [(names.index(a), names.index(b)) for a, b in pairs]


def _sections(sections: Sequence[str], unknowns: int) -> list[str]:
    for section in sections:
        if section not in (CONDITIONAL, PROFILED):
            raise InputError(
                "unknown section",
                key="sections",
                value=section,
                hint=f"use {CONDITIONAL!r} or {PROFILED!r}",
            )
    return [sections[0]] if unknowns == 2 else list(dict.fromkeys(sections))


def _dataset(
    problem: EstimationProblem,
    point: PointEstimate,
    pairs: Sequence[tuple[int, int]],
    sections: Sequence[str],
    found: tuple[Array, Array, Array],
) -> xr.Dataset:
    dims = ("section", "pair", "point", "side")
    mixed = "unit of each parameter"
    names = [[problem.names[i] for i in pair] for pair in pairs]
    contour, ellipse, half = found
    exact, taylor = "contour of the objective", "contour of its second-order expansion"
    return xr.Dataset(
        {
            "contour": xr.Variable(dims, contour, {schema.LONG_NAME: exact, schema.UNITS: mixed}),
            "ellipse": xr.Variable(dims, ellipse, {schema.LONG_NAME: taylor, schema.UNITS: mixed}),
            "half_width": xr.Variable(
                (*dims[:2], "side"),
                half,
                {schema.LONG_NAME: "half width of the ellipse", schema.UNITS: mixed},
            ),
            "name": xr.Variable(("pair", "side"), np.array(names, dtype=object)),
            schema.ESTIMATE: xr.Variable(
                (schema.PARAMETER,),
                point.theta,
                {schema.LONG_NAME: "estimate", schema.UNITS: mixed},
            ),
        },
        coords={
            "section": list(sections),
            "pair": [" and ".join(pair) for pair in names],
            "side": ["x", "y"],
            schema.PARAMETER: list(problem.names),
        },
    )


def indifference_text(data: xr.Dataset) -> str:
    """Principal axes, and how far each region reaches beyond its ellipse."""
    lines = [axes_text(data), ""]
    lines.append(f"fall of the {data.attrs['kind']}: {float(data.attrs['epsilon']):.3g}")
    for pair in data["pair"].values:
        for section in data["section"].values:
            one = data.sel(pair=pair, section=section)
            lines.append(f"{pair}, {section}: {_compared(one)}")
    return "\n".join(lines)


def _compared(one: xr.Dataset) -> str:
    """How a contour differs from its ellipse, in one clause."""
    contour = one["contour"].values
    if not np.isfinite(contour).all():
        return "open"
    parts = []
    for side in range(2):
        centre = float(one[schema.ESTIMATE].sel(parameter=str(one["name"].values[side])))
        half = float(one["half_width"].values[side])
        low, high = contour[:, side].min() - centre, contour[:, side].max() - centre
        parts.append(f"{one['name'].values[side]} {low / half:+.2f} to {high / half:+.2f}")
    return "reaches " + ", ".join(parts) + " half widths of the ellipse"
