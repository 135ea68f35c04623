"""Difference of two fits: how much their sums of squares differ by chance.

The noise along the difference of the predictions decides, and not that along each effect: what
both models leave alike says nothing of which is better.

References
----------
Vuong (1989), Econometrica 57(2), 307-333: of two models that are both wrong the likelihood ratio
scatters by the noise along their difference. Burnham and Anderson (2002), Model Selection and
Multimodel Inference, section 2.6: models about as likely as the best.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._types import Array
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._refit import Refit
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._score_tests import inflation_by_estimate
from bayesoleo.discovery._transient_variance import noise_along


@dataclass(frozen=True)
class Undecided:
    """Differences of the sums of squares up to which two models are about as likely.

    Parameters
    ----------
    likely : float
        Twice the logarithm of a ratio of likelihoods, in units of the noise along the difference.
    scatter : float
        Standard errors of the difference where both models are wrong; else zero.
    """

    likely: float
    scatter: float = 0.0

    @property
    def most(self) -> float:
        """The larger of both."""
        return max(self.likely, self.scatter)


def undecided(base: Base, one: Refit, other: Refit) -> Undecided:
    """Differences up to which two estimated effects are about as likely.

    Parameters
    ----------
    base : Base
        What both were estimated against.
    one, other : Refit

    Notes
    -----
    Where the better one leaves more than noise both are wrong, and the difference of their squares
    has the standard deviation ``2 sqrt(noise * length)`` about zero. What is left of a transient is
    noise and error alike; that of periodic runs is known apart, and effects that leave an error
    there are compared by their contributions.
    """
    noise, length = noise_between(base, one.fit, other.fit)
    better, policy = max(one, other, key=lambda item: item.fall), one.policy
    likely = policy.equal_likelihood * noise
    if better.reached or base.fit.all_periodic:
        return Undecided(likely)
    return Undecided(likely, policy.both_wrong_errors * 2.0 * float(np.sqrt(noise * length)))


def noise_between(base: Base, one: ModelFit, other: ModelFit) -> tuple[float, float]:
    """Variance, along the difference of two fits, of what the better one leaves over that of white
    noise of the samples, at least one; and the squared length of the difference in their noise.

    Parameters
    ----------
    base : Base
        Noise of the samples by run.
    one, other : ModelFit
        Of the same runs.

    Returns
    -------
    noise, length : float
        One and zero where the fits do not differ or have no solution.
    """
    rests = [[_left(base, r, fit) for r in range(len(base.runs))] for fit in (one, other)]
    better, worse = sorted(rests, key=lambda left: sum(float(np.sum(part**2)) for part in left))
    changes = [a - b for a, b in zip(better, worse, strict=True)]
    length = sum(float(np.sum(part**2)) for part in changes)
    if not (np.isfinite(length) and length > 0.0):
        return 1.0, 0.0
    along, repeats = 0.0, [record.periodic for record in base.fit.records]
    for change, left, periodic in zip(changes, better, repeats, strict=True):
        along += 0.0 if periodic or not left.any() else noise_along(change, left)
    if any(repeats):
        own = [change * periodic for change, periodic in zip(changes, repeats, strict=True)]
        along += _of_periodic(base, better, own) * sum(float(np.sum(part**2)) for part in own)
    return max(1.0, along / length), length


def _left(base: Base, r: int, fit: ModelFit) -> Array:
    """What a fit leaves of a run, in units of the noise of each output, shape (ny, N)."""
    y = fit.predictions[r].y
    return (fit.predictor.runs[r].measured - y) * base.runs[r].scale.reshape(y.shape)


def _of_periodic(base: Base, left: list[Array], changes: list[Array]) -> float:
    # A score is judged by what remains without the effect's own part.
    pairs = zip(base.runs, left, changes, strict=True)
    runs = [replace(run, residual=(rest + change).ravel()) for run, rest, change in pairs]
    return inflation_by_estimate(replace(base, runs=runs), [c.ravel() for c in changes])[0]
