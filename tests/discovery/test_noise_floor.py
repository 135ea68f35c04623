"""When a residual counts as down to its noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesoleo.data import PeriodicAverage, periodic_average
from bayesoleo.discovery._fit_and_hold_out_error import ErrorTable, RunError, is_at_floor, limit
from bayesoleo.discovery._policy import SearchPolicy


def average(per_period: int, periods: int, seed: int = 0) -> PeriodicAverage:
    noise = np.random.default_rng(seed).standard_normal(per_period * periods)
    return periodic_average(noise, 1.0 / per_period, 1.0)


def entry(found: PeriodicAverage, run: str = "a", ratio: float = 1.0) -> RunError:
    scaled = replace(found, repeating=ratio * found.noise)
    return RunError(run, "fit", "force", 1.0, scaled, 0.0)


def test_with_many_samples_the_limit_is_the_stated_one():
    assert limit([entry(average(1000, 4))]) == SearchPolicy().floor_ratio


def test_with_few_samples_noise_alone_sets_the_limit():
    """Noise exceeds it about once in a thousand times: hardly in 300, but 1.15 in many."""
    found = [average(20, 2, seed) for seed in range(300)]
    ratios = np.array([item.ratio for item in found])
    assert np.mean(ratios > SearchPolicy().floor_ratio) > 0.1
    # Four or more of 300 at one in a thousand have a probability of 3e-4.
    assert np.sum(ratios > limit([entry(found[0])])) < 4


def test_one_run_above_its_noise_is_not_hidden_by_the_others():
    quiet = [entry(average(1000, 4, k), f"{k}", 0.98) for k in range(13)]
    loud = entry(average(1000, 4), "loud", 1.6)
    pooled = np.sqrt(np.mean([item.ratio**2 for item in (*quiet, loud)]))
    assert pooled < SearchPolicy().floor_ratio
    assert is_at_floor(ErrorTable(tuple(quiet)))
    assert not is_at_floor(ErrorTable((*quiet, loud)))


@pytest.mark.parametrize("ratio", [np.nan, np.inf])
def test_a_run_that_could_not_be_solved_is_never_at_the_floor(ratio):
    table = ErrorTable((entry(average(1000, 4)), entry(average(1000, 4), "failed", ratio)))
    assert not is_at_floor(table)
    assert not table.worst_ratio() < SearchPolicy().floor_ratio
