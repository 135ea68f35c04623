"""The basis of score tests: residuals and sensitivities of the present model.

Both are in units of the noise. Sensitivities include those to parameters that the fitted model
lacks or holds fixed. Candidates are projected out of the present sensitivities by inner products
alone, which needs a test of whether anything but round-off remains.

A constant force on a coordinate that no output contains moves the model without a visible effect.
Its computed sensitivity consists of round-off, and a score divides by it. Such sensitivities are
therefore detected and left out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array, Flags, Integers
from bayesoleo.data._noise import NoiseSpectrum
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._fit_and_hold_out_error import RunError
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._samples_that_count import counted, weights
from bayesoleo.discovery._spectral_data import SpectralData
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.estimation._problem import measured_of
from bayesoleo.model._model import Model
from bayesoleo.prediction._mesh_steps import whole_steps
from bayesoleo.prediction._periodic_run import FEW_STEPS, PredictedSamples, RunPredictor
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._run_errors import errors_known, input_columns
from bayesoleo.solvers._orbit import Status

#: A squared residual norm below this part of the squared norm is no direction of its own: the
#: sensitivities themselves are good to some seven digits beside those of the model.
LEAST = 1e-8
#: Sums of products over some 1e5 samples are good to this part of the size of what they sum.
ROUND_OFF = 1e3 * float(np.finfo(float).eps)

#: Finds samples at other constants, near those at which they were found, in the same way.
type Again = Callable[[Array], PredictedSamples | None]

#: A sensitivity is computed again if a parameter that moves a state by its full size moves an
#: output by less than this part of the output's size: solutions are good to some 1e-13 of their
#: size, and the second computation confirms a real one.
SUSPECT = 1e-9
#: Relative change of the constants for the second look: far above round-off, and far too small for
#: a real sensitivity to follow by more than ``REPEATS`` of its size.
CHANGE, REPEATS = 1e-9, 1e-3
#: Steps of all runs, times sets of shapes, from which a candidate's kernels are compiled: each step
#: takes some ten microseconds in arrays, and to compile them a few tenths of a second.
WORTH_COMPILING = 200_000
#: The same for a candidate with states of its own, whose motion has to be found: that takes some
#: fifty times as many evaluations. Of an oleo with 11 runs of 128 steps an elastic slider took 6 s
#: in arrays, and 0.5 s compiled, compilation included.
WORTH_COMPILING_STATES = 3_000
#: Motions of one run that are sought by shooting for a score on many steps: each takes seconds to
#: minutes, and a candidate is scored with ten sets of shapes. Of those not found nothing is seen.
MOST_SHOTS = 2
#: Samples of a run kept for comparing candidates with each other, chosen at random: an even choice
#: would miss what repeats with it.
MOST_SAMPLES = 1500
#: Directions of input noise that are counted in a run, and the squared size, in noise units, below
#: which one is not worth it.
MOST_DIRECTIONS, NEGLIGIBLE = 256, 1e-2


def coefficients(gram: Array, cross: Array) -> Array:
    """Coefficients ``(l, k)`` of directions on others, from ``J' W J`` and ``J' W C``.

    The gram matrix is brought to a unit diagonal, so that units do not matter; directions that it
    does not determine to the last digit are held back rather than cut off.
    """
    if not len(gram):
        return np.zeros_like(cross)
    scale = np.sqrt(np.diag(gram))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    floor = 10 * len(gram) * np.finfo(float).eps * max(values.max(), 1e-300)
    inverse = vectors / np.maximum(values, floor)
    return cast(Array, (inverse @ (vectors.T @ (cross / scale[:, None]))) / scale[:, None])


def remains(gram: Array, project: Array, own: Array, information: Array) -> NDArray[np.bool_]:
    """Which directions ``(k,)`` are more than round-off beside those projected out.

    What is left of a direction's squared norm is the difference of large parts where the model's
    own directions nearly cancel each other: ``|x|' |G| |x|`` with the coefficients ``x``.

    Parameters
    ----------
    gram : ndarray, shape (l, l)
        ``J' W J``.
    project : ndarray, shape (l, k)
        Of :func:`coefficients`.
    own, information : ndarray, shape (k, k)
        ``C' W C`` before, and what is left after.
    """
    size = np.abs(project)
    parts = np.einsum("ik,ij,jk->k", size, np.abs(gram), size)
    before, left = np.diag(own), np.diag(information)
    kept: NDArray[np.bool_] = left > np.maximum(LEAST * before, ROUND_OFF * parts)
    return kept


def squared_distance(value: Array, covariance: Array) -> float:
    """``value' covariance^-1 value`` of values (k,) in units that may differ by any factor.

    Directions that the covariance does not have, to twelve digits of its correlations, are left
    out.
    """
    sd = np.sqrt(np.diag(covariance))
    unit = np.where(sd > 0, sd, 1.0)
    scaled = value / unit
    return float(
        scaled @ np.linalg.lstsq(covariance / np.outer(unit, unit), scaled, rcond=1e-12)[0]
    )


def resolved_sensitivities(
    run: RunPredictor,
    p: Array,
    samples: PredictedSamples,
    changed: Sequence[int],
    again: Again | None = None,
) -> Array:
    """Derivatives of the outputs, zero where they are round-off.

    What is suspiciously small is computed once more with constants that differ in the tenth digit:
    a derivative repeats, round-off does not.

    Parameters
    ----------
    run : RunPredictor
        At its anchor.
    p : ndarray, shape (L, np)
        Constants of the samples.
    samples : PredictedSamples
        With derivatives ``(L, ny, na, N)``.
    changed : sequence of int
        Which of the constants may be changed for the second look.
    again : callable, optional
        Samples with derivatives at other constants ``(L, np)``, as those were found; by default
        from the anchor. What has no solution there is left as it is.

    Returns
    -------
    ndarray, shape (L, ny, na, N)
    """
    y_p = samples.y_p
    assert y_p is not None
    if run.anchor is None:
        return y_p  # a force law is evaluated, not solved
    suspect = _suspects(run, y_p)
    if not suspect.any():
        return y_p
    nearby = p.copy()
    # Each by a factor of its own, lest a common one scale all equations and change no digit.
    nearby[:, changed] *= 1 + CHANGE * np.linspace(1.0, 2.0, len(changed))
    second = run.predict(nearby, derivatives=True) if again is None else again(nearby)
    if second is None or second.y_p is None:
        return y_p
    solved = second.status == Status.CONVERGED.value
    moved = np.linalg.norm(second.y_p - y_p, axis=-1)
    noisy = suspect & (moved > REPEATS * np.linalg.norm(y_p, axis=-1)) & solved[:, None, None]
    return np.where(noisy[..., None], 0.0, y_p)


def _suspects(run: RunPredictor, y_p: Array) -> NDArray[np.bool_]:
    """Where outputs hardly move with a parameter though states do, shape (L, ny, na)."""
    assert run.anchor is not None
    size = np.abs(run.anchor.x).max(axis=0)
    moved = np.abs(run.anchor.x_p).max(axis=1)
    # A state at rest counts as moved without limit; whether that is real shows in the second look.
    relative = np.where(moved > 0, 1e200, 0.0)
    np.divide(moved, size, out=relative, where=size > 1e-150)
    reach = relative.max(axis=1)
    output = np.abs(run.measured).max(axis=1)
    found = np.abs(y_p).max(axis=-1)
    return cast(NDArray[np.bool_], (found > 0) & (found <= SUSPECT * output[:, None] * reach))


@dataclass(frozen=True)
class Block:
    """Sensitivities of the new unknowns at one set of shapes.

    Parameters
    ----------
    names : tuple of str
        Unknowns, by-run ones expanded.
    by_run : list of ndarray, shape (ny, q, N)
        One a run, SI: of the unknowns that act in that run. Of those of all other runs it would
        hold zeros alone.
    acting : list of ndarray of int, shape (q,), or None
        By run, numbers of these unknowns; None where each run has all.
    """

    names: tuple[str, ...]
    by_run: list[Array]
    acting: list[Integers] | None = None

    @property
    def numbers(self) -> list[Integers]:
        """By run, numbers of the unknowns of which it has columns."""
        every = np.arange(len(self.names))
        return [every for _ in self.by_run] if self.acting is None else self.acting

    def column(self, run: int, name: str) -> Array | None:
        """What an unknown changes in a run, shape (ny, N); None where it does not act, or there is
        no such unknown."""
        if name not in self.names:
            return None
        place = np.flatnonzero(self.numbers[run] == self.names.index(name))
        return self.by_run[run][:, place[0]] if place.size else None


def sensitivities_of(
    fit: ModelFit, model: Model, shapes: Sequence[Mapping[str, float]]
) -> list[Block] | Status:
    """Derivatives with respect to a model's estimated parameters at a fitted model's estimate.

    Parameters
    ----------
    fit : ModelFit
        Of a model that the other one extends, or whose constants it frees.
    model : Model
        Estimates the parameters that are asked for, and no others.
    shapes : sequence of mapping of str to float
        Values of shape parameters, one set a block.

    Returns
    -------
    list of Block, or Status
        Why there are none.
    """
    predictor = Predictor(
        model,
        fit.records,
        steps=fit.steps,
        scheme=fit.numerics.scheme,
        backend=_backend(fit, model, len(shapes)),
        jobs=1,
        share=fit.predictor,
    )
    if predictor.outputs != fit.predictor.outputs:
        return Status.SINGULAR
    layout = predictor.layout
    theta = layout.start(model)
    found: list[list[Array]] = [[] for _ in shapes]
    for r, run in enumerate(predictor.runs):
        p = _constants(fit, r, run, predictor.constants(theta[None], r), shapes)
        run.shots = MOST_SHOTS if run.record.periodic and run.steps > FEW_STEPS else None
        derivatives = _of_run(fit, r, run, p)
        if isinstance(derivatives, Status):
            # Steps that do for the present model may be too long for what an effect adds.
            fewer = fit.steps < whole_steps(model, fit.records)
            coarse = fewer and (run.can_be_coarser or run.can_be_joined)
            finer = replace(fit, steps=2 * fit.steps)
            return sensitivities_of(finer, model, shapes) if coarse else derivatives
        for k, y_p in enumerate(derivatives):
            found[k].append(y_p)
    # A shape whose motion is not found in some run is not seen, and scores nothing.
    seen = [all(np.isfinite(y_p).all() for y_p in item) for item in found]
    acting = list(layout.columns)
    return [
        Block(layout.names, item if known else [np.zeros_like(y_p) for y_p in item], acting)
        for item, known in zip(found, seen, strict=True)
    ]


def _backend(fit: ModelFit, model: Model, count: int) -> str:
    """NumPy's kernels are ready at once; machine code is worth its making on long records."""
    steps = sum(run.steps for run in fit.predictor.runs) if model.dofs else 0
    same = model.dofs.keys() == fit.model.dofs.keys()
    least = WORTH_COMPILING if same else WORTH_COMPILING_STATES
    return fit.numerics.backend if count * steps > least else "numpy"


def _constants(
    fit: ModelFit, r: int, run: RunPredictor, start: Array, shapes: Sequence[Mapping[str, float]]
) -> Array:
    """Constants of an extended model: present estimates, by-run values included, and shapes."""
    p = np.repeat(start, len(shapes), axis=0)
    position = {name: k for k, name in enumerate(run.kernels.derived.constants)}
    names = fit.predictor.runs[r].kernels.derived.constants
    for name, value in zip(names, present_constants(fit, r), strict=True):
        if name in position:
            p[:, position[name]] = value
    for k, values in enumerate(shapes):
        for name, value in values.items():
            p[k, position[name]] = value
    return p


def _of_run(fit: ModelFit, r: int, run: RunPredictor, p: Array) -> Array | Status:
    """Derivatives of one run's outputs, shape (L, ny, na, N)."""
    present = fit.predictor.runs[r]
    run.motions = present.known_motions()
    run.watched = False  # at the null nothing has moved
    found = _samples_of(present, run, p)
    if isinstance(found, Status):
        return found
    samples, again = found
    solved = samples.status == Status.CONVERGED.value
    if solved.any() and not solved.all():
        return _of_two_parts(fit, r, run, p, solved)
    if not solved.all() or samples.y_p is None:
        return Status(int(samples.status.max()))
    return resolved_sensitivities(run, p, samples, _own(fit, run), again)


def _samples_of(
    present: RunPredictor, run: RunPredictor, p: Array
) -> tuple[PredictedSamples, Again | None] | Status:
    """The samples of a candidate by the first way that there is, and how to find them again from
    elsewhere; or why there are none.

    At the null it moves as the present model does, up to states of its own.
    """
    samples = run.evaluate_on(present, p)
    if samples is not None and (samples.status == Status.CONVERGED.value).all():
        return samples, None
    if set(present.kernels.derived.dofs) == run.motions.keys() < set(run.kernels.derived.dofs):
        # All that has to be found are states of the candidate's own.
        samples = run.follow(p)
        if samples is not None:
            return samples, run.follow
    if len(p) == 1:
        return run.evaluate(p[0]), None
    status = _anchored(run, p)
    return (run.predict(p, derivatives=True), None) if status is Status.CONVERGED else status


def _anchored(run: RunPredictor, p: Array) -> Status:
    """Anchor a run at the first constants ``(L, np)`` for which its motion is found."""
    status = Status.NO_CONVERGENCE
    for row in p:
        run.anchor = None
        status = run.set_anchor(row)
        if status is Status.CONVERGED:
            break
    return status


def _of_two_parts(
    fit: ModelFit, r: int, run: RunPredictor, p: Array, solved: Flags
) -> Array | Status:
    """The same where some motions are not reached from that of the first shapes, as of a friction
    that holds in small motions: each of these is sought from its own guess. NaN where it is not
    found."""
    run.anchor = None
    first = _of_run(fit, r, run, p[solved])
    if isinstance(first, Status):
        return first
    found = np.full((len(p), *first.shape[1:]), np.nan)
    found[solved] = first
    anchor = run.anchor
    for lane in np.flatnonzero(~solved):
        run.anchor = None
        derivatives = _of_run(fit, r, run, p[[lane]])
        if isinstance(derivatives, Status) and anchor is not None:
            run.anchor = anchor
            derivatives = _from_another(fit, run, p[[lane]])
        if not isinstance(derivatives, Status):
            found[lane] = derivatives[0]
    return found


def _from_another(fit: ModelFit, run: RunPredictor, p: Array) -> Array | Status:
    """Derivatives at constants ``(1, np)`` whose motion is reached from the anchor alone."""
    samples = run.predict(p, derivatives=True)
    if samples.status[0] != Status.CONVERGED.value or samples.y_p is None:
        return Status(int(samples.status[0]))
    return resolved_sensitivities(run, p, samples, _own(fit, run))


def _own(fit: ModelFit, run: RunPredictor) -> list[int]:
    """Which constants of a run's model are parameters of the present one."""
    constants = run.kernels.derived.constants
    return [k for k, name in enumerate(constants) if name in fit.model.parameters]


def present_constants(fit: ModelFit, r: int) -> Array:
    """Constants of a fitted run at the estimate, shape (np,)."""
    return cast(Array, fit.predictor.constants(fit.problem.full(fit.point.theta[None]), r)[0])


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
        With respect to present unknowns, each in units of its prior's standard deviation.
    input_noise : ndarray, shape (k, m)
        ``B``: change of the outputs by one standard deviation of each input coefficient that
        matters; none where they are too many.
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
    unweighed : ndarray, shape (j, m)
        The same as ``B`` by sums of many coefficients. A sum of their squares along a direction is
        right, and their inverse is not: they are counted in variances, and weigh nothing.
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
    unweighed: Array = field(default_factory=lambda: np.zeros((0, 0)))

    @classmethod
    def of(
        cls,
        scale: Array,
        residual: Array,
        sensitivity: Array,
        columns: Array,
        period: NDArray[np.int64],
        spectra: tuple[NoiseSpectrum, ...] = (),
        *,
        each: bool = True,
    ) -> RunBase:
        """Keep the directions of input noise that matter against the noise of the samples, of which
        ``each`` is one coefficient, or a sum of many."""
        columns = columns * scale
        size = np.sum(columns**2, axis=1)
        count = int(np.sum(size > NEGLIGIBLE))
        kept, none = columns[np.argsort(-size)[:count]], columns[:0]
        kept, unweighed = (kept, none) if each and count <= MOST_DIRECTIONS else (none, kept)
        inverse = np.linalg.inv(np.eye(len(kept)) + kept @ kept.T)
        e, J = residual * scale, sensitivity * scale
        chosen = _choice(e.size)
        mixed, moved = kept @ J.T, kept @ e
        return cls(
            scale, e, J, kept, inverse, period, mixed, moved, chosen, spectra, unweighed
        )  # fmt: skip

    def weighed_noise(self, direction: Array) -> float:
        """Variance along a direction ``(m,)`` by the noise of inputs by which scores weigh."""
        return float(np.sum((self.input_noise @ direction) ** 2))

    def unweighed_noise(self, direction: Array) -> float:
        """The same by that of inputs with too many coefficients."""
        return float(np.sum((self.unweighed @ direction) ** 2)) if self.unweighed.size else 0.0

    def products(self, new: Array) -> tuple[Array, Array, Array]:
        """``J' W C``, ``C' W C`` and ``C' W e`` for new columns ``C (k, m)`` in noise units."""
        moved = self.input_noise @ new.T
        through = self.inverse @ moved
        cross = self.sensitivity @ new.T - self.mixed.T @ through
        own = new @ new.T - moved.T @ through
        return cross, own, new @ self.residual - self.moved @ through


def _choice(size: int) -> NDArray[np.int64]:
    """Some of so many samples, always the same."""
    if size <= MOST_SAMPLES:
        return np.arange(size)
    return np.sort(np.random.default_rng(size).permutation(size)[:MOST_SAMPLES])


@dataclass(frozen=True)
class Base:
    """What every candidate is scored against.

    Parameters
    ----------
    fit : ModelFit
        The present model.
    runs : list of RunBase
        Residuals and sensitivities by run.
    gram : ndarray, shape (l, l)
        ``J' W J``, with the prior precision of nuisance parameters and of constants known to a
        tolerance.
    gradient : ndarray, shape (l,)
        ``J' W e``.
    noise : float
        Expected sum of squares of the averaged residual, had only noise remained.
    excess : float
        Sum of squares of the averaged residual beyond that.
    doubt : float
        Standard deviation of the excess where nothing is missing: the residual's own scatter, and
        that of the noise, which is measured too.
    policy : SearchPolicy
        By which scores and estimates are judged.
    data : SpectralData, optional
        Lines on which changes of the outputs are kept to compare structures.
    units : ndarray, shape (l,)
        Units of the unknowns, their priors' standard deviations, SI.
    """

    fit: ModelFit
    runs: list[RunBase]
    gram: Array
    gradient: Array
    noise: float
    excess: float
    doubt: float
    policy: SearchPolicy = SearchPolicy()
    data: SpectralData | None = None
    units: Array = field(default_factory=lambda: np.ones(1))

    @property
    def fall_back(self) -> float:
        """Denominator of shares: the excess, or what of it noise alone could feign."""
        return max(self.excess, 0.0) + self.feigned

    @property
    def feigned(self) -> float:
        """Excess that noise alone exceeds once in forty times."""
        return self.policy.excess_errors * self.doubt


def base_of(fit: ModelFit, errors: Mapping[tuple[str, str], RunError]) -> Base:
    """Prepare scoring.

    Parameters
    ----------
    fit : ModelFit
        The present model.
    errors : mapping of (run, output) to RunError
        What is left in the fitted runs, and the noise.
    """
    gram, gradient = _prior_terms(fit)
    runs, noise, excess, variance = [], 0.0, 0.0, 0.0
    for r, record in enumerate(fit.records):
        entries = [errors[record.label, output] for output in fit.predictor.outputs]
        measured = fit.predictor.runs[r].measured
        sigma = [_sigma(e.sigma, m) for e, m in zip(entries, measured, strict=True)]
        borne_out = np.array([e.input_scale for e in entries])
        run = _run_base(fit, r, sigma, borne_out, _spectra(entries))
        cross, _, score = run.products(run.sensitivity)
        gram, gradient = gram + cross, gradient + score
        for entry, value in zip(entries, sigma, strict=True):
            own = counted(record) * (entry.noise / value) ** 2
            noise += own
            variance += 2.0 * own**2 * (1.0 / entry.coefficients + 1.0 / max(entry.free, 1.0))
            excess += counted(record) * (entry.repeating**2 - entry.noise**2) / value**2
        runs.append(run)
    doubt = float(np.sqrt(variance))
    data = SpectralData.of(fit)
    units = _units_of(fit)
    return Base(fit, runs, gram, gradient, noise, excess, doubt, fit.policy, data, units)


def _prior_terms(fit: ModelFit) -> tuple[Array, Array]:
    """What priors add to ``J' W J`` and ``J' W e``, unknowns in units of their priors' sd.

    Only of what was measured beside the data: a nuisance parameter or a constant known to a
    tolerance is no free parameter, and must not take up an effect beyond what is known of it.
    """
    scale = PriorScale.of(fit.problem.priors, fit.problem.names)
    theta, measured = fit.point.theta, measured_of(fit.problem)
    slope, precision = scale.quadratic(theta)
    return np.where(np.outer(measured, measured), precision, 0.0), np.where(measured, slope, 0.0)


def _run_base(
    fit: ModelFit,
    r: int,
    sigma: Sequence[float],
    borne_out: Array,
    spectra: tuple[NoiseSpectrum, ...],
) -> RunBase:
    """One run at the present estimate, given the noise of a sample by output, and how much of the
    input's noise the residual bears out."""
    from_input = input_columns(fit.predictor.runs[r], present_constants(fit, r))
    run, record = fit.predictor.runs[r], fit.records[r]
    names = fit.predictor.layout.names
    free = [names.index(name) for name in fit.problem.names]
    own = fit.predictions[r].sensitivity[:, free] * _units_of(fit)[:, None]
    return RunBase.of(
        np.outer(1.0 / np.array(sigma), weights(record)).ravel(),
        (run.measured - fit.predictions[r].y).ravel(),
        flat(own),
        flat(from_input * borne_out[:, None, None]),
        np.tile(replicate(record, fit.policy), len(sigma)),
        spectra,
        each=not record.periodic or errors_known(run),
    )


def _units_of(fit: ModelFit) -> Array:
    return np.array([prior.sd for prior in fit.problem.priors])


def _spectra(entries: Sequence[RunError]) -> tuple[NoiseSpectrum, ...]:
    found = tuple(entry.spectrum for entry in entries if entry.spectrum is not None)
    return found if len(found) == len(entries) else ()


def replicate(record: Record, policy: SearchPolicy) -> NDArray[np.int64]:
    """Number of the period that each sample lies in; of a transient, of the stretch."""
    if record.periodic:
        return np.floor(record.phase + 1e-9).astype(np.int64)
    count = policy.stretches
    return np.minimum((count * record.position).astype(np.int64), count - 1)


def _sigma(noise: float, measured: Array) -> float:
    """Noise of a sample; data without noise get a floor far below what any record resolves."""
    return max(noise, 1e-9 * float(np.ptp(measured)), 1e-300)


def flat(columns: Array) -> Array:
    """Columns of shape (ny, k, N) as (k, ny N), outputs one after the other."""
    outputs, count, samples = columns.shape
    return np.moveaxis(columns, 1, 0).reshape(count, outputs * samples)
