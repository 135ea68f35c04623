"""The priors as an iteration needs them: a scale for each unknown, a slope and the room left."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesoleo.errors import InputError
from bayesoleo.estimation.problem import Array
from bayesoleo.model.priors import Normal, Prior

# A centred difference over this fraction of the prior's sd is exact for a quadratic log density and
# good to about 1e-8 for the others.
_SLOPE_STEP = 1e-4


@dataclass(frozen=True)
class PriorScale:
    """Unknowns in units of their priors' standard deviations.

    Physical parameters range over twelve decades in SI units; in these units they are of order one.

    Parameters
    ----------
    priors : tuple of Prior, length l
        The priors.
    mean, sd, low, high : ndarray, shape (l,)
        Their moments and the limits of their support.
    """

    priors: tuple[Prior, ...]
    mean: Array
    sd: Array
    low: Array
    high: Array

    @classmethod
    def of(cls, priors: Sequence[Prior], names: Sequence[str]) -> PriorScale:
        """Read the priors once, for asking a distribution for its moments is slow.

        Raises
        ------
        InputError
            If a prior has no finite, positive standard deviation.
        """
        sd = np.array([prior.sd for prior in priors], dtype=float)
        for name, value in zip(names, sd, strict=True):
            if not (np.isfinite(value) and value > 0):
                raise InputError(
                    "prior needs a finite, positive standard deviation",
                    key=name,
                    value=float(value),
                    hint="use Normal(centre, spread) with a wide spread for a weak prior",
                )
        mean = np.array([prior.mean for prior in priors], dtype=float)
        low, high = np.array([prior.support for prior in priors], dtype=float).reshape(-1, 2).T
        return cls(tuple(priors), mean, sd, low, high)

    def inside(self, theta: Array) -> bool:
        """Whether every unknown, shape (l,), lies in its prior's support."""
        return bool(np.all((theta >= self.low) & (theta <= self.high)))

    def room(self, theta: Array) -> tuple[Array, Array]:
        """Scaled distances down and up to the limits of the support, each shape (l,)."""
        return (theta - self.low) / self.sd, (self.high - theta) / self.sd

    def slope(self, theta: Array) -> Array:
        """Derivative of the log prior with respect to the scaled unknowns, shape (l,)."""
        return np.array([self._slope(i, float(value)) for i, value in enumerate(theta)])

    def _slope(self, index: int, value: float) -> float:
        prior, sd = self.priors[index], self.sd[index]
        if isinstance(prior, Normal):
            return float(-(value - self.mean[index]) / sd)
        room = min(value - self.low[index], self.high[index] - value)
        step = min(_SLOPE_STEP * sd, room / 2)
        if step <= 0:  # on the limit itself a one-sided look is all there is, and it is not needed
            return 0.0
        behind, ahead = prior.log_density(np.array([value - step, value + step]))
        return float((ahead - behind) * sd / (2 * step))
