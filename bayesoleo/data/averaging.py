"""Averages over periods, and the noise that does not repeat.

The average is least squares on all harmonics of the frequency that the samples of one period
determine. Folding by linear interpolation instead smooths the noise and understates it by a fifth
where samples per period are not whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array, Complex, ComplexArray, Float
from bayesoleo.data.transforms import HarmonicBasis
from bayesoleo.errors import InputError


@dataclass(frozen=True)
class PeriodicAverage:
    """The repeating part of a signal, and what is left.

    Parameters
    ----------
    values : ndarray, shape (N,)
        The average over periods at each sample, in the signal's unit.
    coefficients : ndarray of complex, shape (K + 1,)
        Of ``Re sum_k c_k exp(2 pi i k f (t - t_0))``, all orders 0..K.
    samples, number : int
        Number N of samples and M = 2K + 1 of real coefficients.
    repeating : float
        Root mean square of ``values``.
    sigma : float
        Standard deviation of a single sample about the average, ``sqrt(RSS / (N - M))``.
    noise : float
        Standard error of the average, root mean square over the period: ``sigma * sqrt(M / N)``.
    """

    values: Float[Array, " samples"]
    coefficients: Complex[ComplexArray, " harmonics"]
    samples: int
    number: int
    repeating: float
    sigma: float
    noise: float

    @property
    def ratio(self) -> float:
        """``repeating / noise``: about one where nothing repeats but noise."""
        return self.repeating / self.noise

    def on_phase(self, points: int) -> Array:
        """The average at phases ``0, 1/points, ...`` of one period, counted from the first sample.

        Parameters
        ----------
        points : int
            Number of phases.

        Returns
        -------
        ndarray, shape (points,)
            In the signal's unit.
        """
        orders = np.arange(self.coefficients.size)
        folded = np.zeros(points, dtype=complex)
        # Orders that differ by ``points`` agree on the grid, so they add up in one bin.
        np.add.at(folded, orders % points, self.coefficients)
        return (np.fft.ifft(folded) * points).real


def periodic_average(values: Array, time_step: float, frequency: float) -> PeriodicAverage:
    """Average a signal over its periods by least squares on all harmonics 0..K.

    ``K = (floor(samples per period) - 1) // 2``; samples per period need not be whole.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times over two periods or more.
    time_step : float
        Sampling interval, s.
    frequency : float
        Fundamental frequency, Hz.

    Returns
    -------
    PeriodicAverage
        The average, its standard error and the noise of a single sample.

    Raises
    ------
    InputError
        If the signal is shorter than it takes to tell repeating from not repeating.
    """
    signal = np.asarray(values, dtype=float)
    check_length(signal.size, time_step * frequency)
    return average_on(HarmonicBasis(signal.size, time_step * frequency), signal)


def average_on(basis: HarmonicBasis, values: Array) -> PeriodicAverage:
    """Like :func:`periodic_average`, with a basis made before; it serves all channels of a run.

    Parameters
    ----------
    basis : HarmonicBasis
        All harmonics at the samples.
    values : ndarray, shape (N,)
        Signal.
    """
    coefficients = basis.coefficients(values)
    fitted = basis.evaluate(coefficients)
    free = basis.samples - basis.size
    sigma = float(np.sqrt(np.sum((values - fitted) ** 2) / free))
    return PeriodicAverage(
        values=fitted,
        coefficients=coefficients,
        samples=basis.samples,
        number=basis.size,
        repeating=float(np.sqrt(np.mean(fitted**2))),
        sigma=sigma,
        noise=sigma * float(np.sqrt(basis.size / basis.samples)),
    )


def check_length(samples: int, step: float) -> None:
    """Raise unless the samples hold two periods of four samples or more.

    Parameters
    ----------
    samples : int
        Number of samples.
    step : float
        Cycles per sample.

    Raises
    ------
    InputError
        With the number of periods found.
    """
    if not 0 < step <= 0.25:
        raise InputError(
            "a period needs four samples or more", value=step, hint="give the frequency in Hz"
        )
    # One sample short of two periods is what a record from 0 to 2 T without its end point holds.
    if (samples + 1) * step < 2:
        raise InputError(
            "fewer than two periods", value=round(samples * step, 3), hint="record two or more"
        )
