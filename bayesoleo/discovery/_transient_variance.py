"""Variance of an estimate from transients whose noise is coloured.

An estimate moves by ``a @ e`` with the noise ``e`` of a run. How fast the noise varies is the same
wherever the effect acts, so that the whole record tells it: the spectrum of the residual, averaged
over neighbouring lines, with the cross spectra of the outputs. An effect that acts in one short
stretch of the record, as a stop that is reached once, has its variance as well known as one that
acts throughout. (The scatter between stretches would leave it a single degree of freedom.)

The residual ``r = (I - H) e`` is smaller than the noise, because the estimate absorbs a part of it,
of slow noise the most. Each line is therefore divided by the part that remains of white noise.
Noise, or the error of the model, may be larger where the effect acts than elsewhere. Squares of the
residual, weighted as the estimate weights the samples, are compared with what the spectrum lets
expect of them; where they are larger, the variance is larger in proportion.

References
----------
Newey and West (1987), Econometrica 55(3), 703-708; Priestley (1981), Spectral Analysis and Time
Series, section 6.2: averages over lines and their degrees of freedom; Satterthwaite (1946),
Biometrics Bulletin 2(6), 110-114.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from bayesoleo._types import Array

#: Lines on either side that are averaged, and the part of the frequency where that is wider. Slow
#: noise is steepest near zero: with more lines there an AR(1) of 0.97 is judged too small.
LINES, PART = 3, 0.1
#: Part of a line, or of a sample, that an estimate leaves at least.
LEAST = 1e-3


@dataclass(frozen=True)
class Influence:
    """What the samples of one run do to an estimate, in units of the noise of each output.

    Parameters
    ----------
    weights : ndarray, shape (ny, N)
        ``a``: movement of the estimate by an error of a sample; zero for samples without weight.
    residual : ndarray, shape (ny, N)
        Zero for samples without weight.
    columns : ndarray, shape (l, ny, N)
        Sensitivities with respect to all that was estimated.
    """

    weights: Array
    residual: Array
    columns: Array


def coloured_variance(runs: Sequence[Influence], covariance: Array) -> tuple[float, float]:
    """Variance of an estimate and its degrees of freedom.

    Parameters
    ----------
    runs : sequence of Influence
        Their noise is independent.
    covariance : ndarray, shape (l, l)
        Of all that was estimated, in white noise of unit variance.

    Returns
    -------
    variance, freedom : float
        The degrees of freedom are those of the chi-square variate with the same mean and variance.
    """
    parts = [_of_run(run, covariance) for run in runs if np.any(run.weights)]
    variance = sum(value for value, _ in parts)
    scatter = sum(value**2 / free for value, free in parts)
    return variance, variance**2 / scatter if scatter > 0 else 0.0


def _of_run(run: Influence, covariance: Array) -> tuple[float, float]:
    samples = run.weights.shape[1]
    along, left, columns = (scipy.fft.rfft(x) for x in (run.weights, run.residual, run.columns))
    taken = np.einsum("lbk,lm,mbk->bk", columns.conj(), covariance, columns).real / samples
    kept = np.mean(run.columns.any(axis=0) | (run.residual != 0.0), axis=1)
    # An output without weight or noise tells nothing of what is left of the others.
    remains = np.clip(kept[:, None] - taken, LEAST, 1.0)[kept > 0.0].mean(axis=0)
    lines = _Lines(samples)
    counted = lines.sums(lines.weights * remains)
    cross = left[:, None] * left[None].conj() * lines.weights
    level = lines.sums(cross) / (counted * samples)
    parts = np.einsum("ak,abk,bk->k", along.conj(), level, along).real * lines.weights / samples
    variance = float(parts.sum())
    measured = lines.spread(parts / counted) * lines.weights * remains
    scatter = float(np.sum(2.0 * measured**2 / lines.weights))
    if not (variance > 0 and scatter > 0):
        return 0.0, 1.0
    free = 2.0 * float(measured.sum()) ** 2 / scatter
    own = np.einsum("bbk->bk", level).real
    excess, known = _where_it_acts(run, covariance, own, lines)
    if excess > 1.0:
        variance, free = variance * excess, 1.0 / (1.0 / free + 1.0 / known)
    return variance, free


def _where_it_acts(
    run: Influence, covariance: Array, level: Array, lines: _Lines
) -> tuple[float, float]:
    """Weighted square of the residual over what the spectrum lets expect, and its degrees of
    freedom.

    With the noise's covariance ``G`` the residual has ``(I - H) G (I - H)'``, whose diagonal is
    summed with the squared influence of each sample.
    """
    samples = run.weights.shape[1]
    weight = run.weights**2
    variance = np.sum(level * lines.weights, axis=1) / samples
    coloured = scipy.fft.irfft(scipy.fft.rfft(run.columns) * level, n=samples)
    solved = np.einsum("lm,mbn->lbn", covariance, run.columns)
    inner = np.einsum("lbn,mbn->lm", run.columns, coloured)
    expected = (
        variance[:, None]
        - 2.0 * np.einsum("lbn,lbn->bn", solved, coloured)
        + np.einsum("lbn,lm,mbn->bn", solved, inner, solved)
    )
    expected = np.maximum(expected, LEAST * variance[:, None])
    found = float(np.sum(weight * run.residual**2)) / float(np.sum(weight * expected))
    # Squares of normal variables with the correlation rho are correlated by its square.
    squares = scipy.fft.rfft(scipy.fft.irfft(level, n=samples) ** 2)
    power = np.abs(scipy.fft.rfft(weight)) ** 2
    scatter = 2.0 * float(np.sum(scipy.fft.irfft(power * squares, n=samples)[:, 0]))
    whole = float(np.sum(weight * variance[:, None]))
    return found, max(1.0, 2.0 * whole**2 / scatter)


class _Lines:
    """Lines of a spectrum and the neighbours over which each is averaged.

    Parameters
    ----------
    samples : int
        Number of samples.
    """

    def __init__(self, samples: int) -> None:
        count = samples // 2 + 1
        line = np.arange(count)
        half = np.maximum(LINES, PART * line).astype(np.int64)
        self.low: NDArray[np.int64] = np.maximum(line - half, 0)
        self.high: NDArray[np.int64] = np.minimum(line + half + 1, count)
        #: Real coefficients of each line: two, and one at the ends.
        self.weights = np.full(count, 2.0)
        self.weights[0] = 1.0
        if samples % 2 == 0:
            self.weights[-1] = 1.0

    def sums(self, values: Array) -> Array:
        """Sums over the neighbours of each line, along the last axis."""
        start = np.zeros((*values.shape[:-1], 1), dtype=values.dtype)
        total = np.concatenate([start, np.cumsum(values, axis=-1)], axis=-1)
        found: Array = total[..., self.high] - total[..., self.low]
        return found

    def spread(self, values: Array) -> Array:
        """What each line receives if every line gives its value to its neighbours, shape (K,)."""
        change = np.zeros(values.size + 1)
        np.add.at(change, self.low, values)
        np.add.at(change, self.high, -values)
        return np.cumsum(change)[:-1]
