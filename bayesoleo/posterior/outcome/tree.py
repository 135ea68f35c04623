"""Samples as the labelled groups of the result's tree."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from bayesoleo.model.correlated import sample_of
from bayesoleo.model.priors import Prior
from bayesoleo.posterior.density.log_density import LOG_VARIANCE, LogDensity
from bayesoleo.posterior.sampling.samples import Samples
from bayesoleo.posterior.sampling.segment import REASONS

#: Chains and draws of the prior's group.
PRIOR_CHAINS, PRIOR_DRAWS = 4, 500


def to_datasets(
    samples: Samples,
    priors: Sequence[Prior],
    *,
    units: Mapping[str, str] | None = None,
    long_names: Mapping[str, str] | None = None,
    seed: int = 0,
    density: LogDensity | None = None,
) -> dict[str, xr.Dataset]:
    """Groups ``posterior``, ``prior``, ``sample_stats``, ``log_likelihood`` and ``log_prior``.

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
    density : LogDensity, optional
        What was sampled: gives the prior of all quantities that have a proper one, not only of the
        parameters, and the group ``log_prior``, by which ArviZ scales the prior.

    Returns
    -------
    dict of str to xarray.Dataset
        By group name, dims ``chain``, ``draw`` and ``run``; ready for
        ``xarray.DataTree.from_dict``.
    """
    about = _About(units or {}, long_names or {}, density)
    rng = np.random.default_rng(seed)
    groups = {
        "posterior": _posterior(samples, about),
        "sample_stats": _sample_stats(samples),
        "log_likelihood": _log_likelihood(samples),
    }
    if density is None:
        draws = sample_of(priors, rng, PRIOR_CHAINS * PRIOR_DRAWS)
        return groups | {
            "prior": _prior(dict(zip(samples.parameters, draws.T, strict=True)), about)
        }
    groups["posterior"].attrs["error_model"] = density.errors.word
    draws = density.unknowns.sample_prior(rng, PRIOR_CHAINS * PRIOR_DRAWS)
    table = dict(zip(density.unknowns.names, draws.T, strict=True))
    table |= density.errors.sample_prior(rng, PRIOR_CHAINS * PRIOR_DRAWS)
    return groups | {"prior": _prior(table, about), "log_prior": _log_prior(samples, density)}


@dataclass(frozen=True)
class _About:
    """Units and names of what is stored."""

    units: Mapping[str, str]
    long_names: Mapping[str, str]
    density: LogDensity | None

    def attributes(self, name: str) -> dict[str, str]:
        """Of a quantity of the posterior."""
        quantity = None
        if self.density is not None:
            quantity = next((q for q in self.density.errors.quantities if q.name == name), None)
        if quantity is not None:
            output = next((o for o in self.units if f"_{o}" in name), "")
            unit = quantity.unit.format(self.units.get(output, "1"))
            return {"units": unit, "long_name": quantity.long_name}
        if name.startswith(LOG_VARIANCE):
            output = name.removeprefix(LOG_VARIANCE)
            what = self.long_names.get(output, output)
            text = f"logarithm of the error variance of {what}"
            return {"units": f"ln(({self.units.get(output, '1')})^2)", "long_name": text}
        return {
            "units": self.units.get(name, "1"),
            "long_name": self.long_names.get(name, name),
        }


def _coordinates(samples: Samples) -> dict[str, object]:
    chains, draws = samples.log_density.shape
    return {
        "chain": np.arange(chains),
        "draw": np.arange(draws),
        "ensemble": ("chain", samples.ensemble),
    }


def _posterior(samples: Samples, about: _About) -> xr.Dataset:
    variables = {
        name: (("chain", "draw"), samples.draws[:, :, a], about.attributes(name))
        for a, name in enumerate(samples.names)
    }
    return xr.Dataset(variables, coords=_coordinates(samples))


def _prior(draws: Mapping[str, np.ndarray], about: _About) -> xr.Dataset:
    shape = (PRIOR_CHAINS, PRIOR_DRAWS)
    variables = {
        name: (("chain", "draw"), column.reshape(shape), about.attributes(name))
        for name, column in draws.items()
    }
    coords = {"chain": np.arange(PRIOR_CHAINS), "draw": np.arange(PRIOR_DRAWS)}
    return xr.Dataset(variables, coords=coords)


def _log_prior(samples: Samples, density: LogDensity) -> xr.Dataset:
    """Log prior densities in the quantities' own units, where they are proper."""
    chains, draws, dimension = samples.draws.shape
    flat = samples.draws.reshape(-1, dimension)
    size = len(density.unknowns.names)
    found = density.unknowns.natural_log_prior(flat[:, :size])
    for k, quantity in enumerate(density.errors.quantities):
        if quantity.prior is not None:
            found[quantity.name] = quantity.prior.log_density(flat[:, size + k])
    variables = {
        name: (
            ("chain", "draw"),
            np.asarray(values).reshape(chains, draws),
            {"units": "1", "long_name": f"log prior density of {name}"},
        )
        for name, values in found.items()
    }
    return xr.Dataset(variables, coords=_coordinates(samples))


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
    attributes["branch_jumps"] = samples.branch_jumps
    attributes["reached"] = int(samples.reached)  # netCDF has no truth values
    attributes["warning"] = samples.warning
    about = {"units": "1", "long_name": "log posterior density over coordinates without bounds"}
    variables: dict[str, object] = {"lp": (("chain", "draw"), samples.log_density, about)}
    coordinates = _coordinates(samples)
    if len(samples.failed):
        about = {"units": "1", "long_name": "proposals of density zero on the way to a draw"}
        variables["failed"] = (("draw", "reason"), samples.failed, about)
        coordinates = {**coordinates, "reason": list(REASONS)}
    return xr.Dataset(variables, coords=coordinates, attrs=attributes)


def _log_likelihood(samples: Samples) -> xr.Dataset:
    about = {"units": "1", "long_name": "log-likelihood of each run"}
    coords = {**_coordinates(samples), "run": list(samples.runs)}
    variables = {"runs": (("chain", "draw", "run"), samples.log_likelihood, about)}
    return xr.Dataset(variables, coords=coords)
