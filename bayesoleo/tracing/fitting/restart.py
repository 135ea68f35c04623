"""Other starts for a fit that leaves more than is expected: a wrong optimum is no missing effect.

Where a resonance lies between the frequencies that were driven, the sum of squares has an optimum
on either side of each, and an estimate ends in the one that it starts near.
"""

from __future__ import annotations

from dataclasses import replace

from bayesoleo._types import Array
from bayesoleo.tracing.fitting.fit import Fit, Numerics, fit_model
from bayesoleo.tracing.fitting.other_starts import promising


def better_start(fit: Fit, numerics: Numerics) -> Array | None:
    """Unknowns from which the estimate ends higher than it did.

    Parameters
    ----------
    fit : Fit
        That leaves more than is expected.
    numerics : Numerics

    Returns
    -------
    ndarray, shape (l,), or None
        The better optimum; None where none of those that are reached from draws of the priors is.
    """
    best, height = None, fit.point.objective + numerics.policy.better_optimum_declared
    for start in promising(fit.problem, fit.point.theta, numerics.policy):
        found = fit_model(
            fit.model,
            fit.records,
            replace(numerics, steps=fit.steps),
            start=start,
            tolerance=1e-4,
            max_iterations=30,
            share=fit.predictor,
            check_mesh=False,
        )
        if found.point.status.ok and found.point.objective > height:
            best, height = found.point.theta, found.point.objective
    return best
