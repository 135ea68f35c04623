"""Marginal likelihoods of all structures about estimated models.

Every model that the search has estimated is an anchor: about it the marginal likelihoods of the
structures with no more, one more or two more effects follow from the columns of the scores. Where
several anchors reach a structure, the one that has estimated most of its effects counts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.special import logsumexp

from bayesoleo._types import Array
from bayesoleo.discovery._assembly import Added
from bayesoleo.discovery._fit_and_hold_out_error import RunError
from bayesoleo.discovery._score_basis import Base, present_constants
from bayesoleo.discovery._score_tests import Score
from bayesoleo.discovery._spectral_data import (
    INPUT_DRAWS,
    EstimatedModel,
    SpectralData,
    linearised,
)
from bayesoleo.discovery._structure_columns import (
    Covariances,
    Group,
    Likelihood,
    Reduced,
    Remainders,
    fewer,
    in_a_row,
    log_difference,
    mean_of,
    sizes_between,
)
from bayesoleo.discovery._structure_evidence import Largest, effect_evidence, pair_evidence
from bayesoleo.discovery._structures import StructurePrior
from bayesoleo.prediction._run_errors import drawn_columns, input_columns

#: Effects whose pairs are considered, and directions that a law outside the catalogue is made of.
IN_PAIRS, DIRECTIONS = 10, 40
_LOG_2 = float(np.log(2.0))
#: Prior probability of the likely side of an effect of which both sides are possible.
LIKELY_SIDE = 0.9
#: Columns whose products with each other are kept at a time.
CHUNK = 64
#: A direction of the law weaker than this part of the strongest is left out.
WEAKEST = 1e-4
#: Noise whose degrees of freedom are more than this is known.
KNOWN = 1e5
#: Part of an effect's mean square that is taken to be its own, at least.
LEAST_SEEN = 1e-4
#: Squared change of the outputs by an input's error, in units of the noise, that is not counted.
NEGLIGIBLE_INPUT = 1e-2


@dataclass(frozen=True)
class Columns:
    """Changes of the outputs by candidates, scaled to unit size in units of the noise.

    Parameters
    ----------
    rows : ndarray, shape (k, n)
    groups : mapping of (effect, target) to tuple of Group
        One for each set of shapes.
    law : ndarray, shape (m, n)
        Directions of a law that resembles many effects, by their prior weights.
    curves : mapping of (curve, balance) to tuple of Group
        One for each fineness.
    """

    rows: Array
    groups: Mapping[Added, tuple[Group, ...]]
    law: Array
    curves: Mapping[Added, tuple[Group, ...]]


@dataclass(frozen=True)
class Comparison:
    """What all anchors have in common: data, noise, candidates and prior.

    Parameters
    ----------
    data : SpectralData
    variance : ndarray, shape (n,)
        Of the noise, SI.
    shared : ndarray, shape (k, n)
        Changes of the outputs by one standard deviation of each error of a measured input, SI.
    freedom : float
        Degrees of freedom with which the noise is known.
    scores : sequence of Score
        Candidates, with their columns.
    prior : StructurePrior
    curves : mapping of (curve, balance) to tuple of ndarray, shape (K, n)
        Changes of the outputs by unnamed functions, fine and coarse.
    later : sequence of Score
        Candidates that exist beside other effects only. They have no column about the declared
        model, and are compared about models that have them.
    """

    data: SpectralData
    variance: Array
    shared: Array
    freedom: float
    scores: Sequence[Score]
    prior: StructurePrior
    curves: Mapping[tuple[str, str], tuple[Array, ...]] = field(default_factory=dict)
    later: Sequence[Score] = ()

    @classmethod
    def of(
        cls,
        base: Base,
        errors: Mapping[tuple[str, str], RunError],
        scores: Sequence[Score],
        prior: StructurePrior,
        curves: Mapping[tuple[str, str], tuple[Array, ...]] | None = None,
    ) -> Comparison:
        """With the noise of an error table, and that of the inputs about an estimate."""
        fit, data = base.fit, base.data
        assert data is not None

        def inputs(r: int) -> tuple[Array, int]:
            run, label = fit.predictor.runs[r], fit.records[r].label
            scale = np.array([errors[label, output].input_scale for output in data.outputs])
            columns = input_columns(run, present_constants(fit, r), INPUT_DRAWS)
            return columns * scale[:, None, None], drawn_columns(run, INPUT_DRAWS)

        used = [errors[r.record.label, o] for r in data.runs for o in data.outputs]
        freedom = float(sum(max(entry.free, 1.0) for entry in used))
        own = data.noise(errors)
        shared, rest = data.input_noise(inputs, own)
        variance = own + rest
        seen = np.sum(shared**2 / variance, axis=1) > NEGLIGIBLE_INPUT
        return cls(data, variance, shared[seen], min(freedom, KNOWN), scores, prior, curves or {})

    @property
    def weights(self) -> dict[Added, float]:
        """Prior probability of each candidate as the only effect."""
        return self.prior.weights(self.families)

    @property
    def families(self) -> dict[Added, str]:
        """Family of each candidate."""
        every = (*self.scores, *self.later)
        return {s.option.key: s.option.candidate.family for s in every}

    def unit(self, rows: Array) -> Array:
        """Factors ``(k,)`` that scale rows ``(k, n)`` to unit size in units of the noise."""
        norms = np.sqrt(np.sum(rows**2 / self.variance, axis=1) / self.data.samples)
        return 1.0 / np.where(norms > 0, norms, np.inf)

    def columns(self) -> Columns:
        """Those of all candidates, and of curves."""
        rows: list[Array] = [np.zeros((0, self.variance.size))]
        groups: dict[Added, tuple[Group, ...]] = {}
        law, weights, start = [rows[0]], self.weights, 0
        for score in self.scores:
            own = score.signature.astype(float)
            own = own * self.unit(own)[:, None]
            law.append(own * np.sqrt(weights[score.option.key] / max(len(own), 1)))
            size, shapes = len(score.names), score.option.candidate.shapes
            if size == 1 and len(shapes) == 1 and len(own) > 1:
                own = self._finer(own)
            positive = positive_part(score)
            groups[score.option.key] = tuple(
                Group(tuple(range(start + k, start + k + size)), positive)
                for k in range(0, len(own), size)
            )
            rows.append(own)
            start += len(own)
        curves: dict[Added, tuple[Group, ...]] = {}
        for key, finenesses in self.curves.items():
            for own in finenesses:
                rows.append(own * self.unit(own)[:, None])
                index = tuple(range(start, start + len(own)))
                curves[key] = (*curves.get(key, ()), Group(index))
                start += len(own)
        directions = _directions(np.concatenate(law), self.variance)
        return Columns(np.concatenate(rows), groups, directions, curves)

    def _finer(self, rows: Array) -> Array:
        """Columns at the values of a scan, and between each two of them."""
        between = 0.5 * (rows[:-1] + rows[1:])
        between = between * self.unit(between)[:, None]
        found = np.empty((2 * len(rows) - 1, rows.shape[1]))
        found[::2], found[1::2] = rows, between
        return found


def positive_part(score: Score) -> float:
    """Prior probability that an effect's size is above zero; one half with several sizes."""
    if len(score.names) != 1:
        return 0.5
    candidate, (name,) = score.option.candidate, score.names
    sign = candidate.sign.get(name, 0)
    return 0.5 * (1.0 + (sign or (2.0 * LIKELY_SIDE - 1.0) * candidate.usual.get(name, 0)))


def _directions(rows: Array, variance: Array) -> Array:
    """The strongest directions ``(m, n)`` of rows ``(k, n)``, with the same sum of squares."""
    if not len(rows):
        return rows
    white = rows / np.sqrt(variance)
    values, vectors = np.linalg.eigh(white @ white.T)
    order = np.argsort(-values)[:DIRECTIONS]
    order = order[values[order] > WEAKEST * max(float(values.max()), 1e-300)]
    return np.asarray(vectors[:, order].T @ rows)


#: Effects that act, and whether there is something outside the catalogue.
Key = tuple[frozenset[Added], bool]
#: Log evidence of structures.
Evidences = dict[Key, float]
#: Log evidence of effects that act beside a law that resembles one more, by both.
Similar = dict[tuple[frozenset[Added], Added], float]


@dataclass(frozen=True)
class Reached:
    """What follows about one anchor.

    Parameters
    ----------
    structures : mapping of (effects, outside) to float
        Log evidence.
    curves : mapping of (curve, balance) to float
        Log evidence of unnamed functions beside the anchor's effects.
    similar : mapping of (effects, effect) to float
        Log evidence of some effects and a law outside the catalogue that resembles one more.
    """

    structures: Evidences
    curves: dict[Added, float]
    similar: Similar


@dataclass(frozen=True)
class _At:
    """An anchor with its columns, ready to be compared.

    Products of columns are made for those that are looked at together: there are hundreds, and few
    pairs of them are looked at.

    Parameters
    ----------
    comparison : Comparison
    columns : Columns
        Of all candidates.
    residual : ndarray, shape (n,)
    unknowns : ndarray, shape (l, n)
        In units of their priors.
    offset : ndarray, shape (l,)
        Centres of these.
    rows : ndarray, shape (m, n)
        Of the anchor's effects, of unit size in units of the noise.
    own : tuple of Group
        Of the anchor's effects, among these.
    remainders : Remainders
    sizes : ndarray
        Of an effect: root mean square of the part of its change that can be seen (:func:`visible`).
    """

    comparison: Comparison
    columns: Columns
    residual: Array
    unknowns: Array
    offset: Array
    rows: Array
    own: tuple[Group, ...]
    remainders: Remainders
    sizes: Array

    @property
    def likelihood(self) -> Likelihood:
        """Of the residual."""
        return Likelihood(self.comparison.variance.size, self.comparison.freedom)

    def parts(self, groups: Sequence[Group]) -> list[Reduced]:
        """Columns of some groups, one group after the other, by remainder, once for each set of
        sizes of the anchor's own effects."""
        reduced = self._reduced(groups, self.columns.law)
        size = reduced.size - len(self.columns.law)
        return self._by_size(self.remainders.parts(reduced, range(size), range(size, reduced.size)))

    def alone(self, groups: Sequence[Group]) -> list[Reduced]:
        """The same without anything outside the catalogue: of noise alone."""
        return self._by_size(self._reduced(groups, self.columns.law[:0], 1))

    def _reduced(self, groups: Sequence[Group], law: Array, count: int | None = None) -> Reduced:
        """Columns of the anchor's effects, of some groups and of a law after the unknowns are
        integrated out, for all covariances of noise and remainder or the first few."""
        chosen = self.columns.rows[[column for group in groups for column in group.columns]]
        rows = [self.residual[None], self.unknowns, self.rows, chosen, law]
        products, logs = self.remainders.covariances.products(np.concatenate(rows), count)
        reduced = Reduced.of(products, logs, len(self.unknowns), self.offset)
        every = [*self.own, *in_a_row(groups, len(self.rows))]
        return reduced.scaled(visible(reduced, every, self.comparison.data.samples))

    def _by_size(self, parts: Reduced) -> list[Reduced]:
        """With the anchor's own effects, whose columns come first, in the covariance."""
        if not self.own:
            return [parts]
        return parts.by_sizes(self.own, self._own_sizes())

    def _own_sizes(self) -> list[tuple[float, ...]]:
        """Sizes of the anchor's own effects, over a grid."""
        few, number = fewer(self.sizes), len(self.own)
        if number == 2:
            return [(one, other) for one in few for other in few]
        return [(size,) * number for size in few]


def best_alone(evidences: Evidences, count: int) -> list[Added]:
    """Effects with the largest evidence as the only ones."""
    height: dict[Added, float] = {}
    for (effects, _), value in evidences.items():
        if len(effects) == 1:
            (key,) = effects
            height[key] = max(value, height.get(key, -np.inf))
    return sorted(height, key=lambda key: -height[key])[:count]


def evidences_about(
    anchor: EstimatedModel,
    comparison: Comparison,
    columns: Columns,
    chosen: Sequence[Added] | None,
    best_curves: Sequence[Added] | None,
) -> Reached:
    """Log evidence of all structures that an anchor reaches, with all candidates and unnamed
    functions or only with those that are chosen."""
    beside = [key for key in columns.groups if chosen is None or key in chosen]
    beside = [key for key in beside if key not in anchor.effects]
    tried = [key for key in columns.curves if best_curves is None or key in best_curves]
    at = _anchored(anchor, comparison, columns)
    own = frozenset(anchor.effects)
    totals = np.stack(
        [at.likelihood(p.square, p.log_det) + p.log_moment(at.likelihood) for p in at.parts([])],
        axis=1,
    )
    found: Evidences = {}
    for outside, value in zip((False, True), at.remainders.split(totals), strict=True):
        found[own, outside] = mean_of(value)
    similar = _like_own(at, tuple(anchor.effects), totals)
    logs = {key: _curve(at, columns.curves[key]) for key in tried}
    by_curve = _like_own_by_curves(at, tuple(anchor.effects), logs, len(columns.curves))
    for pair, log in by_curve.items():
        similar[pair] = float(np.logaddexp(similar[pair], log) - _LOG_2)
    for some in _chunks({key: columns.groups[key] for key in beside}):
        more, alike = _one_more(at, some)
        found |= {(own | {key}, outside): value for (key, outside), value in more.items()}
        similar |= {(own, key): value for key, value in alike.items()}
    if chosen is None:
        found |= _pairs(at, best_alone(found, IN_PAIRS))
    curves = {key: mean_of(value) for key, value in logs.items()}
    curves = {key: value for key, value in curves.items() if np.isfinite(value)}
    if curves:
        # Half of what is outside the catalogue is a function of one quantity; those that are not
        # tried here explain next to nothing.
        total = logsumexp(list(curves.values())) - np.log(len(columns.curves))
        found[own, True] = float(np.logaddexp(found[own, True], total) - _LOG_2)
    return Reached(found, curves, similar)


def _like_own(at: _At, effects: Sequence[Added], totals: Array) -> Similar:
    """Log evidence of an anchor with a law that resembles one of its effects instead of the effect,
    from that of all remainders and sizes of its own effects (parts, grid)."""
    few, every = fewer(at.sizes), frozenset(effects)
    found: Similar = {}
    for place, key in enumerate(effects):
        logs = totals
        if len(effects) == 2:  # the grid has each size of the one with each of the other
            pairs = totals.reshape(len(totals), few.size, few.size)
            logs = np.moveaxis(pairs, 1 + place, 2)
        found[every - {key}, key] = mean_of(at.remainders.similar(logs, few))
    return found


def _curve(at: _At, groups: Sequence[Group]) -> Array:
    """Log evidence of the anchor's structure with an unnamed function, by fineness, sizes of the
    anchor's own effects, and size of the function."""
    values = []
    for group in groups:
        local, noise = in_a_row([group], 0), at.alone([group])
        found = [effect_evidence(part, at.likelihood, local, at.sizes) for part in noise]
        values.append([logs[0, 0] for logs in found])
    return np.array(values)


def _like_own_by_curves(
    at: _At, effects: Sequence[Added], logs: Mapping[Added, Array], number: int
) -> Similar:
    """The same as :func:`_like_own`, of a law that differs from the effect by a function of one
    quantity, of which there are so many."""
    few, every = fewer(at.sizes), frozenset(effects)
    finite = [value for value in logs.values() if np.isfinite(value).all()]
    if not effects or not finite:
        return {}
    share = log_difference(at.sizes / few[:, None])
    share = share - logsumexp(share, axis=1, keepdims=True)  # (own sizes, sizes of the function)
    found: Similar = {}
    for place, key in enumerate(effects):
        grid = np.arange(few.size)
        if len(effects) == 2:
            grid = np.repeat(grid, few.size) if place == 0 else np.tile(grid, few.size)
        each = [mean_of(logsumexp(value + share[grid], axis=2)) for value in finite]
        found[every - {key}, key] = float(logsumexp(each) - np.log(number))
    return found


def _chunks(groups: Mapping[Added, Sequence[Group]]) -> list[list[Added]]:
    """Effects a few at a time, so that products of all their columns need little memory."""
    chunks: list[list[Added]] = [[]]
    count = 0
    for key, own in groups.items():
        count += sum(len(group.columns) for group in own)
        if count > CHUNK and chunks[-1]:
            chunks.append([])
            count = sum(len(group.columns) for group in own)
        chunks[-1].append(key)
    return chunks


def _one_more(
    at: _At, keys: Sequence[Added]
) -> tuple[dict[tuple[Added, bool], float], dict[Added, float]]:
    """Log evidence of the anchor's structure with one more effect, and with a law like it."""
    flat = [(key, group) for key in keys for group in at.columns.groups[key]]
    if not flat:
        return {}, {}
    own = in_a_row([group for _, group in flat], 0)
    labels, largest = [list(keys).index(key) for key, _ in flat], Largest.of(len(keys))
    each: dict[int, Array] = {}
    parts = at.parts([group for _, group in flat])
    # Probable sizes of the anchor's own effects come first: beside them most others are small.
    height = [at.likelihood(part.square, part.log_det).max() for part in parts]
    for k in np.argsort(height)[::-1]:
        each[k] = effect_evidence(parts[k], at.likelihood, own, at.sizes, labels, largest)
    # (remainders, own sizes, groups, sizes)
    logs = np.stack([each[k] for k in range(len(parts))], axis=1)
    without, outside = at.remainders.split(logs)
    alike = at.remainders.similar(logs, at.sizes)
    found, similar = {}, {}
    for key in keys:
        index = [k for k, (other, _) in enumerate(flat) if other == key]
        found[key, False], found[key, True] = mean_of(without[:, index]), mean_of(outside[:, index])
        similar[key] = mean_of(alike[:, index])
    return found, similar


def grids_of(comparison: Comparison, reach: Array) -> tuple[Remainders, Array]:
    """Remainders, and sizes of an effect."""
    data, variance = comparison.data, comparison.variance
    outputs = len(data.outputs)
    unit = np.array([np.sqrt(variance[data.output_of == b].mean()) for b in range(outputs)])
    sizes = sizes_between(float(np.max(reach / unit)), data.samples)
    covariances = Covariances.of(
        variance, data.smooth(), data.output_of, reach, data.samples // outputs
    )
    return Remainders.of(covariances, fewer(sizes)), sizes


def _anchored(anchor: EstimatedModel, comparison: Comparison, columns: Columns) -> _At:
    """Residual, unknowns and columns about an anchor."""
    here = linearised(anchor, comparison.data)
    # Errors of the inputs are unknowns as well.
    return _At(
        comparison,
        columns,
        here.residual,
        np.concatenate([here.unknowns, comparison.shared]),
        np.concatenate([here.offset, np.zeros(len(comparison.shared))]),
        here.own * comparison.unit(here.own)[:, None],
        own_groups(anchor, comparison),
        *grids_of(comparison, comparison.data.signal(anchor.fit)),
    )


def visible(reduced: Reduced, groups: Sequence[Group], samples: int) -> Array:
    """Factors ``(k,)`` by which columns of unit size grow, so that what the unknowns of the model
    cannot do of them has unit size: the smallest size that could be seen is that of this part.

    Unknowns are those of the model about which structures are compared, with the shapes of its
    effects. Under a prior whose sizes begin where a change as a whole could be seen, much of what
    is called missing could not be, for most of it is a change of the model's own parameters.
    """
    seen, factors = np.diagonal(reduced.gram[0]), np.ones(reduced.size)
    for group in groups:
        index = list(group.columns)
        part = float(np.sum(seen[index])) / (samples * len(index))
        factors[index] = min(max(part, LEAST_SEEN), 1.0) ** -0.5
    return factors


def own_groups(anchor: EstimatedModel, comparison: Comparison) -> tuple[Group, ...]:
    """Columns of each of an anchor's effects, in the order of :func:`linearised`."""
    scores = {s.option.key: s for s in (*comparison.scores, *comparison.later)}
    found, start = [], 0
    for key, names in anchor.effects.items():
        size = sum(name.split("[")[0] in names for name in anchor.fit.problem.names)
        positive = positive_part(scores[key]) if size == 1 and key in scores else 0.5
        found.append(Group(tuple(range(start, start + size)), positive))
        start += size
    return tuple(found)


def _pairs(at: _At, best: Sequence[Added]) -> Evidences:
    """Log evidence of pairs of some effects with one unknown each."""
    every = at.columns.groups
    able = [key for key in best if all(len(group.columns) == 1 for group in every[key])]
    flat = [(key, group) for key in able for group in every[key]]
    local = in_a_row([group for _, group in flat], 0)
    groups = {
        key: [one for one, (other, _) in zip(local, flat, strict=True) if other == key]
        for key in able
    }
    found: Evidences = {}
    (parts,), few = at.parts([group for _, group in flat]), fewer(at.sizes)
    for place, first in enumerate(able[:-1], 1):
        flat = [(second, group) for second in able[place:] for group in groups[second]]
        others = [group for _, group in flat]
        labels, largest = [able.index(second) for second, _ in flat], Largest.of(len(able))
        each = [
            pair_evidence(parts, at.likelihood, one, others, few, labels, largest)
            for one in groups[first]
        ]
        # (remainders, groups of the first, groups of others, sizes, sizes)
        logs = np.stack(each, axis=1)
        for outside, value in zip((False, True), at.remainders.split(logs), strict=True):
            for second in able[place:]:
                index = [k for k, (key, _) in enumerate(flat) if key == second]
                found[frozenset({first, second}), outside] = mean_of(value[:, index])
    return found
