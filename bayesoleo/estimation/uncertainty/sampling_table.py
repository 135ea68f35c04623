"""Bias and scatter of replications beside theory, as labelled arrays and as text."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.estimation.shown import columns
from bayesoleo.storage.slots import Arrays

_MIXED = "unit of each parameter"


def by_replication(parts: Arrays) -> dict[str, xr.Variable]:
    """What each replication found."""
    each, of_output = ("replication", schema.PARAMETER), ("replication", schema.OUTPUT)
    squared = "square of the output's SI unit"
    return {
        "replicate": _variable(each, parts["theta"], "estimate by replication", _MIXED),
        "status": _variable(("replication",), parts["status"], "outcome", "1"),
        schema.VARIANCE: _variable(
            of_output, parts["variance"], "error variance by replication", squared
        ),
    }


def moments(found: Array, truth: Array, expected: Array, bound: Array) -> dict[str, xr.Variable]:
    """Mean and covariance of estimates (R, l), beside the truth and what theory expects."""
    mean, covariance = np.full_like(truth, np.nan), np.full_like(expected, np.nan)
    if len(found) > 1:
        mean, covariance = found.mean(axis=0), np.atleast_2d(np.cov(found, rowvar=False))
    sd, bound_sd = np.sqrt(np.diag(covariance)), np.sqrt(np.diag(bound))
    one, square = (schema.PARAMETER,), (schema.PARAMETER, schema.PARAMETER_COLUMN)
    products = "product of the parameters' units"
    table = {
        "truth": (one, truth, "true value", _MIXED),
        "mean": (one, mean, "mean of the estimates", _MIXED),
        "bias": (one, mean - truth, "mean of the estimates less the truth", _MIXED),
        "bias_standard_error": (
            one,
            sd / np.sqrt(max(len(found), 1)),
            "standard error of the bias",
            _MIXED,
        ),
        schema.SD: (one, sd, "standard deviation of the estimates", _MIXED),
        "expected_sd": (
            one,
            np.sqrt(np.diag(expected)),
            "standard deviation by linearisation",
            _MIXED,
        ),
        "bound_sd": (one, bound_sd, "least standard deviation (Cramér and Rao)", _MIXED),
        schema.COVARIANCE: (square, covariance, "covariance of the estimates", products),
        "expected_covariance": (square, expected, "covariance by linearisation", products),
        "bound": (square, bound, "least covariance (Cramér and Rao)", products),
        "efficiency": (one, bound_sd**2 / sd**2, "variance of the bound over that found", "1"),
    }
    return {name: _variable(*item) for name, item in table.items()}


def _variable(dims: tuple[str, ...], values: NDArray[Any], name: str, unit: str) -> xr.Variable:
    return xr.Variable(dims, values, {schema.LONG_NAME: name, schema.UNITS: unit})


def sampling_text(data: xr.Dataset) -> str:
    """Bias and scatter against theory, one line a parameter.

    Parameters
    ----------
    data : xarray.Dataset
        The group ``sampling_distribution``.
    """
    head = [
        "parameter",
        "truth",
        "bias",
        "± se",
        "bias/sd",
        "sd",
        "expected",
        "bound",
        "efficiency",
    ]
    rows = []
    for name in data[schema.PARAMETER].values:
        one = data.sel({schema.PARAMETER: name})
        value = {key: float(one[key]) for key in one.data_vars if one[key].ndim == 0}
        cells = [
            f"{value['truth']:.6g}",
            f"{value['bias']:.2e}",
            f"{value['bias_standard_error']:.1e}",
        ]
        cells += [f"{value['bias'] / value['sd']:.3f}", f"{value['sd']:.4g}"]
        cells += [f"{value['expected_sd']:.4g}", f"{value['bound_sd']:.4g}"]
        rows.append([str(name), *cells, f"{value['efficiency']:.3f}"])
    about = data.attrs
    end = (
        f"{about['method']}, {about['converged']} of {about['replications']} replications converged"
    )
    text = f"{columns(head, rows)}\n{end}, {about['iterations']:.1f} iterations on average"
    held = about.get("held", "")
    return f"{text}\nheld at the truth, so that noise alone scatters: {held}" if held else text
