"""Evidence of one parameter's values in a structure, by solutions of the model at each of them.

At each value the other unknowns move to their optimum given it, by one or two Gauss-Newton steps
from those at the nearest value. About what is reached the outputs are linearised, and everything
else is integrated out as in the comparison of structures. So the density follows the model along
the parameter, and is linearised across only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.special import logsumexp, ndtr, ndtri

from bayesoleo._types import Array
from bayesoleo.discovery._adaptive_grid import FINE, GridDensity, on_a_grid
from bayesoleo.discovery._limited_parameters import Coordinates
from bayesoleo.discovery._spectral_data import (
    EstimatedModel,
    LinearisedModel,
    SpectralData,
    linearised,
)
from bayesoleo.discovery._structure_parameters import Cell, Frame, GivenStructure
from bayesoleo.estimation._problem import undisturbed
from bayesoleo.estimation._sensitivity import quantile
from bayesoleo.model._correlated_priors import Correlated
from bayesoleo.model._priors import Prior

#: Standard deviations from the estimate, by linearisation, and normal scores of the prior at which
#: each grid begins.
ABOUT, OF_PRIOR = (1.25, 3.0), (-4.0, -2.5, -1.0, 0.0, 1.0, 2.5, 4.0)
#: Gauss-Newton steps at each value, and standard deviations that need no further one.
STEPS, NEAR = 6, 0.5
#: Standard deviations from its optimum at which a vector says nothing of it.
LOST = 2.0
#: Solutions for one parameter about one anchor at most.
MOST_SOLUTIONS = 60
#: Remainders and sizes that are kept, by falling weight at the estimate: so many, and this part.
MOST_CELLS, PART = 12, 0.99
#: Largest change of a logarithm of another unknown in one step where the parameter itself changes
#: by less than half of that.
FARTHEST = 1.0
#: Values of another parameter given each value.
EACH = 32
#: Part of the way to a limit that a step may go.
_PART = 0.99


@dataclass(frozen=True)
class _Place:
    """What was solved at one value.

    Parameters
    ----------
    theta : ndarray, shape (l,)
        All unknowns of the anchor's problem.
    found : list
        Where the solvers stood.
    here : LinearisedModel
    """

    theta: Array
    found: list[dict[str, Any]]
    here: LinearisedModel


@dataclass(frozen=True)
class Followed:
    """Density of a parameter along which the model was followed, and what comes of the others.

    Parameters
    ----------
    grid : GridDensity
        Of the parameter's coordinate.
    mean, sd : ndarray, shape (FINE, l)
        Of the coordinates of all parameters given each of its values; deviations of its own are
        zero.
    """

    grid: GridDensity
    mean: Array
    sd: Array

    def moments(self, j: int) -> tuple[float, float]:
        """Mean and deviation of another parameter's coordinate."""
        mean = float(self.mean[:, j].mean())
        return mean, float(np.sqrt(np.mean(self.sd[:, j] ** 2 + (self.mean[:, j] - mean) ** 2)))

    def values(self, j: int) -> Array:
        """Coordinates of equal probability of another parameter, in no order."""
        scores = ndtri((np.arange(EACH) + 0.5) / EACH)
        return np.asarray((self.mean[:, j, None] + self.sd[:, j, None] * scores).ravel())

    def below(self, j: int, place: float) -> float:
        """Probability of less than a place of another parameter's coordinate."""
        return float(np.mean(ndtr((place - self.mean[:, j]) / self.sd[:, j])))


@dataclass
class Budget:
    """Solutions that are left for all parameters and structures."""

    left: int


@dataclass
class Section:
    """Solutions along one parameter about one anchor, for all structures that share it.

    Parameters
    ----------
    anchor : EstimatedModel
    data : SpectralData
    name : str
    start : LinearisedModel
        At the anchor's estimate.
    power : ndarray, shape (l,)
        Of the coordinates in which outputs are linear.
    budget : Budget
    """

    anchor: EstimatedModel
    data: SpectralData
    name: str
    start: LinearisedModel
    power: Array
    budget: Budget
    solutions: int = 0
    places: dict[float, _Place] = field(default_factory=dict)
    #: What was solved along other parameters: there the others go along with this one.
    seeds: list[_Place] = field(default_factory=list)

    @property
    def able(self) -> bool:
        """Whether solutions are cheap, and the parameter's prior is its own."""
        prior = self.start.priors[self.start.names.index(self.name)]
        return not self.is_long and not isinstance(prior, Correlated)

    @property
    def is_long(self) -> bool:
        """Whether solutions are dear."""
        return any(run.is_long for run in self.anchor.fit.predictor.runs)

    @property
    def is_spent(self) -> bool:
        """Whether no more solutions are allowed."""
        return self.solutions >= MOST_SOLUTIONS or self.budget.left <= 0

    def density(
        self, frame: Frame, known: GivenStructure, mean: float, sd: float
    ) -> Followed | None:
        """Density of the parameter's coordinate in a structure.

        Parameters
        ----------
        frame : Frame
        known : GivenStructure
            About the anchor's estimate.
        mean, sd : float
            Of the coordinate, as linearisation expects it.
        """
        along = _Along(self, frame.fixed(self.start), _heaviest(known), known.coordinates)
        k, coordinates, problem = along.k, known.coordinates, self.anchor.fit.problem
        centre, known_places = float(coordinates.place[k]), sorted(self.places)
        if not self.places:
            found = [run.found() for run in problem.predictor.runs]
            self.places[centre] = _Place(self.anchor.fit.point.theta, found, self.start)
        scores = _quantiles(coordinates.priors[k])
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = coordinates.coordinate(k, scores)
        ends = ends[np.isfinite(ends)]
        if not ends.size:
            return None
        sides = [outwards(centre, mean, sign * sd, ends) for sign in (-1.0, 1.0)]
        if known_places:  # in another structure
            below = [place for place in known_places if place < centre]
            sides = [below[::-1], [place for place in known_places if place > centre]]
        # Far from the estimate much is no number; what is not is left out.
        with undisturbed(problem), np.errstate(all="ignore"):
            grid = on_a_grid(
                lambda places: coordinates.log_prior(k, places), along.log_evidence, centre, sides
            )
        return None if grid is None else along.followed(grid)


@dataclass
class _Along:
    """A section in one structure: frame, remainders and sizes, and coordinates at the anchor."""

    section: Section
    frame: Frame
    cells: Sequence[Cell]
    coordinates: Coordinates
    about: dict[float, GivenStructure] = field(default_factory=dict)
    #: Means and deviations of the others' coordinates given a value.
    others: dict[float, tuple[Array, Array]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        fit, anchor = self.section.anchor.fit, self.section.anchor
        names = fit.problem.names
        self.k = self.section.start.names.index(self.section.name)
        self.amplitudes = anchor.amplitudes
        self.rest = [j for j in range(len(names)) if j not in self.amplitudes]
        self.patterns = 1 + max(cell[0] for cell in self.cells)

    def log_evidence(self, place: float) -> float:
        """Log evidence of one value; NaN where nothing is known of it."""
        try:
            return self._log_evidence(place)
        except np.linalg.LinAlgError:
            return float("nan")

    def _log_evidence(self, place: float) -> float:
        places = self.section.places
        there = places.get(place) or self._solved(place)
        if there is None:
            return float("nan")
        places[place] = there
        held = self._about(place, there).without(self.k)
        log, mean, sd = held.log_evidence(self.cells, np.delete(self.section.power, self.k))
        if np.isfinite(log):
            self.others[place] = mean, sd
        return log

    def followed(self, grid: GridDensity) -> Followed:
        """With the others between the places that were solved."""
        places = np.array(sorted(self.others))
        rows = np.array([self.others[place] for place in places]).transpose(1, 2, 0)
        mean, sd = (
            np.array([np.interp(grid.values, places, row) for row in part]).reshape(-1, FINE).T
            for part in rows
        )
        mean, sd = np.insert(mean, self.k, grid.values, axis=1), np.insert(sd, self.k, 0.0, axis=1)
        return Followed(grid, mean, sd)

    def _about(self, place: float, there: _Place) -> GivenStructure:
        if place not in self.about:
            self.about[place] = self.frame.about(there.here, self.patterns)
        return self.about[place]

    def _solved(self, place: float) -> _Place | None:
        """A solution at a value, with the other unknowns next to their optimum given it."""
        section = self.section
        nearest, there = min(self._solved_so_far(), key=lambda item: abs(item[0] - place))
        for run, found in zip(section.anchor.fit.predictor.runs, there.found, strict=True):
            run.restore(found)
        theta, away = self._moved(self._about(nearest, there), there, place)
        for _ in range(STEPS):
            allowed = not section.is_spent and np.isfinite(theta).all()
            one = self._evaluated(theta) if allowed else None
            about = None if one is None else self.frame.about(one.here, self.patterns)
            if one is None or about is None or not about.is_finite:
                return None
            there, self.about[place] = one, about
            theta, away = self._moved(self.about[place], there, place)
            if away < NEAR:
                return there
        return there if away < LOST else None

    def _solved_so_far(self) -> list[tuple[float, _Place]]:
        """Coordinates of the parameter, and what was solved there."""
        values = np.array([seed.here.theta[self.k] for seed in self.section.seeds])
        places = self.coordinates.coordinate(self.k, values) if values.size else values
        seeds = zip(map(float, places), self.section.seeds, strict=True)
        return [*self.section.places.items(), *seeds]

    def _evaluated(self, theta: Array) -> _Place | None:
        """Outputs linearised at all unknowns of the problem."""
        section, fit = self.section, self.section.anchor.fit
        section.solutions, section.budget.left = section.solutions + 1, section.budget.left - 1
        predictor = fit.problem.predictor
        predictions = predictor.evaluate(fit.problem.full(theta[None])[0])
        if not all(run.status.ok and np.isfinite(run.sensitivity).all() for run in predictions):
            return None
        fit = replace(fit, point=replace(fit.point, theta=theta), predictions=predictions)
        here = linearised(replace(section.anchor, fit=fit), section.data)
        return _Place(theta, [run.found() for run in predictor.runs], here)

    def _moved(self, about: GivenStructure, there: _Place, place: float) -> tuple[Array, float]:
        """Unknowns at their optimum given a value, by the outputs linearised elsewhere; by how many
        standard deviations the farthest of the others moves."""
        k, count, size = self.k, len(about.names), self.frame.units.size
        coordinates = replace(about.coordinates, power=self.section.power)
        value = float(self.coordinates.parameter(k, np.array([place]))[0])
        moved = about.coordinates.theta.copy()
        moved[k] = value
        step = float(coordinates.moves(moved)[k])
        unit = np.diag(about.change)
        mean, covariance = _given(*about.expected(self.cells[0]), k, step / unit[k])
        sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        low, high = self._limits(coordinates, there.theta, abs(step))
        first = about.effects[0].columns[0] if about.effects else count
        index = [*(j for j in range(count) if j != k), *range(first, first + size)]
        before = np.zeros(mean.size)
        before[first : first + size] = there.theta[self.amplitudes] / self.frame.units
        ends = np.full((2, mean.size), np.inf) * np.array([[-1.0], [1.0]])
        ends[:, :count] = low / unit, high / unit
        ends[:, first : first + size] = self._sides(there.theta)
        for _ in index:
            beyond = np.maximum(ends[0] - mean, mean - ends[1])[index]
            far = index[int(np.argmax(beyond))] if index else k
            if not index or beyond.max() <= 1e-9 * max(1.0, abs(mean[far])):
                break
            end = float(np.clip(mean[far], *ends[:, far]))
            mean, covariance = _given(mean, covariance, far, end)
        mean = np.clip(mean, *ends)
        theta = there.theta.copy()
        theta[self.rest] = coordinates.parameters(coordinates.place + about.change @ mean[:count])
        theta[self.rest[k]] = value
        theta[self.amplitudes] = mean[first : first + size] * self.frame.units
        away = np.abs(mean - before)[index] / np.maximum(sd[index], 1e-300)
        return theta, float(np.max(away, initial=0.0))

    def _limits(self, coordinates: Coordinates, theta: Array, step: float) -> tuple[Array, Array]:
        """How far coordinates may move down and up at once, each (l,)."""
        priors, rest = self.section.anchor.fit.problem.priors, theta[self.rest]
        supports = np.array([priors[number].support for number in self.rest]).reshape(-1, 2)
        of_logs = max(FARTHEST, 2.0 * step if coordinates.logarithmic[self.k] else 0.0)
        farthest = np.where(coordinates.logarithmic, of_logs, 4.0 * coordinates.spread)
        down, up = (coordinates.moves(_towards(rest, end)) for end in supports.T)
        return (
            np.maximum(np.where(np.isfinite(down), down, -np.inf), -farthest),
            np.minimum(np.where(np.isfinite(up), up, np.inf), farthest),
        )

    def _sides(self, theta: Array) -> Array:
        """Limits (2, k) of the coefficients of amplitudes."""
        priors, units = self.section.anchor.fit.problem.priors, self.frame.units
        supports = [priors[number].support for number in self.amplitudes]
        ends = np.array(supports).reshape(-1, 2).T
        return _towards(theta[self.amplitudes], ends) / units


def _given(mean: Array, covariance: Array, k: int, value: float) -> tuple[Array, Array]:
    """A normal density given one of its variables."""
    along = covariance[:, k] / covariance[k, k]
    mean, covariance = mean + along * (value - mean[k]), covariance - np.outer(along, covariance[k])
    mean[k], covariance[k], covariance[:, k] = value, 0.0, 0.0
    covariance[k, k] = np.finfo(float).tiny
    return mean, covariance


def _towards(value: Array, end: Array) -> Array:
    """Most of the way to a limit."""
    return np.asarray(value + _PART * (end - value))


def outwards(centre: float, mean: float, sd: float, ends: Array) -> list[float]:
    """Places from a centre outwards on the side of a deviation: first by linearisation, then by
    scores of the prior."""
    sign, least = np.sign(sd), 0.2 * abs(sd)
    last = max(sign * ends)
    about = [mean + step * sd for step in ABOUT]
    about = [p for p in about if sign * p < last and sign * (p - centre) > least]
    far = max([sign * place for place in about], default=sign * centre)
    beyond = sorted(sign * end for end in ends if sign * end > far + least)
    return [*about, *(sign * end for end in beyond)]


def _heaviest(known: GivenStructure) -> list[Cell]:
    """The heaviest remainders and sizes at the estimate, heaviest first."""
    cells = known.cells()
    if len(cells) == 1:
        return cells
    logs = np.array([logsumexp([log for log, _, _ in known.each([cell])]) for cell in cells])
    if not np.isfinite(logs).any():
        return cells[:1]  # data want a sign of an effect that physics forbids, whatever its size
    weight = np.exp(logs - logsumexp(logs))
    order = np.argsort(-weight)
    enough = 1 + int(np.searchsorted(np.cumsum(weight[order]), PART))
    return [cells[k] for k in order[: min(enough, MOST_CELLS)]]


def _quantiles(prior: Prior) -> Array:
    """Values at scores of a prior, and the limits of its support."""
    values = np.asarray(quantile(prior, ndtr(OF_PRIOR)))
    low, high = (float(end) for end in prior.support)
    values = np.clip(values, low, high)
    # Draws of a prior do not reach its limits.
    ends = [end for end in (low, high) if np.isfinite(end) and end != 0.0]
    return np.unique([*values, *ends])
