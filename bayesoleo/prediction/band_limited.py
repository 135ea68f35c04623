r"""A channel that does not repeat as an input: the band-limited curve through its samples.

A curve holds all frequencies up to half the sampling rate, unless the spectrum has fallen to a
floor of noise below that. There it is cut off if a derivative is taken of it, or if no other
channel answers to what is cut off. Curves are kept on a grid so fine that quintic pieces between
its points are exact to 5e-6.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy import signal

from bayesoleo._types import Array
from bayesoleo.prediction.filtering import Band, filtered
from bayesoleo.prediction.smoothing import Smoothed, smooth_signal
from bayesoleo.prediction.spectrum import Spectrum, segment_length, spectrum_of

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
    states = filtered(values, step, band, per_sample)
    return Smoothed(step / per_sample, states, noise, band=band, per_sample=per_sample)
