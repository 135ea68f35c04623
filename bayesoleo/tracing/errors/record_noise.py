"""The noise of a record: the same whatever the model, and never more than the residual bears out.

What the noise of an input does to a prediction is computed by sending its spectrum through the
model. A model that differentiates its input makes much of it, and the spectrum between the input's
harmonics may hold a rig's real motion, to which the output answers, or a converter's steps, instead
of noise. So it counts only as far as the residual has the power for it, band by band: a residual is
the sum of what the model lacks and of noise, and nowhere smaller than either.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy import stats

from bayesoleo._types import Array
from bayesoleo.data.smoothing import innovation_noise
from bayesoleo.prediction.records import Record
from bayesoleo.tracing.fitting.masked import without_masked
from bayesoleo.tracing.fitting.roles import RecordNoise
from bayesoleo.tracing.policy import SearchPolicy

#: Columns whose overlap says how many independent coefficients a band holds.
MOST_COLUMNS = 128


def borne_out(
    columns: Array,
    residuals: Sequence[Array],
    *,
    drawn: bool = False,
    policy: SearchPolicy = SearchPolicy(),
) -> float:
    """Largest factor, at most one, by which the input's noise may be what the residual holds.

    Parameters
    ----------
    columns : ndarray, shape (ny, k, N)
        Change of the outputs by one standard deviation of each input coefficient.
    residuals : sequence of ndarray, shape (N,)
        What the average over periods (or neighbouring samples) leaves of each output.
    drawn : bool
        Whether columns are draws of an error with as many coefficients as samples, as those of a
        transient's input are, instead of one coefficient each.
    policy : SearchPolicy

    Returns
    -------
    float
        One factor for all outputs of the run, because it is the input's; what it leaves in doubt by
        chance is left in.
    """
    least = 1.0
    for block, residual in zip(columns, residuals, strict=True):
        if block.shape[0] == 0 or not (block.any() and np.isfinite(residual).all()):
            continue
        lines = scipy.fft.rfft(block, axis=1)
        power, there = np.sum(np.abs(lines) ** 2, axis=0), np.abs(scipy.fft.rfft(residual)) ** 2
        for band in _bands(power, policy.noise_bands):
            coefficients = _of_lines(power[band]) if drawn else _coefficients(lines[:, band])
            level = policy.noise_false_alarm / policy.noise_bands
            low = float(stats.chi2.ppf(level, coefficients)) / coefficients
            ratio = float(there[band].sum() / power[band].sum())
            least = min(least, ratio / max(low, 1e-300))
    return float(np.sqrt(least))


def _bands(power: Array, count: int) -> list[slice]:
    """Stretches of lines with about the same part of the power each."""
    total = np.cumsum(power)
    edges = np.searchsorted(total, np.arange(1, count) / count * total[-1]) + 1
    ends = np.unique(np.concatenate([[0], edges, [power.size]]))
    found = [slice(int(a), int(b)) for a, b in pairwise(ends)]
    return [band for band in found if power[band].sum() > 0.01 * total[-1]]


def _of_lines(power: Array) -> float:
    """The same where each line has two of its own."""
    return max(2.0 * float(power.sum() ** 2 / np.sum(power**2)), 1.0)


def _coefficients(lines: NDArray[np.complex128]) -> float:
    """Number of equally large independent coefficients that a band's power scatters like."""
    size = np.sum(np.abs(lines) ** 2, axis=1)
    chosen = np.argsort(-size)[:MOST_COLUMNS]
    gram = (lines[chosen] @ lines[chosen].conj().T).real
    return max(float(np.trace(gram) ** 2 / np.sum(gram**2)), 1.0)


def sample_noise(
    record: Record,
    output: str,
    residual: Array,
    before: RecordNoise | None = None,
    *,
    policy: SearchPolicy = SearchPolicy(),
) -> float:
    """Standard deviation of the noise of a transient's sample, SI.

    Differences of neighbours see whatever is not smooth as noise, be it the record's or what a
    model predicts. Both the record and the residual hold the noise: it is no more than the smaller.

    Parameters
    ----------
    record : Record
    output : str
    residual : ndarray, shape (N,)
        Of the present model.
    before : RecordNoise, optional
        Where it was measured before.
    policy : SearchPolicy
    """
    shown = innovation_noise(residual)
    if before is not None:
        known = before.sigma
        return shown if shown < policy.clearly_less_noise * known else known
    return min(shown, innovation_noise(without_masked(record, record.samples[output])))
