"""Samples as the labelled groups of the result's tree."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from bayesoleo.model.correlated import sample_of
from bayesoleo.model.priors import Prior
from bayesoleo.posterior.density import LOG_VARIANCE
from bayesoleo.posterior.samples import Samples

#: Chains and draws of the prior's group.
PRIOR_CHAINS, PRIOR_DRAWS = 4, 500


def to_datasets(
    samples: Samples,
    priors: Sequence[Prior],
    *,
    units: Mapping[str, str] | None = None,
    long_names: Mapping[str, str] | None = None,
    seed: int = 0,
) -> dict[str, xr.Dataset]:
    """Groups ``posterior``, ``prior``, ``sample_stats`` and ``log_likelihood``.

    Parameters
    ----------
    samples : Samples
        Draws of the posterior.
    priors : sequence of Prior
        Of the ``l`` parameters, in the order of ``samples.parameters``.
    units : mapping of str to str, optional
        Unit of each parameter and output (an output's gives that of its variance); ``"1"`` where
        there is none.
    long_names : mapping of str to str, optional
        What each parameter or output is; its name where there is none.
    seed : int
        Seeds the prior's draws.

    Returns
    -------
    dict of str to xarray.Dataset
        By group name, dims ``chain``, ``draw`` and ``run``; ready for
        ``xarray.DataTree.from_dict``.
    """
    units, long_names = units or {}, long_names or {}
    return {
        "posterior": _posterior(samples, units, long_names),
        "prior": _prior(samples.parameters, priors, units, long_names, seed),
        "sample_stats": _sample_stats(samples),
        "log_likelihood": _log_likelihood(samples),
    }


def _coordinates(samples: Samples) -> dict[str, object]:
    chains, draws = samples.log_density.shape
    return {
        "chain": np.arange(chains),
        "draw": np.arange(draws),
        "ensemble": ("chain", samples.ensemble),
    }


def _attributes(
    name: str, units: Mapping[str, str], long_names: Mapping[str, str]
) -> dict[str, str]:
    if not name.startswith(LOG_VARIANCE):
        return {"units": units.get(name, "1"), "long_name": long_names.get(name, name)}
    output = name.removeprefix(LOG_VARIANCE)
    what = long_names.get(output, output)
    unit = units.get(output, "1")
    return {"units": f"ln(({unit})^2)", "long_name": f"logarithm of the error variance of {what}"}


def _posterior(
    samples: Samples, units: Mapping[str, str], long_names: Mapping[str, str]
) -> xr.Dataset:
    variables = {
        name: (("chain", "draw"), samples.draws[:, :, a], _attributes(name, units, long_names))
        for a, name in enumerate(samples.names)
    }
    return xr.Dataset(variables, coords=_coordinates(samples))


def _prior(
    names: Sequence[str],
    priors: Sequence[Prior],
    units: Mapping[str, str],
    long_names: Mapping[str, str],
    seed: int,
) -> xr.Dataset:
    all_draws = sample_of(priors, np.random.default_rng(seed), PRIOR_CHAINS * PRIOR_DRAWS)
    variables = {}
    for name, column in zip(names, all_draws.T, strict=True):
        draws = column.reshape(PRIOR_CHAINS, PRIOR_DRAWS)
        variables[name] = (("chain", "draw"), draws, _attributes(name, units, long_names))
    coords = {"chain": np.arange(PRIOR_CHAINS), "draw": np.arange(PRIOR_DRAWS)}
    return xr.Dataset(variables, coords=coords)


def _sample_stats(samples: Samples) -> xr.Dataset:
    by_name = {
        "autocorrelation_time": samples.autocorrelation_time,
        "effective_sample_size": samples.effective_size,
        "rhat_nested": samples.rhat_nested,
    }
    attributes: dict[str, object] = {
        key: json.dumps(dict(zip(samples.names, values.tolist(), strict=True)))
        for key, values in by_name.items()
    }
    attributes["acceptance"] = json.dumps(samples.acceptance)
    attributes["evaluations"] = samples.evaluations
    attributes["failures"] = json.dumps(samples.failures)
    attributes["reached"] = int(samples.reached)  # netCDF has no truth values
    attributes["warning"] = samples.warning
    about = {"units": "1", "long_name": "log posterior density over coordinates without bounds"}
    variables = {"lp": (("chain", "draw"), samples.log_density, about)}
    return xr.Dataset(variables, coords=_coordinates(samples), attrs=attributes)


def _log_likelihood(samples: Samples) -> xr.Dataset:
    about = {"units": "1", "long_name": "log-likelihood of each run"}
    coords = {**_coordinates(samples), "run": list(samples.runs)}
    variables = {"runs": (("chain", "draw", "run"), samples.log_likelihood, about)}
    return xr.Dataset(variables, coords=coords)
