r"""Correlated errors: white noise and an Ornstein-Uhlenbeck process, in time O(n).

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

References
----------
Kelly, Becker, Sobolewska, Siemiginowska and Uttley (2014), "Flexible and scalable methods for
quantifying stochastic variability", *Astrophysical Journal* 788, eqs. 9-16 (the filter). Rasmussen
and Williams (2006), *Gaussian Processes for Machine Learning*, eq. B.26 (the process).
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
from bayesoleo.error_models._base import Frame, Quantity, RunSamples
from bayesoleo.error_models._independent import ByOutput
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
    white, log_sd = np.empty_like(rows), np.empty(time.size)
    eta = np.array([0.0, float(ndtri(share)), float(np.log(length))])
    if not len(rows):
        rows, white = np.zeros((1, time.size)), np.empty((1, time.size))
    _whiten(np.ascontiguousarray(rows), *_kinds(np.diff(time)), eta, white, log_sd)
    return white, float(np.sum(log_sd))


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
