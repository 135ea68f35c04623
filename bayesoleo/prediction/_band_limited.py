"""Inputs that do not repeat: smooth curves through noisy samples, with derivatives.

A signal is modelled as a process whose third derivative is white noise, sampled with white noise.
Its smoothed mean is a quintic smoothing spline (Wahba 1978), found by a Kalman filter and a
backward pass in O(N); its smoothness follows from the filter's innovations, by maximum likelihood.
Value, velocity and acceleration at the samples define the spline between them, and the same model
gives draws of the remaining uncertainty.

The band-limited curve holds all frequencies up to half the sampling rate, unless the spectrum has
fallen to a noise floor below that. It is then cut off at that frequency if a derivative of the
channel is taken, or if no other channel responds to the higher frequencies. Curves are kept on a
grid so fine that quintic pieces between its points are exact to 5e-6.

References
----------
Wahba, G. (1978). Improper priors, spline smoothing and the problem of guarding against model errors
in regression. J. Royal Statistical Society B 40(3), 364-372.

Durbin, J. and Koopman, S. J. (2002). A simple and efficient simulation smoother for state space
time series analysis. Biometrika 89(3), 603-616.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.optimize import minimize_scalar

from bayesoleo._types import Array, Float
from bayesoleo.errors import InputError
from bayesoleo.prediction._filtering import (
    Band,
    evaluate_pieces,
    filtered,
    innovations,
    pieces,
    process_noise,
    smooth,
    walk,
)
from bayesoleo.prediction._spectrum import Spectrum, segment_length, spectrum_of

#: Process noise over measurement noise, per sample: logarithms to base ten that are tried.
ROUGHNESS = np.linspace(-16.0, 6.0, 23)
#: Highest derivative that a curve of its own is kept for; of a higher one it is the same.
DERIVATIVES = 2
#: Part of a channel's power above the frequency that a mesh has to follow: a thousandth of its
#: size.
_UNRESOLVED = 1e-6
#: Points of the grid in a period of the highest frequency: quintic pieces between eight miss it by
#: 5e-6.
_FINE = 8.0
#: Noise over a signal's deviation at which few samples still show a smooth signal.
_MOST_NOISE = 0.3
#: Standard errors by which the coherence of two channels has to exceed chance, and its least size.
_SURE, _COHERENT = 5.0, 0.02


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A curve through equidistant samples, quintic between the points of a grid.

    Parameters
    ----------
    step : float
        Interval of the grid, s.
    states : ndarray, shape (N, 3)
        Value, first and second derivative at its points; SI.
    noise : float
        Standard deviation of a sample's white noise, SI; zero for a curve that is known.
    roughness : float
        Process noise over measurement noise, per sample, of a smoothing spline.
    band : Band, optional
        What the curve holds, of a band-limited one.
    per_sample : int
        Points of the grid in a sampling interval.
    derivatives : tuple of Smoothed
        Curves to take as many derivatives of: of those, noise is cut off lower down.
    """

    step: float
    states: Float[Array, "samples 3"]
    noise: float = 0.0
    roughness: float = 0.0
    band: Band | None = None
    per_sample: int = 1
    derivatives: tuple[Smoothed, ...] = ()

    def for_derivative(self, highest: int) -> Smoothed:
        """The curve for a model that takes derivatives up to an order."""
        if highest == 0 or not self.derivatives:
            return self
        return self.derivatives[min(highest, len(self.derivatives)) - 1]

    def evaluate(self, phase: Array, frequency: float, derivative: int = 0) -> Array:
        """Value or time derivative.

        Parameters
        ----------
        phase : ndarray, shape (M,)
            Parts of the record's length since the first sample.
        frequency : float
            Reciprocal of that length, Hz.
        derivative : int
            Order of the time derivative; beyond the fifth all are zero.

        Returns
        -------
        ndarray, shape (M,)
            In the channel's SI unit per second to the power ``derivative``.
        """
        return self.at(phase / frequency, derivative)

    def at(self, time: Array, derivative: int = 0) -> Array:
        """The same at times in s since the first sample, shape (M,)."""
        return evaluate_pieces(self.pieces, np.asarray(time, dtype=float), self.step, derivative)

    @cached_property
    def pieces(self) -> Array:
        """Coefficients ``(N - 1, 6)`` by rising power over each sampling interval, made one."""
        return pieces(self.states, self.step)

    def errors(self, count: int, seed: int = 0) -> list[Smoothed]:
        """Draws of what may lie between this curve and the true one.

        Parameters
        ----------
        count : int
            How many.
        seed : int
            Seeds them.
        """
        if self.noise == 0.0:
            return []
        rng, size = np.random.default_rng(seed), len(self.states)
        if self.band is not None:
            return [self._noise_in_band(rng) for _ in range(count)]
        root = np.linalg.cholesky(process_noise() * self.roughness)
        unit = self.noise / self.step ** np.arange(3)
        found = []
        for _ in range(count):
            true = walk(rng.standard_normal((size, 3)) @ root.T)
            seen = smooth(true[:, 0] + rng.standard_normal(size), self.roughness)
            found.append(Smoothed(self.step, (true - seen) * unit))
        return found

    def _noise_in_band(self, rng: np.random.Generator) -> Smoothed:
        """A draw of the noise that the curve holds, and of as much signal as it lacks: at each
        frequency noise times gain, as of a Wiener filter."""
        count = (len(self.states) - 1) // self.per_sample + 1
        white = self.noise * rng.standard_normal(count)
        assert self.band is not None
        states = filtered(white, self.step * self.per_sample, self.band, self.per_sample, 0.5)
        return Smoothed(self.step, states)


def smooth_signal(values: Array, step: float) -> Smoothed:
    """Find the smooth curve behind noisy samples.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Signal at equidistant times; at least eight samples.
    step : float
        Sampling interval, s.

    Returns
    -------
    Smoothed
        With the noise and the roughness that make the innovations most likely.

    Raises
    ------
    InputError
        If there are too few samples.
    """
    if values.size < 8:
        raise InputError(
            "too few samples to smooth", value=values.size, hint="record eight or more"
        )
    size = float(np.std(values)) or 1.0
    scaled = np.ascontiguousarray((values - values[0]) / size)

    def cost(logarithm: float) -> float:
        return float(innovations(scaled, 10.0**logarithm)[0])

    costs = [cost(value) for value in ROUGHNESS]
    best = int(np.argmin(costs))
    low, high = ROUGHNESS[max(best - 1, 0)], ROUGHNESS[min(best + 1, ROUGHNESS.size - 1)]
    found = minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 1e-2})
    logarithm = float(found.x) if found.fun < costs[best] else float(ROUGHNESS[best])
    states = smooth(scaled, 10.0**logarithm) * size / step ** np.arange(3)
    states[:, 0] += values[0]
    noise = size * float(np.sqrt(innovations(scaled, 10.0**logarithm)[1]))
    return Smoothed(step, states, noise, 10.0**logarithm)


def band_limited(
    values: Array, step: float, quantum: float = 0.0, bandwidth: float | None = None
) -> Smoothed:
    """The curve through equidistant samples, with those for derivatives to be taken.

    Parameters
    ----------
    values : ndarray, shape (N,)
        At least eight.
    step : float
        Sampling interval, s.
    quantum : float
        Step of the grid that samples lie on, zero where there is none.
    bandwidth : float, optional
        Hz, instead of what the spectrum says.

    Returns
    -------
    Smoothed
        For its value; :meth:`Smoothed.for_derivative` gives the others.
    """
    spectrum = spectrum_of(values, step, quantum)
    if bandwidth is not None:
        return declared(values, step, bandwidth, spectrum)
    if spectrum is None:
        return _of_few(values, step)
    noise = noise_of(spectrum)
    curves = []
    for order in range(DERIVATIVES + 1):
        cut = spectrum.cut(order)
        band = Band(
            cut,
            spectrum.fastest(_UNRESOLVED, order, cut),
            spectrum.held(cut, order),
            spectrum.lost(cut, order),
        )
        curves.append(_curve(values, step, band, noise))
    return replace(curves[0], derivatives=tuple(curves[1:]))


def _of_few(values: Array, step: float) -> Smoothed:
    """Of samples too few for a spectrum: a smoothing spline for derivatives, if it leaves them
    nearly as they are."""
    whole, spline = _curve(values, step, Band(np.inf, 0.5 / step), 0.0), smooth_signal(values, step)
    if spline.noise > _MOST_NOISE * np.std(values):
        return whole
    whole = replace(whole, noise=spline.noise)
    return replace(whole, derivatives=(spline,) * DERIVATIVES)


def declared(
    values: Array,
    step: float,
    bandwidth: float,
    spectrum: Spectrum | None = None,
    fade: float = 0.5,
) -> Smoothed:
    """The curve up to a frequency that is given, whatever is done with it.

    Parameters
    ----------
    values : ndarray, shape (N,)
    step : float
        Sampling interval, s.
    bandwidth : float
        Hz.
    spectrum : Spectrum, optional
        Of the samples, for their noise.
    fade : float
        Part of the bandwidth over which the curve fades out above it.
    """
    highest = 0.5 / step
    cut = bandwidth if bandwidth < highest else np.inf
    noise = 0.0 if spectrum is None else noise_of(spectrum)
    return _curve(values, step, Band(cut, min(cut, highest), fade=fade), noise)


def band_limited_channels(
    samples: Mapping[str, Array],
    step: float,
    quanta: Mapping[str, float] | None = None,
    bandwidths: Mapping[str, float] | None = None,
) -> dict[str, Smoothed]:
    """Curves of all channels of a run.

    What lies above a channel's floor stays in the curve of its value where another channel answers
    to it: then it is no noise of its sensor.

    Parameters
    ----------
    samples : mapping of str to ndarray, shape (N,)
    step : float
        Sampling interval, s.
    quanta : mapping of str to float, optional
        Steps of the grids that samples lie on.
    bandwidths : mapping of str to float, optional
        Hz, of channels of which they are known.
    """
    known, given = quanta or {}, bandwidths or {}
    curves = {
        name: band_limited(x, step, known.get(name, 0.0), given.get(name))
        for name, x in samples.items()
    }
    for name in curves.keys() - given.keys():
        curve = curves[name]
        others = [x for other, x in samples.items() if other != name and np.ptp(x) > 0]
        if (
            curve.band is not None
            and np.isfinite(curve.band.cut)
            and answered(samples[name], others, step, curve.band.cut)
        ):
            whole = _curve(samples[name], step, Band(np.inf, 0.5 / step), curve.noise)
            curves[name] = replace(whole, derivatives=curve.derivatives)
    return curves


def noise_of(spectrum: Spectrum) -> float:
    """Standard deviation of a sample's noise, zero where none can be told from signal."""
    if not np.isfinite(min(spectrum.cut(order) for order in range(DERIVATIVES + 1))):
        return 0.0
    return spectrum.noise


def sample_noise(values: Array, step: float) -> float:
    """Standard deviation that a sample's white noise has at most.

    Parameters
    ----------
    values : ndarray, shape (N,)
        At least eight.
    step : float
        Sampling interval, s.
    """
    spectrum = spectrum_of(values, step)
    return smooth_signal(values, step).noise if spectrum is None else spectrum.noise


def answered(values: Array, others: list[Array], step: float, above: float) -> bool:
    """Whether any other channel is coherent with one above a frequency.

    Parameters
    ----------
    values : ndarray, shape (N,)
    others : list of ndarray, shape (N,)
    step : float
        Sampling interval, s.
    above : float
        Hz.
    """
    # Only transients need it, and loading it takes as long as much of a search of periodic runs.
    from scipy import signal

    size = segment_length(values.size)
    for other in others:
        f, found = signal.coherence(values, other, 1.0 / step, "hann", size, size // 2)
        found = found[f > above]
        # Of segments that overlap by half about seven tenths count as independent.
        chance = 1.0 / max(1.4 * values.size / size, 1.0)
        # Neighbouring bins of that window are correlated, three count as one.
        error = chance / np.sqrt(max(found.size / 3.0, 1.0))
        if found.size and np.mean(found) > chance + max(_SURE * error, _COHERENT):
            return True
    return False


def _curve(values: Array, step: float, band: Band, noise: float) -> Smoothed:
    """The curve of one band, on a grid as fine as it asks for."""
    per_sample = max(int(np.ceil(_FINE * step * min(band.upper, 0.5 / step))), 1)
    states = filtered(values, step, band, per_sample, noise=noise)
    return Smoothed(step / per_sample, states, noise, band=band, per_sample=per_sample)
