r"""Posterior of parameters whose likelihood is normal, under the priors that they have.

A structure gives normal densities of the parameters, or of their logarithms where a prior has
nothing below zero. The priors in it are normal in the same coordinates. That is all where data
determine a parameter well within its support. Elsewhere the normal part of a prior is taken off
again, and what is left, the likelihood, is multiplied by the prior itself. Parameters are drawn one
after the other, each from the likelihood given those before times its own prior, with the weight of
the integral of both.

Where a logarithm is known to a tenth at best, it matters in which coordinate the likelihood is
normal. Outputs are linear in a force's size, hardly change with a slope that is steep already, and
are linear in the logarithm of neither. That coordinate is

.. math:: v = \frac{(\theta/\theta_a)^\lambda - 1}{\lambda},
   \qquad \lambda = 1 + \frac{d \ln |\partial y / \partial \theta|}{d \ln \theta},

with the change of the sensitivity towards the posterior; :math:`\lambda = 0` is the logarithm.

References
----------
Geweke (1991); Keane (1994), *Econometrica* 62(1), 95-116, for draws one after the other. Box and
Cox (1964), *Journal of the Royal Statistical Society B* 26(2), eq. 1.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp, ndtr, ndtri

from bayesoleo._types import Array, Flags, Integers
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.estimation._problem import Evaluation, undisturbed
from bayesoleo.estimation._sensitivity import quantile
from bayesoleo.model._correlated_priors import Correlated
from bayesoleo.model._priors import LogNormal, Normal, Prior

#: Standard deviations of a logarithm, and of a parameter over that of its prior, from which on it
#: matters what the prior is, and in which coordinate the likelihood is normal.
ROUGH = 0.1
#: Standard deviations beyond which nothing of a normal density lies.
REACH = 6.0
#: Part of a prior's precision that stays where the rest is taken off: without it the likelihood of
#: what data say nothing of would have no width.
FLAT = 1e-6
#: Powers between which a coordinate lies, and steps of a logarithm by which its power is found.
POWERS, STEPS = (-1.0, 1.0), (0.1, 5.0)
#: Places at which a density of one parameter is computed: by its likelihood, and by its prior.
PLACES = 96
#: A power so near to zero is the logarithm, and a parameter so near to zero is zero.
_ZERO, _TINY = 1e-6, 1e-300
#: Logarithm of the largest density over one that is as good as zero.
_FALL = 700.0


@dataclass(frozen=True)
class Coordinates:
    """Coordinates of parameters, in which their likelihood is normal.

    Parameters
    ----------
    priors : tuple of Prior, length l
    theta : ndarray, shape (l,)
        Parameters about which outputs were linearised.
    logarithmic : ndarray of bool, shape (l,)
        Which coordinates are logarithms.
    centre, spread : ndarray, shape (l,)
        Of the normal part of each prior, in its coordinate.
    power : ndarray, shape (l,)
        Of what is logarithmic: zero for the logarithm itself.
    """

    priors: tuple[Prior, ...]
    theta: Array
    logarithmic: Flags
    centre: Array
    spread: Array
    power: Array

    @classmethod
    def of(cls, priors: Sequence[Prior], theta: Array, unit: Array, offset: Array) -> Coordinates:
        """About an estimate.

        Parameters
        ----------
        priors : sequence of Prior, length l
        theta : ndarray, shape (l,)
        unit : ndarray, shape (l,)
            Standard deviations of the normal parts of the priors, in units of the parameters.
        offset : ndarray, shape (l,)
            Their centres, from the estimate, over these.
        """
        positive = [p.support[0] >= 0.0 and not isinstance(p, Correlated) for p in priors]
        logarithmic = np.array(positive, dtype=bool) & (theta > 0.0)
        logs = np.log(np.where(logarithmic, theta, 1.0))
        spread = unit / np.where(logarithmic, theta, 1.0)
        place = np.where(logarithmic, logs, theta)
        power = np.zeros(theta.size)
        return cls(tuple(priors), theta, logarithmic, place + spread * offset, spread, power)

    @property
    def place(self) -> Array:
        """Coordinates (l,) of the parameters about which outputs were linearised."""
        logs = np.log(np.where(self.logarithmic, self.theta, 1.0))
        return np.where(self.logarithmic, logs, self.theta)

    @property
    def slope(self) -> Array:
        """Derivatives (l,) of these parameters with respect to their coordinates."""
        return np.where(self.logarithmic, self.theta, 1.0)

    def rough(self, mean: Array, sd: Array) -> Flags:
        """Parameters (l,) whose posterior is not normal in their coordinates, from the moments that
        it has with the normal parts of the priors."""
        poor = np.where(self.logarithmic, sd, sd / self.spread) > ROUGH
        low, high = np.array([prior.support for prior in self.priors]).reshape(-1, 2).T
        with np.errstate(divide="ignore", invalid="ignore"):
            low, high = (np.where(self.logarithmic, np.log(x), x) for x in (low, high))
        reached = (mean - REACH * sd < low) | (mean + REACH * sd > high)
        kinds = [_kind(prior) for prior in self.priors]
        exact = [kind is LogNormal and self.power[k] == 0.0 for k, kind in enumerate(kinds)]
        own = poor & ~np.array([kind in (Normal, Correlated) for kind in kinds]) & ~np.array(exact)
        return np.asarray(own | reached)

    def of_some(self, chosen: Integers) -> Coordinates:
        """Those of some parameters."""
        return Coordinates(
            tuple(self.priors[k] for k in chosen),
            self.theta[chosen],
            self.logarithmic[chosen],
            self.centre[chosen],
            self.spread[chosen],
            self.power[chosen],
        )

    def log_ratio(self, mean: Array, covariance: Array, count: int) -> float:
        """Logarithm of the evidence under the priors over that with their normal parts, by the
        coordinates' posterior with the latter."""
        sd = np.sqrt(np.diag(covariance))
        taken, total = self.rough(mean, sd), 0.0
        if taken.any():
            total = float(logsumexp(self.draws(mean, covariance, count)[1]) - np.log(count))
        for k, prior in enumerate(self.priors):
            if taken[k] or _kind(prior) is Correlated:
                continue
            away = (mean[k] - self.centre[k]) / self.spread[k]
            normal = -0.5 * away**2 - np.log(self.spread[k] * np.sqrt(2 * np.pi))
            total += float(self.log_prior(k, np.array([mean[k]]))[0] - normal)
        return total

    def draws(self, mean: Array, covariance: Array, count: int) -> tuple[Array, Array]:
        """Draws under the priors themselves.

        Parameters
        ----------
        mean : ndarray, shape (l,)
        covariance : ndarray, shape (l, l)
            Of the coordinates' posterior with the normal parts of the priors.
        count : int
            A power of two.

        Returns
        -------
        ndarray, shape (count, l)
            Parameters.
        ndarray, shape (count,)
            Logarithms of weights, whose mean is the evidence over that with the normal parts.
        """
        from scipy.stats import qmc  # as in :func:`_normal_nodes`

        sd = np.sqrt(np.diag(covariance))
        special = self.rough(mean, sd)
        taken = special & ~np.array([_kind(prior) is Correlated for prior in self.priors])
        # In units of the deviations, and away from the mean.
        precision = np.linalg.inv(covariance / np.outer(sd, sd))
        off = np.where(taken, (1.0 - FLAT) * (sd / self.spread) ** 2, 0.0)
        target = -off * (self.centre - mean) / sd
        # What is determined best is drawn first, and stands last in a root of the precision.
        order = np.lexsort((-sd / self.spread, special))
        likelihood = (precision - np.diag(off))[np.ix_(order, order)]
        root = _upper_root(likelihood)
        first = solve_triangular(root, target[order], trans="T")
        normal = np.linalg.slogdet(precision)[1] / 2
        constant = normal + first @ first / 2 - np.log(np.diag(root)).sum()
        parts = 0.5 * off * ((self.centre - mean) / sd) ** 2 + np.log(
            self.spread * np.sqrt(2 * np.pi)
        )
        log = np.full(count, constant + parts[taken].sum())
        uniform = qmc.Sobol(mean.size, seed=0).random(count)
        away = np.zeros((count, mean.size))
        for k in reversed(range(mean.size)):
            name = order[k]
            centre = (first[k] - away[:, k + 1 :] @ root[k, k + 1 :]) / root[k, k]
            if not special[name]:
                away[:, k] = centre + ndtri(uniform[:, k]) / root[k, k]
                continue
            here = mean[name] + sd[name] * centre, sd[name] / root[k, k]
            drawn, part = self._drawn(name, *here, uniform[:, k])
            away[:, k] = (drawn - mean[name]) / sd[name]
            log += part
        place = np.empty_like(away)
        place[:, order] = mean[order] + sd[order] * away
        found = [self.parameter(k, values) for k, values in enumerate(place.T)]
        return np.stack(found, axis=1), log

    def _drawn(self, k: int, centre: Array, sd: float, uniform: Array) -> tuple[Array, Array]:
        """Draws of a coordinate from a normal density times its prior, and the logarithms of the
        integrals of both, each (count,)."""
        places = self._places(k)
        own = centre[:, None] + sd * np.linspace(-REACH, REACH, PLACES)
        own = np.clip(own, places[0], places[-1])
        grid = np.sort(
            np.concatenate([own, np.broadcast_to(places, (len(own), places.size))], axis=1), axis=1
        )
        logs = -0.5 * ((grid - centre[:, None]) / sd) ** 2 + self.log_prior(k, grid)
        logs = np.where(np.isnan(logs), -np.inf, logs)
        return _by_cells(grid, logs, uniform, np.log(sd * np.sqrt(2 * np.pi)))

    def _places(self, k: int) -> Array:
        """Coordinates at which a prior changes, from the lowest to the highest, in rising order."""
        prior = self.priors[k]
        values = _quantiles(prior)
        ends = [end for end in prior.support if np.isfinite(end)]
        if self.logarithmic[k]:
            ends = [end for end in ends if end > 0.0]
        return np.unique(self.coordinate(k, np.concatenate([values, ends])))

    def log_prior(self, k: int, place: Array) -> Array:
        """Logarithm of the density of a prior over its coordinate, any shape."""
        prior, value = self.priors[k], self.parameter(k, place)
        if _kind(prior) is Correlated:  # its density is in the precision, its limits are not
            low, high = prior.support
            return np.where((value >= low) & (value <= high), 0.0, -np.inf)
        flat = np.ascontiguousarray(value).ravel()
        with np.errstate(divide="ignore", invalid="ignore"):
            log = prior.log_density(flat).reshape(place.shape)
            if not self.logarithmic[k]:
                return log
            # d theta / d v = theta (theta / theta_a)**-power
            ratio = np.log(np.maximum(value, _TINY)) - np.log(self.theta[k])
            return np.asarray(log + np.log(self.theta[k]) + (1.0 - self.power[k]) * ratio)

    def parameter(self, k: int, place: Array) -> Array:
        """A parameter at coordinates, any shape."""
        if not self.logarithmic[k]:
            return place
        power, away = self.power[k], place - self.place[k]
        with np.errstate(over="ignore", divide="ignore"):
            if abs(power) < _ZERO:
                return np.asarray(self.theta[k] * np.exp(away))
            grown = np.maximum(1.0 + power * away, _TINY)
            return np.asarray(self.theta[k] * grown ** (1.0 / power))

    def coordinate(self, k: int, value: Array) -> Array:
        """A coordinate of parameters, any shape."""
        if not self.logarithmic[k]:
            return value
        power, log = self.power[k], np.log(value / self.theta[k])
        bent = log if abs(power) < _ZERO else np.expm1(power * log) / power
        return np.asarray(self.place[k] + bent)

    def parameters(self, place: Array) -> Array:
        """Parameters (l,) at coordinates (l,)."""
        power, away = self.power, place - self.place
        with np.errstate(over="ignore", invalid="ignore"):
            flat = np.abs(power) < _ZERO
            grown = np.maximum(1.0 + power * away, _TINY) ** (1.0 / np.where(flat, 1.0, power))
            factor = np.where(flat, np.exp(np.where(self.logarithmic, away, 0.0)), grown)
        return np.where(self.logarithmic, self.theta * factor, place)

    def moves(self, value: Array) -> Array:
        """Coordinates (l,) of parameters (l,) less those about which outputs were linearised."""
        with np.errstate(divide="ignore", invalid="ignore"):
            log = np.log(np.where(self.logarithmic, value, 1.0) / self.theta)
            flat = np.abs(self.power) < _ZERO
            bent = np.expm1(self.power * log) / np.where(flat, 1.0, self.power)
        return np.where(self.logarithmic, np.where(flat, log, bent), value - self.theta)


def _by_cells(grid: Array, logs: Array, uniform: Array, unit: float) -> tuple[Array, Array]:
    """Draws (count,) from densities whose logarithms are straight lines between places
    ``(count, places)``, and the logarithms of their integrals less that of a unit."""
    top = np.max(logs, axis=1, keepdims=True)
    away = logs - np.where(np.isfinite(top), top, 0.0)
    # A density that is zero on one side only falls to what is as good as zero.
    away = np.maximum(away, -_FALL)
    rise = np.diff(away, axis=1)
    level = np.abs(rise) < _ZERO
    cells = np.exp(away[:, :-1]) * np.diff(grid, axis=1)
    cells *= np.where(level, 1.0, np.expm1(rise) / np.where(level, 1.0, rise))
    sums = np.cumsum(cells, axis=1)
    wanted, row = uniform * sums[:, -1], np.arange(len(grid))
    cell = np.sum(sums < wanted[:, None], axis=1).clip(max=cells.shape[1] - 1)
    before = np.where(cell > 0, sums[row, cell - 1], 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.clip(np.nan_to_num((wanted - before) / cells[row, cell]), 0.0, 1.0)
        # The inverse of the integral of an exponential function over a part of a cell.
        steep, own = np.where(level, 1.0, rise)[row, cell], level[row, cell]
        share = np.where(own, part, np.log1p(part * np.expm1(steep)) / steep)
        total = top[:, 0] + np.log(sums[:, -1]) - unit
    drawn = grid[row, cell] + np.clip(share, 0.0, 1.0) * (grid[row, cell + 1] - grid[row, cell])
    return drawn, total


def _quantiles(prior: Prior) -> Array:
    """Values of a prior at even normal scores; of some priors they are those of draws, and are
    therefore kept."""
    return _kept_quantiles(prior) if isinstance(prior, Hashable) else _quantiles_of(prior)


def _quantiles_of(prior: Prior) -> Array:
    return np.asarray(quantile(prior, ndtr(np.linspace(-REACH, REACH, PLACES))))


@lru_cache(maxsize=64)
def _kept_quantiles(prior: Hashable) -> Array:
    return _quantiles_of(cast(Prior, prior))


def _kind(prior: Prior) -> type:
    """The class of a prior whose treatment differs from that of a density of any form."""
    kinds = (Normal, LogNormal, Correlated)
    return next((kind for kind in kinds if isinstance(prior, kind)), object)


def _upper_root(matrix: Array) -> Array:
    """Upper triangular root ``R`` with ``R' R`` a precision; where taking priors off has left less
    than round-off, the least that counts."""
    try:
        return np.asarray(np.linalg.cholesky(matrix).T)
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(matrix)
        rows = np.sqrt(np.maximum(values, FLAT * FLAT))[:, None] * vectors.T
        triangle = np.linalg.qr(rows, mode="r")
        sign = np.where(np.diag(triangle) < 0.0, -1.0, 1.0)
        return np.asarray(triangle * sign[:, None])


def powers(fit: ModelFit, names: Sequence[str], shift: Array) -> Array:
    """Powers of parameters in which the outputs of a model are linear.

    Parameters
    ----------
    fit : ModelFit
    names : sequence of str, length l
        Parameters.
    shift : ndarray, shape (l,)
        Of the logarithm of each: where sensitivities are compared with those at the estimate; zero
        for those that are not asked for.

    Returns
    -------
    ndarray, shape (l,)
        Zero for those that are not asked for, and where the model could not be solved.
    """
    problem, theta, found = fit.problem, fit.point.theta, np.zeros(len(names))
    asked = [
        (int(place), problem.names.index(names[int(place)])) for place in np.flatnonzero(shift)
    ]
    if not asked:
        return found
    here = _sizes(problem.evaluate(theta), fit.point.variance)
    for place, k in asked:
        moved = theta.copy()
        moved[k] *= np.exp(shift[place])
        with undisturbed(problem):
            there = _sizes(problem.evaluate(moved), fit.point.variance)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.log(there[k] / here[k])
        if np.isfinite(ratio):
            found[place] = np.clip(1.0 + ratio / shift[place], *POWERS)
    return found


def _sizes(evaluation: Evaluation, variance: Array) -> Array:
    """Changes of the outputs (l,) by a unit of each unknown, in units of the noise."""
    parts = zip(evaluation.sensitivity, variance, strict=True)
    return np.asarray(np.sqrt(sum(np.sum(rows**2, axis=0) / v for rows, v in parts)))
