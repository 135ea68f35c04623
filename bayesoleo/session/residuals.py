"""Residuals of a result as labelled arrays."""

from __future__ import annotations

import xarray as xr

from bayesoleo import schema

_MEASURED, _PREDICTED = "_measured", "_predicted"


def measured(output: str) -> str:
    """Name of the variable with an output's measurements."""
    return output + _MEASURED


def predicted(output: str) -> str:
    """Name of the variable with an output's predictions."""
    return output + _PREDICTED


def outputs(data: xr.Dataset) -> list[str]:
    """Output channels of residuals."""
    names = [str(name) for name in data.data_vars]
    return [name for name in names if measured(name) in names]


def place(one: xr.Dataset) -> str:
    """The coordinate over which a run is drawn: phase, time, or a function's input."""
    names = [str(name) for name in one.coords if schema.SAMPLE in one[name].dims]
    if schema.PHASE in names and not one[schema.PHASE].notnull().any():
        names.remove(schema.PHASE)  # of a transient
    return next(name for name in (schema.PHASE, schema.TIME, *names) if name in names)


def residuals(tree: xr.DataTree) -> xr.Dataset:
    """Residual, measurement and prediction of each output of each predicted run.

    Parameters
    ----------
    tree : DataTree
        With ``observed_data``, ``prediction`` and ``residual``. Of a result with added effects,
        those of the extended model.

    Returns
    -------
    Dataset
        ``<output>``, ``<output>_measured``, ``<output>_predicted`` ``(run, sample)`` with the
        coordinates ``time`` and ``phase``, or the inputs of a function.
    """
    predictions = tree[schema.PREDICTION].to_dataset()
    left = tree[schema.RESIDUAL].to_dataset()
    observed = tree[schema.OBSERVED_DATA].to_dataset().sel({schema.RUN: predictions[schema.RUN]})
    width = predictions.sizes[schema.SAMPLE]
    observed = observed.isel({schema.SAMPLE: slice(width)})
    end, data = schema.before(""), {}
    names = [str(n)[: -len(end)] for n in predictions.data_vars if str(n).endswith(end)]
    for name in names:
        stage = schema.after if schema.after(name) in predictions else schema.before
        about = dict(observed[name].attrs)
        data[name] = left[stage(name)].drop_attrs().assign_attrs(about)
        data[name].attrs[schema.LONG_NAME] = f"residual of {name}"
        data[measured(name)] = observed[name]
        data[predicted(name)] = predictions[stage(name)]
    places = {name: item for name, item in observed.data_vars.items() if name not in names}
    kept = {n: v for n, v in places.items() if n in (schema.TIME, schema.PHASE)} or places
    return xr.Dataset(data).assign_coords(kept)
