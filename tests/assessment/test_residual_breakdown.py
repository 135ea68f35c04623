"""Where a repeating error lives, on residuals whose law is known."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo.assessment import residual_breakdown
from bayesoleo.assessment._residual_breakdown import ORDERS
from bayesoleo.errors import InputError

RUNS, SAMPLES, PERIODS, PHASES, NOISE = 3, 1600, 4, 200, 0.5
#: Frequency and amplitude of the motion: velocities overlap, and differ at equal phases.
FREQUENCY, AMPLITUDE = np.array([1.0, 1.7, 0.6]), np.array([1.0, 0.8, 1.5])


def result(law, seed=0, transient=False):
    """A tree as of ``trace``, whose residual of ``force`` is a law ``(q, v, phase, run)``."""
    rng = np.random.default_rng(seed)
    phase = np.tile(np.arange(SAMPLES) * PERIODS / SAMPLES, (RUNS, 1))
    rate = 2 * np.pi * FREQUENCY[:, None]

    def motion(cycles):
        q = AMPLITUDE[:, None] * np.sin(2 * np.pi * cycles)
        return q, rate * AMPLITUDE[:, None] * np.cos(2 * np.pi * cycles)

    q, v = motion(phase)
    grid = np.tile(np.arange(PHASES) / PHASES, (RUNS, 1))
    mean = law(*motion(grid), grid, np.arange(RUNS)[:, None]) + np.zeros((RUNS, PHASES))
    mean = mean + NOISE * rng.standard_normal(mean.shape)
    rows, units = (schema.RUN, schema.SAMPLE), {schema.UNITS: "1"}
    groups = {
        schema.RECORDS: xr.Dataset(
            {
                schema.PHASE: (rows, np.full_like(phase, np.nan) if transient else phase),
                schema.TIME: (rows, phase / FREQUENCY[:, None]),
                "displacement": (rows, q),
            }
        ),
        schema.CONSTANT_DATA: xr.Dataset({schema.RUN_GROUP: (schema.RUN, [""] * RUNS)}),
        schema.RESIDUAL: xr.Dataset(
            {
                "force_before_mean": ((schema.RUN, schema.PHASE), mean, units),
                "force_noise": (schema.RUN, np.full(RUNS, NOISE)),
                schema.STROKE: (rows, q, {schema.LONG_NAME: "position of q"}),
                schema.VELOCITY: (rows, v, {schema.LONG_NAME: "velocity of q"}),
            }
        ),
    }
    return xr.DataTree.from_dict(groups)


def shares(law, **options):
    data = residual_breakdown(result(law, **options)).isel(stage=0, output=0)
    share = data["share"].to_series().to_dict()
    return data["power"].values, share, float(data["excess"])


def test_friction_is_a_function_of_direction_and_of_velocity():
    power, share, _ = shares(lambda q, v, c, r: 5 * np.sign(v))
    assert share["direction"] == pytest.approx(1.0, abs=0.02)
    # Bins at the reversal hold both signs.
    assert share["velocity of q"] > 0.95
    assert share["position of q"] < 0.1
    # The fundamental of a square wave holds 8/pi^2 of its power.
    assert power[1] == pytest.approx(8 / np.pi**2, abs=0.02)


def test_a_cubic_spring_is_a_function_of_position():
    _, share, _ = shares(lambda q, v, c, r: 5 * q**3)
    assert share["position of q"] > 0.97
    assert share["velocity of q"] < 0.2
    assert "displacement" not in share  # the same coordinate once more


def test_offsets_of_runs_are_constants():
    power, share, _ = shares(lambda q, v, c, r: 3.0 * (r - 1))
    assert share["run"] == pytest.approx(1.0, abs=0.01)
    assert power[0] == pytest.approx(1.0, abs=0.01)


def test_high_harmonics_are_counted_together():
    power, _, excess = shares(lambda q, v, c, r: 2 * np.cos(2 * np.pi * 30 * c))
    assert power[ORDERS] == pytest.approx(1.0, abs=0.05)
    assert excess == pytest.approx(2.0 / NOISE**2, rel=0.1)


def test_powers_add_up_to_the_excess():
    power, _, _ = shares(lambda q, v, c, r: 5 * np.sign(v) + q**3)
    assert power.sum() == pytest.approx(1.0, abs=1e-6)


def test_noise_alone_has_no_excess():
    excess = [shares(lambda q, v, c, r: 0.0, seed=seed)[2] for seed in range(20)]
    # Mean square of 600 normal numbers less one: sd 0.058; of twenty of them 0.013.
    assert abs(np.mean(excess)) < 4 * 0.013


def test_transients_and_results_without_residuals_are_refused():
    with pytest.raises(InputError, match="no run is periodic"):
        residual_breakdown(result(lambda q, v, c, r: q, transient=True))
    with pytest.raises(InputError, match="no residual"):
        residual_breakdown(xr.DataTree())
