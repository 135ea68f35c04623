"""Which samples of a record count, and what stands in for those that do not.

Masked samples have no weight; they are interpolated where whole periods are needed.
"""

from __future__ import annotations

from dataclasses import replace
from typing import cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.data._noise import PeriodicAverage
from bayesoleo.data._sample_quality import bridged
from bayesoleo.prediction._records import Record


def weights(record: Record) -> Array:
    """One for every sample that counts, zero for the others, shape (N,)."""
    return np.ones(record.time.size) if record.kept is None else record.kept.astype(float)


def counted(record: Record) -> int:
    """Number of samples that count."""
    return record.time.size if record.kept is None else int(record.kept.sum())


def without_masked(record: Record, residual: Array) -> Array:
    """A residual with what the other samples say where it does not count, shape (N,).

    Of a periodic run that is the average over its other periods: least squares on all harmonics
    then is that of the samples that count. Of a transient it is a straight line.
    """
    if record.kept is None or not np.isfinite(residual).all():
        return residual
    cycles = (record.time[-1] - record.time[0]) / (record.time.size - 1) * record.frequency
    step = float(cycles) if record.periodic else None
    return cast(Array, bridged(residual[None], ~record.kept, step)[0])


def of_those_counted(record: Record, average: PeriodicAverage) -> PeriodicAverage:
    """The average of a bridged residual, its noise that of the samples which count.

    What was bridged lies on the average: it adds nothing to the squares, and nothing is known by
    it.
    """
    if record.kept is None:
        return average
    count, all_ = counted(record), average.samples
    sigma = average.sigma * np.sqrt((all_ - average.number) / (count - average.number))
    noise = float(sigma * np.sqrt(average.number / count))
    return replace(average, sigma=float(sigma), noise=noise, samples=count)
