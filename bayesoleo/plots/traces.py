"""The chains, to see whether they have settled and agree."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.plots import reading, style
from bayesoleo.plots.draws import chosen, draws, unit_of
from bayesoleo.plots.units import engineering

LEFT, TOP, BOTTOM, HIGH, GAP = 1.0, 0.6, 0.6, 0.75, 0.32
WALKERS = 2
POINTS = 250


def trace(tree: xr.DataTree, most: int = 7) -> Figure:
    """Some walkers of each ensemble over the draws, and the log posterior.

    Parameters
    ----------
    tree : DataTree
        Needs ``posterior``; ``sample_stats`` for the log posterior.
    most : int
        How many parameters.

    Returns
    -------
    Figure
        Two walkers of each ensemble, one colour an ensemble: colours that keep apart show
        ensembles that do not agree.
    """
    names = chosen(tree, most)
    stats = reading.group(tree, schema.SAMPLE_STATS)
    rows = [(name, unit_of(tree, name), draws(tree, name)) for name in names]
    if stats is not None and schema.LP in stats:
        lp = stats[schema.LP].transpose(schema.CHAIN, schema.DRAW).values
        rows.append(("log posterior", "", lp))
    columns = 2 if len(rows) > 2 else 1
    lines = -(-len(rows) // columns)
    height = TOP + lines * (HIGH + GAP) - GAP + BOTTOM
    figure = style.blank(style.WIDTH, height)
    wide = (style.WIDTH - 0.1) / columns
    for place, (name, unit, values) in enumerate(rows):
        line, column = divmod(place, columns)
        x, y = LEFT + column * wide, height - TOP - (line + 1) * HIGH - line * GAP
        box = (x / style.WIDTH, y / height, (wide - LEFT - 0.15) / style.WIDTH, HIGH / height)
        axes = figure.add_axes(box)
        _chains(axes, name, unit, values, _ensembles(tree, values.shape[0]))
        axes.tick_params(labelbottom=place + columns >= len(rows))
    middle = 0.12 / height
    figure.text(0.5, middle, "draw", ha="center", fontsize=style.TEXT, color=style.INK)
    count = np.unique(_ensembles(tree, rows[0][2].shape[0])).size
    remark = f"{WALKERS} walkers of each of {count} ensemble{'s' if count > 1 else ''}"
    style.legend(figure, [], remark)
    return figure


def _chains(axes: Axes, name: str, unit: str, values: Array, ensembles: Array) -> None:
    """A few walkers, thinned to what a screen can show."""
    style.dress(axes, ticks=3)
    spread = values.std()
    scale = engineering(unit, style.magnitude(values))
    step = max(values.shape[1] // POINTS, 1)
    index = np.arange(0, values.shape[1], step)
    # A narrow posterior of a large value (a log posterior, an area) is shown about its mean.
    offset = float(values.mean()) if spread < 1e-3 * abs(values.mean()) else 0.0
    if offset:
        scale = engineering(unit, 3 * float(spread))
    for number, label in enumerate(np.unique(ensembles)):
        colour = style.ENSEMBLES[number % len(style.ENSEMBLES)]
        for chain in np.flatnonzero(ensembles == label)[:WALKERS]:
            shown = scale.factor * (values[chain, index] - offset)
            axes.plot(index, shown, color=colour, lw=0.5, alpha=0.7)
    axes.set_xlim(0, max(values.shape[1] - 1, 1))
    text = style.plain(scale.label(f"{name} − mean" if offset else name), 50)
    axes.set_title(text, loc="left", fontsize=style.SMALL, pad=3, color=style.INK)


def _ensembles(tree: xr.DataTree, chains: int) -> Array:
    """To which ensemble each chain belongs; one for all where the tree does not say."""
    posterior = tree[schema.POSTERIOR]
    if schema.ENSEMBLE in posterior.coords:
        return np.asarray(posterior[schema.ENSEMBLE].values, dtype=float)
    return np.zeros(chains)
