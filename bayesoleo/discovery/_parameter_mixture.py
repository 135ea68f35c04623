"""Posterior of one parameter as a mixture of normal and log-normal densities, and of draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize
from scipy.special import ndtr, ndtri

from bayesoleo._types import Array, Flags
from bayesoleo.discovery._structures import AveragedParameter

#: Tail outside a central interval of 90 %, on each side.
TAIL = 0.05
#: Points that stand for a density.
POINTS = 128


@dataclass(frozen=True)
class Mixture:
    """Normal and log-normal densities of one parameter, and draws.

    Parameters
    ----------
    weight, mean, sd : ndarray, shape (m,)
        Deviations are zero for draws.
    logarithmic : ndarray of bool, shape (m,)
        Where mean and deviation are those of the logarithm.
    """

    weight: Array
    mean: Array
    sd: Array
    logarithmic: Flags

    @classmethod
    def of(cls, parts: Sequence[Mixture]) -> Mixture:
        """Several as one, of unit weight."""
        rows = [[p.weight, p.mean, p.sd, p.logarithmic] for p in parts]
        weight, mean, sd, logarithmic = (
            np.concatenate(column) for column in zip(*rows, strict=True)
        )
        return cls(weight / weight.sum(), mean, sd, logarithmic)

    def scaled(self, factor: float) -> Mixture:
        """With all weights times a factor."""
        return replace(self, weight=factor * self.weight)

    def summary(self) -> AveragedParameter:
        """Moments, interval and median."""
        first, second = self._moments()
        centre = float(self.weight @ first)
        spread = float(np.sqrt(self.weight @ (second + (first - centre) ** 2)))
        low, high, middle = (self.quantile(chance) for chance in (TAIL, 1.0 - TAIL, 0.5))
        return AveragedParameter(centre, spread, low, high, middle)

    def _moments(self) -> tuple[Array, Array]:
        """Means and variances of the parameter in each part."""
        with np.errstate(over="ignore"):
            grown = np.exp(np.where(self.logarithmic, self.mean + 0.5 * self.sd**2, 0.0))
            wide = np.expm1(np.where(self.logarithmic, self.sd**2, 0.0)) * grown**2
        first = np.where(self.logarithmic, grown, self.mean)
        return first, np.where(self.logarithmic, wide, self.sd**2)

    def values(self) -> tuple[Array, Array]:
        """Weights and values of points that stand for all parts."""
        scores = ndtri((np.arange(POINTS) + 0.5) / POINTS)
        scores = scores if self.sd.any() else scores[:1]  # draws stand for themselves
        places = self.mean[:, None] + self.sd[:, None] * scores
        flags = np.broadcast_to(self.logarithmic[:, None], places.shape)
        with np.errstate(over="ignore"):
            places = np.where(flags, np.exp(np.where(flags, places, 0.0)), places)
        weights = np.broadcast_to(self.weight[:, None] / scores.size, places.shape)
        return weights.ravel(), places.ravel()

    def changed(self, plain: Mixture, values: Array) -> Mixture:
        """What becomes of it by the change that turns another mixture into values (n,) of equal
        probability: each quantile of the other turns into one of the values."""
        weight, place = plain.values()
        order = np.argsort(place)
        weight, place = weight[order] / weight.sum(), place[order]
        own, here = self.values()
        level = np.interp(here, place, np.cumsum(weight) - 0.5 * weight)
        return part_of(own, np.quantile(values, np.clip(level, 0.0, 1.0)), 0.0, False)

    def quantile(self, chance: float) -> float:
        """Value below which the parameter lies with a probability."""
        if not self.weight.all():
            kept = self.weight > 0.0
            parts = self.weight[kept], self.mean[kept], self.sd[kept], self.logarithmic[kept]
            return Mixture(*parts).quantile(chance)
        ends = self.mean + self.sd * float(ndtri(chance))
        ends = np.where(self.logarithmic, np.exp(np.where(self.logarithmic, ends, 0.0)), ends)
        low, high = float(ends.min()), float(ends.max())
        if not low < high:
            return low
        # Parameters range over twelve decades, and so do some that are known to a decade only.
        # Within one, a straight scale has all digits.
        stretched = bool(self.logarithmic.all()) or (low > 0.0 and high > 10.0 * low)

        def at(part: float) -> float:
            if stretched:
                return float(low * (high / low) ** part)
            return float(low + part * (high - low))

        if self._below(low) >= chance:  # round-off, and draws
            return low
        if self._below(high) <= chance:
            return high
        found = optimize.brentq(lambda part: self._below(at(part)) - chance, 0.0, 1.0)
        return at(float(found))

    def _below(self, value: float) -> float:
        """Probability of less than a value, or of it."""
        with np.errstate(divide="ignore", invalid="ignore"):
            place = np.where(self.logarithmic, np.log(max(value, 0.0)), value)
            away = (place - self.mean) / self.sd
        return float(self.weight @ np.where(self.sd > 0.0, ndtr(away), place >= self.mean))


def part_of(weight: Array | float, mean: Array | float, sd: float, logarithmic: bool) -> Mixture:
    """A part of one density, or of draws."""
    place = np.atleast_1d(mean)
    weights = np.broadcast_to(weight, place.shape)
    return Mixture(weights, place, np.full(place.size, sd), np.full(place.size, logarithmic))
