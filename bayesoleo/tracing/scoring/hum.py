"""Frequency of what hums in transients: a line in what a model leaves that no input has.

A frequency that the null leaves undefined cannot be scanned by a coarse grid: its score has a peak
as narrow as the reciprocal of the record's length. So the highest line of the residual's spectrum
is taken, if one so high comes by chance less than once in a thousand times; where there is none,
there is no periodic force to score, and nothing that the search would have to be corrected for.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage, optimize, stats

from bayesoleo._types import Array
from bayesoleo.data.lines import FALSE_ALARM
from bayesoleo.prediction.records import Record
from bayesoleo.tracing.fitting.fit import Fit
from bayesoleo.tracing.fitting.masked import weights

#: Lines on either side from whose median the level beside a line is taken; cycles over the record
#: below which a line is a drift.
_BESIDE, _FEWEST = 25, 5
#: A window that keeps strong lines from leaking far makes lines this many bins wide.
_WIDE = 3


def dominant_residual_frequency(fit: Fit) -> float | None:
    """Frequency at which the residuals of transients hum, Hz; None where they do not."""
    best: tuple[float, float] = (FALSE_ALARM, 0.0)
    for r, record in enumerate(fit.records):
        if record.periodic:
            continue
        e = fit.predictor.runs[r].measured - fit.predictions[r].y
        e = np.where(weights(record) > 0, e, 0.0)
        inputs = [record.samples[n] for n in fit.model.inputs if n in record.samples]
        for values in e:
            found = line_of(values, inputs, _step(record))
            if found is not None:
                best = min(best, found)
    return best[1] if best[1] > 0 else None


def line_of(values: Array, inputs: Sequence[Array], step: float) -> tuple[float, float] | None:
    """Probability and frequency of the highest line of a signal that no input shares.

    Parameters
    ----------
    values : ndarray, shape (N,)
    inputs : sequence of ndarray, shape (N,)
    step : float
        Sampling interval, s.

    Returns
    -------
    (p-value, frequency in Hz), or None where the record is too short.
    """
    own = _over_level(values)
    if own is None:
        return None
    shared = np.zeros(own.size, dtype=bool)
    for item in inputs:
        level = _over_level(item)
        if level is not None:
            strong = level > stats.f.isf(FALSE_ALARM, 2, _BESIDE)
            shared |= ndimage.binary_dilation(strong, iterations=_WIDE)
    own[shared] = 0.0
    k = int(np.argmax(own))
    if own[k] == 0:
        return None
    p = float(-np.expm1(own.size * np.log1p(-stats.f.sf(own[k], 2, _BESIDE))))
    return p, _refined(values, k) / (values.size * step)


def _over_level(values: Array) -> Array | None:
    """Powers of a windowed signal over their level beside them."""
    window = np.hanning(values.size)
    power = np.abs(np.fft.rfft((values - values.mean()) * window)) ** 2
    if power.size < 4 * _BESIDE or not power.any():
        return None
    # Of exponential powers the median is ln 2 of the mean.
    level = ndimage.median_filter(power, 2 * _BESIDE + 1, mode="reflect") / np.log(2.0)
    ratio: Array = power / np.maximum(level, 1e-9 * power.mean())
    ratio[:_FEWEST] = 0.0
    return ratio


def _refined(values: Array, k: int) -> float:
    """Cycles over the record at which the windowed signal's power is highest, near a bin."""
    shown = (values - values.mean()) * np.hanning(values.size)
    turn = -2j * np.pi * np.arange(values.size) / values.size

    def less(cycles: float) -> float:
        return -float(np.abs(np.exp(turn * cycles) @ shown))

    found = optimize.minimize_scalar(less, bounds=(k - 1.0, k + 1.0), method="bounded")
    return float(found.x)


def _step(record: Record) -> float:
    return float((record.time[-1] - record.time[0]) / (record.time.size - 1))
