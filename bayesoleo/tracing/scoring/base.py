"""What every candidate is scored against: residuals and sensitivities of the present model, in
units of the noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.data.noise_spectrum import NoiseSpectrum
from bayesoleo.estimation.problems.problem import measured_of
from bayesoleo.estimation.problems.scaling import PriorScale
from bayesoleo.prediction.input_noise import input_columns
from bayesoleo.prediction.records import Record
from bayesoleo.tracing.errors.errors_table import RunError
from bayesoleo.tracing.fitting.fit import Fit
from bayesoleo.tracing.fitting.masked import counted, weights
from bayesoleo.tracing.policy import SearchPolicy
from bayesoleo.tracing.scoring.sensitivities import present_constants

#: Samples of a run kept for comparing candidates with each other, chosen at random: an even choice
#: would miss what repeats with it.
MOST_SAMPLES = 1500
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
        With respect to present unknowns, each in units of its prior's standard deviation.
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
    fit : Fit
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
    """

    fit: Fit
    runs: list[RunBase]
    gram: Array
    gradient: Array
    noise: float
    excess: float
    doubt: float
    policy: SearchPolicy = SearchPolicy()

    @property
    def fall_back(self) -> float:
        """Denominator of shares: the excess, or what of it noise alone could feign."""
        return max(self.excess, 0.0) + self.feigned

    @property
    def feigned(self) -> float:
        """Excess that noise alone exceeds once in forty times."""
        return self.policy.excess_errors * self.doubt


def base_of(fit: Fit, errors: Mapping[tuple[str, str], RunError]) -> Base:
    """Prepare scoring.

    Parameters
    ----------
    fit : Fit
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
    return Base(fit, runs, gram, gradient, noise, excess, doubt, fit.policy)


def _prior_terms(fit: Fit) -> tuple[Array, Array]:
    """What priors add to ``J' W J`` and ``J' W e``, unknowns in units of their priors' sd.

    Only of what was measured beside the data: a nuisance parameter or a constant known to a
    tolerance is no free parameter, and must not take up an effect beyond what is known of it.
    """
    scale = PriorScale.of(fit.problem.priors, fit.problem.names)
    theta, measured = fit.point.theta, measured_of(fit.problem)
    slope = scale.slope(theta) * scale.sd / scale.unit(theta)
    # Next to nothing is known of the curvature within bounds; the width says as much.
    precision = scale.root.T @ scale.root
    return np.where(np.outer(measured, measured), precision, 0.0), np.where(measured, slope, 0.0)


def _run_base(
    fit: Fit,
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
    unit = np.array([prior.sd for prior in fit.problem.priors])
    own = fit.predictions[r].sensitivity[:, free] * unit[:, None]
    return RunBase.of(
        np.outer(1.0 / np.array(sigma), weights(record)).ravel(),
        (run.measured - fit.predictions[r].y).ravel(),
        flat(own),
        flat(from_input * borne_out[:, None, None]),
        np.tile(replicate(record, fit.policy), len(sigma)),
        spectra,
    )


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
