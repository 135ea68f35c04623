"""When to adapt, how long to keep, and whether that was enough."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array
from bayesoleo.posterior.sampling.diagnostics import rhat_limit


@dataclass(frozen=True)
class Schedule:
    """When to adapt, how long to keep, when to stop.

    Parameters
    ----------
    effective_size : float
        Effective draws asked for, of every quantity.
    max_evaluations : int
        No segment begins that would take more rows of the log density than this.
    warm_up : int
        Draws of the first warm-up round; each later one has twice as many.
    most_rounds : int
        Warm-up rounds at most.
    least : int
        Kept draws of each walker before anything is decided.
    times : float
        Kept draws in autocorrelation times before the estimates are believed.
    segment : int
        Draws of the longest segment: what a kill can cost.
    """

    effective_size: float
    max_evaluations: int
    warm_up: int
    most_rounds: int
    least: int
    times: float
    segment: int


@dataclass(frozen=True)
class Quality:
    """Diagnostics of the draws kept so far.

    Parameters
    ----------
    times, sizes, rhat : ndarray, shape (d,)
        Autocorrelation time, effective size, nested R-hat.
    draws : int
        Kept draws of each walker.
    """

    times: Array
    sizes: Array
    rhat: Array
    draws: int

    def shortfalls(self, schedule: Schedule, ensembles: int) -> list[str]:
        """What is not yet good enough, in words; empty if everything is."""
        if not np.all(np.isfinite(self.times)):
            return ["a quantity never moved"]
        short = []
        if self.sizes.min() < schedule.effective_size:
            short.append(
                f"the effective size is {self.sizes.min():.0f}"
                f" of {schedule.effective_size:.0f} asked for"
            )
        if self.draws < schedule.times * self.times.max():
            short.append(
                f"{self.draws} draws are fewer than {schedule.times:.0f}"
                f" autocorrelation times of {self.times.max():.1f}"
            )
        limit = rhat_limit(ensembles, schedule.effective_size)
        if self.rhat.max() > limit:
            short.append(
                f"the ensembles disagree: nested R-hat {self.rhat.max():.3f} above {limit:.3f}"
            )
        return short
