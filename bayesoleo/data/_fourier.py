"""Sums over harmonics at an exact frequency, and autocovariance by FFT.

The period of a record is not a whole number of samples, so that a plain FFT has no bin at the
harmonics. The chirp transform evaluates ``sum_n x_n exp(-2 pi i k step n)`` for any real step in a
few FFTs. Least squares on all harmonics then needs only products with a nearly diagonal symmetric
Toeplitz matrix, and a few conjugate-gradient iterations solve it.

The autocovariance follows from the FFT by the theorem of Wiener and Khinchin.
"""

from __future__ import annotations

from functools import lru_cache
from typing import cast

import numpy as np
from scipy import fft

from bayesoleo._types import Array, ComplexArray

# Part of the largest curvature below which a direction's own is rounding.
_UNSEEN = 1e-9
#: Bases that are kept, and samples up to which: 50 MB at most.
KEPT, KEPT_SAMPLES = 32, 16_384


class ChirpTransform:
    """Sums ``X_k = sum_n x_n exp(-2 pi i k step n)`` (Rabiner, Schafer and Rader 1969).

    Parameters
    ----------
    inputs, outputs : int
        Lengths of ``x`` and ``X``.
    step : float
        Cycles per sample and order: frequency times sampling interval. May be negative.
    """

    def __init__(self, inputs: int, outputs: int, step: float) -> None:
        self.inputs, self.outputs = inputs, outputs
        index = np.arange(max(inputs, outputs), dtype=float)
        # Whole cycles are removed before the exponential, which keeps the phase error near eps *
        # index**2 * step.
        chirp = np.exp(-2j * np.pi * ((0.5 * step * index**2) % 1.0))
        self._before, self._after = chirp[:inputs], chirp[:outputs]
        self._length = fft.next_fast_len(inputs + outputs - 1)
        kernel = np.zeros(self._length, dtype=complex)
        kernel[:outputs] = chirp[:outputs].conj()
        kernel[self._length - inputs + 1 :] = chirp[inputs - 1 : 0 : -1].conj()
        self._kernel = fft.fft(kernel)

    def __call__(self, values: Array | ComplexArray) -> ComplexArray:
        """Transform along the last axis: ``(..., inputs)`` to ``(..., outputs)``."""
        spectrum = fft.fft(values * self._before, self._length, axis=-1)
        return cast(
            ComplexArray,
            fft.ifft(spectrum * self._kernel, axis=-1)[..., : self.outputs] * self._after,
        )


class HarmonicBasis:
    """Least squares on all harmonics 0..``highest`` of one frequency at equidistant samples.

    Coefficients are those of ``x_n = Re sum_k c_k exp(2 pi i k step n)``.

    Parameters
    ----------
    samples : int
        Number N of samples.
    step : float
        Cycles per sample.
    highest : int, optional
        Highest order K; by default the largest that the samples of one period determine,
        ``(floor(1/step) - 1) // 2``.
    """

    def __init__(self, samples: int, step: float, highest: int | None = None) -> None:
        self.samples, self.step = samples, step
        self.highest = highest_order(step) if highest is None else highest
        self.orders = np.arange(self.highest + 1)
        self._analyse = ChirpTransform(samples, self.highest + 1, step)
        self._synthesise = ChirpTransform(self.highest + 1, samples, -step)
        # Time counted from the middle of the record makes the normal matrix real.
        self._to_middle = np.exp(2j * np.pi * ((self.orders * step * 0.5 * (samples - 1)) % 1.0))
        self._gram = _toeplitz_spectrum(samples, step, self.highest)

    @property
    def size(self) -> int:
        """Number M = 2K + 1 of real coefficients."""
        return 2 * self.highest + 1

    def coefficients(self, values: Array) -> ComplexArray:
        """Least-squares coefficients of real signals, ``(..., N)`` to ``(..., K + 1)``."""
        moments = self._analyse(values) * self._to_middle
        two_sided = np.concatenate([moments[..., :0:-1].conj(), moments], axis=-1)
        solved = self._solve(two_sided)[..., self.highest :] * self._to_middle.conj()
        solved[..., 1:] *= 2.0
        solved[..., 0] = solved[..., 0].real
        return solved

    def evaluate(self, coefficients: ComplexArray) -> Array:
        """Signals at the samples, ``(..., K + 1)`` to ``(..., N)``."""
        return self._synthesise(coefficients).real

    def fit(self, values: Array) -> Array:
        """Projection of real signals on the harmonics, ``(..., N)``."""
        return self.evaluate(self.coefficients(values))

    def _multiply(self, vector: ComplexArray) -> ComplexArray:
        length = self._gram.size
        product = fft.ifft(fft.fft(vector, length, axis=-1) * self._gram, axis=-1)
        return cast(ComplexArray, product[..., : vector.shape[-1]])

    def _solve(self, moments: ComplexArray) -> ComplexArray:
        """Conjugate gradients on the normal equations, several right-hand sides at once."""
        solution = moments / self.samples
        residual = moments - self._multiply(solution)
        direction, power = residual, _power(residual)
        # Rounding of the transforms stops the descent near 1e-14; more iterations would only
        # shuffle noise.
        target = 1e-26 * np.maximum(_power(moments), np.finfo(float).tiny)
        for _ in range(200):
            if np.all(power <= target):
                break
            image = self._multiply(direction)
            curvature = np.sum((direction.conj() * image).real, -1, keepdims=True)
            # A direction that the samples do not see, for lack of them, is left alone: dividing by
            # its curvature, which is rounding, would run away.
            seen = curvature > _UNSEEN * self.samples * _power(direction)
            going = seen & (power > target)
            length = np.where(going, power / np.where(going, curvature, 1.0), 0.0)
            solution = solution + length * direction
            residual = residual - length * image
            previous, power = power, _power(residual)
            direction = residual + power / np.maximum(previous, 1e-300) * direction
        return solution


def basis_of(samples: int, step: float) -> HarmonicBasis:
    """The basis of all harmonics; those asked for last are kept, unless records are long.

    To make one takes half as long as to average a signal, and every residual of a run has the same.
    """
    return _kept_basis(samples, step) if samples <= KEPT_SAMPLES else HarmonicBasis(samples, step)


@lru_cache(maxsize=KEPT)
def _kept_basis(samples: int, step: float) -> HarmonicBasis:
    return HarmonicBasis(samples, step)


def highest_order(step: float) -> int:
    """Highest order K that the samples of one period determine: ``(floor(1/step) - 1) // 2``.

    Parameters
    ----------
    step : float
        Cycles per sample.
    """
    # The margin keeps a period of 1025 samples, known to a millionth, from being counted as 1024.
    return (int(np.floor(1.0 / step * (1 + 1e-9))) - 1) // 2


def _power(vector: ComplexArray) -> Array:
    return np.sum(vector.real**2 + vector.imag**2, axis=-1, keepdims=True)


def _toeplitz_spectrum(samples: int, step: float, highest: int) -> Array:
    """Spectrum of the circulant that holds ``sin(pi N step m) / sin(pi step m)``, m = j - k."""
    turns = step * np.arange(1, 2 * highest + 1)
    whole = np.round(turns)
    part = turns - whole
    # Two orders a whole number of cycles per sample apart cannot be told apart: the quotient of the
    # sines is 0/0 there, that of their sincs is not.
    sign = np.where((samples - 1) * whole % 2 == 0, 1.0, -1.0)
    column = sign * samples * np.sinc(samples * part) / np.sinc(part)
    length = fft.next_fast_len(4 * highest + 1)
    circulant = np.zeros(length)
    circulant[0] = samples
    circulant[1 : 2 * highest + 1] = column
    circulant[length - 2 * highest :] = column[::-1]
    return cast(Array, fft.fft(circulant).real)


def lagged_products(rows: Array, length: int | None = None) -> Array:
    """Sums of the products of samples that are so many samples apart, averaged over rows.

    Parameters
    ----------
    rows : ndarray, shape (k, n) or (k, n, d)
        Deviations from whatever mean is meant, of ``k`` records.
    length : int, optional
        Of the transform, at least ``2 n - 1``; by default one that is fast.

    Returns
    -------
    ndarray, shape (n,) or (n, d)
        At lags 0 to ``n - 1``; the sum at lag ``t`` has ``n - t`` terms.
    """
    length = length or fft.next_fast_len(2 * rows.shape[1])
    power = np.mean(np.abs(fft.rfft(rows, length, axis=1)) ** 2, axis=0)
    return np.asarray(fft.irfft(power, length, axis=0)[: rows.shape[1]])


def integrated_time(correlation: Array, power: int = 1) -> float:
    """Integrated autocorrelation time in samples, at least one.

    Parameters
    ----------
    correlation : ndarray, shape (lags + 1,)
        Autocorrelation, one at lag zero.
    power : {1, 2}, optional
        To which it is raised in the sum: for the information on a mean, or on a variance.

    References
    ----------
    Sokal (1997), *Functional Integration*, 131-192, eq. 3.11: a window of five times the sum.
    """
    total = 1.0 + 2.0 * np.cumsum(correlation[1:])
    window = np.arange(1, correlation.size) >= 5.0 * np.maximum(total, 1.0)
    end = int(np.argmax(window)) if window.any() else total.size - 1
    return float(max(1.0 + 2.0 * np.sum(correlation[1 : end + 2] ** power), 1.0))
