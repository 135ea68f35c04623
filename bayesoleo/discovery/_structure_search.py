"""Which structures are worth an estimate, and their posterior probabilities.

Scores linearise the model at its estimate without the effects. That is exact enough for small
effects only, and shapes are scanned on a coarse grid. Structures that may be probable are therefore
estimated, and compared again about their estimates, until no other one may be.

A law outside the catalogue has no name, but acts alike in all runs. It is represented by a smooth
function of one quantity of the model, by itself, times the velocity, or by direction of motion, in
each balance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations

import numpy as np
from scipy.special import logsumexp

from bayesoleo._parallel import thread_map
from bayesoleo._types import Array, ProgressCallback
from bayesoleo._worker_processes import process_map
from bayesoleo.discovery._assembly import Added, Assembly, Option
from bayesoleo.discovery._averaged_parameters import averaged
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._fit_and_hold_out_error import RunError
from bayesoleo.discovery._nonparametric_quantities import (
    TOGETHER,
    Forced,
    Motions,
    quantities_of,
)
from bayesoleo.discovery._nonparametric_search import coarser
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._refit import new_parameters, quick_fit
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._score_tests import Score
from bayesoleo.discovery._spectral_data import EstimatedModel, scan_prior
from bayesoleo.discovery._structure_columns import log_sum_of
from bayesoleo.discovery._structure_comparison import (
    Columns,
    Comparison,
    Evidences,
    Key,
    Reached,
    best_alone,
    evidences_about,
)
from bayesoleo.discovery._structures import Structure, StructurePosterior, StructurePrior
from bayesoleo.effects._nonparametric import Axis, balance_places
from bayesoleo.errors import ModelError, number_of
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Parameter
from bayesoleo.model._priors import LogNormal
from bayesoleo.prediction._records import Record
from bayesoleo.solvers._orbit import Status

#: Structures are estimated this many at a time, so often, where their probability may be more than
#: this part of the most probable one's.
AT_A_TIME, TIMES, WORTH = 4, 6, 0.01
#: Part of what an effect explains alone, from which it is estimated beside others.
LESS = 0.3
#: Parts of sets of effects are estimated where the whole is this probable, compared with the most
#: probable structure.
LIKELY = 0.1
DEFAULT_PRIOR = StructurePrior()
LOG_2 = math.log(2.0)
#: Effects and unnamed functions that are considered beside the effects of an anchor.
BESIDE, BEST_CURVES = 40, 3
#: Part of the log evidence for an effect that its score may miss, the same of one whose shapes are
#: scanned, and what of it does not matter.
UNSURE, UNSURE_SHAPE, NEGLIGIBLE = 0.01, 0.2, 0.1
#: Pieces of the splines: a curve is either fine or coarse.
FINE, COARSE = 16, 4
#: Part of the largest velocity within which a change of direction takes place.
TURNING = 0.02

#: What a curve is of, and its balance.
CurveKey = tuple[str, str]
_Courses = Callable[[int, Array], Array]


@dataclass
class Evidence:
    """Log evidence of all structures that the anchors so far reach.

    Parameters
    ----------
    comparison : Comparison
    """

    comparison: Comparison
    columns: Columns = field(init=False)
    found: Evidences = field(default_factory=dict)
    _depth: dict[Key, int] = field(default_factory=dict)
    _curves: list[Added] | None = None
    _beyond: Evidences = field(default_factory=dict)
    _chosen: list[Added] | None = None
    _similar: dict[frozenset[Added], dict[Added, float]] = field(default_factory=dict)
    _anchors: dict[Key, EstimatedModel] = field(default_factory=dict)
    _resemblance: dict[Added, float] = field(init=False)
    #: Sets of several effects, by the other effects that they were compared beside.
    _several: dict[frozenset[Added], set[frozenset[Added]]] = field(default_factory=dict)
    _shaped: set[Added] = field(init=False)
    _weights: dict[Added, float] = field(init=False)
    _shares: dict[frozenset[Added], float] = field(default_factory=dict)
    #: Evidence with what may resemble others, until there is more.
    _whole: Evidences = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.columns = self.comparison.columns()
        self._weights = self.comparison.weights
        prior = self.comparison.prior
        self._resemblance = prior.resemblance(self.comparison.families)
        options = [s.option for s in (*self.comparison.scores, *self.comparison.later)]
        self._shaped = {option.key for option in options if option.candidate.shapes}

    def add(self, *anchors: EstimatedModel, jobs: int | None = 1) -> None:
        """Compare structures about more estimated models; the declared one comes first, alone.

        Where several anchors reach a structure, the one that has more of its effects counts, and
        of those the one with the larger evidence: it is better linearised. About different anchors
        evidence is computed on so many threads.
        """
        # One that has effects that were not scored, such as a curve, is left out.
        known = [one for one in anchors if set(one.effects) <= set(self.comparison.families)]
        for anchor, reached in zip(known, thread_map(self._reached, known, jobs), strict=True):
            self._take(anchor, reached)

    def _reached(self, anchor: EstimatedModel) -> Reached:
        # What cannot be computed about a poor estimate is no number; the rest counts.
        with np.errstate(all="ignore"):
            return evidences_about(
                anchor, self.comparison, self.columns, self._chosen, self._curves
            )

    def _take(self, anchor: EstimatedModel, reached: Reached) -> None:
        result, curves = reached.structures, reached.curves
        own = frozenset(anchor.effects)
        if not np.isfinite([result[own, False], result[own, True]]).all():
            return  # an estimate that failed, about which nothing is known
        self._whole.clear()
        result = {key: value for key, value in result.items() if np.isfinite(value)}
        if self._chosen is None:
            self._chosen = best_alone(result, BESIDE)
            self._curves = sorted(curves, key=lambda key: -curves[key])[:BEST_CURVES]
        here = len(anchor.effects)
        for (effects, alike), value in reached.similar.items():
            like = self._similar.setdefault(effects, {})
            # About an estimate of the effect itself it is better linearised.
            if np.isfinite(value) and (alike in own or alike not in like):
                like[alike] = value
        for key, value in result.items():
            there = self._depth.get(key, -1)
            if here > there or (here == there and value > self.found[key]):
                self.found[key], self._depth[key] = value, here
                self._anchors[key] = anchor
                self._beyond[key] = max(value - result[own, key[1]], 0.0)
        for every in {effects for effects, outside in result if not outside}:
            for count in range(2, len(every) + 1):
                for more in map(frozenset, combinations(sorted(every), count)):
                    self._several.setdefault(every - more, set()).add(more)

    def evidence_of(self, key: Key) -> float:
        """Log evidence of a structure.

        Half of the laws outside the catalogue resemble one of its effects, or several together.
        """
        effects, outside = key
        if not outside:
            return self.found[key]
        if key not in self._whole:
            self._whole[key] = self._with_likeness(effects)
        return self._whole[key]

    def _with_likeness(self, effects: frozenset[Added]) -> float:
        """Log evidence of some effects with something outside that may resemble others."""
        found = self.found
        like = [
            value + self._log_share(frozenset({one}))
            for one, value in self._similar.get(effects, {}).items()
        ]
        # Several resemble whatever is missing so nearly that half the time no difference is seen.
        for more in self._several.get(effects, ()):
            both = [found[effects | more, False], found.get((effects | more, True), -math.inf)]
            like.append(log_sum_of(both) - LOG_2 + self._log_share(more))
        alone = found[effects, True]
        return log_sum_of([alone, log_sum_of(like)]) - LOG_2 if like else alone

    def _log_share(self, effects: frozenset[Added]) -> float:
        """Logarithm of the probability that what is outside resembles some effects together."""
        if effects not in self._shares:
            share = [self._resemblance[one] for one in effects]
            self._shares[effects] = self.comparison.prior.log_of_set(share)
        return self._shares[effects]

    def _height(self, key: Key) -> float:
        """Logarithm of a structure's probability, but for a constant."""
        effects, (prior, weights) = tuple(sorted(key[0])), (self.comparison.prior, self._weights)
        return self.evidence_of(key) + prior.log_probability(effects, key[1], weights)

    def posterior(self) -> StructurePosterior:
        """Probabilities by the evidence and the prior.

        Raises
        ------
        ArithmeticError
            If not even the declared model could be compared.
        """
        if not self.found:
            raise ArithmeticError("the evidence of the declared model is not a number")
        keys = list(self.found)
        logs = np.array([self._height(key) for key in keys])
        probability = np.exp(logs - logsumexp(logs))
        structures = [
            Structure(
                tuple(sorted(key[0])), key[1], float(p), self.evidence_of(key), self.estimated(key)
            )
            for key, p in zip(keys, probability, strict=True)
        ]
        by_probability = sorted(structures, key=lambda item: -item.probability)
        names = next(iter(self._anchors.values())).fit.problem.names
        shared = averaged(by_probability, self._anchors, self.comparison, self.columns, names)
        return StructurePosterior(tuple(by_probability), self.comparison.prior, shared)

    def estimated(self, key: Key) -> bool:
        """Whether a structure's effects were estimated together."""
        return self._depth.get(key, -1) == len(key[0])

    def nearest(self, effects: tuple[Added, ...], declared: EstimatedModel) -> EstimatedModel:
        """The best estimate of the largest part of some effects, from which all are estimated."""
        there = [k for k in self._anchors if self.estimated(k) and not k[1] and k[0] < {*effects}]
        if not there:  # nothing could be compared about the declared model
            return declared
        return self._anchors[max(there, key=lambda key: (len(key[0]), self.found[key]))]

    def without_outside(self) -> list[tuple[Added, ...]]:
        """The best sets of effects that explain the data alone, of each number one, where something
        outside seems more probable.

        Scores of large effects miss much. A function of phase misses nothing, and would be
        preferred to effects that nobody estimated.
        """
        best: dict[tuple[int, bool], tuple[float, tuple[Added, ...]]] = {}
        for key in self.found:
            effects = tuple(sorted(key[0]))
            place = (len(effects), key[1])
            best[place] = max(best.get(place, (-np.inf, ())), (self._height(key), effects))
        if not best:
            return []
        closed = max((item for place, item in best.items() if not place[1]), default=(0.0, ()))
        if closed[0] > max(item[0] for place, item in best.items() if place[1]):
            return []
        found = [effects for (_, outside), (_, effects) in best.items() if not outside]
        return [e for e in found if e and not self.estimated((frozenset(e), False))]

    def parts(self, least: float) -> list[tuple[Added, ...]]:
        """What is left of the most probable sets of effects without one of them, best first.

        About these every set follows that has another effect in the place of the one left out.
        Otherwise two effects that were found together would have no rivals but those that are
        among the best alone.

        Parameters
        ----------
        least : float
            Logarithm of the smallest ratio to the most probable structure.
        """
        height: dict[frozenset[Added], float] = {}
        for key in self.found:
            height[key[0]] = max(self._height(key), height.get(key[0], -np.inf))
        best = max(height.values(), default=-np.inf)
        likely = [effects for effects, value in height.items() if value > best + least]
        ordered = sorted(likely, key=lambda one: -height[one])
        found = dict.fromkeys(effects - {key} for effects in ordered for key in sorted(effects))
        return [tuple(sorted(e)) for e in found if e and not self.estimated((e, False))]

    def doubtful(self, least: float) -> list[tuple[Added, ...]]:
        """Sets of effects that may be probable but are known by scores only, best first.

        A score is linear and knows shapes coarsely: of what a set explains beyond the estimate that
        it was scored at, it may miss a part. Where that part is small no estimate is needed.

        Parameters
        ----------
        least : float
            Logarithm of the smallest ratio to the most probable structure.
        """
        prior, weights = self.comparison.prior, self._weights
        height: dict[tuple[Added, ...], float] = {}
        best = -np.inf
        for key, value in self.found.items():
            effects = tuple(sorted(key[0]))
            missed = (UNSURE_SHAPE if key[0] & self._shaped else UNSURE) * self._beyond[key]
            value = value + prior.log_probability(effects, key[1], weights)
            best = max(best, value)
            if not self.estimated(key) and missed > NEGLIGIBLE:
                height[effects] = max(height.get(effects, -np.inf), value + missed)
        likely = [effects for effects in height if height[effects] > best + least]
        # An estimate of a part tells whether the whole is worth one.
        whole = [e for e in likely if any(set(part) < set(e) for part in likely)]
        return sorted(set(likely) - set(whole), key=lambda effects: -height[effects])


def structure_posterior(
    base: Base,
    assembly: Assembly,
    scores: Sequence[Score],
    errors: Mapping[tuple[str, str], RunError],
    numerics: Numerics,
    *,
    prior: StructurePrior = DEFAULT_PRIOR,
    known: Sequence[tuple[Assembly, ModelFit]] = (),
    later: Sequence[Score] = (),
    callback: ProgressCallback = lambda _: None,
) -> StructurePosterior:
    """Probabilities of what a model lacks.

    Parameters
    ----------
    base : Base
        Residuals and sensitivities of the declared model at its estimate.
    assembly : Assembly
        The declared model.
    scores : sequence of Score
        Of all candidates about that estimate.
    errors : mapping of (run, output) to RunError
        For the noise.
    numerics : Numerics
    prior : StructurePrior, optional
    known : sequence of (Assembly, ModelFit), optional
        Models with effects that were estimated already.
    later : sequence of Score, optional
        Of candidates that exist beside other effects only.
    callback : callable, optional
        Receives a message at each step.
    """
    assert base.data is not None
    by_key = {score.option.key: score for score in (*scores, *later)}
    curves = curves_of(base, assembly, numerics.jobs)
    comparison = Comparison.of(base, errors, scores, prior, curves)
    evidence = Evidence(replace(comparison, later=later))
    declared = EstimatedModel(base.fit, {})
    evidence.add(declared)
    evidence.add(*(_anchor(grown, fit, by_key) for grown, fit in known), jobs=numerics.jobs)
    tried: set[tuple[Added, ...]] = set()
    ground = Ground(base, assembly, by_key, numerics)
    for _ in range(TIMES):
        doubtful = [e for e in evidence.doubtful(float(np.log(WORTH))) if e and e not in tried]
        chosen = [e for e in evidence.without_outside() if e not in tried]
        for others in (evidence.parts(float(np.log(LIKELY))), doubtful):
            new = [e for e in others if e not in tried and e not in chosen]
            chosen += new[: max(AT_A_TIME - len(chosen), 0)]
        if not chosen:
            break
        callback(f"estimate {number_of(len(chosen), 'structure')}")
        tried |= set(chosen)
        starts = [(effects, evidence.nearest(effects, declared)) for effects in chosen]
        found = process_map(extended, ground, starts, numerics.jobs, known=_records_of)
        evidence.add(*(one for one in found if one is not None), jobs=numerics.jobs)
    return evidence.posterior()


def _anchor(assembly: Assembly, fit: ModelFit, scores: Mapping[Added, Score]) -> EstimatedModel:
    """An estimated model with the effects that it has."""
    effects = {(step.effect.id, step.target): step.amplitudes for step in assembly.steps}
    shapes = {
        name: tuple(values)
        for key in effects
        if key in scores
        for name, values in scores[key].option.candidate.shapes.items()
    }
    return EstimatedModel(fit, effects, shapes)


def _named_as(score: Score, option: Option) -> Score:
    """A score with the names that its parameters have beside other effects: where these make a
    second place for it, they are called after the place."""
    own, other = score.option.candidate, option.candidate
    table = dict(zip(own.parameters, other.parameters, strict=True))
    # A shape that another effect has brought already is not needed twice.
    table |= {name: new for name in own.shapes for new in other.shapes if _alike(name, new)}

    def new(name: str) -> str:
        bare, bracket, run = name.partition("[")
        return table[bare] + bracket + run

    return replace(
        score,
        option=option,
        names=tuple(map(new, score.names)),
        shapes={table[name]: value for name, value in score.shapes.items() if name in table},
    )


def _alike(name: str, other: str) -> bool:
    """Whether two names are the same but for the place after which one is called."""
    return name == other or other.startswith(f"{name}_") or name.startswith(f"{other}_")


def _parameters(grown: Assembly, score: Score, part: float, base: Base) -> dict[str, Parameter]:
    """New parameters of an effect, which start at a part of what it explains alone, its shapes with
    the prior by which they are compared."""
    found = new_parameters(grown, score, base.policy)
    found = {name: replace(one, value=part * one.value) for name, one in found.items()}
    for name, guess in score.shapes.items():
        centre, spread = scan_prior(score.option.candidate.shapes[name])
        found[name] = replace(
            found[name], value=guess, prior=LogNormal(float(np.exp(centre)), spread)
        )
    return found


@dataclass(frozen=True)
class Ground:
    """What structures are estimated from: the declared model, and the scores of all effects."""

    base: Base
    assembly: Assembly
    scores: Mapping[Added, Score]
    numerics: Numerics


def extended(
    ground: Ground, start: tuple[tuple[Added, ...], EstimatedModel]
) -> EstimatedModel | None:
    """Estimate a set of effects together from the estimate of some of them; None where that
    failed."""
    effects, near = start
    base, scores = ground.base, ground.scores
    order = {key: place for place, key in enumerate(scores)}
    grown, known = ground.assembly.with_values(base.fit.shared), dict(base.fit.values)
    named: dict[Added, Score] = {}
    try:
        # What exists beside another effect only comes after it.
        for key in sorted(effects, key=lambda one: order[one]):
            step = scores[key].option.assembly.steps[-1]
            option = grown.option(step.effect, step.target, step.scales)
            score = named[key] = _named_as(scores[key], option)
            grown = option.assembly
            # Beside others an effect has less to explain than alone.
            part = LESS if near.effects else 1.0
            grown = grown.with_parameters(_parameters(grown, score, part, base))
            expected = zip(score.names, map(float, part * score.expected), strict=True)
            known |= {
                name: value for name, value in expected if name not in grown.model().parameters
            }
        present = grown.model().parameters
        shared = near.fit.shared
        grown = grown.with_values({name: shared[name] for name in shared if name in present})
        known |= near.fit.values
        fit = quick_fit(base, grown.model(), known, ground.numerics, "be")
    except ModelError:
        # Effects may exclude each other: what drifts has no periodic state that lags behind it.
        return None
    # A fit that stopped early is linearised where it is, which does nearly as well.
    solved = all(np.isfinite(p.sensitivity).all() for p in fit.predictions)
    return _anchor(grown, fit, named) if solved else None


def structure_fits(
    base: Base,
    assembly: Assembly,
    scores: Sequence[Score],
    structures: Sequence[tuple[Added, ...]],
    numerics: Numerics,
) -> list[EstimatedModel | None]:
    """Estimates of some structures; None where one failed. No effects are the base itself."""
    ground = Ground(base, assembly, {s.option.key: s for s in scores}, numerics)
    declared = EstimatedModel(base.fit, {})
    starts = [(effects, declared) for effects in structures if effects]
    found = iter(process_map(extended, ground, starts, numerics.jobs, known=_records_of))
    return [next(found) if effects else declared for effects in structures]


def _records_of(ground: Ground) -> Sequence[Record]:
    return ground.base.fit.records


def curves_of(
    base: Base, assembly: Assembly, jobs: int | None = None
) -> dict[CurveKey, tuple[Array, ...]]:
    """Changes of the outputs by the splines of each curve, fine and coarse.

    Parameters
    ----------
    base : Base
        The present model at its estimate.
    assembly : Assembly
        The same, with its drive.
    jobs : int, optional
        Threads.

    Returns
    -------
    dict of (curve, balance) to tuple of ndarray, shape (K, n)
        On the lines of :class:`~bayesoleo.discovery._spectral_data.SpectralData`, per unit of each
        spline. Balances that could not be solved are left out.
    """
    motions = Motions(base.fit, assembly, quantities_of(assembly.native))
    axes = dict(motions.axes({}))
    curves = list(_curves(motions, axes, assembly.native))
    some = max(TOGETHER // coarser(1, COARSE, FINE).shape[0], 1)
    places: list[tuple[str, Forced, Sequence[tuple[str, _Courses]]]] = []
    for target in balance_places(assembly.native):
        try:
            forced = Forced(base.fit, assembly, target)
        except ModelError:
            continue  # nothing is left to solve for with a term there
        parts = [curves[k : k + some] for k in range(0, len(curves), some)]
        places += [(target, forced, part) for part in parts]
    found = thread_map(
        lambda place: _columns(base, place[1], [courses for _, courses in place[2]]), places, jobs
    )
    return {
        (name, target): (fine, coarser(1, COARSE, FINE).T @ fine)
        for (target, _, part), columns in zip(places, found, strict=True)
        for (name, _), fine in zip(part, columns, strict=True)
        if fine is not None
    }


def _columns(base: Base, forced: Forced, several: Sequence[_Courses]) -> list[Array | None]:
    """Changes of the outputs by the splines of some curves, each (K, n), solved for together; None
    for those that could not be solved for alone."""
    assert base.data is not None
    by_run = []
    for r in range(len(base.runs)):
        found = forced.responses(r, partial(_after_each_other, several, r))
        if isinstance(found, Status) or not np.isfinite(found).all():
            alone = several if len(several) > 1 else ()
            return [_columns(base, forced, [one])[0] for one in alone] or [None]
        by_run.append(found)
    return list(np.split(base.data.columns(by_run), len(several)))


def _after_each_other(several: Sequence[_Courses], r: int, phase: Array) -> Array:
    return np.concatenate([courses(r, phase) for courses in several])


def _curves(
    motions: Motions, axes: Mapping[int, Axis], native: Model
) -> Iterator[tuple[str, _Courses]]:
    """Functions by name, each as its splines (K, N) in a run at phases (N,)."""
    number = {axis.expression: k for k, axis in axes.items()}
    velocities = {item.position: item.velocity for item in native.coordinates()}

    def spline(k: int) -> _Courses:
        return lambda r, phase: axes[k].basis(motions.at(r, k, phase), FINE)

    def times(courses: _Courses, factor: _Courses) -> _Courses:
        return lambda r, phase: courses(r, phase) * factor(r, phase)

    for k, axis in axes.items():
        yield axis.name, spline(k)
        moving = number.get(velocities.get(axis.expression))
        if moving is None:
            continue
        largest = max(abs(axes[moving].low), abs(axes[moving].high))
        middle, half = 0.5 * (axis.low + axis.high), 0.5 * (axis.high - axis.low)

        def speed(r: int, phase: Array, of: int = moving, unit: float = largest) -> Array:
            return motions.at(r, of, phase) / unit

        def direction(r: int, phase: Array, of: int = moving, unit: float = largest) -> Array:
            return np.tanh(motions.at(r, of, phase) / (TURNING * unit))

        def place(
            r: int, phase: Array, of: int = k, zero: float = middle, unit: float = half
        ) -> Array:
            return (motions.at(r, of, phase) - zero) / unit

        yield f"{axis.name} times velocity", times(spline(k), speed)
        yield f"{axis.name} by direction", times(spline(k), direction)
        yield f"{axes[moving].name} times position", times(spline(moving), place)
