"""Candidate effects, placed by the sizes of the motion, scored and ranked for one round.

The sizes of the estimated motion place the scan grids of effects.

The frequency of a periodic force is undefined at the null, and a coarse grid cannot scan it: the
score has a peak as narrow as the reciprocal of the record's length. The highest line of the
residual's spectrum is taken instead, if the probability of such a line by chance is less than one
in a thousand. Without one no periodic force is scored, and the search needs no correction for it.
"""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import integrate, ndimage, optimize

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array, ProgressCallback
from bayesoleo.data._harmonics import FALSE_ALARM
from bayesoleo.discovery._assembly import Assembly, Option
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._fit_difference import Undecided, undecided
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._refit import Refit
from bayesoleo.discovery._samples_that_count import weights
from bayesoleo.discovery._scanned_columns import MOST_KEPT, Scanned, size_of
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._score_tests import (
    Score,
    classes,
    corrected_p,
    score_all,
    score_and_keep,
    without_twins,
)
from bayesoleo.effects._effect import Effect
from bayesoleo.effects._parts import Scales
from bayesoleo.effects._places import BETWEEN
from bayesoleo.errors import number_of
from bayesoleo.model._model import Model, velocities_of
from bayesoleo.model._velocity_dofs import is_velocity
from bayesoleo.prediction._inputs import lacking
from bayesoleo.prediction._records import Record

#: Lines on either side whose median is the level beside a line; cycles over the record below which
#: a line is a drift.
_BESIDE, _FEWEST = 25, 5
#: Width in bins of a line with the window that limits the leakage of strong lines.
_WIDE = 3

POINTS = 512


def dominant_residual_frequency(fit: ModelFit) -> float | None:
    """Dominant frequency of the residuals of transients, Hz; None without a significant line."""
    best: tuple[float, float] = (FALSE_ALARM, 0.0)
    for r, record in enumerate(fit.records):
        if record.periodic:
            continue
        e = fit.predictor.runs[r].measured - fit.predictions[r].y
        e = np.where(weights(record) > 0, e, 0.0)
        inputs = [record.samples[n] for n in fit.model.inputs if n in record.samples]
        for values in e:
            found = line_of(values, inputs, _step(record))
            if found is not None:
                best = min(best, found)
    return best[1] if best[1] > 0 else None


def line_of(values: Array, inputs: Sequence[Array], step: float) -> tuple[float, float] | None:
    """Probability and frequency of the highest line of a signal that no input shares.

    Parameters
    ----------
    values : ndarray, shape (N,)
    inputs : sequence of ndarray, shape (N,)
    step : float
        Sampling interval, s.

    Returns
    -------
    (p-value, frequency in Hz), or None where the record is too short.
    """
    own = _over_level(values)
    if own is None:
        return None
    shared = np.zeros(own.size, dtype=bool)
    for item in inputs:
        level = _over_level(item)
        if level is not None:
            strong = level > distributions.f.isf(FALSE_ALARM, 2, _BESIDE)
            shared |= ndimage.binary_dilation(strong, iterations=_WIDE)
    own[shared] = 0.0
    k = int(np.argmax(own))
    if own[k] == 0:
        return None
    p = float(-np.expm1(own.size * np.log1p(-distributions.f.sf(own[k], 2, _BESIDE))))
    return p, _refined(values, k) / (values.size * step)


def _over_level(values: Array) -> Array | None:
    """Powers of a windowed signal over the level of their neighbours."""
    window = np.hanning(values.size)
    power = np.abs(np.fft.rfft((values - values.mean()) * window)) ** 2
    if power.size < 4 * _BESIDE or not power.any():
        return None
    # The median of exponentially distributed powers is ln 2 times the mean.
    level = ndimage.median_filter(power, 2 * _BESIDE + 1, mode="reflect") / np.log(2.0)
    ratio: Array = power / np.maximum(level, 1e-9 * power.mean())
    ratio[:_FEWEST] = 0.0
    return ratio


def _refined(values: Array, k: int) -> float:
    """Cycles over the record at which the windowed signal's power is highest, near a bin."""
    shown = (values - values.mean()) * np.hanning(values.size)
    turn = -2j * np.pi * np.arange(values.size) / values.size

    def less(cycles: float) -> float:
        return -float(np.abs(np.exp(turn * cycles) @ shown))

    found = optimize.minimize_scalar(less, bounds=(k - 1.0, k + 1.0), method="bounded")
    return float(found.x)


def _step(record: Record) -> float:
    return float((record.time[-1] - record.time[0]) / (record.time.size - 1))


def scales_of(fit: ModelFit, drive: str | None, native: Model) -> Scales:
    """Ranges of every coordinate over all fitted runs.

    A dof that the drive replaced has the motion of the driving channel, up to small offsets and
    gains.

    Parameters
    ----------
    fit : ModelFit
    drive : str or None
        The channel that drives the fitted model.
    native : Model
        It in its own drive.
    """
    position: dict[str, tuple[float, float]] = {}
    velocity: dict[str, float] = {}

    def add(name: str, values: np.ndarray, rates: np.ndarray) -> None:
        low, high = position.get(name, (np.inf, -np.inf))
        position[name] = (min(low, float(values.min())), max(high, float(values.max())))
        velocity[name] = max(velocity.get(name, 0.0), float(np.abs(rates).max()))

    for run, record in zip(fit.predictor.runs, fit.records, strict=True):
        phase = _places(record)
        rows_of: dict[str, tuple[Array, Array]] = {}
        for dof, motion in run.known_motions().items():
            rows = motion(phase)
            rows_of[dof] = rows[0], rows[1]
        for channel, item in record.signals.items():
            values, rates = (item.evaluate(phase, record.rate, k) for k in (0, 1))
            rows_of[channel] = values, rates
            if channel == drive:
                for dof in native.dofs:
                    if dof not in run.known_motions():
                        rows_of[dof] = values, rates
        motions = _motions(native, rows_of, phase / record.rate)
        for name in rows_of:
            add(name, *(rows_of if name in native.inputs else motions)[name])
        for (one, here), (other, there) in itertools.permutations(motions.items(), 2):
            if one in native.dofs:
                add(f"{one}{BETWEEN}{other}", here[0] - there[0], here[1] - there[1])
    outputs = {
        name: max(
            float(np.ptp(run.measured[k][weights(run.record) > 0])) for run in fit.predictor.runs
        )
        for k, name in enumerate(fit.predictor.outputs)
    }
    periods = [time for record in fit.records for time in _times(record)]
    ranges = {
        name: (
            min(float(run.measured[k].min()) for run in fit.predictor.runs),
            max(float(run.measured[k].max()) for run in fit.predictor.runs),
        )
        for k, name in enumerate(fit.predictor.outputs)
    }
    kinds = frozenset(record.kind for record in fit.records)
    times = min(periods), max(periods)
    stated = [record.conditions for record in fit.records]
    shared = set.intersection(*map(set, stated))
    conditions = {name: float(np.mean([run[name] for run in stated])) for name in shared}
    return Scales(
        position,
        velocity,
        outputs,
        *times,
        ranges,
        kinds,
        dominant_residual_frequency(fit),
        conditions,
    )


def _motions(
    native: Model, rows: dict[str, tuple[Array, Array]], time: Array
) -> dict[str, tuple[Array, Array]]:
    """Position and velocity of all that moves, from values and rates: of a velocity the position
    is that of its dof, or the way since the start."""
    found = dict(rows)
    measured = {name for name, unit in native.inputs.items() if is_velocity(unit)}
    for name in rows.keys() & (velocities_of(native).velocities | measured):
        values = rows[name][0]
        way = integrate.cumulative_trapezoid(values, time, initial=0.0)
        known = rows.get(velocities_of(native).position_of(name) or "")
        found[name] = (way if known is None else known[0]), values
    return found


def _places(record: Record) -> np.ndarray:
    """Where the motion is evaluated: over a period, or at the samples of a transient."""
    return np.arange(POINTS) / POINTS if record.periodic else record.position


def _times(record: Record) -> tuple[float, ...]:
    """Time scales of a run: the period, or for a transient its length and, for each channel, the
    period of a harmonic motion with the same ratio of rate to size."""
    if record.periodic:
        return (record.span,)
    found = [record.span]
    for item in record.signals.values():
        values, rates = (item.evaluate(record.position, record.rate, k) for k in (0, 1))
        if np.std(values) > 0 and np.std(rates) > 0:
            found.append(float(min(record.span, 2 * np.pi * np.std(values) / np.std(rates))))
    return tuple(found)


#: Absorbing families, whose effects absorb a part of any model error: parameters that vary from run
#: to run, and forces that repeat with the drive.
ABSORBING_FAMILIES = frozenset({"run-to-run", "clock"})


@dataclass(frozen=True)
class Ranked:
    """A scored candidate with its place in the search.

    Parameters
    ----------
    score : Score
    p_value : float
        Corrected for the search.
    gain : float
        Share of the excess, after estimation where it was estimated.
    refitted : bool
        Whether it was estimated.
    same : tuple of str
        Ids of effects that these data cannot distinguish from it.
    refit : Refit or None
        The extended model, where it was estimated.
    closest : tuple of (str, float)
        For a nonparametric effect: the most similar named effects, with the cosine between the
        changes.
    beside : Refit or None
        Its estimate beside the other effects of the final model, where these have changed since
        it was added.
    p_on_trial : float or None
        The p-value by which it is taken on trial; see :attr:`Inflation.on_trial`.
    """

    score: Score
    p_value: float
    gain: float
    refitted: bool
    same: tuple[str, ...]
    refit: Refit | None = None
    closest: tuple[tuple[str, float], ...] = ()
    beside: Refit | None = None
    p_on_trial: float | None = None

    def may_be_tried(self, level: float) -> bool:
        """Whether it is significant enough to be added on trial."""
        return (self.p_value if self.p_on_trial is None else self.p_on_trial) < level

    @property
    def effect(self) -> str:
        """Canonical id."""
        return self.score.option.candidate.effect

    @property
    def target(self) -> str:
        """Its place in the model."""
        return self.score.option.candidate.target

    @property
    def absorbs(self) -> bool:
        """Whether it is of an absorbing family, which names no cause."""
        return self.score.option.candidate.family in ABSORBING_FAMILIES


#: What was prepared last, with the base and the assembly that it is of.
_prepared: list[tuple[weakref.ref[Base], Assembly, Sequence[Effect] | None, list[Option]]] = []


def prepare_options(base: Base, assembly: Assembly, effects: Sequence[Effect] | None) -> None:
    """Find the candidates that :func:`score_candidates` is asked for next, by the same arguments.

    That takes as long as half an estimate, and may be done while something else has to be waited
    for.
    """
    options = _options_of(base, assembly, effects)
    _prepared[:] = [(weakref.ref(base), assembly, effects, options)]


def forget_options() -> None:
    """Free what was prepared for a model that is no longer the present one."""
    _prepared.clear()


def _options_of(base: Base, assembly: Assembly, effects: Sequence[Effect] | None) -> list[Option]:
    """Every effect at every place; those that were prepared are given away once."""
    known, _prepared[:] = list(_prepared), []
    for of, of_assembly, of_effects, options in known:
        if of() is base and of_assembly is assembly and of_effects is effects:
            return options
    scales = scales_of(base.fit, assembly.drive, assembly.native)
    return assembly.options(scales, None if effects is None else tuple(effects))


def score_candidates(
    base: Base,
    assembly: Assembly,
    effects: Sequence[Effect] | None,
    jobs: int | None,
    *,
    order: Callable[[Option, int], int | bool] | None = None,
    keep: Callable[[Scanned], None] | None = None,
    before: Callable[[], object] = lambda: None,
    callback: ProgressCallback = lambda _: None,
) -> tuple[list[Score], dict[str, str]]:
    """Score every effect at every place, each effect once.

    Parameters
    ----------
    base : Base
        Residuals and sensitivities of the present model.
    assembly : Assembly
        The present model.
    effects : sequence of Effect or None
        Instead of the catalogue.
    jobs : int or None
        Threads.
    order : callable (option, place in the catalogue) -> int, optional
        Of equivalent effects the first in this order is kept; by default the first of the
        catalogue. Their shares are equal but for round-off, which differs between machines.
    keep : callable, optional
        Receives what the candidates change in the outputs, unless that is large.
    before : callable, optional
        What this process does first, while others score.
    callback : callable, optional
        Receives a message at each step.

    Returns
    -------
    scores : list of Score
        By falling share; with ``order``, by that first.
    failed : dict of str to str
        Reason by effect without a score.
    """
    options = _options_of(base, assembly, effects)
    reasons = [lacking(option.model.inputs, base.fit.records) for option in options]
    without = {
        " at ".join(option.key): reason
        for option, reason in zip(options, reasons, strict=True)
        if reason is not None
    }
    options = [one for one, reason in zip(options, reasons, strict=True) if reason is None]
    callback(f"score {number_of(len(options), 'candidate')}")
    if keep is not None and size_of(base.fit, options) <= MOST_KEPT:
        scores, failed, columns = score_and_keep(base, options, jobs, before)
        keep(Scanned(base.fit, assembly, effects, options, columns))
    else:
        scores, failed = score_all(base, options, jobs, before)
    places = {option.key: k for k, option in enumerate(options)}
    chosen = order or (lambda _, place: place)
    scores.sort(key=lambda score: chosen(score.option, places[score.option.key]))
    kept, twins = without_twins(scores, policy=base.policy)
    if order is None:
        kept.sort(key=lambda score: -score.share)
    return kept, without | failed | twins


def rank(
    scores: Sequence[Score],
    tests: float,
    refits: dict[int, Refit],
    *,
    base: Base | None = None,
    policy: SearchPolicy = SearchPolicy(),
) -> tuple[Ranked, ...]:
    """Candidates in the order of the search, estimated ones first.

    Parameters
    ----------
    scores : sequence of Score
    tests : float
        Effective number of independent tests.
    refits : dict of int to Refit
        By the ``id`` of the score.
    base : Base, optional
        What they were estimated against: the noise along their differences says which are alike.
    policy : SearchPolicy
    """
    groups = classes(scores, policy=policy)
    known: dict[frozenset[int], Undecided] = {}

    def about_as_likely(one: Refit, other: Refit) -> Undecided | None:
        if base is None or not (np.isfinite(one.share) and np.isfinite(other.share)):
            return None
        pair = frozenset((id(one), id(other)))
        if pair not in known:
            known[pair] = undecided(base, one, other)
        return known[pair]

    ranked = []
    for k, score in enumerate(scores):
        same = _same(scores, k, groups[k], refits, about_as_likely)
        fitted = refits.get(id(score))
        if fitted is not None and not np.isfinite(fitted.share):
            fitted = None  # a failed estimate adds nothing to the score
        # The excess is known up to noise, so that a share may exceed one; it is limited to one.
        gain = min(score.share if fitted is None else max(fitted.share, 0.0), 1.0)
        p = corrected_p(score if fitted is None else estimated(score, fitted), tests)
        trial = None if fitted is None else corrected_p(_on_trial(score, fitted), tests)
        ranked.append(Ranked(score, p, gain, fitted is not None, same, fitted, p_on_trial=trial))
    # Estimates are more reliable than scores and come first.
    return tuple(sorted(ranked, key=lambda item: (not item.refitted, -item.gain)))


def estimated(score: Score, fitted: Refit) -> Score:
    """A score with the estimated values in place of those expected at the null."""
    noise = fitted.noise
    return replace(score, fall=fitted.fall, inflation=noise.value, freedom=noise.freedom)


def _on_trial(score: Score, fitted: Refit) -> Score:
    return replace(estimated(score, fitted), inflation=fitted.noise.on_trial)


def _same(
    scores: Sequence[Score],
    k: int,
    group: Sequence[int],
    refits: dict[int, Refit],
    about_as_likely: Callable[[Refit, Refit], Undecided | None],
) -> tuple[str, ...]:
    """Effects that are indistinguishable from number ``k``, by their estimates if both have one."""
    own, found = refits.get(id(scores[k])), []
    for j, other in enumerate(scores):
        estimated = refits.get(id(other))
        if j == k:
            continue
        if own is not None and estimated is not None and np.isfinite(estimated.share):
            within = about_as_likely(own, estimated)
            limits = () if within is None else (within.likely, within.scatter)
            alike = own.resembles(estimated, *limits)
        elif own is not None and estimated is not None and own.reached:
            # After a failed estimate only the score can distinguish the two.
            alike = not own.outdoes(other)
        else:
            alike = j in group and not (own is not None and own.outdoes(other))
        if alike:
            found.append(name_among(scores[k], other))
    return tuple(dict.fromkeys(found))


def name_among(own: Score, other: Score) -> str:
    """Name of another effect in the class of an effect; with its place if the ids are equal."""
    effect, target = other.option.key
    return f"{effect} @ {target}" if effect == own.option.key[0] else effect
