"""Score an effect at its null: how much of the residual it would explain, without estimating
anything anew.

With residual ``e``, sensitivities ``J`` of the present parameters, ``C`` of the candidate's and
weights ``W``, what the candidate adds is
``C_perp = C - J (J' W J)^-1 J' W C``; its score is ``s = C_perp' W e`` with information ``I =
C_perp' W C_perp``. The expected parameter is
``I^-1 s`` and the sum of squares falls by ``s' I^-1 s`` (Rao's score test). Shape parameters that
the null leaves undefined are scanned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from bayesoleo.data.noise_spectrum import NoiseSpectrum
from bayesoleo.model import Model
from bayesoleo.parallel import thread_map
from bayesoleo.prediction.input_noise import input_columns
from bayesoleo.prediction.layout import Layout
from bayesoleo.prediction.predictor import Predictor
from bayesoleo.prediction.records import Record
from bayesoleo.solvers.status import Status
from bayesoleo.tracing.assembly import Option
from bayesoleo.tracing.colour import inflation_of
from bayesoleo.tracing.errors_table import RunError
from bayesoleo.tracing.fit import Fit
from bayesoleo.tracing.projection import coefficients, remains
from bayesoleo.tracing.visible import without_round_off

Array = NDArray[np.float64]

#: Samples of a run kept for comparing candidates with each other, chosen at random: an even choice
#: would miss what repeats with it.
MOST_SAMPLES = 1500
#: Stretches of a transient whose scatter stands in for that between periods.
STRETCHES = 8
#: Why an effect has no score.
SPANNED = "the model can already do what it would"
INVISIBLE = "not visible in these data: no output changes with it"
#: Directions of input noise that are counted in a run, and the squared size, in noise units, below
#: which one is not worth it.
MOST_DIRECTIONS, NEGLIGIBLE = 256, 1e-2


@dataclass(frozen=True)
class RunBase:
    """One run in units of its noise: all arrays are divided by the noise of a sample, outputs one
    after the other.

    The noise covariance is ``I + B' B`` in these units; ``B``, from the input's noise, is counted
    by Woodbury's identity.

    Parameters
    ----------
    scale : ndarray, shape (m,)
        Inverse standard deviation of a single sample's noise.
    residual : ndarray, shape (m,)
    sensitivity : ndarray, shape (l, m)
        With respect to present unknowns and uncertain constants, each in units of its prior's
        standard deviation.
    input_noise : ndarray, shape (k, m)
        ``B``: change of the outputs by one standard deviation of each input coefficient that
        matters.
    inverse : ndarray, shape (k, k)
        ``(I + B B')^-1``.
    period : ndarray of int, shape (m,)
        Number of the period that each sample lies in.
    mixed, moved : ndarray, shapes (k, l) and (k,)
        ``B J`` and ``B e``, kept because every candidate needs them.
    chosen : ndarray of int
        Samples kept for comparing candidates with each other.
    spectra : tuple of NoiseSpectrum
        Of the outputs' noise; empty where it is taken as white.
    """

    scale: Array
    residual: Array
    sensitivity: Array
    input_noise: Array
    inverse: Array
    period: NDArray[np.int64]
    mixed: Array
    moved: Array
    chosen: NDArray[np.int64]
    spectra: tuple[NoiseSpectrum, ...] = ()

    @classmethod
    def of(
        cls,
        scale: Array,
        residual: Array,
        sensitivity: Array,
        columns: Array,
        period: NDArray[np.int64],
        spectra: tuple[NoiseSpectrum, ...] = (),
    ) -> RunBase:
        """Keep the directions of input noise that matter against the noise of the samples."""
        columns = columns * scale
        size = np.sum(columns**2, axis=1)
        kept = columns[np.argsort(-size)[: min(MOST_DIRECTIONS, int(np.sum(size > NEGLIGIBLE)))]]
        inverse = np.linalg.inv(np.eye(len(kept)) + kept @ kept.T)
        e, J = residual * scale, sensitivity * scale
        chosen = _choice(e.size)
        return cls(scale, e, J, kept, inverse, period, kept @ J.T, kept @ e, chosen, spectra)

    def products(self, new: Array) -> tuple[Array, Array, Array]:
        """``J' W C``, ``C' W C`` and ``C' W e`` for new columns ``C (k, m)`` in noise units."""
        moved = self.input_noise @ new.T
        through = self.inverse @ moved
        cross = self.sensitivity @ new.T - self.mixed.T @ through
        own = new @ new.T - moved.T @ through
        return cross, own, new @ self.residual - self.moved @ through


@dataclass(frozen=True)
class Base:
    """What every candidate is scored against.

    Parameters
    ----------
    fit : Fit
        The present model.
    runs : list of RunBase
        Residuals and sensitivities by run.
    gram : ndarray, shape (l, l)
        ``J' W J``, with the prior precision of uncertain constants.
    gradient : ndarray, shape (l,)
        ``J' W e``.
    noise : float
        Expected sum of squares of the averaged residual, had only noise remained.
    excess : float
        Sum of squares of the averaged residual beyond that.
    """

    fit: Fit
    runs: list[RunBase]
    gram: Array
    gradient: Array
    noise: float
    excess: float

    @property
    def fall_back(self) -> float:
        """Denominator of shares: the excess, or what of it noise alone could feign."""
        return max(self.excess, 0.0) + self.feigned

    @property
    def feigned(self) -> float:
        """Excess that noise alone exceeds once in fifty times."""
        return 2.0 * float(np.sqrt(2.0 * self.noise))


def base_of(fit: Fit, errors: Mapping[tuple[str, str], RunError]) -> Base:
    """Prepare scoring.

    Parameters
    ----------
    fit : Fit
        The present model.
    errors : mapping of (run, output) to RunError
        What is left in the fitted runs, and the noise.
    """
    unit = np.array([prior.sd for prior in fit.problem.priors])
    tolerances = _tolerance_columns(fit)
    size, known = len(unit) + len(fit.model.uncertain()), len(unit)
    gram, gradient, runs = np.zeros((size, size)), np.zeros(size), []
    # A constant known to a tolerance is no free parameter: its prior's precision, one in this unit,
    # stays with it.
    gram[known:, known:] += np.eye(size - known)
    for k, name in enumerate(fit.problem.names):
        if name in fit.problem.nuisances:
            gram[k, k] += 1.0
            gradient[k] -= (fit.point.theta[k] - fit.problem.priors[k].mean) / unit[k]
    noise = excess = 0.0
    for r, record in enumerate(fit.records):
        run = fit.predictor.runs[r]
        sigma = [
            _sigma(errors[record.label, o].average.sigma, m)
            for o, m in zip(fit.predictor.outputs, run.measured, strict=True)
        ]
        columns = np.concatenate(
            [fit.predictions[r].sensitivity[:, _free(fit)] * unit[:, None], tolerances[r]], axis=1
        )
        present = RunBase.of(
            np.repeat(1.0 / np.array(sigma), record.time.size),
            (run.measured - fit.predictions[r].y).ravel(),
            _flat(columns),
            _flat(input_columns(run, _present(fit, r))),
            np.tile(replicate(record), len(sigma)),
            _spectra([errors[record.label, o] for o in fit.predictor.outputs]),
        )
        cross, _, _ = present.products(present.sensitivity)
        gram += cross
        gradient += present.products(present.sensitivity)[2]
        for output, value in zip(fit.predictor.outputs, sigma, strict=True):
            entry = errors[record.label, output]
            noise += record.time.size * (entry.noise / value) ** 2
            excess += record.time.size * (entry.repeating**2 - entry.noise**2) / value**2
        runs.append(present)
    return Base(fit, runs, gram, gradient, noise, excess)


def _spectra(entries: Sequence[RunError]) -> tuple[NoiseSpectrum, ...]:
    found = tuple(entry.spectrum for entry in entries if entry.spectrum is not None)
    return found if len(found) == len(entries) else ()


def replicate(record: Record) -> NDArray[np.int64]:
    """Number of the period that each sample lies in; of a transient, of the stretch."""
    if record.periodic:
        return np.floor(record.phase + 1e-9).astype(np.int64)
    return np.minimum((STRETCHES * record.position).astype(np.int64), STRETCHES - 1)


def _sigma(noise: float, measured: Array) -> float:
    """Noise of a sample; data without noise get a floor far below what any record resolves."""
    return max(noise, 1e-9 * float(np.ptp(measured)), 1e-300)


def _flat(columns: Array) -> Array:
    """Columns of shape (ny, k, N) as (k, ny N), outputs one after the other."""
    outputs, count, samples = columns.shape
    return np.moveaxis(columns, 1, 0).reshape(count, outputs * samples)


def _present(fit: Fit, r: int) -> Array:
    """Constants of a run at the estimate, shape (np,)."""
    return fit.predictor.constants(fit.problem.full(fit.point.theta[None]), r)[0]


def _tolerance_columns(fit: Fit) -> list[Array]:
    """Sensitivities to the constants known to a tolerance only, in units of their priors' standard
    deviations."""
    names = fit.model.uncertain()
    if not names:
        return [
            np.zeros((run.measured.shape[0], 0, run.measured.shape[1]))
            for run in fit.predictor.runs
        ]
    model = fit.model.fixing(*fit.model.estimated()).freeing(*names)
    scale = np.array([prior.sd for prior in Layout.of(model, ["any"]).priors(model)])
    blocks = _sensitivities(fit, model, [{}])
    if isinstance(blocks, Status):
        return [
            np.zeros((run.measured.shape[0], len(scale), run.measured.shape[1]))
            for run in fit.predictor.runs
        ]
    return [block * scale[:, None] for block in blocks[0].by_run]


def _free(fit: Fit) -> NDArray[np.int64]:
    names = fit.predictor.layout.names
    return np.array([names.index(name) for name in fit.problem.names], dtype=np.int64)


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

    @property
    def statistic(self) -> float:
        """Chi-square statistic with ``rank`` degrees of freedom, corrected for coloured noise."""
        return self.fall / self.inflation


def score_all(
    base: Base, options: Sequence[Option], jobs: int | None = None
) -> tuple[list[Score], dict[str, str]]:
    """Score every candidate.

    Returns
    -------
    scores : list of Score
        By falling share.
    failed : dict of str to str
        Reason by effect where the extended model could not be solved.
    """
    results = thread_map(lambda option: _attempt(base, option), list(options), jobs)
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


def _attempt(base: Base, option: Option) -> Score | Status | str:
    """The score, or why there is none."""
    candidate = option.candidate
    shapes = [
        dict(zip(candidate.shapes, values, strict=True))
        for values in product(*candidate.shapes.values())
    ]
    columns = _columns(base, option, shapes)
    if isinstance(columns, Status):
        return columns
    best, used, thinned = None, columns[0], []
    for values, block in zip(shapes, columns, strict=True):
        score = _evaluate(base, option, values, block)
        if score is None:
            continue
        thinned.append(score.columns)
        if best is None or score.fall > best.fall:
            best, used = score, block
    if best is None:
        seen = any(item.any() for block in columns for item in block.by_run)
        return SPANNED if seen else INVISIBLE
    inflation, freedom = inflation_of(base, _directions(base, used, best.expected))
    return replace(best, columns=np.concatenate(thinned), inflation=inflation, freedom=freedom)


@dataclass(frozen=True)
class _Block:
    """Sensitivities of the new unknowns at one set of shapes."""

    names: tuple[str, ...]
    by_run: list[Array]  # each (ny, k, N)


def _columns(
    base: Base, option: Option, shapes: Sequence[Mapping[str, float]]
) -> list[_Block] | Status:
    """Derivatives of the outputs with respect to the new unknowns, for each set of shapes."""
    fixed = [name for name in option.model.estimated() if name not in option.candidate.parameters]
    return _sensitivities(base.fit, option.model.fixing(*fixed), shapes)


def _sensitivities(
    fit: Fit, model: Model, shapes: Sequence[Mapping[str, float]]
) -> list[_Block] | Status:
    """Derivatives with respect to a model's estimated parameters at the present estimate."""
    predictor = Predictor(
        model,
        fit.records,
        steps=fit.steps,
        scheme=fit.numerics.scheme,
        backend="numpy",
        jobs=1,
        share=fit.predictor,
    )
    if predictor.outputs != fit.predictor.outputs:
        return Status.SINGULAR
    layout = predictor.layout
    theta = layout.start(model)
    found: list[list[Array]] = [[] for _ in shapes]
    for r, run in enumerate(predictor.runs):
        p = np.repeat(predictor.constants(theta[None], r), len(shapes), axis=0)
        _set_present(fit, r, predictor, p)
        for k, values in enumerate(shapes):
            for name, value in values.items():
                p[k, run.kernels.derived.constants.index(name)] = value
        run.motions = fit.predictor.runs[r].known_motions()
        run.watched = False  # at the null nothing has moved
        status = run.set_anchor(p[0])
        if status is not Status.CONVERGED:
            return status
        samples = run.predict(p, derivatives=True)
        if (samples.status != Status.CONVERGED.value).any() or samples.y_p is None:
            return Status(int(samples.status.max()))
        constants = run.kernels.derived.constants
        own = [k for k, name in enumerate(constants) if name in fit.model.parameters]
        y_p = without_round_off(run, p, samples, own)
        for k in range(len(shapes)):
            full = np.zeros((samples.y.shape[1], theta.size, samples.y.shape[2]))
            full[:, layout.columns[r]] = y_p[k]
            found[k].append(full)
    return [_Block(layout.names, item) for item in found]


def _set_present(fit: Fit, r: int, predictor: Predictor, p: Array) -> None:
    """Give an extended model the estimates of the present one, by-run values included."""
    present = _present(fit, r)
    names = fit.predictor.runs[r].kernels.derived.constants
    position = {name: k for k, name in enumerate(predictor.runs[r].kernels.derived.constants)}
    for name, value in zip(names, present, strict=True):
        if name in position:
            p[:, position[name]] = value


def _evaluate(
    base: Base, option: Option, values: Mapping[str, float], block: _Block
) -> Score | None:
    k, size = len(block.names), base.gram.shape[0]
    cross, own, score = np.zeros((size, k)), np.zeros((k, k)), np.zeros(k)
    columns = [_flat(item) * run.scale for run, item in zip(base.runs, block.by_run, strict=True)]
    for run, new in zip(base.runs, columns, strict=True):
        parts = run.products(new)
        cross, own, score = cross + parts[0], own + parts[1], score + parts[2]
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
    thin = _thinned(base, columns, project)
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
    )


def _allowed(option: Option, names: Sequence[str], expected: Array) -> bool:
    """Whether the expected values lie on the physical side of a one-sided null."""
    for name, value in zip(names, expected, strict=True):
        sign = option.candidate.sign.get(name.split("[")[0], 0)
        if sign * value < 0:
            return False
    return True


def _choice(size: int) -> NDArray[np.int64]:
    """Some of so many samples, always the same."""
    if size <= MOST_SAMPLES:
        return np.arange(size)
    return np.sort(np.random.default_rng(size).permutation(size)[:MOST_SAMPLES])


def _thinned(base: Base, columns: Sequence[Array], project: Array) -> Array:
    """``C_perp`` in noise units at some samples, shape (k, n)."""
    rows = []
    for run, new in zip(base.runs, columns, strict=True):
        rows.append(new[:, run.chosen] - project.T @ run.sensitivity[:, run.chosen])
    return np.concatenate(rows, axis=1)


def _directions(base: Base, block: _Block, expected: Array) -> list[Array]:
    """What the expected parameters add to each run beside the present ones, in noise units."""
    columns = [_flat(item) * run.scale for run, item in zip(base.runs, block.by_run, strict=True)]
    cross = np.zeros((base.gram.shape[0], expected.size))
    for run, new in zip(base.runs, columns, strict=True):
        cross += run.products(new)[0]
    project = coefficients(base.gram, cross)
    return [
        expected @ new - (project @ expected) @ run.sensitivity
        for run, new in zip(base.runs, columns, strict=True)
    ]
