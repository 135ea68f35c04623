"""What the posterior says that the point estimate, its covariances and its regions did not."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import xarray as xr
from scipy import linalg, stats

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.errors import ResultsError
from bayesoleo.estimation.shown import columns

#: With what the posterior is compared.
LINEARISED, MONTE_CARLO, REGION = "linearised", "monte carlo", "indifference"


def compare(groups: Mapping[str, xr.Dataset] | xr.DataTree) -> xr.Dataset:
    """Hold the posterior against the estimate and whatever says how uncertain it is.

    Parameters
    ----------
    groups : DataTree or mapping of str to Dataset
        ``posterior`` and ``point``; ``sampling_distribution`` and ``indifference`` where there are.

    Returns
    -------
    Dataset
        The group ``comparison``. ``shift(parameter)``: posterior mean minus estimate in linearised
        standard deviations. ``sd_ratio(reference, parameter)``: posterior standard deviation over
        the linearised one, over the scatter of simulated experiments, and over the indifference
        region's half-width, scaled to one standard deviation of a normal posterior.
        ``variance_ratio(reference, extreme)``: least and greatest ratio of the posterior's variance
        to the reference's over all directions. ``skewness(parameter)``,
        ``excess_kurtosis(parameter)``. NaN where there is nothing to compare with.

    Raises
    ------
    ResultsError
        If there is no posterior, or no point.

    References
    ----------
    Verbeek (1993), eqs. 2.36-2.41 (linearised), 2.18-2.20 (Monte Carlo), 2.43 (region).
    """
    for name in (schema.POSTERIOR, schema.POINT):
        if name not in groups:
            raise ResultsError(f"needs the group {name!r}", hint="sample the posterior first")
    point, posterior = _dataset(groups, schema.POINT), _dataset(groups, schema.POSTERIOR)
    names = [str(n) for n in point[schema.PARAMETER].values if str(n) in posterior]
    draws = np.stack([posterior[name].values.ravel() for name in names])
    covariance = np.atleast_2d(np.cov(draws))
    keep = point.sel({schema.PARAMETER: names, schema.PARAMETER_COLUMN: names})
    references = {LINEARISED: keep[schema.COVARIANCE].values}
    references[MONTE_CARLO] = _monte_carlo(groups, names)
    region = _region(groups, names)
    sd = np.sqrt(np.diag(covariance))
    linear = np.sqrt(np.diag(references[LINEARISED]))
    ratio = [sd / np.sqrt(np.diag(matrix)) for matrix in references.values()]
    extremes = [_extremes(covariance, matrix) for matrix in references.values()]
    each, both = (schema.PARAMETER,), ("reference", schema.PARAMETER)
    return xr.Dataset(
        {
            "shift": (
                each,
                (draws.mean(axis=1) - keep[schema.ESTIMATE].values) / linear,
                _about("posterior mean minus estimate, in linearised standard deviations"),
            ),
            "sd_ratio": (
                both,
                np.array([*ratio, sd / region]),
                _about("posterior standard deviation over the reference's"),
            ),
            "variance_ratio": (
                ("reference", "extreme"),
                np.array([*extremes, (np.nan, np.nan)]),
                _about("posterior variance over the reference's, over all directions"),
            ),
            "skewness": (each, stats.skew(draws, axis=1), _about("skewness")),
            "excess_kurtosis": (each, stats.kurtosis(draws, axis=1), _about("excess kurtosis")),
        },
        coords={
            schema.PARAMETER: names,
            "reference": [LINEARISED, MONTE_CARLO, REGION],
            "extreme": ["least", "greatest"],
        },
    )


def comparison_text(found: xr.Dataset) -> str:
    """A comparison as a table: one line for each parameter, and one over all directions.

    Parameters
    ----------
    found : Dataset
        Of :func:`compare`, or the group ``comparison`` of a result.

    Returns
    -------
    str
        Columns of references that there are not are left out.
    """
    there = found["sd_ratio"].notnull().any(schema.PARAMETER)
    references = [str(name) for name in found["reference"].values[there.values]]
    head = ["parameter", "shift in sd", *(f"sd / {name}" for name in references), "skewness"]
    rows = []
    for name in found[schema.PARAMETER].values:
        one = found.sel({schema.PARAMETER: name})
        ratios = [float(one["sd_ratio"].sel(reference=r)) for r in references]
        numbers = [float(one["shift"]), *ratios, float(one["skewness"])]
        rows.append([str(name), *("–" if np.isnan(x) else f"{x:.2f}" for x in numbers)])
    lines = [columns(head, rows)]
    for reference in references:
        least, greatest = found["variance_ratio"].sel(reference=reference).values
        if np.isfinite(least):
            between = f"{least:.2f} to {greatest:.2f}"
            lines.append(f"variance over the {reference} one, over all directions: {between}")
    return "\n".join(lines)


def _about(text: str) -> dict[str, str]:
    return {schema.UNITS: "1", schema.LONG_NAME: text}


def _dataset(groups: Mapping[str, xr.Dataset] | xr.DataTree, name: str) -> xr.Dataset:
    found = groups[name]
    return found.to_dataset() if isinstance(found, xr.DataTree) else found  # type: ignore[return-value]


def _monte_carlo(groups: Mapping[str, xr.Dataset] | xr.DataTree, names: list[str]) -> Array:
    """Covariance of simulated estimates, (l, l); NaN where not all parameters were simulated."""
    missing = np.full((len(names), len(names)), np.nan)
    if schema.SAMPLING_DISTRIBUTION not in groups:
        return missing
    data = _dataset(groups, schema.SAMPLING_DISTRIBUTION)
    if not set(names) <= {str(n) for n in data[schema.PARAMETER].values}:
        return missing
    chosen = data.sel({schema.PARAMETER: names, schema.PARAMETER_COLUMN: names})
    return np.asarray(chosen[schema.COVARIANCE].values, dtype=float)


def _region(groups: Mapping[str, xr.Dataset] | xr.DataTree, names: list[str]) -> Array:
    """Half of each parameter's extent of the region, as a standard deviation, (l,).

    A normal posterior falls by ``epsilon`` at ``sqrt(2 epsilon)`` standard deviations.
    """
    half = np.full(len(names), np.nan)
    if schema.INDIFFERENCE not in groups:
        return half
    data = _dataset(groups, schema.INDIFFERENCE)
    # The shadow of the region if it was made; with two parameters there is one section only.
    contour = data["contour"].isel(section=-1)
    for k, name in enumerate(names):
        where = np.argwhere(data["name"].values == name)
        if where.size:
            pair, side = where[0]
            values = contour.isel(pair=int(pair), side=int(side)).values
            half[k] = 0.5 * (values.max() - values.min())
    return np.asarray(half / np.sqrt(2 * float(data.attrs["epsilon"])))


def _extremes(covariance: Array, reference: Array) -> tuple[float, float]:
    """Least and greatest eigenvalue of ``reference^-1 covariance``."""
    if not np.isfinite(reference).all():
        return np.nan, np.nan
    try:
        values = linalg.eigh(covariance, reference, eigvals_only=True)
    except linalg.LinAlgError:  # a reference that is not positive definite says nothing
        return np.nan, np.nan
    return float(values[0]), float(values[-1])
