r"""Parameters that scatter between runs: their population mean and spread, sampled with the runs.

In unbounded coordinates a parameter of run :math:`\kappa` is

.. math:: u_\kappa \sim N(\mu, s^2),

with the parameter's own prior for the mean :math:`\mu`, and a half-normal prior for the spread
:math:`s` whose scale is the standard deviation of that prior. For a parameter without bounds
:math:`s` is in its unit; with one bound it is the spread of the logarithm of the distance to that
bound, with two bounds that of the logit.

The centred form correlates the runs' values with the mean when :math:`s` is small, the non-centred
form correlates their deviations when :math:`s` is large. The coordinates therefore depend on the
estimate of each run. Where run :math:`\kappa` alone, given the parameters that all runs share,
gives :math:`\hat u_\kappa \pm \sigma_\kappa`,

.. math::

    u_\kappa = \frac{s^2 \hat u_\kappa + \sigma_\kappa^2 \mu}{s^2 + \sigma_\kappa^2}
               + \frac{s \sigma_\kappa}{\sqrt{s^2 + \sigma_\kappa^2}}\, z_\kappa ,

and likewise :math:`\mu` is its conditional mean given :math:`s` plus a multiple of its conditional
standard deviation. For a linear model with normal errors all :math:`z` are then independent and
standard normal for every :math:`s`: centred where the data are strong, non-centred where they are
weak, and in between otherwise. The coordinate of the spread is the normal quantile of a half-Cauchy
distribution function. In it both tails of the spread, flat at zero and a power law at infinity,
are like those of a normal. The posterior does not depend on the numbers :math:`\hat u` and
:math:`\sigma`; only the efficiency of sampling does.

References
----------
Gelman et al. (2013), *Bayesian Data Analysis*, third edition, section 5.4 (the conditional means
and variances). Papaspiliopoulos, Roberts and Sköld (2007), "A general framework for the
parametrization of hierarchical models", *Statistical Science* 22, section 4 (between centred and
not). Gelman (2006), "Prior distributions for variance parameters in hierarchical models",
*Bayesian Analysis* 1, section 2.2 (half-normal).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np
from scipy.special import ndtr, ndtri

from bayesoleo import _schema as schema
from bayesoleo._types import Array, Integers
from bayesoleo.error_models._base import ErrorModel
from bayesoleo.error_models._registry import error_model
from bayesoleo.errors import InputError
from bayesoleo.estimation._problem import EstimationProblem
from bayesoleo.model._priors import Prior, Transform
from bayesoleo.posterior._log_density import PlainUnknowns, Unknowns, information_at, residuals_at

_HALF_NORMAL = 0.5 * float(np.log(2 / np.pi))
_LOG_SQRT_2_PI = 0.5 * float(np.log(2 * np.pi))
#: A start's spread is at least this part of its prior's scale.
_LEAST_SPREAD = 0.02
# Step of central differences over coordinates of about unit spread.
_STEP = 1e-4


@dataclass(frozen=True)
class Population:
    """One parameter's values in the runs, and their common distribution.

    Parameters
    ----------
    name : str
        The parameter's.
    members : ndarray of int, shape (N,)
        Places of the runs' values among the unknowns.
    prior : Prior
        Of the mean, in the parameter's unit.
    centres, sds : ndarray, shape (N,)
        Estimate of each run's value from that run alone, in unbounded coordinates.
    slopes : ndarray, shape (N, k)
        How the centres move with the coordinates of the ``k`` shared unknowns ...
    common : ndarray, shape (k,)
        ... from these.
    """

    name: str
    members: Integers
    prior: Prior
    centres: Array
    sds: Array
    slopes: Array
    common: Array

    def conditional_centres(self, shared: Array) -> Array:
        """Centres, shape (W, N), given coordinates of the shared unknowns, shape (W, k)."""
        centres = np.repeat(self.centres[None], len(shared), axis=0)
        for k, place in enumerate(self.common):
            away = shared[:, k] - place
            for run, slope in enumerate(self.slopes[:, k]):
                centres[:, run] += slope * away
        return centres

    @cached_property
    def transform(self) -> Transform:
        """From coordinates without bounds to the parameter's unit."""
        return Transform(*self.prior.support)

    @cached_property
    def middle(self) -> float:
        """The prior's mean, in coordinates without bounds."""
        return float(self.transform.unbounded(np.array([self.prior.mean]))[0])

    @cached_property
    def typical(self) -> float:
        """Spread suggested by the runs' own estimates, or the smallest that they can resolve."""
        noise = float(np.mean(self.sds**2))
        seen = float(np.var(self.centres, ddof=1)) - noise
        # A variance from N values has a relative error of sqrt(2 / N).
        return float(np.sqrt(max(seen, noise * np.sqrt(2 / self.centres.size))))

    def spread_of(self, w: Array) -> tuple[Array, Array]:
        """Spread, shape (W,), and logarithm of its derivative, from its coordinate."""
        # Computed from the nearer end, so that neither tail is lost to rounding.
        angle = 0.5 * np.pi * ndtr(-np.abs(w))
        tangent = np.tan(angle)
        ratio = np.where(w < 0, tangent, 1.0 / tangent)
        log_normal = -0.5 * w * w - _LOG_SQRT_2_PI
        slope = log_normal + np.log(0.5 * np.pi * self.typical) + np.log1p(ratio * ratio)
        return self.typical * ratio, slope

    def coordinate_of(self, spread: Array) -> Array:
        """Coordinate of spreads, shape (W,)."""
        ratio = spread / self.typical
        tail = 2 / np.pi * np.arctan(np.minimum(ratio, 1.0 / ratio))
        return np.asarray(np.where(ratio < 1, 1.0, -1.0) * ndtri(tail))

    @cached_property
    def scale(self) -> float:
        """Scale of the spread's prior: the parameter's prior sd, in coordinates without bounds."""
        slope = self.transform.derivative(np.array([self.middle]))[0]
        return float(self.prior.sd / abs(slope))

    def mean_given(self, spread: Array, centres: Array) -> tuple[Array, Array]:
        """Mean of ``mu`` given spreads (W,) and centres (W, N), and its standard deviation."""
        precision = np.full(spread.shape, self.scale**-2.0)
        weighted = precision * self.middle
        for centre, sd in zip(centres.T, self.sds, strict=True):
            weight = 1.0 / (sd * sd + spread * spread)
            precision += weight
            weighted += weight * centre
        return weighted / precision, 1.0 / np.sqrt(precision)

    def run_given(self, k: int, mean: Array, spread: Array, centres: Array) -> tuple[Array, Array]:
        """Mean of run ``k``'s value given ``mu`` and spreads (W,), and its standard deviation."""
        own, common = self.sds[k] * self.sds[k], spread * spread
        total = own + common
        middle = (common * centres[:, k] + own * mean) / total
        return middle, self.sds[k] * spread / np.sqrt(total)

    def values(
        self, z: Array, zeta: Array, w: Array, shared: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Runs' values (W, N), mean, spread and log Jacobian (W,) from coordinates."""
        centres = self.conditional_centres(shared)
        spread, stretch = self.spread_of(w)
        middle, width = self.mean_given(spread, centres)
        mean, jacobian = middle + width * zeta, stretch + np.log(width)
        u = np.empty(z.shape)
        for k in range(z.shape[1]):
            middle, width = self.run_given(k, mean, spread, centres)
            u[:, k] = middle + width * z[:, k]
            jacobian = jacobian + np.log(width)
        return u, mean, spread, jacobian

    def coordinates(
        self, u: Array, mean: Array, spread: Array, shared: Array
    ) -> tuple[Array, Array, Array]:
        """``z (W, N)``, ``zeta (W,)`` and ``w (W,)`` of values, mean and spread."""
        centres = self.conditional_centres(shared)
        middle, width = self.mean_given(spread, centres)
        zeta, z = (mean - middle) / width, np.empty(u.shape)
        for k in range(u.shape[1]):
            middle, width = self.run_given(k, mean, spread, centres)
            z[:, k] = (u[:, k] - middle) / width
        return z, zeta, self.coordinate_of(spread)

    def log_prior(self, u: Array, mean: Array, spread: Array) -> Array:
        """Log density, shape (W,), of values and mean without bounds, and of the spread."""
        total = self.prior.log_density(self.transform.natural(mean))
        total = total + self.transform.log_jacobian(mean) + self.log_prior_of_spread(spread)
        for column in u.T:
            away = (column - mean) / spread
            total -= 0.5 * away * away + np.log(spread) + _LOG_SQRT_2_PI
        return np.asarray(total)

    def log_prior_of_spread(self, spread: Array) -> Array:
        """Half-normal."""
        scaled = spread / self.scale
        return np.asarray(_HALF_NORMAL - np.log(self.scale) - 0.5 * scaled * scaled)


@dataclass(frozen=True)
class HierarchicalUnknowns(Unknowns):
    """Unknowns of which some scatter between runs.

    They are the problem's ``l`` unknowns, then mean and spread of each population.

    Parameters
    ----------
    plain : PlainUnknowns
        All unknowns of the problem; the priors of members are those of their population's mean.
    populations : tuple of Population
    """

    plain: PlainUnknowns
    populations: tuple[Population, ...] = ()

    @cached_property
    def _shared(self) -> Integers:
        """Places of the unknowns that belong to no population."""
        taken = np.concatenate([population.members for population in self.populations])
        return np.setdiff1d(np.arange(len(self.plain.labels)), taken)

    @cached_property
    def _rest(self) -> PlainUnknowns:
        labels, priors = self.plain.labels, self.plain.priors
        return PlainUnknowns(
            tuple(labels[k] for k in self._shared), tuple(priors[k] for k in self._shared)
        )

    @property
    def scattering(self) -> tuple[str, ...]:  # type: ignore[override]
        """Names of the populations."""
        return tuple(population.name for population in self.populations)

    @property
    def names(self) -> tuple[str, ...]:
        more = [
            name
            for label in self.scattering
            for name in (schema.population_mean(label), schema.spread(label))
        ]
        return (*self.plain.names, *more)

    def _places(self, k: int) -> tuple[int, int]:
        """Places of mean and spread of population ``k``."""
        first = len(self.plain.labels) + 2 * k
        return first, first + 1

    def _values(self, block: Array, k: int) -> tuple[Array, Array, Array, Array]:
        """Values, mean, spread and log Jacobian of population ``k``."""
        mean, spread = (np.ascontiguousarray(block[:, i]) for i in self._places(k))
        population = self.populations[k]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return population.values(
                block[:, population.members], mean, spread, block[:, self._shared]
            )

    def theta(self, block: Array) -> Array:
        u = np.array(block[:, : len(self.plain.labels)], dtype=float)
        for k, population in enumerate(self.populations):
            u[:, population.members] = self._values(block, k)[0]
        return self.plain.theta(u)

    def natural(self, block: Array) -> Array:
        out = np.empty(np.shape(block))
        out[:, : len(self.plain.labels)] = self.theta(block)
        for k, population in enumerate(self.populations):
            _, mean, spread, _ = self._values(block, k)
            first, second = self._places(k)
            out[:, first], out[:, second] = population.transform.natural(mean), spread
        return out

    def coordinates(self, natural: Array) -> Array:
        out, count = np.empty(np.shape(natural)), len(self.plain.labels)
        out[:, :count] = self.plain.coordinates(natural[:, :count])
        for k, population in enumerate(self.populations):
            first, second = self._places(k)
            mean = population.transform.unbounded(natural[:, first])
            spread = np.ascontiguousarray(natural[:, second])
            u = out[:, population.members]
            shared = out[:, self._shared]
            z, out[:, first], out[:, second] = population.coordinates(u, mean, spread, shared)
            out[:, population.members] = z
        return out

    def log_prior(self, block: Array) -> Array:
        total = np.zeros(len(block))
        if self._shared.size:
            total += self._rest.log_prior(np.ascontiguousarray(block[:, self._shared]))
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for k, population in enumerate(self.populations):
                u, mean, spread, jacobian = self._values(block, k)
                total += population.log_prior(u, mean, spread) + jacobian
        return total

    def natural_log_prior(self, natural: Array) -> dict[str, Array]:
        found = self._rest.natural_log_prior(natural[:, self._shared])
        for k, population in enumerate(self.populations):
            first, second = self._places(k)
            mean, spread = self.names[first], self.names[second]
            found[mean] = population.prior.log_density(natural[:, first])
            found[spread] = population.log_prior_of_spread(natural[:, second])
        return found

    def sample_prior(self, rng: np.random.Generator, size: int) -> Array:
        out = np.empty((size, len(self.names)))
        out[:, self._shared] = self._rest.sample_prior(rng, size)
        for k, population in enumerate(self.populations):
            first, second = self._places(k)
            out[:, first] = population.prior.sample(rng, size)
            out[:, second] = population.scale * np.abs(rng.standard_normal(size))
            mean = population.transform.unbounded(out[:, first])
            for member in population.members:
                u = mean + out[:, second] * rng.standard_normal(size)
                out[:, member] = population.transform.natural(u)
        return out

    def start(self, theta: Array) -> Array:
        theta = np.asarray(theta, dtype=float)
        u = self.plain.start(theta)
        natural = np.concatenate([theta, np.empty(2 * len(self.populations))])
        for k, population in enumerate(self.populations):
            own, (first, second) = u[population.members], self._places(k)
            natural[first] = population.transform.natural(np.array([own.mean()]))[0]
            natural[second] = max(float(own.std(ddof=1)), _LEAST_SPREAD * population.scale)
        return cast(Array, self.coordinates(natural[None])[0])

    def jacobian(self, block: Array) -> Array:
        steps = _STEP * np.eye(len(block))
        ahead, behind = self.theta(block + steps), self.theta(block - steps)
        return np.asarray((ahead - behind).T / (2 * _STEP))

    def precision(self, block: Array) -> Array:
        matrix, shared = np.zeros((len(block), len(block))), self._shared
        if shared.size:
            matrix[np.ix_(shared, shared)] = self._rest.precision(block[shared])
        steps = _STEP * np.eye(len(block))
        for k in range(len(self.populations)):
            # As sums of squares: the runs' deviations, and the mean's from its prior.
            ahead, behind = (self._deviations(block + sign * steps, k) for sign in (1, -1))
            slope = (ahead - behind) / (2 * _STEP)
            matrix += slope @ slope.T
            # The spread's coordinate is about standard normal.
            place = self._places(k)[1]
            matrix[place, place] += 1.0
        return matrix

    def _deviations(self, block: Array, k: int) -> Array:
        """Standardised deviations of population ``k`` from its mean, and of that, (W, N + 1)."""
        u, mean, spread, _ = self._values(block, k)
        population = self.populations[k]
        own = (u - mean[:, None]) / spread[:, None]
        return np.column_stack([own, (mean - population.middle) / population.scale])


def hierarchical(
    problem: EstimationProblem,
    names: Sequence[str],
    *,
    theta: Array | None = None,
    errors: ErrorModel | str = "independent",
) -> HierarchicalUnknowns:
    """Unknowns of a problem whose by-run parameters scatter about an estimated mean.

    Parameters
    ----------
    problem : EstimationProblem
        With unknowns ``name[run]`` for every name. It is evaluated once: freeze its anchor
        afterwards.
    names : sequence of str
        Parameters that scatter.
    theta : ndarray, shape (l,), optional
        An estimate with a value for each run, which gives the centres of the coordinates. The
        posterior does not depend on it, only the number of evaluations. By default the problem's
        start.
    errors : ErrorModel or str, optional
        Says how much the data are worth there.

    Returns
    -------
    HierarchicalUnknowns

    Raises
    ------
    InputError
        If a parameter does not vary by run, there are fewer than three runs, or the problem cannot
        be evaluated.
    """
    plain = PlainUnknowns(tuple(problem.names), tuple(problem.priors))
    members = {name: _members(problem, name) for name in dict.fromkeys(names)}
    theta = np.asarray(problem.start if theta is None else theta, dtype=float)
    model = error_model(errors, problem) if isinstance(errors, str) else errors
    eta = model.start(residuals_at(problem, model, theta))
    units = plain.transforms.derivative(plain.start(theta)[None])[0]
    information = information_at(problem, model, theta, eta) * np.outer(units, units)
    # A run without information on a value leaves it to the prior.
    widths = np.array([prior.sd for prior in plain.priors]) / np.abs(units)
    information += np.diag(widths**-2.0)
    centres = plain.start(theta)
    taken = np.concatenate(list(members.values()))
    shared = np.setdiff1d(np.arange(len(plain.labels)), taken)
    table = np.stack(list(members.values()))  # population, run
    sds, slopes = np.empty(table.shape), np.empty((*table.shape, shared.size))
    for run, own in enumerate(table.T):
        inverse = np.linalg.inv(information[np.ix_(own, own)])
        sds[:, run] = np.sqrt(np.diag(inverse))
        slopes[:, run] = -inverse @ information[np.ix_(own, shared)]
    return HierarchicalUnknowns(
        plain,
        tuple(
            Population(
                name,
                places,
                plain.priors[int(places[0])],
                centres[places],
                sds[k],
                slopes[k],
                centres[shared],
            )
            for k, (name, places) in enumerate(members.items())
        ),
    )


def _members(problem: EstimationProblem, name: str) -> Integers:
    """Places of a parameter's values in the runs."""
    wanted = {schema.by_run(name, run) for run in problem.runs}
    members = np.array([k for k, own in enumerate(problem.names) if own in wanted], dtype=np.int64)
    if members.size == 0:
        raise InputError(
            "this parameter has no value of each run's own",
            key="between_runs",
            value=name,
            hint="declare it with by_run=True",
        )
    if members.size < 3:
        raise InputError(
            "a scatter between runs needs three of them",
            key="between_runs",
            value=name,
            hint="leave it common to all runs",
        )
    return members
