"""Score tests of candidate effects, corrected for coloured noise and multiple testing.

A score test predicts at the null how much of the residual an effect explains, without a refit. With
residual ``e``, sensitivities ``J`` of the present parameters, ``C`` of the candidate's and weights
``W``, the candidate adds ``C_perp = C - J (J' W J)^-1 J' W C``; its score is ``s = C_perp' W e``
with information ``I = C_perp' W C_perp``. The expected parameter is ``I^-1 s`` and the sum of
squares falls by ``s' I^-1 s`` (Rao's score test). Shape parameters are undefined at the null and
are scanned.

Coloured noise increases the variance of a score. The spectrum of the noise and the scatter between
periods give the factor. The probability of the best candidate accounts for the number of
candidates, and candidates that the data cannot distinguish are grouped.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from bayesoleo import _distributions as distributions
from bayesoleo._parallel import single_blas_thread
from bayesoleo._types import Array
from bayesoleo._worker_processes import process_map
from bayesoleo.data._noise import NoiseSpectrum, noise_spectrum, periodic_average
from bayesoleo.discovery._assembly import Option
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._score_basis import (
    Base,
    Block,
    coefficients,
    flat,
    remains,
    sensitivities_of,
)
from bayesoleo.effects._places import balance_of
from bayesoleo.effects._terms import FAMILY as TERMS
from bayesoleo.prediction._inputs import lacking
from bayesoleo.solvers._orbit import Status

if TYPE_CHECKING:
    from bayesoleo.discovery._fit import ModelFit
    from bayesoleo.discovery._score_basis import RunBase


#: Families that a change of a term may be one of, in other words.
FORCES = frozenset({TERMS, "damping", "friction", "stiffness"})
#: Samples of all candidates that are multiplied at a time.
SAMPLES_AT_A_TIME = 2048
#: Degrees of freedom of a variance that is not measured.
ASSUMED = 1e9

#: Why an effect has no score.
SPANNED = "existing parameters already produce this change"
UNRESOLVED = "not visible in these data: no output changes with it"


def inflation_of(base: Base, directions: Sequence[Array]) -> tuple[float, int]:
    """Variance of a score over white noise's, at least one, and its degrees of freedom.

    The spectrum of each output's noise says how much of it lies along the direction; it uses all
    lines between harmonics, and so knows it well from few periods. What it cannot see - noise that
    comes and goes, or that outputs share - shows in the scatter of the score between periods, which
    is believed where it is larger than the spectrum would seldom let it be.

    Parameters
    ----------
    base : Base
        Residuals and spectra by run.
    directions : sequence of ndarray, shape (m,)
        What the effect adds to each run, in noise units, outputs one after the other.
    """
    white = sum(float(d @ d) for d in directions)
    if not white > 0:
        return 1.0, 0
    parts = [_by_spectrum(base, r, direction) for r, direction in enumerate(directions)]
    variance = sum(value for value, _ in parts)
    scatter = sum(value**2 / free for value, free in parts if free > 0)
    freedom = variance**2 / scatter if scatter > 0 else ASSUMED
    between, degrees = _between_periods(base.runs, directions)
    # Against the spectrum's own uncertainty: neither is exact.
    unsteady = degrees > 0 and between / variance > distributions.f.isf(
        base.policy.unsteady, degrees, freedom
    )
    if unsteady:
        variance, freedom = between, degrees
    # Errors of the inputs repeat, so that no difference between periods shows them.
    variance += sum(r.unweighed_noise(d) for r, d in zip(base.runs, directions, strict=True))
    return max(1.0, variance / white), 0 if freedom >= ASSUMED else max(1, int(freedom))


def inflation_by_estimate(base: Base, changes: Sequence[Array]) -> tuple[float, int]:
    """Variance of the fall by an estimate over white noise's, and its degrees of freedom.

    A score weighs the noise of measured inputs with that of the outputs. An estimate is by least
    squares of the outputs, in which an error of an input's harmonic repeats in every period, so
    that no difference between periods shows it.

    Parameters
    ----------
    base : Base
        Residuals, spectra and noise of the inputs by run.
    changes : sequence of ndarray, shape (m,)
        What the estimate changes in each run, in noise units, outputs one after the other.
    """
    value, freedom = inflation_of(base, changes)
    white = sum(float(change @ change) for change in changes)
    if not white > 0:
        return value, freedom
    moved = sum(run.weighed_noise(c) for run, c in zip(base.runs, changes, strict=True))
    return value + moved / white, freedom


def _spectra(
    base: Base, r: int, direction: Array, powers: Sequence[Array]
) -> tuple[NoiseSpectrum, ...]:
    """Spectra of a run's noise, without what a direction that does not repeat would explain of it.

    A drift lies between the harmonics, where noise is measured: it must not count as its own noise.
    ``powers`` are those of the direction by the spectra as they were measured.
    """
    run = base.runs[r]
    most = base.policy.aperiodic_power
    if not any(_wanders(power, s, most) for power, s in zip(powers, run.spectra, strict=True)):
        return run.spectra
    record, found = base.fit.records[r], []
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    for k, left in enumerate((run.residual - direction).reshape(len(run.spectra), -1)):
        average = periodic_average(left, step, record.frequency)
        unit = run.scale[k * left.size]
        rest = (left - average.values) / unit
        found.append(noise_spectrum(rest, record.periods, run.spectra[k].emptied))
    return tuple(found)


def _wanders(power: Array, spectrum: NoiseSpectrum, most: float) -> bool:
    """Whether a good part of a signal of such power does not repeat from period to period."""
    return bool(power.sum() - power[:: spectrum.lines].sum() > most * power.sum())


def _by_spectrum(base: Base, r: int, direction: Array) -> tuple[float, float]:
    """Variance of the score of one run and its degrees of freedom, zero where it is assumed."""
    run = base.runs[r]
    if not run.spectra:
        return float(direction @ direction), 0.0
    parts = direction.reshape(len(run.spectra), -1)
    powers = [spectrum.power(part) for part, spectrum in zip(parts, run.spectra, strict=True)]
    spectra, variance, scatter = _spectra(base, r, direction, powers), 0.0, 0.0
    for k, (power, spectrum) in enumerate(zip(powers, spectra, strict=True)):
        own_power = power * run.scale[k * parts.shape[1]] ** 2
        own, free = float(own_power @ spectrum.level), spectrum.freedom(own_power)
        variance += own
        scatter += own**2 / free if free > 0 else 0.0
    return variance, variance**2 / scatter if scatter > 0 else 0.0


def _between_periods(runs: Sequence[RunBase], directions: Sequence[Array]) -> tuple[float, int]:
    """The same variance by the scatter of the score between periods.

    A direction that repeats moves the mean over periods only, so that what was estimated takes one
    degree of freedom a run from the scatter.
    """
    total, degrees = 0.0, 0
    for run, direction in zip(runs, directions, strict=True):
        # What the effect itself would explain is no noise, and must not count as such.
        sums = np.bincount(run.period, direction * (run.residual - direction))
        if sums.size > 1:
            total += sums.size * float(np.var(sums, ddof=1))
            degrees += sums.size - 1
    return total, degrees


@dataclass(frozen=True)
class Score:
    """Result of scoring one candidate.

    Parameters
    ----------
    option : Option
        The candidate.
    names : tuple of str
        Its new unknowns, by-run ones expanded.
    expected : ndarray, shape (k,)
        Their expected values, SI.
    shapes : mapping of str to float
        Values of shape parameters at which it scores best.
    fall : float
        Fall of the weighted sum of squares.
    share : float
        Part of the excess explained.
    inflation : float
        Variance of the score by the noise's spectrum and by its scatter between periods, over what
        white noise gives; at least one.
    columns : ndarray, shape (m, n)
        Thinned, weighted, normalised ``C_perp`` of all scanned shapes, for the correction for the
        search.
    contribution : ndarray, shape (n,)
        Thinned, weighted ``C_perp I^-1 s``, for comparing candidates.
    z : float
        Signed root of the statistic for one new unknown, its root for several.
    rank : int
        Directions that the new unknowns can move the outputs in, beside the present ones.
    freedom : int
        Degrees of freedom that the inflation was measured with; zero where none was.
    information : ndarray, shape (k, k)
        ``C_perp' W C_perp`` of the new unknowns, SI, at the shapes that score best.
    signature : ndarray, shape (shapes * k, lines)
        Change of the outputs per unit of each unknown on the lines of :class:`SpectralData`, SI,
        for one set of shapes after the other.
    beside : ndarray, shape (l,)
        How far the present unknowns move with the expected values, SI.
    """

    option: Option
    names: tuple[str, ...]
    expected: Array
    shapes: Mapping[str, float]
    fall: float
    share: float
    inflation: float
    columns: Array
    contribution: Array
    z: float
    rank: int = 1
    freedom: int = 0
    information: Array = field(default_factory=lambda: np.zeros((0, 0)))
    signature: Array = field(default_factory=lambda: np.zeros((0, 0), dtype=np.float32))
    beside: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def size(self) -> int:
        """Number of unknowns that the effect adds, shapes included."""
        return len(self.names) + len(self.shapes)

    @property
    def statistic(self) -> float:
        """Chi-square statistic with ``rank`` degrees of freedom, corrected for coloured noise."""
        return self.fall / self.inflation


def score_all(
    base: Base,
    options: Sequence[Option],
    jobs: int | None = None,
    before: Callable[[], object] = lambda: None,
) -> tuple[list[Score], dict[str, str]]:
    """Score every candidate; ``before`` as of :func:`process_map`.

    Returns
    -------
    scores : list of Score
        By falling share.
    failed : dict of str to str
        Reason by effect where the extended model could not be solved.
    """
    cost = partial(cost_of, base.fit)
    found = process_map(_apart, base, options, jobs, before=before, cost=cost)
    return _of_results(found, options)


def score_and_keep(
    base: Base,
    options: Sequence[Option],
    jobs: int | None = None,
    before: Callable[[], object] = lambda: None,
) -> tuple[list[Score], dict[str, str], list[list[Block] | Status]]:
    """The same with the columns of each option, by set of shapes, or why there are none."""
    cost = partial(cost_of, base.fit)
    found = process_map(_apart_with_columns, base, options, jobs, before=before, cost=cost)
    scores, failed = _of_results([result for _, result in found], options)
    return scores, failed, [columns for columns, _ in found]


def _of_results(
    found: Sequence[Score | Status | str], options: Sequence[Option]
) -> tuple[list[Score], dict[str, str]]:
    """Scores by falling share, and the reasons of options without one."""
    results = [
        replace(one, option=option) if isinstance(one, Score) else one
        for one, option in zip(found, options, strict=True)
    ]
    scores = [item for item in results if isinstance(item, Score)]
    failed = {
        f"{o.key[0]} at {o.key[1]}": r.message
        for o, r in zip(options, results, strict=True)
        if isinstance(r, Status)
    }
    failed |= {
        f"{o.key[0]} at {o.key[1]}": r
        for o, r in zip(options, results, strict=True)
        if isinstance(r, str)
    }
    return sorted(scores, key=lambda item: -item.share), failed


def _directions_of(columns: Array) -> Array:
    """Rows as single-precision numbers with a largest one of one: a power of a pressure in pascals
    is beyond their range."""
    largest = np.abs(columns).max(axis=1, keepdims=True, initial=0.0)
    return np.asarray((columns / np.where(largest > 0, largest, 1.0)).astype(np.float32))


def _apart(base: Base, option: Option) -> Score | Status | str:
    """The score without its candidate, which whoever asked has."""
    return _apart_with_columns(base, option)[1]


def _apart_with_columns(
    base: Base, option: Option
) -> tuple[list[Block] | Status, Score | Status | str]:
    """The same after the columns that were scored."""
    columns = columns_of(base.fit, option)
    found = columns if isinstance(columns, Status) else _attempt(base, option, columns)
    apart = replace(found, option=cast(Any, None)) if isinstance(found, Score) else found
    return columns, apart


def cost_of(fit: ModelFit, option: Option) -> int:
    """About how long :func:`columns_of` takes: a motion is sought for each set of shapes where an
    effect has states of its own, and is known elsewhere."""
    return len(shapes_of(option)) * (len(option.model.dofs) - len(fit.model.dofs))


def columns_of(fit: ModelFit, option: Option) -> list[Block] | Status:
    """Derivatives of the outputs with respect to an option's new unknowns, for each set of shapes
    in the order of :func:`shapes_of`; no solution where a run lacks an input that it adds."""
    if lacking(option.model.inputs, fit.records) is not None:
        return Status.INADMISSIBLE
    fixed = [name for name in option.model.estimated() if name not in option.candidate.parameters]
    return sensitivities_of(fit, option.model.fixing(*fixed), shapes_of(option))


def shapes_of(option: Option) -> list[dict[str, float]]:
    """All sets of values of shape parameters that are scanned."""
    shapes = option.candidate.shapes
    return [dict(zip(shapes, values, strict=True)) for values in product(*shapes.values())]


def _attempt(base: Base, option: Option, columns: Sequence[Block]) -> Score | str:
    """The score, or why there is none."""
    shapes = shapes_of(option)
    best, used, thinned, signatures = None, columns[0], [], []
    for values, block in zip(shapes, columns, strict=True):
        score = _evaluate(base, option, values, block)
        if score is None:
            continue
        thinned.append(score.columns)
        if base.data is not None:
            columns_of_data = base.data.columns(block.by_run, block.acting, len(block.names))
            signatures.append(_directions_of(columns_of_data))
        if best is None or score.fall > best.fall:
            best, used = score, block
    if best is None:
        seen = any(item.any() for block in columns for item in block.by_run)
        return SPANNED if seen else UNRESOLVED
    inflation, freedom = inflation_of(base, _directions(base, used, best.expected))
    return replace(
        best,
        columns=np.concatenate(thinned),
        inflation=inflation,
        freedom=freedom,
        signature=np.concatenate(signatures) if signatures else best.signature,
    )


def _evaluate(
    base: Base, option: Option, values: Mapping[str, float], block: Block
) -> Score | None:
    k, size = len(block.names), base.gram.shape[0]
    cross, own, score = np.zeros((size, k)), np.zeros((k, k)), np.zeros(k)
    columns = _in_units(base, block)
    for run, acting, new in zip(base.runs, block.numbers, columns, strict=True):
        parts = run.products(new)
        cross[:, acting] += parts[0]
        own[np.ix_(acting, acting)] += parts[1]
        score[acting] += parts[2]
    project = coefficients(base.gram, cross)
    information = own - cross.T @ project
    score = score - project.T @ base.gradient
    keep = remains(base.gram, project, own, information)
    if not keep.any() or not np.isfinite(information).all():
        return None
    expected = np.zeros(k)
    unit = np.sqrt(np.diag(information)[keep])
    inner = information[np.ix_(keep, keep)] / np.outer(unit, unit)
    solution, _, rank, _ = np.linalg.lstsq(inner, score[keep] / unit, rcond=1e-10)
    expected[keep] = solution / unit
    if not _allowed(option, block.names, expected):
        expected = np.zeros(k)
    fall = float(expected @ score)
    thin = _thinned(base, block, columns, project)
    norms = np.linalg.norm(thin, axis=1, keepdims=True)
    root = float(np.sqrt(max(fall, 0.0)))
    return Score(
        option=option,
        names=block.names,
        expected=expected,
        shapes=dict(values),
        fall=fall,
        share=fall / base.fall_back,
        inflation=1.0,
        columns=(thin / np.where(norms > 0, norms, 1.0))[keep],
        contribution=expected @ thin,
        z=root * float(np.sign(expected[0])) if k == 1 else root,
        rank=int(rank),
        information=information,
        beside=-base.units * (project @ expected),
    )


def _allowed(option: Option, names: Sequence[str], expected: Array) -> bool:
    """Whether the expected values lie on the physical side of a one-sided null."""
    for name, value in zip(names, expected, strict=True):
        sign = option.candidate.sign.get(name.split("[")[0], 0)
        if sign * value < 0:
            return False
    return True


def _in_units(base: Base, block: Block) -> list[Array]:
    """A block's columns in noise units, outputs one after the other, by run."""
    return [flat(item) * run.scale for run, item in zip(base.runs, block.by_run, strict=True)]


def _thinned(base: Base, block: Block, columns: Sequence[Array], project: Array) -> Array:
    """``C_perp`` in noise units at some samples, shape (k, n)."""
    rows = []
    for run, acting, new in zip(base.runs, block.numbers, columns, strict=True):
        beside = -(project.T @ run.sensitivity[:, run.chosen])
        beside[acting] += new[:, run.chosen]
        rows.append(beside)
    return np.concatenate(rows, axis=1)


def _directions(base: Base, block: Block, expected: Array) -> list[Array]:
    """What the expected parameters add to each run beside the present ones, in noise units."""
    columns, cross = _in_units(base, block), np.zeros((base.gram.shape[0], expected.size))
    for run, acting, new in zip(base.runs, block.numbers, columns, strict=True):
        cross[:, acting] += run.products(new)[0]
    project = coefficients(base.gram, cross)
    return [
        expected[acting] @ new - (project @ expected) @ run.sensitivity
        for run, acting, new in zip(base.runs, block.numbers, columns, strict=True)
    ]


def effective_tests(
    scores: Sequence[Score], seed: int, *, policy: SearchPolicy = SearchPolicy()
) -> float:
    """Number of independent tests that a search over correlated candidates amounts to.

    Noise is drawn in the space of all candidates' columns, scanned shapes included; its largest
    statistic has the distribution of the largest of ``m`` independent ones, and ``m`` is read off
    at the median (Westfall and Young 1993, max-T; Sidak 1967).
    """
    if sum(len(score.columns) for score in scores) < 2:
        return 1.0
    with single_blas_thread():  # of a few hundred columns threads only get in each other's way
        values, vectors = np.linalg.eigh(_products([score.columns for score in scores]))
        root = vectors * np.sqrt(np.clip(values, 0.0, None))
        draws = np.random.default_rng(seed).standard_normal((policy.search_draws, values.size))
        largest = np.abs(draws @ root.T).max(axis=1)
    smallest_p = 2 * distributions.norm.sf(np.median(largest))
    return float(max(1.0, np.log(0.5) / np.log1p(-smallest_p)))


def _products(columns: Sequence[Array]) -> Array:
    """Products of all columns with each other, a part of the samples at a time: one array of them
    all takes longer to fill than to multiply."""
    size, samples = sum(map(len, columns)), columns[0].shape[1]
    found, part = np.zeros((size, size)), np.empty((size, min(samples, SAMPLES_AT_A_TIME)))
    for first in range(0, samples, SAMPLES_AT_A_TIME):
        chosen = slice(first, first + SAMPLES_AT_A_TIME)
        here = part[:, : min(samples - first, SAMPLES_AT_A_TIME)]
        np.concatenate([one[:, chosen] for one in columns], out=here)
        found += here @ here.T
    return found


def corrected_p(score: Score, tests: float) -> float:
    """p-value of a score for the best of ``tests`` independent ones."""
    if score.inflation > 1.0 and score.freedom > 0:
        # The noise was measured between few periods, and is itself uncertain.
        local = float(distributions.f.sf(score.statistic / score.rank, score.rank, score.freedom))
    else:
        local = float(distributions.chi2.sf(score.statistic, score.rank))
    one_sided = score.rank == 1 and any(score.option.candidate.sign.values())
    local = local / 2 if one_sided and score.fall > 0 else local
    return float(-np.expm1(tests * np.log1p(-min(local, 1 - 1e-16))))


def without_twins(
    scores: Sequence[Score], *, policy: SearchPolicy = SearchPolicy()
) -> tuple[list[Score], dict[str, str]]:
    """Scores without effects that are another one in other words, and which those are.

    Where damping is a parameter of the model, more of it in extension is less of it in compression:
    beside the model's own terms both do the same, whatever the data. So does a friction that the
    model declares and that grows with pressure, and a further friction in proportion to pressure.
    Effects of different causes that do the same are no twins, but a class.

    Parameters
    ----------
    scores : sequence of Score
        In the catalogue's order, which says what twins are called.
    policy : SearchPolicy

    Returns
    -------
    kept : list of Score
    twins : dict of str to str
        Reason by effect.
    """
    kept: list[Score] = []
    twins: dict[str, str] = {}
    for score in scores:
        effect, target = score.option.key
        like = next((other for other in kept if _are_twins(score, other, policy)), None)
        if like is None:
            kept.append(score)
        else:
            twins[f"{effect} at {target}"] = f"the same as {like.option.key[0]} in other words"
    return kept, twins


def _are_twins(one: Score, other: Score, policy: SearchPolicy) -> bool:
    here, there = one.option.candidate, other.option.candidate
    families = {here.family, there.family}
    dependent = TERMS in families and families <= FORCES
    if dependent and balance_of(here.target) != balance_of(there.target):
        return False
    if not dependent and (here.family, here.target) != (there.family, there.target):
        return False
    if len(one.columns) != 1 or len(other.columns) != 1:
        return False  # effects with shapes, or with several unknowns
    return float(one.columns[0] @ other.columns[0]) ** 2 > policy.twin_cosine


def classes(scores: Sequence[Score], *, policy: SearchPolicy = SearchPolicy()) -> list[list[int]]:
    """For each score the others that these data cannot distinguish from it."""
    size = len(scores)
    found: list[list[int]] = [[] for _ in range(size)]
    lengths = [float(np.linalg.norm(score.contribution)) for score in scores]
    for i in range(size):
        for j in range(i + 1, size):
            if lengths[i] == 0 or lengths[j] == 0:
                continue
            cosine = float(scores[i].contribution @ scores[j].contribution) / (
                lengths[i] * lengths[j]
            )
            if cosine > 0 and cosine**2 > policy.same_cosine:
                found[i].append(j)
                found[j].append(i)
    return found
