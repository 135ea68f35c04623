"""How well estimates are known beside noise that is not white, or that measured inputs have.

The noise of a measured input reaches the outputs through the model, coloured by its resonances. It
may be small in all that a model leaves, and large in the very direction that an unknown moves the
outputs. Noise of a sensor may be slow, or ring. The covariance of the estimate under the spectra of
all noise says what both do to each unknown.

The noise of periodic runs shows between their harmonics. That of transients is what the model
leaves of them, where its spectrum is not flat; see ``_transient_variance.py``.
"""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import scipy.fft

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array
from bayesoleo.discovery._expected_error import LinearisedRun, expected_of_fitted, linearised_runs
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._fit_and_hold_out_error import ErrorTable, compared, is_at_floor
from bayesoleo.discovery._refit import noise_of_fit
from bayesoleo.discovery._run_predictions import predict_fitted
from bayesoleo.discovery._signatures import COLOUR_FALSE_ALARM
from bayesoleo.discovery._transient_variance import RunNoise, coloured_variance, scatter_of
from bayesoleo.prediction._run_errors import DRAWS, errors_known

#: Variance that inputs add to an estimate, over what it has without them, above which they count:
#: intervals are 2.5 % too narrow without.
MATTERS = 0.05
#: Part of the squared noise of an average that comes from inputs, above which what a model leaves
#: shows it, so that effects of the catalogue would imitate it.
SHOWS = 0.05
#: Bands of lines, of equal width in the logarithm of the frequency, whose power shows a colour, and
#: fewest samples by which it is judged.
BANDS, FEWEST = 12, 100


@dataclass(frozen=True)
class NoiseOfEstimates:
    """What noise does to an estimate.

    Parameters
    ----------
    covariance : ndarray, shape (l, l)
        Of the estimate about the truth, under the spectra of all noise.
    stated : ndarray, shape (l, l)
        Under white noise of the residual's size, which the estimate states.
    beyond : bool
        Whether more is left than noise and the uncertainty of the unknowns lets expect.
    by_inputs : bool
        Whether noise of measured inputs widens an interval by what matters.
    shown : bool
        Whether it is a part of what is left that matters.
    coloured : dict of str to float
        By output whose noise in transients is not white, the probability of its spectrum by chance.
    """

    covariance: Array
    stated: Array
    beyond: bool = False
    by_inputs: bool = False
    shown: bool = False
    coloured: dict[str, float] | None = None

    @classmethod
    def of(cls, fit: ModelFit) -> NoiseOfEstimates:
        """Of the fitted runs. That of the last fit is kept: the choice of an error model and what
        is told to it ask for the same."""
        for last, found in _last:
            if last() is fit:
                return found
        found = cls._of(fit)
        _last[:] = [(weakref.ref(fit), found)]
        return found

    @classmethod
    def _of(cls, fit: ModelFit) -> NoiseOfEstimates:
        response, fitted = fit.point.covariance, predict_fitted(fit)
        roles = {one.record.label: "fit" for one in fitted}
        found = [compared(one, roles, policy=fit.policy) for one in fitted]
        runs = linearised_runs(fit, fitted, found)
        if not runs:
            return cls(response, response)
        entries, _ = expected_of_fitted(fit, fitted, found)
        drawn = any(not errors_known(one.predictor.runs[0]) for one in fitted)
        own, inputs = _scatters(runs, response, drawn)
        known = np.diag(response + own) > 0.0
        share = np.diag(inputs)[known] / np.diag(response + own)[known]
        matters = bool(np.max(share, initial=0.0) > MATTERS)
        shown = any(e.input_noise**2 > SHOWS * e.noise**2 for e in entries)
        beyond = not is_at_floor(ErrorTable(tuple(entries)), policy=fit.policy)
        # The noise of inputs is known line by line. In what is left of a transient its peaks at
        # resonances are wider: averages over neighbouring lines make them lower.
        coloured = {} if matters and not beyond else colours_of(fit)
        if coloured:
            own, inputs = coloured_surplus(fit, runs), 0.0 * inputs
        covariance = response + own + inputs
        return cls(covariance, response, beyond, matters, shown, coloured)

    @property
    def inputs_alone(self) -> bool:
        """Whether noise of inputs matters, and no more is left than it and the outputs' noise."""
        return self.by_inputs and not self.beyond

    @property
    def inflation(self) -> float:
        """Variance of the worst known unknown over the stated one, at least one."""
        variance, white = np.diag(self.covariance), np.diag(self.stated)
        return float(np.max(variance[white > 0.0] / white[white > 0.0], initial=1.0))


_last: list[tuple[weakref.ref[ModelFit], NoiseOfEstimates]] = []


def _scatters(runs: Sequence[LinearisedRun], response: Array, drawn: bool) -> tuple[Array, Array]:
    """What the outputs' own noise and that of inputs add to the covariance that is stated."""
    own, inputs = np.zeros_like(response), np.zeros_like(response)
    for run in runs:
        inputs += run.pulled @ run.pulled.T
        own += run.scatter - run.pulled @ run.pulled.T - run.information
    # A variance by so many draws is that uncertain.
    more = DRAWS / (DRAWS - 2.0) if drawn else 1.0
    return response @ own @ response, more * response @ inputs @ response


# -- transients ------------------------------------------------------------------------------------


def colours_of(fit: ModelFit) -> dict[str, float]:
    """Outputs whose noise in transients has a spectrum that is not flat, with its probability."""
    if fit.all_periodic or not np.isfinite(fit.point.covariance).all():
        return {}
    pairs = zip(fit.records, noise_of_fit(fit), strict=True)
    noise = [run for record, run in pairs if not record.periodic and run.samples >= FEWEST]
    if not all(np.isfinite(part).all() for run in noise for part in (run.columns, run.residual)):
        return {}
    outputs, found = fit.predictor.outputs, dict[str, float]()
    for b, output in enumerate(outputs):
        p_value = flatness_p([_lines(run, b) for run in noise])
        if p_value < COLOUR_FALSE_ALARM / len(outputs):
            found[output] = p_value
    return found


def _lines(run: RunNoise, output: int) -> Array:
    """Power of the noise of an output by line, of what the estimate leaves of it."""
    power = np.abs(scipy.fft.rfft(run.residual[output])) ** 2 / run.remains
    lines: Array = power[1 : (run.samples - 1) // 2]
    return lines


def flatness_p(lines: Sequence[Array]) -> float:
    """Least probability of so much power in any band of lines, were all of it alike.

    Parameters
    ----------
    lines : sequence of ndarray, shape (q,)
        By run; each power has two degrees of freedom.
    """
    whitened = [power / power.mean() for power in lines if power.size and power.mean() > 0.0]
    if not whitened:
        return 1.0
    edges = np.unique(np.geomspace(1, max(w.size for w in whitened) + 1, BANDS + 1).astype(int)) - 1
    least, rest = 1.0, sum(one.size for one in whitened)
    for low, high in pairwise(edges):
        band = np.concatenate([one[low:high] for one in whitened])
        others = rest - band.size
        if band.size and others:
            # Beside the mean of all other lines: one that holds nearly all power is seen too.
            mean = max((rest - float(band.sum())) / others, 1e-300)
            chance = distributions.f.sf(float(band.mean()) / mean, 2 * band.size, 2 * others)
            least = min(least, float(chance))
    return min(least * (edges.size - 1), 1.0)


def coloured_surplus(fit: ModelFit, runs: Sequence[LinearisedRun]) -> Array:
    """What noise of the spectra of what is left of transients adds to the stated covariance.

    The spectra are known to so many degrees of freedom by unknown, by which intervals are wider.
    """
    noise, response = noise_of_fit(fit), fit.point.covariance
    total, surplus = np.zeros_like(response), np.zeros_like(response)
    transients = [k for k, record in enumerate(fit.records) if not record.periodic]
    for k, run in enumerate(runs):
        if k in transients:
            total += scatter_of(noise[k])
            surplus -= run.information
        else:
            surplus += run.scatter - run.information
    spread, wider = response @ total @ response, np.ones(len(response))
    chosen = [noise[k] for k in transients]
    for j, row in enumerate(response):
        moved = [np.tensordot(row, run.columns, axes=1) for run in chosen]
        variance, free = coloured_variance(moved, chosen)
        if spread[j, j] > 0.0 and variance > 0.0:
            wider[j] = np.sqrt(variance / spread[j, j] * free / max(free - 2.0, 1.0))
    return response @ surplus @ response + np.outer(wider, wider) * spread
