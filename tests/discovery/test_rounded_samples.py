"""Coarse steps of a converter are counted with the noise, and are no effect."""

from __future__ import annotations

import numpy as np
import pytest
from fitted_states import NUMERICS, fitted
from small_campaigns import (
    DAMPER_CHANNELS,
    DAMPER_RUNS,
    FRICTION,
    damper,
    spring_damper_force,
)

from bayesoleo import _schema as schema
from bayesoleo.data import (
    SimulatedRun,
    data_warnings,
    load_campaign,
    reduce_campaign,
    write_campaign,
)
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._loop import close_loop
from bayesoleo.effects import find_effect

STEP, PERIODS = 0.5, 8
FEW = tuple(map(find_effect, ("coulomb_friction", "quadratic_damping", "quintic_stiffness")))


def rounded(folder, noise, per_period, law=spring_damper_force, seed=0):
    """Forces as a converter gives them; amplitudes differ, lest every run rounds alike."""
    rng, made = np.random.default_rng(seed), []
    for label, frequency, amplitude, role in DAMPER_RUNS:
        time = np.arange(int(np.ceil(PERIODS * per_period))) / (per_period * frequency)
        omega, a = 2 * np.pi * frequency, amplitude * (1 + 0.1 * rng.uniform())
        x = a * (np.sin(omega * time) + 0.05 * np.cos(2 * omega * time))
        v = a * omega * (np.cos(omega * time) - 0.1 * np.sin(2 * omega * time))
        y = law(x, v, time) + noise * rng.standard_normal(time.size)
        samples = {"displacement": x, "force": STEP * np.round(y / STEP)}
        made.append(SimulatedRun(label, time, samples, frequency, role=role))
    write_campaign(
        folder, name="damper", channels=DAMPER_CHANNELS, runs=made, controlled="displacement"
    )
    return reduce_campaign(load_campaign(folder), jobs=1)


@pytest.mark.parametrize("noise", [0.0, 0.05, 0.3])
@pytest.mark.parametrize("per_period", [100, 100.37], ids=["same phases", "moving phases"])
def test_rounding_is_counted_in_the_floor(noise, per_period, tmp_path):
    errors = fitted(rounded(tmp_path, noise, per_period), damper()).fit_errors
    ratio = np.sqrt(np.mean([entry.ratio**2 for entry in errors.entries]))
    # Three runs of a hundred errors each, pooled: 1 within three standard errors of 4 %.
    assert ratio == pytest.approx(1.0, abs=0.12)


def test_coarse_steps_are_no_effect_and_hide_none(tmp_path):
    def rubbing(x, v, t):
        return spring_damper_force(x, v, t) + FRICTION * 2 / np.pi * np.arctan(v / 2e-3)

    for name, law, expected in (
        ("plain", spring_damper_force, ()),
        ("rubbing", rubbing, ("coulomb_friction",)),
    ):
        reduced = rounded(tmp_path / name, 0.05, 100, law)
        loop = close_loop(
            Assembly(damper()), assign(reduced.records), NUMERICS, effects=FEW, nonparametric=False
        )
        assert loop.effects == expected
        assert loop.final.worst_ratio < 1.3
        if not expected:
            assert loop.verdict == schema.NOTHING_MISSING
        assert any("goes in steps of 0.5 N" in text for text in told(reduced))


def told(reduced):
    return data_warnings(reduced.records, reduced.campaign.units)
