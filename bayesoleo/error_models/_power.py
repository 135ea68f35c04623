r"""Independent errors whose likelihood counts as many samples as are effectively independent.

The likelihood of every run and output is raised to the power :math:`n' / n`,

.. math:: p(\theta, v | y) \propto p(\theta, v) \prod p(y_{rb} | \theta, v_b)^{n_{rb}' / n_{rb}},

so that a residual which is alike from sample to sample, or from period to period, promises no more
than it tells. The effective number follows from the residual at the estimate:

.. math:: n / n' = \tau + s (P - 1) \tau_r ,

with the integrated autocorrelation time :math:`\tau` of the residual, the part :math:`s` of its
variance that repeats in each of :math:`P` periods, and the autocorrelation time :math:`\tau_r` of
that part. The exponents are then kept.

References
----------
Sokal (1997), *Functional Integration*, 131-192, eq. 3.11: autocorrelation time by a window.
Kish (1965), *Survey Sampling*, section 5.4: the design effect of repetitions.
Grünwald and van Ommen (2017), Bayesian Analysis 12, 1069-1103; Miller and Dunson (2019), JASA 114,
1113-1125: posteriors by powers of the likelihood where models are wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import signal

from bayesoleo._types import Array, Integers
from bayesoleo.error_models._base import Frame, RunSamples
from bayesoleo.error_models._independent import IndependentErrors, log_likelihood_by_run
from bayesoleo.errors import InputError

#: Autocorrelation is summed over this many times its sum.
WINDOW = 5.0
#: Standard deviations by which the part that repeats must exceed chance.
REPEATS = 3.0


class PowerErrors(IndependentErrors):
    """Independent errors, their likelihood to the power of the effective part of the samples."""

    word = "power"

    def __init__(self, frame: Frame) -> None:
        super().__init__(frame)
        if frame.effective is None:
            raise InputError(
                "the effective number of samples is not known",
                key="error_model",
                value=self.word,
                hint="write problem.effective = effective_samples(residuals, problem.samples)",
            )
        #: Exponent by run and output, (N, s).
        self.exponent: Array = np.asarray(frame.effective) / frame.counts

    def of_sums(self, sums: Array, eta: Array) -> Array:
        counts = self.exponent * self.frame.counts
        return log_likelihood_by_run(sums * self.exponent, counts, eta)

    def blocks_of_run(self, run: int, residual: Array, eta: Array, starts: Integers) -> Array:
        blocks = super().blocks_of_run(run, residual, eta, starts)
        return np.asarray(blocks * self.exponent[run][:, None])

    def products(self, run: int, columns: Sequence[Array], eta: Array) -> Array:
        rows = zip(columns, eta, self.exponent[run], strict=True)
        return np.asarray(sum(power * (c @ c.T) * np.exp(-log_v) for c, log_v, power in rows))

    def start(self, residuals: Sequence[Array]) -> Array:
        squares = np.array([np.sum(e * e, axis=1) for e in residuals])
        counts = self.exponent * self.frame.counts
        sums = np.maximum((squares * self.exponent).sum(axis=0), 1e-300)
        return np.asarray(np.log(sums / counts.sum(axis=0)))

    def scales(self) -> Array:
        counts = (self.exponent * self.frame.counts).sum(axis=0)
        return np.sqrt(2.0 / np.maximum(counts, 2.0))


def effective_samples(residuals: Sequence[Array], samples: Sequence[RunSamples]) -> Array:
    """Effective number of independent samples by run and output.

    Parameters
    ----------
    residuals : sequence over runs of ndarray, shape (s, n)
        At the estimate.
    samples : sequence of RunSamples
        When they were taken.

    Returns
    -------
    ndarray, shape (N, s)
        Between one and ``n``.
    """
    found = np.empty((len(residuals), len(residuals[0])))
    for b in range(found.shape[1]):
        rows = [np.asarray(e[b], dtype=float) for e in residuals]
        own = autocorrelation_time(rows)
        curves = [_repeating(e, when) for e, when in zip(rows, samples, strict=True)]
        share = _repeating_share(rows, curves, own)
        known = [curve for curve, _ in curves if curve is not None]
        again = autocorrelation_time(known) if share > 0 else 1.0
        for r, (e, (curve, periods)) in enumerate(zip(rows, curves, strict=True)):
            more = 0.0 if curve is None else share * (periods - 1.0) * again
            found[r, b] = max(e.size / (own + more), 1.0)
    return found


def autocorrelation_time(rows: Sequence[Array]) -> float:
    """Integrated autocorrelation time of several records about zero together, at least one.

    Parameters
    ----------
    rows : sequence of ndarray
        Records of the same process; the residual of an estimate has mean zero, but for a constant
        that the model lacks, which counts.
    """
    longest = max(e.size for e in rows) // 4
    products = np.zeros(longest + 1)
    overlap = np.zeros(longest + 1)
    for e in rows:
        lags = min(longest, e.size - 1)
        own = signal.correlate(e, e, method="auto")[e.size - 1 :][: lags + 1]
        products[: lags + 1] += own
        overlap[: lags + 1] += e.size - np.arange(lags + 1)
    if products[0] <= 0 or longest < 1:
        return 1.0
    rho = products / np.maximum(overlap, 1.0) / (products[0] / overlap[0])
    total = 1.0 + 2.0 * np.cumsum(rho[1:])
    inside = np.arange(1, rho.size) >= WINDOW * np.maximum(total, 1.0)
    end = int(np.argmax(inside)) if inside.any() else total.size - 1
    return float(max(total[end], 1.0))


def _repeating(residual: Array, when: RunSamples) -> tuple[Array | None, float]:
    """Average over the periods at each phase, and their number; None where nothing can repeat."""
    if when.frequency is None:
        return None, 1.0
    phase = when.frequency * (when.time - when.time[0])
    step = float((phase[-1] - phase[0]) / (phase.size - 1))
    periods = phase.size * step
    if periods < 1.5:
        return None, periods
    bins = max(int(1.0 / step), 1)
    place = np.minimum((phase % 1.0 * bins).astype(int), bins - 1)
    number = np.bincount(place, minlength=bins)
    sums = np.bincount(place, residual, minlength=bins)
    return sums[number > 0] / number[number > 0], periods


def _repeating_share(
    rows: Sequence[Array], curves: Sequence[tuple[Array | None, float]], time: float
) -> float:
    """Part of the variance that repeats in every period; zero where chance does as much."""
    ratio, free, periods = 0.0, 0, 0.0
    for e, (curve, number) in zip(rows, curves, strict=True):
        if curve is not None:
            mean_square = max(float(np.mean(e**2)), 1e-300)
            ratio += curve.size * float(np.mean(curve**2)) * number / mean_square
            periods += curve.size * number
            free += curve.size
    if not free:
        return 0.0
    excess, mean = ratio / free - 1.0, periods / free
    if excess <= REPEATS * np.sqrt(2.0 * time / free):
        return 0.0
    return float(np.clip(excess / (mean - 1.0), 0.0, 1.0))
