"""Which parameters did the data say nothing about? Posterior against prior, parameter by parameter.

A narrow interval may be the prior's own. The ratio of posterior to prior standard deviation tells:
near one, the data added nothing, and the estimate is what was put in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr

from bayesoleo import schema
from bayesoleo.errors import InputError
from bayesoleo.estimation.estimators.point import PointEstimate
from bayesoleo.model import Model, Prior

#: Ratio above which the data count as silent: the posterior is within 5 % as wide as the prior.
SILENT = 0.95


def data_against_prior(
    sd: Mapping[str, float] | PointEstimate,
    priors: Mapping[str, Prior] | Sequence[Prior],
    *,
    model: Model | None = None,
    silent: float = SILENT,
) -> xr.Dataset:
    """How much narrower the data made what was known of each parameter.

    Parameters
    ----------
    sd : mapping of str to float, or PointEstimate
        Posterior standard deviations by name, from an estimate or from draws.
    priors : mapping of str to Prior, or sequence of Prior
        Of the same parameters; a sequence in the estimate's order.
    model : Model, optional
        Its constants that are known to a tolerance and were not estimated are listed too: they were
        not asked.
    silent : float, optional
        Ratio from which on the data are said to add nothing.

    Returns
    -------
    xarray.Dataset
        ``prior_sd``, ``posterior_sd``, ``ratio``, ``said_nothing`` (parameter); the attribute
        ``statement`` says it in a sentence.

    Raises
    ------
    InputError
        If a parameter has no prior here.
    """
    found = dict(zip(sd.names, sd.sd, strict=True)) if isinstance(sd, PointEstimate) else dict(sd)
    known = priors if isinstance(priors, Mapping) else dict(zip(found, priors, strict=True))
    for name in found:
        if name not in known:
            raise InputError("no prior is given for this parameter", key=name)
    prior_sd = {name: known[name].sd for name in found}
    parameters = {} if model is None else {n: model.parameters[n] for n in model.uncertain()}
    absent = [name for name in parameters if name not in found]
    held = [*(sd.known if isinstance(sd, PointEstimate) else ()), *absent]
    for name in absent:
        prior = parameters[name].prior
        assert prior is not None
        found[name] = prior_sd[name] = prior.sd
    width = np.array([prior_sd[name] for name in found])
    ratio = np.array(list(found.values())) / width
    quiet = ratio >= silent
    return xr.Dataset(
        {
            "prior_sd": (schema.PARAMETER, width),
            "posterior_sd": (schema.PARAMETER, list(found.values())),
            "ratio": (schema.PARAMETER, ratio),
            "said_nothing": (schema.PARAMETER, quiet),
        },
        coords={schema.PARAMETER: list(found)},
        attrs={"statement": _statement(found, quiet, held)},
    )


def _statement(names: Mapping[str, float], quiet: np.ndarray, held: Sequence[str]) -> str:
    silent = [n for n, flag in zip(names, quiet, strict=True) if flag and n not in held]
    parts = []
    if silent:
        parts.append(f"the data add nothing to the prior of {', '.join(silent)}")
    if held:
        parts.append(f"{', '.join(held)} was held, known to its tolerance only")
    return "; ".join(parts) if parts else "the data add to the prior of every parameter"
