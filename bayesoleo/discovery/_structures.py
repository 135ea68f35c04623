"""Posterior probabilities of structures: which effects act, alone or together, and whether there is
something outside the catalogue.

Every model that the search has estimated is an anchor: about it the marginal likelihoods of the
structures with no more, one more or two more effects follow from the columns of the scores. Where
several anchors reach a structure, the one that has estimated most of its effects counts.

The prior is stated: one half that nothing is missing, two fifths for effects of the catalogue, one
tenth for something outside of it. The share of the catalogue is divided equally among families,
then among the effects of a family, so that near copies do not weigh more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from scipy.special import logsumexp

from bayesoleo._types import Array
from bayesoleo.discovery._assembly import Added
from bayesoleo.discovery._error_table import RunError
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._ranking import ABSORBING_FAMILIES
from bayesoleo.discovery._score_tests import Score
from bayesoleo.discovery._spectral_data import SpectralData
from bayesoleo.discovery._structure_evidence import (
    Covariances,
    Group,
    Likelihood,
    Reduced,
    effect_evidence,
    fewer,
    mean_of,
    pair_evidence,
    sizes_between,
)
from bayesoleo.estimation._least_squares import PriorScale

#: Effects that are considered beside those of an anchor, pairs of them, and directions that a law
#: outside the catalogue is made of.
BESIDE, IN_PAIRS, DIRECTIONS = 40, 10, 40
#: Unnamed functions that are considered beside the effects of an anchor.
BEST_CURVES = 3
#: Prior weight of a family that absorbs any model error, beside that of one which names a cause.
ABSORBING = 0.2
#: Part of the log evidence for an effect that its score may miss, and what of it does not matter.
UNSURE, NEGLIGIBLE = 0.03, 0.1
_LOG_2 = float(np.log(2.0))
#: Columns whose products with each other are kept at a time.
CHUNK = 64
#: A direction of the law weaker than this part of the strongest is left out.
WEAKEST = 1e-4
#: Noise whose degrees of freedom are more than this is known.
KNOWN = 1e5


@dataclass(frozen=True)
class StructurePrior:
    """Prior probabilities of structures.

    Parameters
    ----------
    nothing, catalogue, outside : float
        That nothing is missing, that effects of the catalogue are, and that only something outside
        of it is. They are divided by their sum.
    numbers : tuple of float
        Of one, two, three... effects, given that some act. They are divided by their sum.
    families : mapping of str to float
        Weights of families of effects. By default they are one, but less for parameters that vary
        from run to run and forces that repeat with the drive, because these absorb a part of
        whatever is missing and name no cause.
    """

    nothing: float = 0.5
    catalogue: float = 0.4
    outside: float = 0.1
    numbers: tuple[float, ...] = (0.75, 0.2, 0.04, 0.01)
    families: Mapping[str, float] = field(default_factory=dict)

    @property
    def also_outside(self) -> float:
        """Probability that something outside acts too where effects of the catalogue do."""
        return self.outside / (self.nothing + self.outside)

    def weights(self, families: Mapping[Added, str]) -> dict[Added, float]:
        """Prior probability of each effect as the only one."""
        members: dict[str, list[Added]] = {}
        for key, family in families.items():
            members.setdefault(family, []).append(key)
        share = {
            family: self.families.get(family, ABSORBING if family in ABSORBING_FAMILIES else 1.0)
            for family in members
        }
        total = sum(share.values())
        return {
            key: share[family] / total / len(keys)
            for family, keys in members.items()
            for key in keys
        }

    def log_probability(
        self, effects: Sequence[Added], outside: bool, weights: Mapping[Added, float]
    ) -> float:
        """Logarithm of the prior probability of a structure."""
        total = self.nothing + self.catalogue + self.outside
        if not effects:
            return float(np.log((self.outside if outside else self.nothing) / total))
        numbers = np.array(self.numbers) / sum(self.numbers)
        number = numbers[min(len(effects), numbers.size) - 1]
        # A set of effects comes about in any order.
        sets = float(np.prod([weights[key] for key in effects]))
        sets *= float(np.prod(np.arange(1, len(effects) + 1)))
        rest = self.also_outside if outside else 1.0 - self.also_outside
        return float(np.log(self.catalogue / total * number * sets * rest))


@dataclass(frozen=True)
class Structure:
    """A set of effects with its probability.

    Parameters
    ----------
    effects : tuple of (effect, target)
        Those that act; empty for none.
    outside : bool
        Whether something outside the catalogue acts.
    probability : float
    log_evidence : float
        Of the data, but for a constant that all structures share.
    estimated : bool
        Whether all its effects were estimated together; else it follows from scores.
    """

    effects: tuple[Added, ...]
    outside: bool
    probability: float
    log_evidence: float
    estimated: bool


@dataclass(frozen=True)
class StructurePosterior:
    """Probabilities of all structures that were compared.

    Parameters
    ----------
    structures : tuple of Structure
        By falling probability; their sum is one.
    prior : StructurePrior
    """

    structures: tuple[Structure, ...]
    prior: StructurePrior

    @property
    def nothing(self) -> float:
        """Probability that nothing is missing."""
        return sum(s.probability for s in self.structures if not s.effects and not s.outside)

    @property
    def outside(self) -> float:
        """Probability that something outside the catalogue acts, alone or beside effects."""
        return sum(s.probability for s in self.structures if s.outside)

    @property
    def only_outside(self) -> float:
        """Probability that something outside the catalogue acts, and no effect of it."""
        return sum(s.probability for s in self.structures if s.outside and not s.effects)

    @property
    def effects(self) -> dict[Added, float]:
        """Probability of each effect, by falling probability."""
        found: dict[Added, float] = {}
        for structure in self.structures:
            for key in structure.effects:
                found[key] = found.get(key, 0.0) + structure.probability
        return dict(sorted(found.items(), key=lambda item: -item[1]))


@dataclass(frozen=True)
class EstimatedModel:
    """An estimated model, about which structures are compared.

    Parameters
    ----------
    fit : ModelFit
    effects : mapping of (effect, target) to tuple of str
        Those that it has, with the names of their amplitudes.
    shapes : mapping of str to tuple of float
        Scanned values of their shape parameters. A shape has a prior that is normal in its
        logarithm, with the centre and the spread of the whole scan, as scores have.
    """

    fit: ModelFit
    effects: Mapping[Added, tuple[str, ...]]
    shapes: Mapping[str, tuple[float, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class _Columns:
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
    freedom : float
        Degrees of freedom with which the noise is known.
    scores : sequence of Score
        Candidates, with their columns.
    prior : StructurePrior
    curves : mapping of (curve, balance) to tuple of ndarray, shape (K, n)
        Changes of the outputs by unnamed functions, fine and coarse.
    """

    data: SpectralData
    variance: Array
    freedom: float
    scores: Sequence[Score]
    prior: StructurePrior
    curves: Mapping[tuple[str, str], tuple[Array, ...]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        data: SpectralData,
        errors: Mapping[tuple[str, str], RunError],
        scores: Sequence[Score],
        prior: StructurePrior,
        curves: Mapping[tuple[str, str], tuple[Array, ...]] | None = None,
    ) -> Comparison:
        """With the noise of an error table."""
        used = [errors[r.record.label, o] for r in data.runs for o in data.outputs]
        freedom = float(sum(max(entry.free, 1.0) for entry in used))
        return cls(data, data.noise(errors), min(freedom, KNOWN), scores, prior, curves or {})

    @property
    def weights(self) -> dict[Added, float]:
        """Prior probability of each candidate as the only effect."""
        families = {s.option.key: s.option.candidate.family for s in self.scores}
        return self.prior.weights(families)

    def unit(self, rows: Array) -> Array:
        """Factors ``(k,)`` that scale rows ``(k, n)`` to unit size in units of the noise."""
        norms = np.sqrt(np.sum(rows**2 / self.variance, axis=1) / self.data.samples)
        return 1.0 / np.where(norms > 0, norms, np.inf)

    def columns(self) -> _Columns:
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
            sign = score.option.candidate.sign.get(score.names[0], 0) if size == 1 else 0
            groups[score.option.key] = tuple(
                Group(tuple(range(start + k, start + k + size)), sign)
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
        return _Columns(np.concatenate(rows), groups, directions, curves)

    def _finer(self, rows: Array) -> Array:
        """Columns at the values of a scan, and between each two of them."""
        between = 0.5 * (rows[:-1] + rows[1:])
        between = between * self.unit(between)[:, None]
        found = np.empty((2 * len(rows) - 1, rows.shape[1]))
        found[::2], found[1::2] = rows, between
        return found


def _directions(rows: Array, variance: Array) -> Array:
    """The strongest directions ``(m, n)`` of rows ``(k, n)``, with the same sum of squares."""
    if not len(rows):
        return rows
    white = rows / np.sqrt(variance)
    values, vectors = np.linalg.eigh(white @ white.T)
    order = np.argsort(-values)[:DIRECTIONS]
    order = order[values[order] > WEAKEST * max(float(values.max()), 1e-300)]
    return np.asarray(vectors[:, order].T @ rows)


@dataclass(frozen=True)
class _Remainders:
    """Covariances of what lies outside the catalogue.

    Parameters
    ----------
    covariances : Covariances
    weights : tuple of (pattern, law, weight)
        Number of a covariance, number of a size of the law or None, and prior probability given
        that there is something outside; the first of all stands for nothing outside.
    laws : ndarray
        Sizes of the law.
    """

    covariances: Covariances
    weights: tuple[tuple[int, int | None, float], ...]
    laws: Array

    @classmethod
    def of(cls, covariances: Covariances, laws: Array) -> _Remainders:
        """Half of what is outside is a function of phase alone, half a law with or without one."""
        patterns, sizes = len(covariances.patterns), laws.size
        together = range(1, 1 + covariances.levels.shape[1])
        found: list[tuple[int, int | None, float]] = [(0, None, 0.0)]
        found += [(k, None, 0.5 / (patterns - 1)) for k in range(1, patterns)]
        found += [(0, j, 0.25 / sizes) for j in range(sizes)]
        found += [(k, j, 0.25 / sizes / len(together)) for k in together for j in range(sizes)]
        return cls(covariances, tuple(found), laws)

    def parts(self, reduced: Reduced, keep: Sequence[int], law: Sequence[int]) -> Reduced:
        """Some columns for each covariance in turn, after a law is integrated out."""
        size = len(law)
        patterns = [k for k, _, _ in self.weights]
        grown = reduced.of_some(patterns, [*law, *keep])
        power = np.array([0.0 if j is None else self.laws[j] ** 2 for _, j, _ in self.weights])
        some = np.repeat(power[:, None], size, axis=1)
        return grown.with_columns(range(size), some, range(size, size + len(keep)))

    def split(self, logs: Array) -> tuple[Array, Array]:
        """Log evidence without, and with something outside, from that of all parts (parts, ...)."""
        weights = np.array([w for _, _, w in self.weights[1:]])
        shape = (-1, *(1,) * (logs.ndim - 1))
        return logs[0], logsumexp(logs[1:], axis=0, b=weights.reshape(shape))


#: Effects that act, and whether there is something outside the catalogue.
Key = tuple[frozenset[Added], bool]
#: Log evidence of structures.
Evidences = dict[Key, float]


@dataclass(frozen=True)
class _At:
    """An anchor with its columns, ready to be compared.

    Parameters
    ----------
    reduced : Reduced
        By covariance of noise and remainder; own columns first, then candidates, then the law.
    remainders : _Remainders
    likelihood : Likelihood
    sizes : ndarray
        Of an effect.
    own : tuple of Group
        Of the anchor's effects.
    groups : mapping of (effect, target) to list of Group
        Of candidates.
    curves : mapping of (curve, balance) to list of Group
        Of unnamed functions.
    law : list of int
        Columns of the law.
    """

    reduced: Reduced
    remainders: _Remainders
    likelihood: Likelihood
    sizes: Array
    own: tuple[Group, ...]
    groups: dict[Added, list[Group]]
    curves: dict[Added, list[Group]]
    law: list[int]

    def parts(self, columns: Sequence[int]) -> list[Reduced]:
        """Some columns by remainder, once for each set of sizes of the anchor's own effects."""
        own = [c for group in self.own for c in group.columns]
        parts = self.remainders.parts(self.reduced, [*own, *columns], self.law)
        if not own:
            return [parts]
        rest = range(len(own), parts.size)
        return [parts.with_columns(range(len(own)), power, rest) for power in self._powers()]

    def _powers(self) -> list[Array]:
        """Variances of the anchor's own columns, over a grid of sizes."""
        few, number = fewer(self.sizes), len(self.own)
        if number == 2:
            grid = [(one, other) for one in few for other in few]
        else:
            grid = [(size,) * number for size in few]
        counts = [len(group.columns) for group in self.own]
        return [np.repeat(np.array(chosen) ** 2 / counts, counts) for chosen in grid]


@dataclass
class Evidence:
    """Log evidence of all structures that the anchors so far reach.

    Parameters
    ----------
    comparison : Comparison
    """

    comparison: Comparison
    columns: _Columns = field(init=False)
    found: Evidences = field(default_factory=dict)
    _depth: dict[Key, int] = field(default_factory=dict)
    _curves: list[Added] | None = None
    _beyond: Evidences = field(default_factory=dict)
    _chosen: list[Added] | None = None

    def __post_init__(self) -> None:
        self.columns = self.comparison.columns()

    def add(self, anchor: EstimatedModel) -> None:
        """Compare structures about one more estimated model; the declared one comes first.

        Where several anchors reach a structure, the one that has more of its effects counts, and
        of those the one with the larger evidence: it is better linearised.
        """
        if not set(anchor.effects) <= set(self.columns.groups):
            return  # it has effects that were not scored, such as a curve
        result, curves = _evidences(
            anchor, self.comparison, self.columns, self._chosen, self._curves
        )
        if self._chosen is None:
            self._chosen = _best(result, BESIDE)
            self._curves = sorted(curves, key=lambda key: -curves[key])[:BEST_CURVES]
        here = len(anchor.effects)
        for key, value in result.items():
            there = self._depth.get(key, -1)
            if here > there or (here == there and value > self.found[key]):
                self.found[key], self._depth[key] = value, here
                own = result[frozenset(anchor.effects), key[1]]
                self._beyond[key] = max(value - own, 0.0)

    def posterior(self) -> StructurePosterior:
        """Probabilities by the evidence and the prior."""
        prior, weights = self.comparison.prior, self.comparison.weights
        keys = list(self.found)
        logs = np.array(
            [
                self.found[key] + prior.log_probability(tuple(key[0]), key[1], weights)
                for key in keys
            ]
        )
        probability = np.exp(logs - logsumexp(logs))
        structures = [
            Structure(tuple(sorted(key[0])), key[1], float(p), self.found[key], self.estimated(key))
            for key, p in zip(keys, probability, strict=True)
        ]
        by_probability = sorted(structures, key=lambda item: -item.probability)
        return StructurePosterior(tuple(by_probability), prior)

    def estimated(self, key: Key) -> bool:
        """Whether a structure's effects were estimated together."""
        return self._depth.get(key, -1) == len(key[0])

    def doubtful(self, least: float) -> list[tuple[Added, ...]]:
        """Sets of effects that may be probable but are known by scores only, best first.

        A score is linear and knows shapes coarsely: of what a set explains beyond the estimate that
        it was scored at, it may miss a part. Where that part is small no estimate is needed.

        Parameters
        ----------
        least : float
            Logarithm of the smallest ratio to the most probable structure.
        """
        prior, weights = self.comparison.prior, self.comparison.weights
        height: dict[tuple[Added, ...], float] = {}
        best = -np.inf
        for key, value in self.found.items():
            effects, missed = tuple(sorted(key[0])), UNSURE * self._beyond[key]
            value = value + prior.log_probability(effects, key[1], weights)
            best = max(best, value)
            if not self.estimated(key) and missed > NEGLIGIBLE:
                height[effects] = max(height.get(effects, -np.inf), value + missed)
        likely = [effects for effects in height if height[effects] > best + least]
        # An estimate of a part tells whether the whole is worth one.
        whole = [e for e in likely if any(set(part) < set(e) for part in likely)]
        return sorted(set(likely) - set(whole), key=lambda effects: -height[effects])


def _best(evidences: Evidences, count: int) -> list[Added]:
    """Effects with the largest evidence as the only ones."""
    height: dict[Added, float] = {}
    for (effects, _), value in evidences.items():
        if len(effects) == 1:
            (key,) = effects
            height[key] = max(value, height.get(key, -np.inf))
    return sorted(height, key=lambda key: -height[key])[:count]


def _evidences(
    anchor: EstimatedModel,
    comparison: Comparison,
    columns: _Columns,
    chosen: Sequence[Added] | None,
    best_curves: Sequence[Added] | None,
) -> tuple[Evidences, dict[Added, float]]:
    """Log evidence of all structures that an anchor reaches, and of unnamed functions beside its
    effects: all of them, or only those that are chosen."""
    beside = [key for key in columns.groups if chosen is None or key in chosen]
    beside = [key for key in beside if key not in anchor.effects]
    tried = [key for key in columns.curves if best_curves is None or key in best_curves]
    at = _anchored(anchor, comparison, columns, beside, tried)
    own = frozenset(anchor.effects)
    totals = np.stack([at.likelihood(p.square, p.log_det) for p in at.parts([])], axis=1)
    found: Evidences = {}
    for outside, value in zip((False, True), at.remainders.split(totals), strict=True):
        found[own, outside] = mean_of(value)
    for some in _chunks(at.groups):
        found |= {
            (own | {key}, outside): value for (key, outside), value in _one_more(at, some).items()
        }
    if chosen is None:
        found |= _pairs(at, _best(found, IN_PAIRS))
    curves = {key: _curve(at, groups) for key, groups in at.curves.items()}
    if curves:
        # Half of what is outside the catalogue is a function of one quantity; those that are not
        # tried here explain next to nothing.
        total = logsumexp(list(curves.values())) - np.log(len(columns.curves))
        found[own, True] = float(np.logaddexp(found[own, True], total) - _LOG_2)
    return found, curves


def _curve(at: _At, groups: Sequence[Group]) -> float:
    """Log evidence of the anchor's structure with an unnamed function."""
    values = []
    for group in groups:
        local = Group(tuple(range(len(group.columns))))
        noise = [part.of_some([0], local.columns) for part in at.parts(group.columns)]
        values += [effect_evidence(part, at.likelihood, [local], at.sizes) for part in noise]
    return mean_of(np.array(values))


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


def _one_more(at: _At, keys: Sequence[Added]) -> dict[tuple[Added, bool], float]:
    """Log evidence of the anchor's structure with one more effect."""
    columns, groups = _local(at, keys)
    flat = [(key, group) for key in keys for group in groups[key]]
    if not flat:
        return {}
    own = [group for _, group in flat]
    logs = np.stack(
        [effect_evidence(p, at.likelihood, own, at.sizes) for p in at.parts(columns)], axis=1
    )  # (remainders, own sizes, groups, sizes)
    found = {}
    for outside, value in zip((False, True), at.remainders.split(logs), strict=True):
        for key in keys:
            index = [k for k, (other, _) in enumerate(flat) if other == key]
            found[key, outside] = mean_of(value[:, index])
    return found


def _local(at: _At, keys: Sequence[Added]) -> tuple[list[int], dict[Added, list[Group]]]:
    """Columns of some effects, and their groups among these."""
    columns = [c for key in keys for group in at.groups[key] for c in group.columns]
    place = {column: k for k, column in enumerate(columns)}
    groups = {
        key: [Group(tuple(place[c] for c in g.columns), g.sign) for g in at.groups[key]]
        for key in keys
    }
    return columns, groups


def _grids(comparison: Comparison, reach: Array) -> tuple[_Remainders, Array]:
    """Remainders, and sizes of an effect."""
    data, variance = comparison.data, comparison.variance
    outputs = len(data.outputs)
    unit = np.array([np.sqrt(variance[data.output_of == b].mean()) for b in range(outputs)])
    sizes = sizes_between(float(np.max(reach / unit)), data.samples)
    covariances = Covariances.of(
        variance, data.smooth(), data.output_of, reach, data.samples // outputs
    )
    return _Remainders.of(covariances, fewer(sizes)), sizes


def _anchored(
    anchor: EstimatedModel,
    comparison: Comparison,
    columns: _Columns,
    beside: Sequence[Added],
    tried: Sequence[Added],
) -> _At:
    """Products of residual, unknowns and columns about an anchor, unknowns integrated out."""
    fit, data = anchor.fit, comparison.data
    residual, unknowns, offset, own, values = _linearised(anchor, data)
    # The prior of an effect's amplitude is centred on its absence, not on its estimate.
    residual = residual + values @ own
    index: list[int] = []

    def placed(chosen: Sequence[Group]) -> list[Group]:
        """Groups with their columns in the order in which these are used."""
        found = []
        for group in chosen:
            start = len(own) + len(index)
            index.extend(group.columns)
            found.append(Group(tuple(range(start, start + len(group.columns))), group.sign))
        return found

    groups = {key: placed(columns.groups[key]) for key in beside}
    curves = {key: placed(columns.curves[key]) for key in tried}
    scale = comparison.unit(own)[:, None]
    rows = [residual[None], unknowns, own * scale, columns.rows[index], columns.law]
    remainders, sizes = _grids(comparison, data.signal(fit))
    products, logs = remainders.covariances.products(np.concatenate(rows))
    count = len(own) + len(index)
    return _At(
        Reduced.of(products, logs, len(unknowns), offset),
        remainders,
        Likelihood(comparison.variance.size, comparison.freedom),
        sizes,
        _own_groups(anchor),
        groups,
        curves,
        list(range(count, count + len(columns.law))),
    )


def _own_groups(anchor: EstimatedModel) -> tuple[Group, ...]:
    """Columns of each of an anchor's effects, in the order of :func:`_linearised`."""
    found, start = [], 0
    for names in anchor.effects.values():
        size = sum(name.split("[")[0] in names for name in anchor.fit.problem.names)
        found.append(Group(tuple(range(start, start + size))))
        start += size
    return tuple(found)


def _linearised(
    anchor: EstimatedModel, data: SpectralData
) -> tuple[Array, Array, Array, Array, Array]:
    """Residual (n,), columns (l, n) of unknowns in units of their priors, centres (l,) of these,
    and columns (k, n) and values (k,) of the amplitudes of the anchor's effects."""
    fit = anchor.fit
    problem, theta = fit.problem, fit.point.theta
    place = [fit.predictor.layout.names.index(name) for name in problem.names]
    rows = data.columns([p.sensitivity[:, place] for p in fit.predictions])
    amplitudes = [
        k
        for names in anchor.effects.values()
        for k, name in enumerate(problem.names)
        if name.split("[")[0] in names
    ]
    rest = [k for k in range(len(problem.names)) if k not in amplitudes]
    scale = PriorScale.of(problem.priors, problem.names)
    precision = (scale.root.T @ scale.root)[np.ix_(rest, rest)]
    unit, slope = scale.unit(theta)[rest], np.nan_to_num(scale.slope(theta)[rest])
    for k, index in enumerate(rest):
        scan = anchor.shapes.get(problem.names[index])
        if scan is not None:
            centre, spread = scan_prior(scan)
            unit[k], slope[k] = theta[index] * spread, (centre - np.log(theta[index])) / spread
    root = np.linalg.cholesky(precision)  # lower, of the precision: root' delta has unit variance
    unknowns = np.linalg.solve(root, rows[rest] * unit[:, None])
    offset = np.linalg.solve(root, slope)
    own = rows[amplitudes]
    return data.residual(fit), unknowns, offset, own, theta[amplitudes]


def scan_prior(values: Sequence[float]) -> tuple[float, float]:
    """Centre and standard deviation of the logarithm of a shape, as wide as its scan."""
    logs = np.log(np.asarray(values, dtype=float))
    # Each value stands for the range half way to its neighbours.
    step = np.mean(np.diff(logs)) if logs.size > 1 else 1.0
    return float(logs.mean()), float((np.ptp(logs) + step) / np.sqrt(12.0))


def _pairs(at: _At, best: Sequence[Added]) -> Evidences:
    """Log evidence of pairs of some effects with one unknown each."""
    able = [key for key in best if all(len(group.columns) == 1 for group in at.groups[key])]
    columns, groups = _local(at, able)
    found: Evidences = {}
    (parts,), few = at.parts(columns), fewer(at.sizes)
    for first, second in combinations(able, 2):
        logs = np.stack(
            [
                pair_evidence(parts, at.likelihood, one, other, few)
                for one in groups[first]
                for other in groups[second]
            ],
            axis=1,
        )
        for outside, value in zip((False, True), at.remainders.split(logs), strict=True):
            found[frozenset({first, second}), outside] = mean_of(value)
    return found
