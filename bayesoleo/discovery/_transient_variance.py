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

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

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
class RunNoise:
    """Noise of one run's samples as its residual tells it, in units of the noise of each output.

    What does not depend on the unknown whose variance is asked for is computed once.

    Parameters
    ----------
    residual : ndarray, shape (ny, N)
        Zero for samples without weight.
    columns : ndarray, shape (l, ny, N)
        Sensitivities with respect to all that was estimated.
    covariance : ndarray, shape (l, l)
        Of all that was estimated, in white noise of unit variance.
    """

    residual: Array
    columns: Array
    covariance: Array

    @property
    def samples(self) -> int:
        """Number of samples."""
        return int(self.residual.shape[1])

    @cached_property
    def lines(self) -> _Lines:
        """Lines of the spectrum and their neighbours."""
        return _Lines(self.samples)

    @cached_property
    def transformed(self) -> Array:
        """Fourier transform of the columns, shape (l, ny, K)."""
        return cast(Array, scipy.fft.rfft(self.columns))

    @cached_property
    def remains(self) -> Array:
        """Part of each line of white noise that an estimate leaves, shape (K,)."""
        columns = self.transformed
        parts = (_quadratic(self.covariance, part) for part in (columns.real, columns.imag))
        taken = sum(parts, np.zeros(columns.shape[1:])) / self.samples
        kept = np.mean(self.columns.any(axis=0) | (self.residual != 0.0), axis=1)
        # An output without weight or noise tells nothing of what is left of the others.
        left: Array = np.clip(kept[:, None] - taken, LEAST, 1.0)[kept > 0.0].mean(axis=0)
        return left

    @cached_property
    def counted(self) -> Array:
        """Coefficients that each average stands on, shape (K,)."""
        return self.lines.sums(self.lines.weights * self.remains)

    @cached_property
    def level(self) -> Array:
        """Spectra and cross spectra of the outputs, shape (ny, ny, K)."""
        left = scipy.fft.rfft(self.residual)
        cross = left[:, None] * left[None].conj() * self.lines.weights
        return self.lines.sums(cross) / (self.counted * self.samples)

    @cached_property
    def own_level(self) -> Array:
        """Spectrum of each output, shape (ny, K)."""
        return cast(Array, np.einsum("bbk->bk", self.level).real)

    @cached_property
    def variance(self) -> Array:
        """Variance of the noise of a sample, shape (ny, 1)."""
        total: Array = np.sum(self.own_level * self.lines.weights, axis=1, keepdims=True)
        return total / self.samples

    @cached_property
    def expected(self) -> Array:
        """Squares of the residual that the spectrum lets expect, shape (ny, N).

        With the noise's covariance ``G`` the residual has the diagonal of ``(I - H) G (I - H)'``.
        """
        coloured = scipy.fft.irfft(self.transformed * self.own_level, n=self.samples)
        solved = _times(self.covariance, self.columns)
        inner = _rows(self.columns) @ _rows(coloured).T
        found = (
            self.variance
            - 2.0 * np.einsum("lbn,lbn->bn", solved, coloured)
            + _quadratic(inner, solved)
        )
        return cast(Array, np.maximum(found, LEAST * self.variance))

    @cached_property
    def correlation(self) -> Array:
        """Spectrum of the squared autocovariance of each output, shape (ny, K).

        Squares of normal variables with the correlation rho are correlated by its square.
        """
        return cast(Array, scipy.fft.rfft(scipy.fft.irfft(self.own_level, n=self.samples) ** 2))


def _rows(columns: Array) -> Array:
    """Columns ``(l, ...)`` as rows of one matrix."""
    return columns.reshape(columns.shape[0], math.prod(columns.shape[1:]))


def _times(matrix: Array, columns: Array) -> Array:
    """A matrix ``(l, l)`` times columns ``(l, ...)``."""
    return (matrix @ _rows(columns)).reshape(columns.shape)


def _quadratic(matrix: Array, columns: Array) -> Array:
    """``c' M c`` of each entry of columns ``(l, ny, n)``, shape (ny, n)."""
    return cast(Array, np.einsum("lbn,lbn->bn", columns, _times(matrix, columns)))


def coloured_variance(weights: Sequence[Array], runs: Sequence[RunNoise]) -> tuple[float, float]:
    """Variance of an estimate and its degrees of freedom.

    Parameters
    ----------
    weights : sequence of ndarray, shape (ny, N)
        ``a`` by run: movement of the estimate by an error of a sample; zero for samples without
        weight.
    runs : sequence of RunNoise
        Their noise is independent.

    Returns
    -------
    variance, freedom : float
        The degrees of freedom are those of the chi-square variate with the same mean and variance.
    """
    parts = [_of_run(own, run) for own, run in zip(weights, runs, strict=True) if np.any(own)]
    variance = sum(value for value, _ in parts)
    scatter = sum(value**2 / free for value, free in parts)
    return variance, variance**2 / scatter if scatter > 0 else 0.0


def noise_along(direction: Array, left: Array) -> float:
    """Variance of ``direction @ noise`` in a transient with the spectrum of what is left.

    Parameters
    ----------
    direction, left : ndarray, shape (ny, N)
        In units of the noise of each output.
    """
    nothing = np.zeros((0, *left.shape))
    return coloured_variance([direction], [RunNoise(left, nothing, np.zeros((0, 0)))])[0]


def scatter_of(run: RunNoise) -> Array:
    """Covariance of ``J' e`` in one run's noise ``e``, shape (l, l)."""
    columns, size = run.transformed, len(run.transformed)
    coloured = np.einsum("abk,lbk->lak", run.level * run.lines.weights / run.samples, columns)
    found: Array = (columns.reshape(size, -1).conj() @ coloured.reshape(size, -1).T).real
    return found


def _of_run(weights: Array, run: RunNoise) -> tuple[float, float]:
    along, lines = scipy.fft.rfft(weights), run.lines
    power = np.einsum("ak,abk,bk->k", along.conj(), run.level, along).real
    parts = power * lines.weights / run.samples
    variance = float(parts.sum())
    measured = lines.spread(parts / run.counted) * lines.weights * run.remains
    scatter = float(np.sum(2.0 * measured**2 / lines.weights))
    if not (variance > 0 and scatter > 0):
        return 0.0, 1.0
    free = 2.0 * float(measured.sum()) ** 2 / scatter
    excess, known = _where_it_acts(weights, run)
    if excess > 1.0:
        variance, free = variance * excess, 1.0 / (1.0 / free + 1.0 / known)
    return variance, free


def _where_it_acts(weights: Array, run: RunNoise) -> tuple[float, float]:
    """Square of the residual, weighted with the squared influence of each sample, over what the
    spectrum lets expect, and its degrees of freedom."""
    weight = weights**2
    found = float(np.sum(weight * run.residual**2)) / float(np.sum(weight * run.expected))
    power = np.abs(scipy.fft.rfft(weight)) ** 2
    squares = scipy.fft.irfft(power * run.correlation, n=run.samples)
    scatter = 2.0 * float(np.sum(squares[:, 0]))
    whole = float(np.sum(weight * run.variance))
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
