"""Where in a result the error lives that repeats: at which harmonics, and along which coordinates.

All runs count together, in units of the noise of their averages, so that a function of velocity,
say, is one function for all of them: where it explains most of what repeats it is nearly the law
that is missing.
"""

from __future__ import annotations

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.errors import InputError

#: Harmonics told one by one; what lies above counts together, under the order after the last.
ORDERS = 12
#: Bins of a coordinate, each with as many points.
BINS = 24
#: Coordinates that a run's mean is, and the mean of all runs of a group.
RUN, GROUP, SIGN = "run", "group", "direction"


def residual_breakdown(tree: xr.DataTree) -> xr.Dataset:
    """Share of the repeating error, beyond its noise, by harmonic and by coordinate.

    Parameters
    ----------
    tree : DataTree
        Of ``close`` or ``trace``. Periodic runs only.

    Returns
    -------
    Dataset
        ``power(stage, output, harmonic)`` and ``share(stage, output, coordinate)`` over the excess
        of the first stage, ``before``; ``excess(output)``, that excess as a mean square over the
        noise's. The last harmonic stands for itself and all above. A coordinate's share is what one
        function of it, the same in all runs, explains; ``direction`` is the sign of the velocity,
        ``run`` and ``group`` a constant for each.

    Raises
    ------
    InputError
        If the result holds no residual of a periodic run.
    """
    residual = tree[schema.RESIDUAL].to_dataset() if schema.RESIDUAL in tree.children else None
    if residual is None:
        raise InputError("the result holds no residual", hint="give the result of close or trace")
    observed = tree[schema.RECORDS].to_dataset()
    periodic = np.isfinite(observed[schema.PHASE].values).any(axis=1)
    if not periodic.any():
        raise InputError("no run is periodic", hint="transients have no harmonics")
    stages = [
        s for s in ("before", "after") if any(str(n).endswith(f"_{s}_mean") for n in residual)
    ]
    end = schema.mean(schema.before(""))
    outputs = [str(n)[: -len(end)] for n in residual.data_vars if str(n).endswith(end)]
    places = _coordinates(tree, residual, periodic)
    power = np.zeros((len(stages), len(outputs), ORDERS + 1))
    share = np.zeros((len(stages), len(outputs), len(places)))
    excess = np.zeros(len(outputs))
    for b, output in enumerate(outputs):
        noise = residual[schema.noise(output)].values[periodic]
        for s, stage in enumerate(stages):
            mean = residual[f"{output}_{stage}_mean"].values[periodic] / noise[:, None]
            solved = np.isfinite(mean).all(axis=1)
            if s == 0:
                excess[b] = float(np.mean(mean[solved] ** 2) - 1.0)
            # Where only noise is left, shares of it mean nothing.
            whole = max(excess[b], 2.0 / np.sqrt(mean[solved].size))
            power[s, b] = _by_order(mean[solved]) / whole
            share[s, b] = [_explained(mean[solved], x[solved]) / whole for x in places.values()]
    return xr.Dataset(
        {
            "power": (("stage", schema.OUTPUT, "harmonic"), power),
            "share": (("stage", schema.OUTPUT, "coordinate"), share),
            "excess": (schema.OUTPUT, excess),
        },
        coords={
            "stage": stages,
            schema.OUTPUT: outputs,
            "harmonic": np.arange(ORDERS + 1),
            "coordinate": list(places),
        },
    )


def _by_order(mean: Array) -> Array:
    """Mean square by harmonic less that of noise, the last with all above, shape (ORDERS + 1,)."""
    count = mean.shape[1]
    squares = np.abs(np.fft.rfft(mean, axis=1) / count) ** 2
    # White noise of unit mean square holds as much in each real coefficient: two of most orders,
    # one of the mean and, with an even number of phases, of the last.
    coefficients = np.full(squares.shape[1], 2.0)
    coefficients[[0] if count % 2 else [0, -1]] = 1.0
    squares *= coefficients
    beyond = squares.mean(axis=0) - coefficients / count
    return np.append(beyond[:ORDERS], beyond[ORDERS:].sum())


def _explained(mean: Array, place: Array) -> float:
    """Mean square that a function of a coordinate explains, less what it would of noise."""
    x, m = place.ravel(), mean.ravel()
    labels = np.unique(x)
    if labels.size <= BINS:
        which = np.searchsorted(labels, x)
    else:
        which = np.empty(x.size, dtype=np.int64)
        for k, part in enumerate(np.array_split(np.argsort(x, kind="stable"), BINS)):
            which[part] = k
    sizes = np.bincount(which)
    sums = np.bincount(which, weights=m)
    return float((np.sum(sums**2 / sizes) - sizes.size) / m.size)


def _coordinates(
    tree: xr.DataTree, residual: xr.Dataset, periodic: NDArray[np.bool_]
) -> dict[str, Array]:
    """What the error may be a function of, on the phases of the averages, each (runs, phases)."""
    phases = residual.sizes[schema.PHASE]
    observed = tree[schema.RECORDS].to_dataset()
    phase = observed[schema.PHASE].values[periodic]
    count = phase.shape[0]
    found: dict[str, Array] = {"phase": np.tile(np.arange(phases) / phases, (count, 1))}
    for coordinate in (schema.STROKE, schema.VELOCITY):
        if coordinate in residual:
            values = _folded(phase, residual[coordinate].values[periodic], phases)
            found[str(residual[coordinate].attrs.get(schema.LONG_NAME, coordinate))] = values
            if coordinate == schema.VELOCITY:
                found[SIGN] = np.sign(values)
    for name, item in observed.data_vars.items():
        if name not in (schema.TIME, schema.PHASE):
            values = _folded(phase, item.values[periodic], phases)
            # The channel that drives is as a rule the position itself.
            if not any(_same(values, other) for other in found.values()):
                found[str(name)] = values
    found[RUN] = np.tile(np.arange(float(count))[:, None], (1, phases))
    constant = tree[schema.CONSTANT_DATA].to_dataset()
    groups = constant[schema.RUN_GROUP].values[periodic]
    names, which = np.unique(groups.astype(str), return_inverse=True)
    if names.size > 1:
        found[GROUP] = np.tile(which.astype(float)[:, None], (1, phases))
    return {name: values for name, values in found.items() if np.isfinite(values).all()}


def _same(values: Array, other: Array) -> bool:
    """Whether two coordinates agree but for noise."""
    return bool(np.ptp(values - other) < 0.01 * np.ptp(values))


def _folded(phase: Array, values: Array, count: int) -> Array:
    """A channel at ``count`` phases of a period, averaged over neighbouring samples of all periods;
    where samples are few, interpolated between them."""
    rows = []
    for place, row in zip(phase, values, strict=True):
        keep = np.isfinite(place) & np.isfinite(row)
        which = np.round(place[keep] % 1.0 * count).astype(int) % count
        sizes = np.bincount(which, minlength=count)
        sums = np.bincount(which, weights=row[keep], minlength=count)
        at = np.flatnonzero(sizes)
        rows.append(np.interp(np.arange(count), at, sums[at] / sizes[at], period=count))
    return np.array(rows)
