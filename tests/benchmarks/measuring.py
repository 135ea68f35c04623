"""What every benchmark of a solver measures with: times, errors over the amplitude, exponents."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Phases at which solutions are compared: a prime number, so that no mesh is favoured.
PHASES = np.arange(997) / 997


def best(work: Callable[[], object], repetitions: int = 7) -> float:
    """Shortest wall time of several calls, s."""
    return _least(time.perf_counter, work, repetitions)


def cpu(work: Callable[[], object], repetitions: int = 5) -> float:
    """Least CPU time of several calls, s, summed over threads: what a busy machine leaves alone."""
    return _least(time.process_time, work, repetitions)


def _least(clock: Callable[[], float], work: Callable[[], object], repetitions: int) -> float:
    times = []
    for _ in range(repetitions):
        begin = clock()
        work()
        times.append(clock() - begin)
    return min(times)


def error(found: Array, exact: Array) -> float:
    """Largest difference over the amplitude, half of peak to peak, of the exact motion."""
    return float(np.max(np.abs(found - exact)) / (np.ptp(exact) / 2))


def exponent(sizes: Sequence[float], seconds: Sequence[float]) -> float:
    """Slope of total time against size on logarithmic scales."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def time_at(target: float, errors: Sequence[float], seconds: Sequence[float]) -> float:
    """Time at an error, between measured pairs on logarithmic scales.

    From the cheapest pair below the target and its neighbour above; NaN where no pair is below,
    and the cheapest time where all are: nothing is extrapolated.
    """
    pairs = sorted(zip(seconds, errors, strict=True))
    for k, (after, low) in enumerate(pairs):
        if low <= target:
            if k == 0:
                return after
            before, high = pairs[k - 1]
            part = np.log(high / target) / np.log(high / low)
            return float(before * (after / before) ** part)
    return float("nan")
