"""What the search makes of slow noise: its probabilities are those it states."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import fitted, scored
from small_campaigns import damper, damper_campaign
from synthetic_scores import base_of_noise

from bayesoleo.data._noise import noise_spectrum
from bayesoleo.discovery._score_tests import _between_periods, corrected_p, inflation_of

SEEDS = 30


def plain(x, v, _):
    return 2.0e4 * x + 200.0 * v


@pytest.mark.slow
@pytest.mark.statistical
def test_p_values_under_slow_noise_are_what_they_say(tmp_path):
    """AR(1) with coefficient 0.97, eight periods: nothing is missing, and little is found."""
    names = ("coulomb_friction", "cubic_stiffness", "quadratic_stiffness", "constant_force")
    small, above = dict.fromkeys(names, 0), 0
    for seed in range(SEEDS):
        folder = tmp_path / str(seed)
        state = fitted(
            damper_campaign(folder, plain, coloured=0.97, seed=seed), damper(cubic=False)
        )
        above += not state.at_floor
        for name, score in scored(state, *small).items():
            assert score.inflation > 2
            small[name] += corrected_p(score, 1.0) < 0.05
    # Of 30 at 5 %, six or more with a probability of 0.3 %; at a false alarm of 0.1 % hardly one.
    assert all(count < 6 for count in small.values())
    assert above <= 1


@pytest.mark.parametrize("measured", [True, False], ids=["spectrum", "assumed white"])
def test_noise_that_outputs_share_shows_between_periods(measured):
    """Two outputs with the same noise: a direction along both varies twice as much as apart."""
    found = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        base, direction = base_of_noise(rng, shared=True, periods=60, measured=measured)
        found.append(inflation_of(base, [direction])[0])
    assert np.mean(found) == pytest.approx(2.0, rel=0.15)


def test_noise_of_their_own_is_hardly_inflated():
    found = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        base, direction = base_of_noise(rng, shared=False, periods=60)
        found.append(inflation_of(base, [direction])[0])
    # Never below one, and scatter between 60 periods is 18 %, believed once in twenty.
    assert 1.0 <= np.mean(found) < 1.1


def test_a_drift_is_not_its_own_noise():
    """A ramp lies between the harmonics, where noise is measured; what it explains is no noise."""
    rng, periods, per_period = np.random.default_rng(1), 8, 50
    base, wave = base_of_noise(rng, shared=False, periods=periods)
    size = periods * per_period
    ramp = np.concatenate([np.linspace(-3, 3, size), np.zeros(size)])
    run = replace(base.runs[0], residual=base.runs[0].residual + ramp)
    parts = run.residual.reshape(2, periods, per_period)
    rest = (parts - parts.mean(axis=1, keepdims=True)).reshape(2, size)
    run = replace(run, spectra=tuple(noise_spectrum(part, periods) for part in rest))
    record = SimpleNamespace(time=np.arange(size) / per_period, frequency=1.0, periods=periods)
    drifting = replace(base, runs=[run], fit=SimpleNamespace(records=[record]))
    assert inflation_of(drifting, [ramp])[0] < 1.6
    assert inflation_of(drifting, [wave])[0] > 3.0, "to others the drift is noise"


def test_scatter_between_few_periods_is_unbiased():
    """White noise beside an effect that grows: its variance along that is ``d @ d``, on average."""
    rng, periods = np.random.default_rng(3), 4
    period = np.repeat(np.arange(periods), 30)
    direction = np.sin(np.arange(period.size)) * (1.0 + period)
    found = []
    for _ in range(3000):
        residual = direction + rng.standard_normal(period.size)
        run = SimpleNamespace(period=period, residual=residual)
        value, degrees = _between_periods([run], [direction])
        found.append(value)
        assert degrees == periods - 1
    error = np.std(found) / np.sqrt(len(found))
    assert np.mean(found) == pytest.approx(direction @ direction, abs=4 * error)


def test_degrees_of_freedom_have_no_unit_and_add_up():
    """The size of a direction does not matter; another run that knows as much doubles them."""
    rng = np.random.default_rng(5)
    base, direction = base_of_noise(rng, shared=False, periods=8)
    base = replace(base, policy=replace(base.policy, unsteady=1e-9))  # by the spectrum alone
    _, freedom = inflation_of(base, [direction])
    assert inflation_of(base, [100 * direction])[1] == freedom > 4
    twice = replace(base, runs=[*base.runs, *base.runs])
    assert inflation_of(twice, [direction, direction])[1] == pytest.approx(2 * freedom, abs=1)
