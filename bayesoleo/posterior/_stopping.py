"""When sampling stops, how many draws are handed on, and what is shown meanwhile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from tqdm.auto import tqdm

from bayesoleo._types import Array, Integers
from bayesoleo.error_models._base import ErrorModel
from bayesoleo.posterior._diagnostics import (
    autocorrelation_time,
    effective_size as effective_size_of,
    nested_rhat,
    rhat_limit,
)

#: Draws that are handed on at least, where each one costs a factorisation for each run, and by
#: quick runs.
ENOUGH, ENOUGH_QUICK = 4_000, 1_000
#: What it costs to predict and to store with a draw, in evaluations of the density.
COSTS = 3


@dataclass(frozen=True)
class Schedule:
    """Schedule of sampling: adaptation, length of segments, stopping rule.

    Parameters
    ----------
    effective_size : float
        Requested effective sample size of every quantity.
    max_evaluations : int
        Budget of rows of the log density; no segment begins that would exceed it.
    warm_up : int
        Draws of the first warm-up round; each later one has twice as many.
    most_rounds : int
        Warm-up rounds at most.
    least_rounds : int
        Warm-up rounds before proposals of the mixture that are accepted may end it.
    least : int
        Kept draws of each walker before the stopping rule is applied.
    times : float
        Kept draws, in autocorrelation times, from which the estimates are reliable.
    segment : int
        Draws of the longest segment, the most that an interruption can lose.
    """

    effective_size: float
    max_evaluations: int
    warm_up: int
    most_rounds: int
    least_rounds: int
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

    def shortfalls(
        self, schedule: Schedule, ensembles: int, groups: str = "ensembles"
    ) -> list[str]:
        """Criteria that are not met yet, in words; empty if all are."""
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
                f"the {groups} disagree: nested R-hat {self.rhat.max():.3f} above {limit:.3f}"
            )
        return short


def quality_of(draws: Array, ensemble: Integers) -> Quality:
    """Diagnostics of draws (chains, draws, d) of which each chain belongs to an ensemble."""
    return Quality(
        autocorrelation_time(draws),
        effective_size_of(draws),
        nested_rhat(draws, ensemble),
        draws.shape[1],
    )


def decisions(least: int, done: int) -> list[int]:
    """Numbers of draws at which the stopping rule is applied, up to the first after those done.

    They grow by a fifth and depend on nothing else, so that an interrupted run stops at the same
    draw. The diagnostics, whose cost grows with the draws, are thus computed rarely.
    """
    numbers = [least]
    while numbers[-1] <= done:
        numbers.append(int(np.ceil(1.2 * numbers[-1])))
    return numbers


def stride_of(
    errors: ErrorModel | None, quality: Quality, chains: int, draws: int, quick: bool
) -> int:
    """Of how many draws of a chain one is handed on; all are, unless each one costs a factorisation
    a run, or the run is quick: every draw that is handed on is solved for once more."""
    if quick:
        # An autocorrelation time loses a quarter of the information on the quantity that moves
        # most quickly, and less on the others. Where all draws are nearly independent, enough are
        # left: one costs as much to hand on as three to draw.
        most = draws // -(-ENOUGH_QUICK // chains)
        return int(max(1, min(most, max(COSTS, quality.times.min()))))
    if errors is None or not errors.over_runs:
        return 1
    # A quarter of the autocorrelation time loses a hundredth of the information at most.
    return int(max(1, min(chains * draws // ENOUGH, quality.times.min() / 4)))


def sizes_of_every(quality: Quality, every: int) -> Array:
    """Effective sizes, shape (m,), of every so many draws of chains whose correlation falls as a
    power of the distance."""
    correlation = (quality.times - 1) / (quality.times + 1)  # negative where draws alternate
    apart = (1 + correlation**every) / np.maximum(1 - correlation**every, 1e-300)
    return np.minimum(quality.sizes, quality.sizes * quality.times / (every * apart))


class ProgressBar:
    """Progress towards the effective size."""

    def __init__(self, total: float, shown: bool | float) -> None:
        self._delay = 0.0 if shown is True else shown
        self._bar = tqdm(
            total=round(total), disable=not shown, unit=" effective draws", delay=self._delay
        )
        self._bar.set_description("warm-up", refresh=False)

    def show(self, phase: str, size: float, evaluations: int) -> None:
        self._bar.set_description(phase, refresh=False)
        self._bar.set_postfix(evaluations=evaluations, refresh=False)
        self._bar.n = min(round(size), self._bar.total)
        if self._bar.format_dict["elapsed"] >= self._delay:
            self._bar.refresh()

    def close(self) -> None:
        self._bar.close()
