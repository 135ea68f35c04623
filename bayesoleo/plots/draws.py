"""Draws of the posterior as the figures take them."""

from __future__ import annotations

import numpy as np
import xarray as xr

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.plots import reading
from bayesoleo.plots.rankings import chosen as accepted


def point_table(tree: xr.DataTree) -> dict[str, tuple[float, float, str]]:
    """Estimate, linearised sd and unit of every parameter; empty without a point."""
    point = reading.group(tree, schema.POINT)
    if point is None or schema.ESTIMATE not in point:
        return {}
    names = [str(name) for name in point[schema.PARAMETER].values]
    units = point[schema.UNIT].values if schema.UNIT in point else [""] * len(names)
    sd = point[schema.SD].values if schema.SD in point else np.full(len(names), np.nan)
    rows = zip(names, point[schema.ESTIMATE].values, sd, units, strict=True)
    return {name: (float(value), float(s), str(unit)) for name, value, s, unit in rows}


def chosen(tree: xr.DataTree, most: int) -> list[str]:
    """The parameters worth a panel: those of the effects added, then shared ones, then by run.

    Parameters
    ----------
    tree : DataTree
        Needs ``posterior``.
    most : int
        How many.

    Returns
    -------
    list of str
        In the order of the posterior.
    """
    posterior = tree[schema.POSTERIOR].to_dataset()
    names = [
        str(n) for n in posterior.data_vars if posterior[n].dims == (schema.CHAIN, schema.DRAW)
    ]
    new = _new_parameters(tree)

    def rank(name: str) -> tuple[bool, bool, int]:
        secondary = "[" in name or schema.of_errors(name)
        return name not in new, secondary, names.index(name)

    return sorted(sorted(names, key=rank)[:most], key=names.index)


def draws(tree: xr.DataTree, name: str) -> Array:
    """Draws of one parameter, shape (chain, draw)."""
    values = (
        reading.variable(tree, schema.POSTERIOR, name).transpose(schema.CHAIN, schema.DRAW).values
    )
    return np.asarray(values, dtype=float)


def unit_of(tree: xr.DataTree, name: str) -> str:
    """Unit from the point, or from the posterior itself."""
    table = point_table(tree)
    return (
        table[name][2]
        if name in table
        else reading.unit(reading.variable(tree, schema.POSTERIOR, name))
    )


def _new_parameters(tree: xr.DataTree) -> set[str]:
    """Parameters that came with the effects accepted."""
    new: set[str] = set()
    for entry in reading.summary(tree).get("rounds", []):
        candidate = accepted(entry)
        if candidate is not None:
            new |= set(candidate["expected"])
    return new
