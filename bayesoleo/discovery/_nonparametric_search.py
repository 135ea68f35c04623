"""Search for a nonparametric effect: a smooth function of one or two quantities.

Every quantity of the model is tried in every balance, with splines of several resolutions, by the
score that also ranks named effects. More pieces always explain more. The criterion is therefore the
probability that noise alone explains as much with as many coefficients (a chi-square of their
number), times the number of functions tried.

The data do not determine some of the splines, and the present parameters can produce some
combinations of the others. Only the remaining directions are estimated; the other splines are made
to depend on them, so that no prior has to separate directions that the data cannot.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
import sympy as sp
from numpy.typing import NDArray
from scipy import linalg

from bayesoleo import _distributions as distributions
from bayesoleo._parallel import thread_map
from bayesoleo._types import Array
from bayesoleo.discovery._assembly import Assembly
from bayesoleo.discovery._nonparametric_quantities import (
    Forced,
    Motions,
    direction_at,
    quantities_of,
    times_direction,
)
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._score_basis import Base, coefficients
from bayesoleo.discovery._score_tests import Score, inflation_of
from bayesoleo.effects._nonparametric import Axis, Spline, balance_places, tensor
from bayesoleo.effects._parts import Scales
from bayesoleo.errors import ModelError
from bayesoleo.solvers._orbit import Status

#: Samples at which splines of one fineness are expressed in those of another.
_DENSE = 400
UNIT = Axis("", sp.Integer(0), "", 0.0, 1.0)
#: Balance, quantities with their numbers, and whether the function is multiplied by the direction.
Place = tuple[str, tuple[tuple[int, Axis], ...], bool]


@dataclass(frozen=True)
class CurveDirections:
    """What of a function the data know beside the present parameters.

    Parameters
    ----------
    weights : ndarray, shape (K, r)
        All coefficients from the ``r`` free ones.
    expected : ndarray, shape (r,)
        Of the free coefficients, in the unit of the balance.
    coefficients : ndarray, shape (K,)
        All expected ones.
    fall : float
        Fall of the weighted sum of squares.
    """

    weights: Array
    expected: Array
    coefficients: Array
    fall: float


def known_beside(base: Base, own: Array, cross: Array, score: Array) -> CurveDirections | None:
    """Take out what is not visible, and what the present parameters can do.

    In coordinates in which ``C' W C`` is one, the eigenvalues of ``C_perp' W C_perp`` are the parts
    of each direction that the present parameters cannot do.

    Parameters
    ----------
    base : Base
        What is scored against; its ``J' W J`` is ``(l, l)``.
    own : ndarray, shape (K, K)
        ``C' W C`` of the splines.
    cross : ndarray, shape (l, K)
        ``J' W C``.
    score : ndarray, shape (K,)
        ``C' W e``.

    Returns
    -------
    CurveDirections or None
        None where nothing is visible, or nothing is left beside the present parameters.
    """
    policy = base.policy
    project = coefficients(base.gram, cross)
    information = own - cross.T @ project
    rest = score - project.T @ base.gradient
    size = np.sqrt(np.clip(np.diag(own), 0.0, None))
    seen = size > policy.resolved_spline * size.max(initial=0.0)
    if not seen.any() or not np.isfinite(information).all():
        return None
    scaled = own[np.ix_(seen, seen)] / np.outer(size[seen], size[seen])
    values, vectors = np.linalg.eigh(scaled)
    clear = values > policy.distinct_spline * values.max()
    unit = (vectors[:, clear] / np.sqrt(values[clear])) / size[seen][:, None]
    inner = unit.T @ information[np.ix_(seen, seen)] @ unit
    parts, turned = np.linalg.eigh(0.5 * (inner + inner.T))
    free = parts > policy.own_direction
    if not free.any():
        return None
    directions = unit @ turned[:, free]
    pull = directions.T @ rest[seen]
    own_seen = own[np.ix_(seen, seen)]
    found = directions @ (pull / parts[free])
    weights, chosen = _weights(directions, own_seen)
    full = np.zeros((own.shape[0], weights.shape[1]))
    full[seen] = weights
    everything = np.zeros(own.shape[0])
    everything[seen] = found
    return CurveDirections(full, found[chosen], everything, float(pull @ (pull / parts[free])))


def _weights(directions: Array, own: Array) -> tuple[Array, NDArray[np.int64]]:
    """Matrix that gives all coefficients from the independent ones, and the independent ones.

    All combinations of ``directions (K, r)``: the splines that the others depend on are chosen by
    pivoting, so that none of the weights is large.
    """
    size = np.sqrt(np.diag(own))
    _, _, order = linalg.qr((directions * size[:, None]).T, mode="economic", pivoting=True)
    chosen = np.sort(order[: directions.shape[1]])
    weights = directions @ np.linalg.inv(directions[chosen])
    weights[chosen] = np.eye(chosen.size)
    weights[np.abs(weights) < 1e-12] = 0.0
    return weights, chosen


@dataclass(frozen=True)
class Tried:
    """A function that was tried.

    Parameters
    ----------
    target : str
        The balance.
    axes : tuple of Axis
        Quantities.
    pieces : tuple of int
        Of each.
    rank : int
        Coefficients that the data know beside the present parameters.
    fall : float
        Fall of the weighted sum of squares.
    inflation : float
        Variance by coloured noise over that by white noise.
    freedom : int
        Degrees of freedom with which that was measured; zero where none was.
    log_p : float
        Logarithm of the probability that noise explains as much, for this function alone, were its
        size known: what functions are chosen by.
    weights : ndarray, shape (K, r)
        See :class:`~bayesoleo.effects.Spline`.
    expected : ndarray, shape (r,)
        Of the free coefficients.
    contribution : ndarray
        As of :class:`~bayesoleo.discovery.Score`.
    direction : sympy.Expr, optional
        By which the function is multiplied.
    """

    target: str
    axes: tuple[Axis, ...]
    pieces: tuple[int, ...]
    rank: int
    fall: float
    inflation: float
    freedom: int
    log_p: float
    weights: Array
    expected: Array
    contribution: Array
    direction: sp.Expr | None = None

    @property
    def key(self) -> tuple[str, ...]:
        """Balance and quantities, and whether the direction counts."""
        turned = () if self.direction is None else ("direction",)
        return (self.target, *(axis.name for axis in self.axes), *turned)

    @property
    def spline(self) -> Spline:
        """The function as an effect's."""
        return Spline(self.target, self.axes, self.pieces, self.weights, self.direction)

    def score(self, base: Base, assembly: Assembly, scales: Scales) -> Score:
        """The same as the score of a candidate, which can be refitted and confirmed."""
        option = assembly.option(self.spline.effect(), self.target, scales)
        return Score(
            option=option,
            names=option.candidate.parameters,
            expected=self.expected,
            shapes={},
            fall=self.fall,
            share=self.fall / base.fall_back,
            inflation=self.inflation,
            columns=np.empty((0, self.contribution.size)),
            contribution=self.contribution,
            z=float(np.sqrt(max(self.fall, 0.0))),
            rank=self.rank,
            freedom=self.freedom,
        )


@dataclass(frozen=True)
class CurveSearch:
    """Everything that was tried, the best first.

    Parameters
    ----------
    tried : tuple of Tried
    policy : SearchPolicy
    """

    tried: tuple[Tried, ...]
    policy: SearchPolicy = SearchPolicy()

    @property
    def p_value(self) -> float:
        """Of the best, for the best of so many (Sidak 1967): no more are independent."""
        return corrected(self.tried[0], len(self.tried)) if self.tried else 1.0

    def leading(self, most: int) -> tuple[Tried, ...]:
        """The best few functions of different quantities, each as fine as the data ask for.

        The fineness that is surest is seldom fine enough: what it leaves of a curve stays an error.
        So pieces are cut finer as long as that explains significantly more.
        """
        groups: dict[tuple[str, ...], list[Tried]] = {}
        for item in self.tried:
            groups.setdefault(item.key, []).append(item)
        finer = self.policy.finer
        return tuple(_refined(group, finer) for group in list(groups.values())[:most])

    def finenesses(self, item: Tried) -> tuple[Tried, ...]:
        """A function of the same quantities in the same balance with any number of pieces, the
        coarsest first."""
        group = [one for one in self.tried if one.key == item.key]
        return tuple(sorted(group, key=lambda one: one.pieces))


def _refined(group: Sequence[Tried], level: float) -> Tried:
    """The surest of several finenesses, or finer."""
    chosen = group[0]
    for finer in sorted(group, key=lambda item: item.pieces):
        more = finer.rank - chosen.rank
        if finer.pieces > chosen.pieces and more > 0:
            fall = (finer.fall - chosen.fall) / max(chosen.inflation, finer.inflation)
            if distributions.chi2.sf(fall, more) < level:
                chosen = finer
    return chosen


def corrected(item: Tried, tests: int) -> float:
    """p-value of a function that is the best of so many."""
    statistic = item.fall / item.inflation
    if item.inflation > 1.0 and item.freedom > 0:
        # The noise was measured between few periods, and is itself uncertain.
        local = float(distributions.f.sf(statistic / item.rank, item.rank, item.freedom))
    else:
        local = float(distributions.chi2.sf(statistic, item.rank))
    return float(-np.expm1(tests * np.log1p(-min(local, 1 - 1e-16))))


def search(
    base: Base, assembly: Assembly, jobs: int | None = None, also: Mapping[str, Axis] | None = None
) -> CurveSearch:
    """Try smooth functions of the model's quantities in all of its balances.

    Parameters
    ----------
    base : Base
        What is scored against.
    assembly : Assembly
        The present model.
    jobs : int, optional
        Threads.
    also : mapping of str to Axis, optional
        By name: ranges of quantities to be covered besides those of the present model's motion.

    Returns
    -------
    CurveSearch
        Empty where no quantity moves, or no balance can be solved with a term added.
    """
    motions = Motions(base.fit, assembly, quantities_of(assembly.native))
    axes = motions.axes(also or {})
    forced = {}
    for target in balance_places(assembly.native):
        try:
            forced[target] = Forced(base.fit, assembly, target)
        except ModelError:
            continue  # nothing is left to solve for with a term there
    turns = _directions(base, assembly, forced)
    single: list[Place] = [(target, (item,), False) for target in forced for item in axes]
    # A function of the velocity has the direction in it.
    single += [
        (target, (item,), True)
        for target, (velocity, _) in turns.items()
        for item in axes
        if item[1].expression != velocity
    ]
    found = _all(base, motions, forced, turns, single, base.policy.pieces, jobs)
    plain = [best for best in found if best.direction is None]
    pairs: list[Place] = [
        (best.target, (item, other), False)
        for best in plain[: base.policy.paired]
        for item in axes
        if item[1] is best.axes[0]
        for other in axes
        if other is not item
    ]
    found += _all(base, motions, forced, turns, pairs, base.policy.pieces_of_two, jobs)
    return CurveSearch(tuple(sorted(found, key=lambda item: item.log_p)), base.policy)


#: By balance the velocity there, and the direction along the motion.
Turns = dict[str, tuple[sp.Expr, Motions]]


def _directions(base: Base, assembly: Assembly, targets: Iterable[str]) -> Turns:
    found: Turns = {}
    for target in targets:
        direction = direction_at(base.fit, assembly, target)
        motions = Motions(base.fit, assembly, [] if direction is None else [direction])
        velocity = balance_places(assembly.native)[target].velocity
        if motions.quantities and velocity is not None:
            found[target] = velocity, motions
    return found


def _all(
    base: Base,
    motions: Motions,
    forced: dict[str, Forced],
    turns: Turns,
    places: Sequence[Place],
    pieces: Sequence[int],
    jobs: int | None,
) -> list[Tried]:
    results = thread_map(
        lambda place: list(_tried(base, motions, forced[place[0]], turns, place, pieces)),
        places,
        jobs,
    )
    return sorted((item for found in results for item in found), key=lambda item: item.log_p)


def _tried(
    base: Base,
    motions: Motions,
    forced: Forced,
    turns: Turns,
    place: Place,
    pieces: Sequence[int],
) -> Iterator[Tried]:
    """One function of some quantities, at each fineness."""
    target, items, turned = place
    turn = turns[target][1] if turned else None
    finest = pieces[-1]
    columns = []
    for r, run in enumerate(base.runs):
        answer = forced.responses(r, partial(_courses, motions, turn, r, items, finest))
        if isinstance(answer, Status):
            return
        flat = np.moveaxis(answer, 1, 0).reshape(answer.shape[1], -1)
        columns.append(flat * run.scale)
    axes = tuple(axis for _, axis in items)
    products = [run.products(new) for run, new in zip(base.runs, columns, strict=True)]
    cross, own, score = (sum(parts) for parts in zip(*products, strict=True))
    for count in pieces:
        coarse = coarser(len(axes), count, finest)
        found = known_beside(base, coarse.T @ own @ coarse, cross @ coarse, coarse.T @ score)
        if found is not None:
            tried = _judged(base, target, axes, count, columns, coarse, found)
            yield tried if turn is None else replace(tried, direction=turn.quantities[0].expression)


def _courses(
    motions: Motions,
    turn: Motions | None,
    r: int,
    items: Sequence[tuple[int, Axis]],
    pieces: int,
    phase: Array,
) -> Array:
    values = tensor([axis.basis(motions.at(r, k, phase), pieces) for k, axis in items])
    return times_direction(turn, r, phase, values)


@cache
def coarser(quantities: int, pieces: int, finest: int) -> Array:
    """Splines of one fineness in those of the finest, shape (K_fine, K)."""
    values = np.linspace(0.0, 1.0, _DENSE)
    fine, coarse = (UNIT.basis(values, count).T for count in (finest, pieces))
    single: Array = np.linalg.lstsq(fine, coarse, rcond=None)[0]
    found: Array = single
    for _ in range(quantities - 1):
        found = np.asarray(np.kron(found, single), dtype=float)
    return found


def _judged(
    base: Base,
    target: str,
    axes: tuple[Axis, ...],
    pieces: int,
    columns: Sequence[Array],
    coarse: Array,
    found: CurveDirections,
) -> Tried:
    """How likely noise alone would explain as much."""
    fine = coarse @ found.coefficients
    cross = np.zeros(base.gram.shape[0])
    for run, new in zip(base.runs, columns, strict=True):
        cross += run.products((fine @ new)[None])[0][:, 0]
    project = coefficients(base.gram, cross[:, None])[:, 0]
    directions = [
        fine @ new - project @ run.sensitivity for run, new in zip(base.runs, columns, strict=True)
    ]
    inflation, freedom = inflation_of(base, directions)
    rank = found.weights.shape[1]
    statistic = found.fall / inflation
    log_p = float(distributions.chi2.logsf(statistic, rank))
    if not np.isfinite(log_p):
        log_p = -0.5 * statistic + 0.5 * rank * np.log(max(statistic / rank, 1.0))
    thin = [d[run.chosen] for run, d in zip(base.runs, directions, strict=True)]
    return Tried(
        target, axes, (pieces,) * len(axes), rank, found.fall, inflation, freedom, log_p,
        found.weights, found.expected, np.concatenate(thin),
    )  # fmt: skip


def closest(
    contribution: Array, scores: Sequence[Score], most: int = 3
) -> tuple[tuple[str, float], ...]:
    """Named effects whose contributions are most alike, with the cosine.

    Parameters
    ----------
    contribution : ndarray
        Of the nonparametric effect.
    scores : sequence of Score
        Of the named ones, against the same base.
    most : int
        How many at most.

    Returns
    -------
    tuple of (str, float)
        ``effect @ target`` and the cosine, the most alike first.
    """
    found = []
    for score in scores:
        lengths = float(np.linalg.norm(score.contribution) * np.linalg.norm(contribution))
        if lengths > 0:
            cosine = float(score.contribution @ contribution) / lengths
            found.append((" @ ".join(score.option.key), cosine))
    return tuple(sorted(found, key=lambda item: -item[1])[:most])
