"""How much the posterior leans on the prior, without sampling it again."""

from __future__ import annotations

import numpy as np
import xarray as xr

from bayesoleo import schema
from bayesoleo.errors import ResultsError

#: Above this a sensitivity is worth a look (Kallioinen et al. 2024, section 2.4).
THRESHOLD = 0.05


def prior_sensitivity(tree: xr.DataTree) -> xr.Dataset:
    """Sensitivity of every quantity of the posterior to its prior and to its likelihood.

    Prior or likelihood are raised to a power near one; how far each marginal posterior then moves,
    by the distance of its cumulative distributions per doubling of the power, is the sensitivity.

    Parameters
    ----------
    tree : DataTree
        Needs ``posterior``, ``log_prior`` and ``log_likelihood``.

    Returns
    -------
    Dataset
        ``prior(quantity)``, ``likelihood(quantity)`` and ``diagnosis(quantity)``: empty;
        ``prior-data conflict`` where both are above 0.05; ``strong prior or weak data`` where only
        the prior's is.

    Raises
    ------
    ResultsError
        If a group is missing.

    References
    ----------
    Kallioinen, Paananen, Bürkner and Vehtari (2024), "Detecting and diagnosing prior and
    likelihood sensitivity with power-scaling", *Statistics and Computing* 34, eqs. 3-7.
    """
    import arviz_stats as az

    for group in (schema.POSTERIOR, schema.LOG_PRIOR, schema.LOG_LIKELIHOOD):
        if group not in tree.children:
            raise ResultsError(f"needs the group {group!r}", hint="sample the posterior first")
    found = {group: az.psense(tree, group=group) for group in ("prior", "likelihood")}
    names = [str(name) for name in tree[schema.POSTERIOR].data_vars]
    values = {
        group: np.array([float(data[name]) for name in names]) for group, data in found.items()
    }
    leans = values["prior"] > THRESHOLD
    words = np.where(values["likelihood"] > THRESHOLD, "prior-data conflict", _WEAK)
    data = {
        group: (
            schema.QUANTITY,
            array,
            {schema.UNITS: "1", schema.LONG_NAME: f"sensitivity to the {group}"},
        )
        for group, array in values.items()
    }
    return xr.Dataset(
        {**data, "diagnosis": (schema.QUANTITY, np.where(leans, words, ""))},
        coords={schema.QUANTITY: names},
    )


_WEAK = "strong prior or weak data"
