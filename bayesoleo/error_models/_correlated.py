r"""Correlated errors: a process in time, or a likelihood that counts the effective samples.

**White noise and an Ornstein-Uhlenbeck process**, in time O(n):

.. math::

    e(t) = \epsilon(t) + x(t), \qquad \operatorname{cov}(e_i, e_j) =
    v \left[ (1 - \rho)\, \delta_{ij} + \rho \exp(-|t_i - t_j| / \tau) \right].

``v`` is the total variance, :math:`\rho` the correlated share and :math:`\tau` the correlation
time. Without white noise (:math:`\rho = 1`) equally spaced samples are AR(1). That alone would not
suffice: sensor noise is white and model error is not, and a single process fitted to their sum
would underestimate the correlation time.

Between two samples the process decays by :math:`\exp(-\Delta t / \tau)` for any :math:`\Delta t`,
so gaps and unequal sampling need no special treatment. A Kalman filter with one state whitens a
record in one pass.

**Independent errors whose likelihood counts as many samples as are effectively independent.** The
likelihood of every run and output is raised to the power :math:`n' / n`,

.. math:: p(\theta, v | y) \propto p(\theta, v) \prod p(y_{rb} | \theta, v_b)^{n_{rb}' / n_{rb}},

so that a residual which is alike from sample to sample, or from period to period, promises no more
than it tells. The effective number follows from the residual at the estimate:

.. math:: n / n' = \tau + s (P - 1) \tau_r ,

with the integrated autocorrelation time :math:`\tau` of the residual, the part :math:`s` of its
variance that repeats in each of :math:`P` periods, and the autocorrelation time :math:`\tau_r` of
that part. The exponents are then kept.

References
----------
Kelly, Becker, Sobolewska, Siemiginowska and Uttley (2014), "Flexible and scalable methods for
quantifying stochastic variability", *Astrophysical Journal* 788, eqs. 9-16 (the filter). Rasmussen
and Williams (2006), *Gaussian Processes for Machine Learning*, eq. B.26 (the process).
Kish (1965), *Survey Sampling*, section 5.4: the design effect of repetitions.
Grünwald and van Ommen (2017), Bayesian Analysis 12, 1069-1103; Miller and Dunson (2019), JASA 114,
1113-1125: posteriors by powers of the likelihood where models are wrong.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import numpy as np
from scipy.special import ndtr, ndtri

from bayesoleo import _schema as schema
from bayesoleo._compiled import jit
from bayesoleo._types import Array, Integers
from bayesoleo.data._fourier import integrated_time, lagged_products
from bayesoleo.error_models._base import Frame, Quantity, RunSamples
from bayesoleo.error_models._independent import ByOutput, IndependentErrors, log_likelihood_by_run
from bayesoleo.errors import InputError
from bayesoleo.model._priors import LogNormal

SQRT_2 = math.sqrt(2.0)
_LOG_2_PI = float(np.log(2 * np.pi))
# Number of sampling intervals that a correlation time is likely to exceed.
_LEAST_STEPS = 4
# Sampling intervals that differ by less than this part of their median count as equal.
_EQUAL = 1e-6


@jit
def _log_likelihood(residual: Array, kind: Integers, steps: Array, eta: Array, out: Array) -> None:
    """Log-likelihood of rows ``(L, n)``; ``kind (n - 1)`` indexes ``steps``, the intervals."""
    n = residual.shape[1]
    decay = np.empty(steps.size)
    for lane in range(residual.shape[0]):
        share = 0.5 * math.erfc(-eta[lane, 1] / SQRT_2)
        white = 0.5 * math.erfc(eta[lane, 1] / SQRT_2)
        rate = np.exp(-eta[lane, 2])
        for k in range(steps.size):
            decay[k] = np.exp(-steps[k] * rate)
        mean, power, squares, logs, product = 0.0, share, 0.0, 0.0, 1.0
        steady, last = False, -1
        size = gain = left = 0.0
        for i in range(n):
            if not steady:
                size = power + white
                gain = power / size
                left = gain * white
            innovation = residual[lane, i] - mean
            squares += innovation * innovation / size
            product *= size
            if product < 1e-200 or i % 16 == 15:
                logs += np.log(product)
                product = 1.0
            if i < n - 1:
                a = decay[kind[i]]
                mean = a * (mean + gain * innovation)
                ahead = share + a * a * (left - share)
                # Once the filter has settled, its gain stays until the sampling changes.
                steady = kind[i] == last and abs(ahead - power) <= 1e-15 * power
                last, power = kind[i], ahead
                if steady and kind[min(i + 1, n - 2)] != last:
                    steady = False
        logs += np.log(product)
        out[lane] = -0.5 * (n * (_LOG_2_PI + eta[lane, 0]) + logs + squares * np.exp(-eta[lane, 0]))


@jit
def _whiten(
    columns: Array, kind: Integers, steps: Array, eta: Array, out: Array, log_sd: Array
) -> None:
    """Rows ``(k, n)`` as innovations of unit variance, ``log_sd (n)`` what they are divided by."""
    share, white = 0.5 * math.erfc(-eta[1] / SQRT_2), 0.5 * math.erfc(eta[1] / SQRT_2)
    rate, sd = np.exp(-eta[2]), np.exp(0.5 * eta[0])
    for row in range(columns.shape[0]):
        mean, power = 0.0, share
        for i in range(columns.shape[1]):
            size = power + white
            gain = power / size
            innovation = columns[row, i] - mean
            out[row, i] = innovation / (sd * np.sqrt(size))
            log_sd[i] = 0.5 * (eta[0] + np.log(size))
            if i < columns.shape[1] - 1:
                a = np.exp(-steps[kind[i]] * rate)
                mean = a * (mean + gain * innovation)
                power = share + a * a * (gain * white - share)


class CorrelatedErrors(ByOutput):
    """White noise and an Ornstein-Uhlenbeck process for each output; independent between runs.

    The prior is flat in the logarithm of the total variance, uniform in the correlated share, and
    log-normal in the correlation time, with four sampling intervals and the longest record two
    standard deviations either side of the median.
    """

    word = "correlated"

    def __init__(self, frame: Frame) -> None:
        super().__init__(frame)
        self._usual = float(np.median(np.concatenate([np.diff(r.time) for r in frame.sampled()])))
        self._steps = [_kinds(np.diff(run.time)) for run in frame.sampled()]

    def _declare(self) -> tuple[Quantity, ...]:
        frame, samples = self.frame, self.frame.sampled()
        shortest = min(float(np.median(np.diff(run.time))) for run in samples)
        longest = max(float(run.time[-1] - run.time[0]) for run in samples)
        # A process shorter than a sampling interval would be white noise, of an undetermined share.
        shortest = min(_LEAST_STEPS * shortest, 0.5 * longest)
        reach = max(0.25 * float(np.log(longest / shortest)), 0.5)
        time = LogNormal(float(np.sqrt(shortest * longest)), reach)
        share_text = "share of the error variance of {} that is correlated in time"
        shares = frame.shares(schema.correlated_share, share_text)
        time_text = "correlation time of the error of {}"
        times = frame.lengths(schema.correlation_time, time, "s", time_text)
        return (*frame.log_variances(), *shares, *times)

    def log_new(self, share: Array, log_length: Array) -> Array:
        """Innovation variance of the settled filter, at the usual sampling interval."""
        part, white = ndtr(share), ndtr(-share)
        with np.errstate(over="ignore", under="ignore"):
            left = -np.expm1(-2 * self._usual * np.exp(-log_length))  # 1 - a^2
        # Predicted variance P: P^2 + P (1 - a^2) (white - part) = part (1 - a^2) white.
        half, product = 0.5 * left * (white - part), part * left * white
        root = np.sqrt(half * half + product)
        power = np.where(half > 0, product / (root + np.abs(half)), root - half)
        return np.asarray(np.log(power + white))

    def of_output(self, run: int, residual: Array, eta: Array) -> Array:
        out = np.empty(len(residual))
        _log_likelihood(residual, *self._steps[run], eta, out)
        return out

    def blocks_of_output(self, run: int, residual: Array, eta: Array, starts: Integers) -> Array:
        white, log_sd = np.empty_like(residual), np.empty_like(residual)
        for lane in range(len(residual)):
            rows = slice(lane, lane + 1)
            _whiten(residual[rows], *self._steps[run], eta[lane], white[rows], log_sd[lane])
        logs = -0.5 * (white * white + _LOG_2_PI) - log_sd
        return np.asarray(np.add.reduceat(logs, starts, axis=1))

    def products_of_output(self, run: int, columns: Array, eta: Array) -> Array:
        white = np.empty_like(columns)
        _whiten(columns, *self._steps[run], eta, white, np.empty(columns.shape[1]))
        return np.asarray(white @ white.T)

    def draw_coloured(self, length: Array, samples: RunSamples, rng: np.random.Generator) -> Array:
        return draw_process(length, samples, rng)


def draw_process(length: Array, samples: RunSamples, rng: np.random.Generator) -> Array:
    """Draw Ornstein-Uhlenbeck processes of unit variance, (W, n), with correlation times (W,)."""
    lag = np.diff(samples.time)[:, None] / length
    decay = np.exp(-lag)
    new = rng.standard_normal((samples.time.size, len(length)))
    new[1:] *= np.sqrt(-np.expm1(-2 * lag))
    for i, kept in enumerate(decay):
        new[i + 1] += kept * new[i]
    return new.T


def whitened(rows: Array, time: Array, share: float, length: float) -> tuple[Array, float]:
    """Rows ``(L, n)`` whitened by the model with unit variance, and half its ``ln det``.

    Parameters
    ----------
    rows : ndarray, shape (L, n)
    time : ndarray, shape (n,)
    share : float
        Correlated part of the variance, below one; at zero the rows come back as they are.
    length : float
        Correlation time.
    """
    if not share > 0:
        return rows, 0.0
    white, log_sd, count = np.empty_like(rows), np.empty(time.size), len(rows)
    eta = np.array([0.0, float(ndtri(share)), float(np.log(length))])
    if not count:  # the determinant is asked for all the same
        rows, white = np.zeros((1, time.size)), np.empty((1, time.size))
    _whiten(np.ascontiguousarray(rows), *_kinds(np.diff(time)), eta, white, log_sd)
    return white[:count], float(np.sum(log_sd))


def _kinds(steps: Array) -> tuple[np.ndarray, Array]:
    """Index of each sampling interval among the distinct ones, and their lengths."""
    unit = _EQUAL * float(np.median(steps))
    _, first, kind = np.unique(np.round(steps / unit), return_index=True, return_inverse=True)
    return kind.astype(np.int64), steps[first]


def covariance(time: Sequence[float] | Array, v: float, share: float, tau: float) -> Array:
    """Covariance matrix of the errors, shape (n, n)."""
    t = np.asarray(time, dtype=float)
    kernel = np.exp(-np.abs(t[:, None] - t) / tau)
    return cast(Array, v * ((1 - share) * np.eye(t.size) + share * kernel))


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
        own = lagged_products(e[None])[: lags + 1]
        products[: lags + 1] += own
        overlap[: lags + 1] += e.size - np.arange(lags + 1)
    if products[0] <= 0 or longest < 1:
        return 1.0
    rho = products / np.maximum(overlap, 1.0) / (products[0] / overlap[0])
    return integrated_time(rho)


def _repeating(residual: Array, when: RunSamples) -> tuple[Array | None, float]:
    """Average over the periods at each phase, and their number; None where nothing can repeat."""
    if when.frequency is None:
        return None, 1.0
    phase = when.frequency * (when.time - when.time[0])
    step = float((phase[-1] - phase[0]) / (phase.size - 1))
    periods = phase.size * step
    if periods < 1.5:
        return None, periods
    bins = max(int(1.0 / step + 1e-6), 1)
    # The nearest bin: equal steps of whole periods would stand on its edge, but for rounding.
    place = np.rint(phase % 1.0 * bins).astype(int) % bins
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
