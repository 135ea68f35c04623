"""What figures take out of a DataTree; groups that are absent are None, never an error."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._schema import LabelledResult
from bayesoleo._types import Array
from bayesoleo.errors import InputError

BINS = 120
"""Points shown over one period."""
MERGED = 0.25
"""Part of a bin's width below which the averages of two bins are one."""


@dataclass(frozen=True)
class RunView:
    """What is said about a run in the title of its panel."""

    index: int
    label: str
    role: str
    frequency: float
    duration: float
    periodic: bool

    @property
    def remark(self) -> str:
        """Frequency of a periodic run, duration of a transient one."""
        if not self.periodic:
            return f"transient, {self.duration:.3g} s"
        return f"{self.frequency:.3g} Hz" if np.isfinite(self.frequency) else ""


def dataset(found: LabelledResult | xr.Dataset | xr.DataTree) -> xr.Dataset:
    """The labelled arrays of a result, as the function that found it returns it, bare or a group.

    Raises
    ------
    InputError
        If it is neither.
    """
    data = found.data if isinstance(found, LabelledResult) else found
    if isinstance(data, xr.DataTree):
        return data.to_dataset()
    if not isinstance(data, xr.Dataset):
        raise InputError(
            "a figure needs a result or its Dataset",
            value=type(data).__name__,
            hint="give what the function returns, or a group of a tree",
        )
    return data


def group(tree: xr.DataTree, name: str) -> xr.Dataset | None:
    """A group as a Dataset, or None."""
    return tree[name].to_dataset() if name in tree.children else None


def variable(tree: xr.DataTree, name: str, variable: str) -> xr.DataArray:
    """A variable of a group that is there."""
    return tree[name].to_dataset()[variable]


def summary(tree: xr.DataTree) -> dict[str, Any]:
    """The summary in the root attributes, empty if there is none."""
    found: dict[str, Any] = json.loads(tree.attrs.get(schema.SUMMARY, "{}"))
    return found


def outputs(tree: xr.DataTree) -> list[str]:
    """Output channels, in the order of the prediction."""
    data = group(tree, schema.PREDICTION)
    end = schema.before("")
    return (
        []
        if data is None
        else [str(n)[: -len(end)] for n in data.data_vars if str(n).endswith(end)]
    )


def channels(tree: xr.DataTree) -> list[str]:
    """Measured channels: those that are not outputs (the inputs) first."""
    data = group(tree, schema.RECORDS)
    if data is None:
        return []
    own = [str(name) for name in data.data_vars if name not in (schema.TIME, schema.PHASE)]
    return sorted(own, key=lambda name: name in outputs(tree))


def runs(tree: xr.DataTree) -> list[RunView]:
    """The runs, in the order of the tree."""
    data, constant = group(tree, schema.RECORDS), group(tree, schema.CONSTANT_DATA)
    if data is None:
        return []
    count = data.sizes[schema.RUN]
    labels = data[schema.RUN].values if schema.RUN in data.coords else range(1, count + 1)
    roles, frequencies = [""] * count, np.full(count, np.nan)
    if constant is not None:
        roles = [str(role) for role in constant[schema.ROLE].values]
        frequencies = constant[schema.FREQUENCY].values.astype(float)
    time = data[schema.TIME].values
    periodic = np.zeros(count, dtype=bool)
    if schema.PHASE in data:
        periodic = np.isfinite(data[schema.PHASE].values).any(axis=1)
    duration = np.nanmax(time, axis=1) - np.nanmin(time, axis=1)
    return [
        RunView(
            i,
            str(labels[i]),
            roles[i],
            float(frequencies[i]),
            float(duration[i]),
            bool(periodic[i]),
        )
        for i in range(count)
    ]


def unit(data: xr.DataArray) -> str:
    """Unit of a variable, empty if it has none."""
    return str(data.attrs.get(schema.UNITS, ""))


def abscissa(tree: xr.DataTree, run: RunView) -> Array:
    """Phase modulo 1 of every sample; of a transient the fraction of its duration; NaN padded."""
    data = tree[schema.RECORDS].to_dataset()
    if run.periodic:
        return np.asarray(data[schema.PHASE].values[run.index] % 1.0, dtype=np.float64)
    time = np.asarray(data[schema.TIME].values[run.index], dtype=np.float64)
    return np.asarray((time - np.nanmin(time)) / max(run.duration, float(np.finfo(float).tiny)))


def fold(position: Array, values: Array, bins: int = BINS) -> tuple[Array, Array]:
    """Average values in equal bins of a position from 0 to 1.

    Parameters
    ----------
    position, values : ndarray, shape (n,)
        Pairs with a NaN are left out.
    bins : int
        Number of bins.

    Returns
    -------
    positions, means : ndarray, shape (m,)
        Averages of position and value in each bin that has samples: of a record with few samples a
        period, these are its samples. Where no sample lies for far longer than between others,
        there is one row of NaN, so that a line breaks off.
    """
    keep = np.isfinite(position) & np.isfinite(values)
    index = np.minimum((position[keep] * bins).astype(int), bins - 1)
    count = np.bincount(index, minlength=bins)
    filled = count > 0
    x, y = (
        np.bincount(index, weights=part[keep], minlength=bins)[filled]
        for part in (position, values)
    )
    # Rounding divides samples of one phase that lies on the edge of two bins.
    together = np.cumsum(np.diff(x / count[filled], prepend=0.0) > MERGED / bins)
    size, x, y = (np.bincount(together, weights=part) for part in (count[filled], x, y))
    size, x, y = (part[np.bincount(together) > 0] for part in (size, x, y))
    return _broken(x / size, y / size, bins)


def _broken(x: Array, y: Array, bins: int) -> tuple[Array, Array]:
    """A row of NaN in each gap of more than three usual distances."""
    away = np.diff(x)
    if away.size == 0:
        return x, y
    gaps = np.flatnonzero(away > 3.0 * max(float(np.median(away)), 1.0 / bins)) + 1
    return np.insert(x, gaps, np.nan), np.insert(y, gaps, np.nan)


def is_few(x: Array) -> bool:
    """Whether so few points are drawn that each of them is shown, and not only a line."""
    return bool(np.count_nonzero(np.isfinite(x)) <= BINS // 2)


def is_resolved(position: Array, values: Array) -> bool:
    """Whether bins of phase show a signal; hundreds of harmonics they would average out."""
    means = fold(position, values)[1]
    variance = np.nanvar(values)
    return bool(variance == 0.0 or np.nanvar(means) > 0.9 * variance)


def thin(x: Array, y: Array, points: int = 2 * BINS) -> tuple[Array, Array]:
    """At most ``points`` pairs that keep the extremes: of each stretch its smallest and largest."""
    if y.size <= points or not np.isfinite(y).any():
        return x, y
    chosen: list[int] = []
    for part in np.array_split(np.arange(y.size), points // 2):
        if np.isfinite(y[part]).any():
            chosen += sorted({part[np.nanargmin(y[part])], part[np.nanargmax(y[part])]})
    return x[chosen], y[chosen]


def averaged_residual(tree: xr.DataTree, name: str, run: RunView) -> tuple[Array, Array]:
    """Residual averaged over the periods of a run over phase; of a transient as it is over time.

    Parameters
    ----------
    tree : DataTree
        With ``residual``.
    name : str
        Of the residual: ``force_before``.
    run : RunView

    Returns
    -------
    positions, values : ndarray
        Position from 0 to 1, and values in SI.
    """
    data, mean = tree[schema.RESIDUAL].to_dataset(), schema.mean(name)
    if run.periodic and mean in data and np.isfinite(data[mean].values[run.index]).any():
        return thin(_phases(data), data[mean].values[run.index])
    position, values = abscissa(tree, run), data[name].values[run.index]
    if run.periodic:
        return fold(position, values, 2 * BINS)
    return thin(position, values, 4 * BINS)


def _phases(data: xr.Dataset) -> Array:
    """The grid of the averages; if the tree has none it is regular."""
    if schema.PHASE in data.coords:
        return np.asarray(data[schema.PHASE].values, dtype=float)
    return (np.arange(data.sizes[schema.PHASE]) + 0.5) / data.sizes[schema.PHASE]


def averaged_word(tree: xr.DataTree) -> str:
    """What the error of an average is called: of periods it repeats; a transient has none.

    A transient's residual is averaged over neighbouring samples instead.
    """
    return "repeating" if all(run.periodic for run in runs(tree)) else "averaged"


def coordinate_name(data: xr.Dataset, name: str) -> str:
    """What a coordinate of the residual is called: whose position or velocity it is."""
    return str(data[name].attrs.get(schema.LONG_NAME, name))
