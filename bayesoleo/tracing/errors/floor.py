"""Whether a residual has come down to its noise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import stats

from bayesoleo.tracing.errors.errors_table import ErrorTable, RunError

#: A ratio to the noise below this is not worth an effect, however surely it is above one.
FLOOR_RATIO = 1.15
#: Probability with which noise alone may exceed the limit where samples are few.
FALSE_ALARM = 1e-3


def limit(entries: Sequence[RunError], tests: int = 1) -> float:
    """Ratio that noise alone hardly exceeds, at least :data:`FLOOR_RATIO`.

    The squared ratio of noise is an F variate with the effective numbers of coefficients and of
    free samples as degrees of freedom: where noise is coloured, few coefficients hold most of it.

    Parameters
    ----------
    entries : sequence of RunError
        Over which the ratio is pooled.
    tests : int
        Ratios that are looked at together.
    """
    # The pooled squared ratio is a mean over entries: variances of F variates add up.
    size = len(entries)
    coefficients = size**2 / sum(1.0 / entry.coefficients for entry in entries)
    free = size**2 / sum(1.0 / entry.free for entry in entries)
    noise = math.sqrt(float(stats.f.isf(FALSE_ALARM / tests, coefficients, free)))
    return max(FLOOR_RATIO, noise)


def is_at_floor(table: ErrorTable) -> bool:
    """Whether every output, pooled over each role and in each run, is down to its noise.

    A run that could not be solved is not.
    """
    entries = table.entries
    for role in {entry.role for entry in entries}:
        for output in table.outputs:
            chosen = [e for e in entries if e.role == role and e.output == output]
            pooled = float(np.sqrt(np.mean([entry.ratio**2 for entry in chosen])))
            if not pooled < limit(chosen):
                return False
    return all(entry.ratio < limit([entry], len(entries)) for entry in entries)
