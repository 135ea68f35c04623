"""Indifference regions: all parameters that fit as well as the estimate, give or take ``epsilon``.

Exact, by following the objective outwards, and by Taylor's second order, as ellipses. Where the two
differ, an interval from a covariance says something that is not so.

References
----------
Verbeek (1993), eqs. 2.43-2.45.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
import xarray as xr
from scipy import stats

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation.estimators.point import PointEstimate
from bayesoleo.estimation.objectives.curvature import curvature
from bayesoleo.estimation.problems.problem import Problem
from bayesoleo.estimation.shown import LabelledResult
from bayesoleo.estimation.uncertainty.axes import axes_text, over_variances, principal_axes
from bayesoleo.estimation.uncertainty.drop import Kind, LogLikelihoodRatio
from bayesoleo.estimation.uncertainty.plane import Plane

CONDITIONAL, PROFILED = "conditional", "profiled"


def indifference(
    problem: Problem,
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
    problem : Problem
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
        pair, side)``; what :func:`~bayesoleo.estimation.uncertainty.axes.principal_axes` gives; the
        estimate. Where a contour stays open its end is infinite.

    Raises
    ------
    InputError
        If a name is unknown or there are fewer than two parameters.
    """
    chosen = _pairs(problem, pairs)
    if epsilon is None:
        epsilon = 0.5 * float(stats.chi2.isf(1 - level, 2))
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


def _pairs(problem: Problem, pairs: Sequence[tuple[str, str]] | None) -> list[tuple[int, int]]:
    names = list(problem.names)
    if len(names) < 2:
        raise InputError(
            "a region needs two parameters or more", value=len(names), hint="use profile instead"
        )
    if pairs is None:
        return list(combinations(range(len(names)), 2))
    for name in {name for pair in pairs for name in pair}:
        if name not in names:
            raise InputError("there is no such unknown", key=name, hint=f"use {', '.join(names)}")
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
    problem: Problem,
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
