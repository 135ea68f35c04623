"""The coordinates in which an iteration steps: a scale for each unknown, a slope and the room left.

An unknown with a log-normal prior is stepped in its logarithm, all others as they are. Such an
unknown is a positive scale or shape whose prior says that halving it is as likely as doubling it:
in the logarithm that prior is normal, no step leaves the support, and a linear step that would cut
the unknown to a tenth is one of moderate length.

Only the steps are in these coordinates. The objectives stay functions of the unknown itself, with
``Prior.log_density`` the density per unit of the unknown, so the maximum-likelihood point and the
mode of ``Phi_B`` do not depend on them. (The mode of the density per unit of the logarithm, which
is where a sampler's coordinates have theirs, is another point.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array, Bool, Flags, Float
from bayesoleo.errors import InputError
from bayesoleo.model.correlated import Correlated, log_density_of, scaled_root
from bayesoleo.model.priors import LogNormal, Normal, Prior

# A centred difference over this fraction of the prior's sd is exact for a quadratic log density and
# good to about 1e-8 for the others.
_SLOPE_STEP = 1e-4
# Room for one step of a logarithm, of which at most the part 0.9 is taken: a factor of six. Where
# an unknown sets a scale, as in atan(slope * velocity), the sensitivity to its logarithm changes by
# about the factor of the unknown itself, so further away the linear equations know nothing.
_FARTHEST = 2.0


@dataclass(frozen=True)
class PriorScale:
    """Unknowns, or their logarithms, in units of their priors' standard deviations.

    Physical parameters range over twelve decades in SI units; in these units they are of order one.
    These are the scaled unknowns.

    Parameters
    ----------
    priors : tuple of Prior, length l
        The priors.
    mean, sd, low, high : ndarray, shape (l,)
        Their moments and the limits of their support.
    logarithmic : ndarray of bool, shape (l,)
        Which unknowns are stepped in their logarithm.
    spread : ndarray, shape (l,)
        Standard deviation of what is stepped: of the unknown or of its logarithm.
    root : ndarray, shape (l, l)
        Rows ``P`` with ``P'P`` the prior's precision in scaled unknowns: the identity, but for
        unknowns with a joint prior.
    """

    priors: tuple[Prior, ...]
    mean: Float[Array, " unknowns"]
    sd: Float[Array, " unknowns"]
    low: Float[Array, " unknowns"]
    high: Float[Array, " unknowns"]
    logarithmic: Bool[Flags, " unknowns"]
    spread: Float[Array, " unknowns"]
    root: Float[Array, "unknowns unknowns"]

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
        logarithmic = np.array([isinstance(prior, LogNormal) for prior in priors], dtype=bool)
        spread = sd.copy()
        for index, prior in enumerate(priors):
            if isinstance(prior, LogNormal):
                spread[index] = prior.log_spread
        root = scaled_root(priors, sd)
        return cls(tuple(priors), mean, sd, low, high, logarithmic, spread, root)

    def inside(self, theta: Array) -> NDArray[np.bool_]:
        """Which unknowns lie in their prior's support; zero has no logarithm. Shape (..., l)."""
        return (theta >= self.low) & (theta <= self.high) & ~(self.logarithmic & (theta <= 0))

    def unit(self, theta: Array) -> Array:
        """Derivative of each unknown with respect to its scaled one, shape (..., l)."""
        return np.where(self.logarithmic, theta * self.spread, self.spread)

    def moved(self, theta: Array, step: Array) -> Array:
        """Unknowns, shape (..., l), after a step of the scaled ones, shape (..., l)."""
        with np.errstate(over="ignore"):  # the loop refuses what is not finite
            factor = np.exp(np.where(self.logarithmic, self.spread * step, 0.0))
        return np.where(self.logarithmic, theta * factor, theta + self.spread * step)

    def room(self, theta: Array) -> tuple[Array, Array]:
        """Scaled distances down and up to how far one step may go, each shape (..., l).

        To the limits of the support; for a logarithm as far as linear equations are worth anything.
        """
        farthest = _FARTHEST / self.spread
        down, up = (theta - self.low) / self.sd, (self.high - theta) / self.sd
        return np.where(self.logarithmic, farthest, down), np.where(self.logarithmic, farthest, up)

    def log_density(self, theta: Array) -> Array:
        """Log prior of vectors, shape (L, l), per unit of the unknowns, shape (L,)."""
        return log_density_of(self.priors, theta)

    def slope(self, theta: Array) -> Array:
        """Derivative of the log prior with respect to the scaled unknowns, shape (..., l)."""
        away = (theta - self.mean) / self.sd
        slope = -away @ (self.root.T @ self.root)
        for index, prior in enumerate(self.priors):
            if not isinstance(prior, Normal | Correlated):
                slope[..., index] = self._slope(index, theta[..., index])
        return slope

    def _slope(self, index: int, value: Array) -> Array:
        prior, sd = self.priors[index], self.sd[index]
        if isinstance(prior, LogNormal):  # the density is per unit of the value, hence the second
            spread = prior.log_spread
            return -np.log(value / prior.median) / spread - spread
        room = np.minimum(value - self.low[index], self.high[index] - value)
        step = np.minimum(_SLOPE_STEP * sd, room / 2)
        # on the limit itself a one-sided look is all there is, and it is not needed
        with np.errstate(divide="ignore", invalid="ignore"):
            rise = prior.log_density(value + step) - prior.log_density(value - step)
            return np.where(step > 0, rise * sd / (2 * step), 0.0)
