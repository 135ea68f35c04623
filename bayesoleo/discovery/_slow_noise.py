"""Whether what a model leaves of transients is as slow noise would leave it.

What a periodic run leaves in every period is no noise. A transient does not repeat: slow noise and
a missing effect look alike in it, unless the residual has a spectrum that noise of one correlation
time does not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import scipy.fft

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array
from bayesoleo.discovery._fit_and_hold_out_error import limit
from bayesoleo.discovery._run_predictions import Prediction
from bayesoleo.discovery._signatures import Lines, colour_of, spectrum_of_process
from bayesoleo.discovery._state import State

#: Bands of lines, of equal width in the logarithm of the frequency, whose power is compared with
#: that of the process, and the probability below which it has another spectrum.
BANDS, UNLIKE = 12, 0.01
#: Fewest samples of which that is judged, and correlation times that a record must hold.
FEWEST, TIMES = 100, 10.0


def slow_noise(state: State) -> dict[str, float]:
    """Correlation time in s by output whose error in transients is as slow noise leaves it.

    Parameters
    ----------
    state : State
        The final model. Outputs are judged whose error exceeds what is expected in some run; where
        one of them shows more than slow noise, nothing is left open.
    """
    found: dict[str, float] = {}
    for b, output in enumerate(state.fit.predictor.outputs):
        beyond = {
            e.run
            for e in state.errors.entries
            if e.output == output and not e.ratio_to_expected < limit([e], policy=state.policy)
        }
        chosen = [p for p in (*state.fitted, *state.held_out) if p.record.label in beyond]
        if not chosen:
            continue
        if any(p.record.periodic or not p.status.ok for p in chosen):
            return {}
        lines = [_lines(one, b, output) for one in chosen]
        length = min(float(one.record.time[-1] - one.record.time[0]) for one in chosen)
        time = _time_of(lines)
        if time is None or not TIMES * time < length:
            return {}
        found[output] = time
    return found


def slow_noise_text(found: dict[str, float]) -> str:
    """What is said of outputs that :func:`slow_noise` found; empty where there are none."""
    if not found:
        return ""
    each = ", ".join(f"{name} (correlation time {time:.2g} s)" for name, time in found.items())
    return (
        f"what is left of {each} is as slow noise would leave it: transients do not tell such noise"
        " from an effect that is missing, and runs that repeat would"
    )


def _lines(one: Prediction, b: int, output: str) -> Lines:
    """Pairs of lines of a cosine transform of a residual."""
    record = one.record
    left = np.asarray(record.samples[output] - one.y[b])
    step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
    if record.kept is not None or left.size < FEWEST:
        return Lines(np.zeros(0), np.zeros(0), step, 1.0, 0.0)
    power = scipy.fft.dct(left, norm="ortho")[1 : 2 * ((left.size - 1) // 2) + 1] ** 2
    pairs = power.reshape(-1, 2).mean(axis=1)
    angle = np.pi * (2.0 * np.arange(pairs.size) + 1.5) / left.size
    return Lines(pairs, angle, step, float(np.std(left)), float(left.size))


def _time_of(lines: Sequence[Lines]) -> float | None:
    """Correlation time of the process that has these spectra; None where none has."""
    if not all(one.power.size for one in lines):
        return None
    (share, time), p_value = colour_of(lines)
    if p_value > UNLIKE:  # it is white
        return None
    whitened = []
    for one in lines:
        density, _, _ = spectrum_of_process(np.cos(one.angle), share, one.step / time)
        level = one.power / density
        whitened.append(level / level.mean())
    return time if _least_p(whitened) > UNLIKE else None


def _least_p(whitened: Sequence[Array]) -> float:
    """Least probability of the power in any band, were it that of white noise, by so many bands."""
    least, size = 1.0, max(one.size for one in whitened)
    edges = np.unique(np.geomspace(1, size + 1, BANDS + 1).astype(int)) - 1
    for low, high in pairwise(edges):
        band = np.concatenate([one[low:high] for one in whitened])
        # Each mean of a pair of lines has two degrees of freedom.
        lower = distributions.chi2.cdf(2.0 * band.sum(), 2 * band.size)
        least = min(least, 2.0 * float(min(lower, 1.0 - lower)))
    return min(least * (edges.size - 1), 1.0)
