"""Score an effect at its null: how much of the residual it would explain, without estimating anything anew.

With residual ``e``, sensitivities ``J`` of the present parameters, ``C`` of the candidate's and weights ``W``, what the candidate adds is
``C_perp = C - J (J' W J)^-1 J' W C``; its score is ``s = C_perp' W e`` with information ``I = C_perp' W C_perp``. The expected parameter is
``I^-1 s`` and the sum of squares falls by ``s' I^-1 s`` (Rao's score test). Shape parameters that the null leaves undefined are scanned.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from bayesoleo.model import Model
from bayesoleo.parallel import thread_map
from bayesoleo.prediction.input_noise import input_columns
from bayesoleo.prediction.layout import Layout
from bayesoleo.prediction.predictor import Predictor
from bayesoleo.solvers.status import Status
from bayesoleo.tracing.assembly import Option
from bayesoleo.tracing.fit import Fit

Array = NDArray[np.float64]

#: Samples kept for comparing candidates with each other: every one of this many.
THINNING = 7
#: Directions of input noise that are counted in a run, and the squared size, in noise units, below which one is not worth it.
MOST_DIRECTIONS, NEGLIGIBLE = 256, 1e-2


@dataclass(frozen=True)
class InputNoise:
    """Low-rank part of a run's noise covariance, ``diag(1/w) + B B'``, that comes from its input.

    Parameters
    ----------
    columns : ndarray, shape (ny, k, N)
        ``B``: change of the outputs by one standard deviation of each input coefficient.
    weight : ndarray, shape (ny,)
        ``w``.
    inverse : ndarray, shape (k, k)
        ``(I + B' w B)^-1``.
    """

    columns: Array
    weight: Array
    inverse: Array

    @classmethod
    def of(cls, columns: Array, weight: Array) -> InputNoise:
        """Keep the directions that matter against the noise of the samples."""
        size = np.einsum("ykN,ykN,y->k", columns, columns, weight, optimize=True)
        kept = columns[:, np.argsort(-size)[: min(MOST_DIRECTIONS, int(np.sum(size > NEGLIGIBLE)))]]
        inner = np.einsum("yjN,ykN,y->jk", kept, kept, weight, optimize=True)
        return cls(kept, weight, np.linalg.inv(np.eye(inner.shape[0]) + inner))

    def product(self, left: Array, right: Array) -> Array:
        """``left' W right`` for blocks of shapes (ny, a, N) and (ny, b, N), by Woodbury's identity."""
        plain = np.einsum("yaN,ybN,y->ab", left, right, self.weight, optimize=True)
        if self.inverse.size == 0:
            return plain
        a = np.einsum("ykN,yaN,y->ka", self.columns, left, self.weight, optimize=True)
        b = np.einsum("ykN,ybN,y->kb", self.columns, right, self.weight, optimize=True)
        return plain - a.T @ self.inverse @ b


@dataclass(frozen=True)
class Base:
    """What every candidate is scored against.

    Parameters
    ----------
    fit : Fit
        The present model.
    residual : list of ndarray, each shape (ny, N_r)
        By run, SI.
    weight : list of ndarray, each shape (ny,)
        Inverse variance of a single sample's noise, by run.
    sensitivity : list of ndarray, each shape (ny, l, N_r)
        In units of the prior's standard deviation, so that the normal matrix is well scaled.
    period : list of ndarray of int, each shape (N_r,)
        Number of the period that each sample lies in.
    input_noise : list of InputNoise
        By run: directions in which the input's noise moves the outputs, counted in ``W``.
    gram : ndarray, shape (l, l)
        ``J' W J``.
    gradient : ndarray, shape (l,)
        ``J' W e``.
    noise : float
        Expected sum of squares of the averaged residual, had only noise remained.
    excess : float
        Sum of squares of the averaged residual beyond that.
    """

    fit: Fit
    residual: list[Array]
    weight: list[Array]
    sensitivity: list[Array]
    period: list[NDArray[np.int64]]
    input_noise: list[InputNoise]
    gram: Array
    gradient: Array
    noise: float
    excess: float

    @property
    def fall_back(self) -> float:
        """Denominator of shares: the excess, or what of it noise alone could feign."""
        return max(self.excess, 0.0) + 2.0 * np.sqrt(2.0 * self.noise)


def base_of(fit: Fit, errors: Mapping[tuple[str, str], tuple[float, float, float]]) -> Base:
    """Prepare scoring.

    Parameters
    ----------
    fit : Fit
        The present model.
    errors : mapping of (run, output) to (sigma, repeating, noise)
        Noise of a single sample, root mean square of the averaged residual, and its standard error, input noise included.
    """
    scale = np.array([prior.sd for prior in fit.problem.priors])
    tolerances = _tolerance_columns(fit)
    size, known = len(scale) + len(fit.model.uncertain()), len(scale)
    gram, residual, weight, sensitivity, period = np.zeros((size, size)), [], [], [], []
    # A constant known to a tolerance is no free parameter: its prior's precision, one in this unit, stays with it.
    gram[known:, known:] += np.eye(size - known)
    noise = excess = 0.0
    gradient, moved = np.zeros(size), []
    for r, record in enumerate(fit.records):
        run = fit.predictor.runs[r]
        e = run.measured - fit.predictions[r].y
        sigmas = np.array([max(errors[record.label, o][0], 1e-9 * float(np.ptp(m))) for o, m in zip(fit.predictor.outputs, run.measured, strict=True)])
        w = 1.0 / sigmas**2
        columns = fit.predictions[r].sensitivity[:, _free(fit)] * scale[:, None]
        columns = np.concatenate([columns, tolerances[r]], axis=1)
        from_input = InputNoise.of(input_columns(run, _present(fit, r)), w)
        gram += from_input.product(columns, columns)
        gradient += from_input.product(columns, e[:, None])[:, 0]
        for b, output in enumerate(fit.predictor.outputs):
            _, repeating, floor = errors[record.label, output]
            noise += record.time.size * w[b] * floor**2
            excess += record.time.size * w[b] * (repeating**2 - floor**2)
        residual.append(e)
        weight.append(w)
        sensitivity.append(columns)
        period.append(np.floor(record.phase + 1e-9).astype(np.int64))
        moved.append(from_input)
    return Base(fit, residual, weight, sensitivity, period, moved, gram, gradient, noise, excess)


def _present(fit: Fit, r: int) -> Array:
    """Constants of a run at the estimate, shape (np,)."""
    return fit.predictor.constants(fit.problem.full(fit.point.theta[None]), r)[0]


def _tolerance_columns(fit: Fit) -> list[Array]:
    """Sensitivities to the constants known to a tolerance only, in units of their priors' standard deviations."""
    names = fit.model.uncertain()
    if not names:
        return [np.zeros((run.measured.shape[0], 0, run.measured.shape[1])) for run in fit.predictor.runs]
    model = fit.model.fixing(*fit.model.estimated()).freeing(*names)
    scale = np.array([prior.sd for prior in Layout.of(model, ["any"]).priors(model)])
    blocks = _sensitivities(fit, model, [{}])
    if isinstance(blocks, Status):
        return [np.zeros((run.measured.shape[0], len(scale), run.measured.shape[1])) for run in fit.predictor.runs]
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
        Variance of the score between periods over what white noise gives; at least one.
    columns : ndarray, shape (m, n)
        Thinned, weighted, normalised ``C_perp`` of all scanned shapes, for the correction for the search.
    contribution : ndarray, shape (n,)
        Thinned, weighted ``C_perp I^-1 s``, for comparing candidates.
    z : float
        Signed root of the statistic for one new unknown, its root for several.
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

    @property
    def statistic(self) -> float:
        """Chi-square statistic with ``len(names)`` degrees of freedom, corrected for coloured noise."""
        return self.fall / self.inflation


def score_all(base: Base, options: Sequence[Option], jobs: int | None = None) -> tuple[list[Score], dict[str, str]]:
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
    failed = {f"{o.key[0]} at {o.key[1]}": r.message for o, r in zip(options, results, strict=True) if isinstance(r, Status)}
    return sorted(scores, key=lambda item: -item.share), failed


def _attempt(base: Base, option: Option) -> Score | Status:
    candidate = option.candidate
    shapes = [dict(zip(candidate.shapes, values, strict=True)) for values in product(*candidate.shapes.values())]
    columns = _columns(base, option, shapes)
    if isinstance(columns, Status):
        return columns
    best, thinned = None, []
    for values, block in zip(shapes, columns, strict=True):
        score = _evaluate(base, option, values, block)
        if score is None:
            continue
        thinned.append(score.columns)
        if best is None or score.fall > best.fall:
            best = score
    if best is None:
        return Status.SINGULAR
    return replace(best, columns=np.concatenate(thinned))


@dataclass(frozen=True)
class _Block:
    """Sensitivities of the new unknowns at one set of shapes."""

    names: tuple[str, ...]
    by_run: list[Array]  # each (ny, k, N)


def _columns(base: Base, option: Option, shapes: Sequence[Mapping[str, float]]) -> list[_Block] | Status:
    """Derivatives of the outputs with respect to the new unknowns, for each set of shapes."""
    fixed = [name for name in option.model.estimated() if name not in option.candidate.parameters]
    return _sensitivities(base.fit, option.model.fixing(*fixed), shapes)


def _sensitivities(fit: Fit, model: Model, shapes: Sequence[Mapping[str, float]]) -> list[_Block] | Status:
    """Derivatives with respect to a model's estimated parameters at the present estimate."""
    predictor = Predictor(model, fit.records, steps=fit.steps, scheme=fit.numerics.scheme, backend="numpy", jobs=1)
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
        status = run.set_anchor(p[0])
        if status is not Status.CONVERGED:
            return status
        samples = run.predict(p, derivatives=True)
        if (samples.status != Status.CONVERGED.value).any() or samples.y_p is None:
            return Status(int(samples.status.max()))
        for k in range(len(shapes)):
            full = np.zeros((samples.y.shape[1], theta.size, samples.y.shape[2]))
            full[:, layout.columns[r]] = samples.y_p[k]
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


def _evaluate(base: Base, option: Option, values: Mapping[str, float], block: _Block) -> Score | None:
    k, size = len(block.names), base.gram.shape[0]
    cross, own, score = np.zeros((size, k)), np.zeros((k, k)), np.zeros(k)
    for r, C in enumerate(block.by_run):
        inner = base.input_noise[r]
        cross += inner.product(base.sensitivity[r], C)
        own += inner.product(C, C)
        score += inner.product(C, base.residual[r][:, None])[:, 0]
    regular = base.gram + 1e-12 * np.diag(np.diag(base.gram)) if size else base.gram
    project = np.linalg.lstsq(regular, cross, rcond=None)[0] if size else np.zeros((0, k))
    information = own - cross.T @ project
    score = score - project.T @ base.gradient
    keep = np.diag(information) > 1e-8 * np.diag(own)
    if not keep.any() or not np.isfinite(information).all():
        return None
    expected = np.zeros(k)
    scale = np.sqrt(np.diag(information)[keep])
    inner = information[np.ix_(keep, keep)] / np.outer(scale, scale)
    expected[keep] = np.linalg.lstsq(inner, score[keep] / scale, rcond=1e-10)[0] / scale
    if not _allowed(option, block.names, expected):
        expected = np.zeros(k)
    fall = float(expected @ score)
    inflation = _inflation(base, block, project, expected)
    thin = _thinned(base, block, project)
    norms = np.linalg.norm(thin, axis=1, keepdims=True)
    z = float(np.sign(expected[0]) * np.sqrt(max(fall, 0.0))) if k == 1 else float(np.sqrt(max(fall, 0.0)))
    return Score(
        option=option,
        names=block.names,
        expected=expected,
        shapes=dict(values),
        fall=fall,
        share=fall / base.fall_back,
        inflation=inflation,
        columns=(thin / np.where(norms > 0, norms, 1.0))[keep],
        contribution=expected @ thin,
        z=z,
    )


def _allowed(option: Option, names: Sequence[str], expected: Array) -> bool:
    """Whether the expected values lie on the physical side of a one-sided null."""
    for name, value in zip(names, expected, strict=True):
        sign = option.candidate.sign.get(name.split("[")[0], 0)
        if sign * value < 0:
            return False
    return True


def _thinned(base: Base, block: _Block, project: Array) -> Array:
    """Weighted ``C_perp`` at some samples, shape (k, n)."""
    rows = []
    for r, C in enumerate(block.by_run):
        part = slice(None, None, THINNING)
        rest = C[:, :, part] - np.einsum("ylN,lk->ykN", base.sensitivity[r][:, :, part], project)
        weighted = rest * np.sqrt(base.weight[r])[:, None, None]
        rows.append(np.moveaxis(weighted, 1, 0).reshape(C.shape[1], -1))
    return np.concatenate(rows, axis=1)


def _inflation(base: Base, block: _Block, project: Array, expected: Array) -> float:
    """Variance of the score between periods relative to white noise's, along the expected direction."""
    if not np.any(expected):
        return 1.0
    measured = assumed = 0.0
    for r, C in enumerate(block.by_run):
        direction = np.einsum("ykN,k->yN", C, expected) - np.einsum("ylN,l->yN", base.sensitivity[r], project @ expected)
        product_ = np.sum(direction * base.residual[r] * base.weight[r][:, None], axis=0)
        own = np.sum(direction**2 * base.weight[r][:, None], axis=0)
        sums = np.bincount(base.period[r], product_)
        periods = sums.size
        if periods < 2:
            continue
        measured += periods * float(np.var(sums, ddof=1))
        assumed += float(np.sum(own))
    # Slow noise makes the score vary more than its formula says; too few periods can only feign less, which is not believed.
    return max(1.0, measured / assumed) if assumed > 0 else 1.0
