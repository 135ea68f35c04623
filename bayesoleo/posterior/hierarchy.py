r"""Parameters that scatter between runs: a population with mean and spread, sampled with the runs'.

In coordinates without bounds a parameter of run :math:`\kappa` is

.. math:: u_\kappa \sim N(\mu, s^2),

with the parameter's own prior for the mean :math:`\mu`, and a half-normal one for the spread
:math:`s` whose scale is that prior's standard deviation. Of a parameter without bounds :math:`s` is
in its unit; of one with a bound it is the spread of the logarithm of the distance to that bound, of
one with two bounds that of the logit.

Where the runs determine their own values far better than the population does, the values themselves
are the coordinates (centred); where they do not, their deviations :math:`(u_\kappa - \mu) / s` are
(not centred), because the values would all have to move together whenever :math:`s` shrinks.

References
----------
Gelman et al. (2013), *Bayesian Data Analysis*, third edition, chapter 5. Papaspiliopoulos, Roberts
and Sköld (2007), "A general framework for the parametrization of hierarchical models",
*Statistical Science* 22, section 2 (when to centre). Gelman (2006), "Prior distributions for
variance parameters in hierarchical models", *Bayesian Analysis* 1, section 2.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from bayesoleo import schema
from bayesoleo.errors import InputError
from bayesoleo.estimation.problem import Problem
from bayesoleo.model.priors import Prior
from bayesoleo.posterior.transforms import Transform, Transforms
from bayesoleo.posterior.unknowns import Array, PlainUnknowns, Unknowns, prior_curvature

_HALF_NORMAL = 0.5 * float(np.log(2 / np.pi))
_LOG_SQRT_2_PI = 0.5 * float(np.log(2 * np.pi))
#: A start's spread is at least this part of its prior's scale.
_LEAST_SPREAD = 0.02


@dataclass(frozen=True)
class Population:
    """One parameter's values in the runs, and what they vary about.

    Parameters
    ----------
    name : str
        The parameter's.
    members : ndarray of int, shape (N,)
        Places of the runs' values among the unknowns.
    prior : Prior
        Of the mean, in the parameter's unit.
    centred : bool
        Whether the runs' values are coordinates themselves.
    """

    name: str
    members: NDArray[np.int64]
    prior: Prior
    centred: bool

    @cached_property
    def transform(self) -> Transform:
        """From coordinates to the parameter's unit."""
        return Transform(*self.prior.support)

    @cached_property
    def scale(self) -> float:
        """Scale of the spread's prior: the parameter's prior sd, in coordinates."""
        u = self.transform.unbounded(np.array([self.prior.mean]))
        return float(self.prior.sd / abs(self.transform.derivative(u)[0]))

    def log_prior(self, u: Array, mean: Array, log_spread: Array) -> Array:
        """Log density of coordinates: of the runs (W, N), or deviations, and of mean and spread."""
        spread = np.exp(log_spread)
        total = self.prior.log_density(self.transform.natural(mean))
        total = total + self.transform.log_jacobian(mean)
        scaled = spread / self.scale
        total += _HALF_NORMAL - np.log(self.scale) - 0.5 * scaled * scaled + log_spread
        for column in u.T:
            away = (column - mean) / spread if self.centred else column
            total -= 0.5 * away * away + _LOG_SQRT_2_PI
            if self.centred:
                total -= log_spread
        return np.asarray(total)


@dataclass(frozen=True)
class HierarchicalUnknowns(Unknowns):
    """Unknowns of which some scatter between runs.

    Coordinates are the problem's ``l``, then mean and logarithm of the spread of each population.

    Parameters
    ----------
    plain : PlainUnknowns
        All unknowns of the problem; priors of members are those of their population's mean.
    populations : tuple of Population
    """

    plain: PlainUnknowns
    populations: tuple[Population, ...] = field(default=())

    @cached_property
    def _shared(self) -> NDArray[np.int64]:
        """Places of the unknowns that belong to no population."""
        taken = np.concatenate([population.members for population in self.populations])
        return np.setdiff1d(np.arange(len(self.plain.labels)), taken)

    @cached_property
    def _rest(self) -> PlainUnknowns:
        return PlainUnknowns(
            tuple(self.plain.labels[k] for k in self._shared),
            tuple(self.plain.priors[k] for k in self._shared),
        )

    @property
    def names(self) -> tuple[str, ...]:
        more = [
            name
            for population in self.populations
            for name in (schema.population_mean(population.name), schema.spread(population.name))
        ]
        return (*self.plain.names, *more)

    def _places(self, k: int) -> tuple[int, int]:
        """Places of the mean and the log spread of population ``k``."""
        first = len(self.plain.labels) + 2 * k
        return first, first + 1

    def _unbounded(self, block: Array) -> Array:
        """Coordinates of the unknowns themselves, (W, l): deviations are turned into values."""
        u = np.array(block[:, : len(self.plain.labels)], dtype=float)
        for k, population in enumerate(self.populations):
            if not population.centred:
                mean, log_spread = (np.ascontiguousarray(block[:, i]) for i in self._places(k))
                spread = np.exp(log_spread)
                for member in population.members:
                    u[:, member] = mean + spread * block[:, member]
        return u

    def theta(self, block: Array) -> Array:
        return self.plain.theta(self._unbounded(block))

    def natural(self, block: Array) -> Array:
        out = np.empty(np.shape(block))
        out[:, : len(self.plain.labels)] = self.theta(block)
        for k, population in enumerate(self.populations):
            mean, spread = self._places(k)
            out[:, mean] = population.transform.natural(np.ascontiguousarray(block[:, mean]))
            out[:, spread] = np.exp(np.ascontiguousarray(block[:, spread]))
        return out

    def coordinates(self, natural: Array) -> Array:
        out = np.empty(np.shape(natural))
        count = len(self.plain.labels)
        out[:, :count] = self.plain.coordinates(natural[:, :count])
        for k, population in enumerate(self.populations):
            mean, spread = self._places(k)
            out[:, mean] = population.transform.unbounded(natural[:, mean])
            out[:, spread] = np.log(natural[:, spread])
            if not population.centred:
                away = out[:, population.members] - out[:, mean, None]
                out[:, population.members] = away / natural[:, spread, None]
        return out

    def log_prior(self, block: Array) -> Array:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            total = np.zeros(len(block))
            if self._shared.size:
                total += self._rest.log_prior(np.ascontiguousarray(block[:, self._shared]))
            for k, population in enumerate(self.populations):
                mean, spread = (np.ascontiguousarray(block[:, i]) for i in self._places(k))
                total += population.log_prior(block[:, population.members], mean, spread)
        return total

    def natural_log_prior(self, natural: Array) -> dict[str, Array]:
        found = self._rest.natural_log_prior(natural[:, self._shared])
        for k, population in enumerate(self.populations):
            mean, spread = self._places(k)
            scaled = natural[:, spread] / population.scale
            found[schema.population_mean(population.name)] = population.prior.log_density(
                natural[:, mean]
            )
            found[schema.spread(population.name)] = (
                _HALF_NORMAL - np.log(population.scale) - 0.5 * scaled**2
            )
        return found

    def sample_prior(self, rng: np.random.Generator, size: int) -> Array:
        out = np.empty((size, len(self.names)))
        out[:, self._shared] = self._rest.sample_prior(rng, size)
        for k, population in enumerate(self.populations):
            mean, spread = self._places(k)
            out[:, mean] = population.prior.sample(rng, size)
            out[:, spread] = population.scale * np.abs(rng.standard_normal(size))
            centre = population.transform.unbounded(out[:, mean])
            scatter = rng.standard_normal((size, population.members.size))
            u = centre[:, None] + out[:, spread, None] * scatter
            for j, member in enumerate(population.members):
                out[:, member] = population.transform.natural(np.ascontiguousarray(u[:, j]))
        return out

    def start(self, theta: Array) -> Array:
        u = self.plain.start(theta)
        natural = np.concatenate([np.asarray(theta, dtype=float), np.empty(self._more)])
        for k, population in enumerate(self.populations):
            own = u[population.members]
            mean, spread = self._places(k)
            natural[mean] = population.transform.natural(np.array([own.mean()]))[0]
            natural[spread] = max(float(own.std(ddof=1)), _LEAST_SPREAD * population.scale)
        return self.coordinates(natural[None])[0]

    @property
    def _more(self) -> int:
        return 2 * len(self.populations)

    def jacobian(self, block: Array) -> Array:
        count = len(self.plain.labels)
        u = self._unbounded(block[None])
        by_u = np.eye(count, len(block))
        for k, population in enumerate(self.populations):
            mean, spread = self._places(k)
            if not population.centred:
                size = np.exp(block[spread])
                members = population.members
                by_u[members, members] = size
                by_u[members, mean] = 1.0
                by_u[members, spread] = size * block[members]
        return np.asarray(self.plain.transforms.derivative(u)[0][:, None] * by_u)

    def precision(self, block: Array) -> Array:
        matrix = np.zeros((len(block), len(block)))
        shared = self._shared
        if shared.size:
            matrix[np.ix_(shared, shared)] = self._rest.precision(block[shared])
        for k, population in enumerate(self.populations):
            mean, spread = self._places(k)
            members, each = population.members, np.exp(-2 * block[spread])
            transforms = Transforms((population.transform,))
            curvature = prior_curvature([population.prior], transforms, block[mean : mean + 1])
            matrix[mean, mean] = curvature[0]
            # Of a logarithm of a standard deviation that N values determine; of one that only a
            # half-normal prior does, about two.
            matrix[spread, spread] = 2.0 * members.size if population.centred else 2.0
            matrix[members, members] = each if population.centred else 1.0
            if population.centred:
                matrix[mean, mean] += members.size * each
                matrix[members, mean] = matrix[mean, members] = -each
        return matrix


def hierarchical(
    problem: Problem,
    names: Sequence[str],
    *,
    theta: Array | None = None,
    sd: Array | None = None,
    centred: bool | None = None,
) -> HierarchicalUnknowns:
    """Let parameters that vary by run scatter about a mean that is estimated.

    Parameters
    ----------
    problem : Problem
        With unknowns ``name[run]`` for every name.
    names : sequence of str
        Parameters that scatter.
    theta, sd : ndarray, shape (l,), optional
        An estimate with its standard deviations, which says whether to centre: where the runs'
        values scatter by more than a typical one is uncertain.
    centred : bool, optional
        Instead of finding out; by default, without an estimate, True.

    Returns
    -------
    HierarchicalUnknowns

    Raises
    ------
    InputError
        If a parameter does not vary by run, or there are fewer than three runs.
    """
    plain = PlainUnknowns(tuple(problem.names), tuple(problem.priors))
    populations = []
    for name in dict.fromkeys(names):
        wanted = [schema.by_run(name, run) for run in problem.runs]
        members = np.array([k for k, own in enumerate(problem.names) if own in wanted])
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
        prior = problem.priors[int(members[0])]
        populations.append(
            Population(name, members, prior, _centred(prior, members, theta, sd, centred))
        )
    return HierarchicalUnknowns(plain, tuple(populations))


def _centred(
    prior: Prior,
    members: NDArray[np.int64],
    theta: Array | None,
    sd: Array | None,
    wanted: bool | None,
) -> bool:
    if wanted is not None or theta is None or sd is None:
        return True if wanted is None else wanted
    scatter = float(np.std(theta[members], ddof=1))
    return bool(scatter > float(np.median(sd[members])))
