"""How often each test cries wolf over noise alone, and whether it sees the fault that it is for."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter

from bayesoleo.assessment import Series, assess

PERIODS, PER_PERIOD, RUNS, GROUPS = 5, 200, "abcdef", "xxyyzz"
TRIALS = 120
Fault = Callable[[np.ndarray, np.ndarray, str, np.random.Generator], np.ndarray]


def campaign(rng, coefficient: float = 0.0, fault: Fault | None = None) -> list[Series]:
    """Residuals of six runs in three groups: noise of unit variance, and a fault."""
    size = PERIODS * PER_PERIOD
    time, made = np.arange(size) / PER_PERIOD, []
    for run, group in zip(RUNS, GROUPS, strict=True):
        white = rng.standard_normal(size + 200)
        noise = lfilter([np.sqrt(1 - coefficient**2)], [1.0, -coefficient], white)[200:]
        residual = noise if fault is None else fault(noise, time, run, rng)
        stroke = np.sin(2 * np.pi * time)
        variables = {"time": time, "phase": time % 1, "stroke": stroke}
        variables["velocity"] = np.cos(2 * np.pi * time)
        made.append(
            Series(run, "force", "fit", group, "N", residual, 1 / PER_PERIOD, 1.0, variables)
        )
    return made


@pytest.mark.statistical
@pytest.mark.parametrize("coefficient", [0.0, 0.8])
def test_false_alarms_are_as_rare_as_promised(coefficient):
    rng = np.random.default_rng(20)
    found = [assess(campaign(rng, coefficient)) for _ in range(TRIALS)]
    # White noise in order is all that the test on runs knows: it sees colour, and should.
    keys = ["runs_p"] * (coefficient == 0) + ["normality_p", "lack_of_fit_p", "share_p"]
    for key in (*keys, "share_of_runs_p", "share_of_groups_p"):
        p = np.concatenate([one[key].values.ravel() for one in found])
        # Three and a half binomial standard errors above; where noise is coloured its memory is
        # estimated from fifty samples' worth, which may double the rate.
        excess = 3.5 * np.sqrt(0.05 * 0.95 / p.size) + 0.05 * (coefficient > 0)
        assert np.mean(p < 0.05) < 0.05 + excess, key
        assert stats.kstest(p, "uniform", alternative="greater").statistic < 0.05 + 1.9 / np.sqrt(
            p.size
        ), key
    named = np.concatenate([one["outliers"].values.ravel() > 0 for one in found])
    # once in twenty records is the promise
    assert np.mean(named) < 0.05 + 3.5 * np.sqrt(0.05 * 0.95 / named.size)


def stuck(noise, time, run, rng):
    return noise + 0.5 * np.sign(np.cos(2 * np.pi * time))


def heavy(noise, time, run, rng):
    return rng.standard_t(4, noise.size) / np.sqrt(2)


def skewed(noise, time, run, rng):
    return rng.exponential(size=noise.size) - 1


def hit(noise, time, run, rng):
    noise = noise.copy()
    noise[rng.integers(noise.size)] += 7.0
    return noise


def drifting(noise, time, run, rng):
    return noise + 0.6 * (time / time[-1] - 0.5)


def shifted(noise, time, run, rng):
    return noise + 0.2 * (-1) ** RUNS.index(run)


def grouped(noise, time, run, rng):
    return noise + {"x": -0.3, "y": 0.0, "z": 0.3}[GROUPS[RUNS.index(run)]]


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("fault", "keys"),
    [
        (stuck, ["runs_p", "lack_of_fit_p", "share_p velocity", "share_p phase"]),
        (heavy, ["normality_p"]),
        (skewed, ["normality_p"]),
        (drifting, ["share_p time"]),
        (shifted, ["share_of_runs_p"]),
        (grouped, ["share_of_groups_p", "share_of_runs_p"]),
        (hit, ["outliers"]),
    ],
    ids=lambda item: getattr(item, "__name__", ""),
)
def test_planted_fault_is_seen_by_the_test_for_it(fault, keys):
    rng = np.random.default_rng(21)
    found = [assess(campaign(rng, fault=fault)) for _ in range(12)]
    for key in keys:
        name, _, variable = key.partition(" ")
        values = [one[name].sel(variable=variable) if variable else one[name] for one in found]
        flat = np.concatenate([np.ravel(value) for value in values])
        seen = flat > 0 if name == "outliers" else flat < 0.01
        assert np.mean(seen) > 0.9, key


@pytest.mark.statistical
def test_fault_is_seen_by_no_test_that_is_not_for_it():
    rng = np.random.default_rng(22)
    found = [assess(campaign(rng, fault=shifted)) for _ in range(40)]
    for key in ("normality_p", "share_of_groups_p"):
        p = np.concatenate([one[key].values.ravel() for one in found])
        assert np.mean(p < 0.05) < 0.05 + 3.5 * np.sqrt(0.05 * 0.95 / p.size), key
    for variable in ("time", "phase"):
        p = np.concatenate([one["share_p"].sel(variable=variable).values.ravel() for one in found])
        assert np.mean(p < 0.05) < 0.05 + 3.5 * np.sqrt(0.05 * 0.95 / p.size), variable
