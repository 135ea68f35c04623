"""An effect without a name that follows two quantities, or that transients show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitted_states import NUMERICS
from small_campaigns import DAMPER_CHANNELS, damper, damper_campaign, spring_damper_force

from bayesoleo import _schema as schema
from bayesoleo.data import SimulatedRun, load_campaign, reduce_campaign, write_campaign
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._curves import shapes
from bayesoleo.discovery._loop import close_loop
from bayesoleo.effects import find_effect

EFFECTS = tuple(map(find_effect, ("coulomb_friction", "quadratic_damping", "quintic_stiffness")))


def valve(x, v):
    """Drag that one part of the stroke has, and saturates: a product of both."""
    return 6.0 * np.exp(-(((x - 0.003) / 0.006) ** 2)) * np.tanh(v / 0.04)


def bump(x):
    return 8.0 * np.exp(-(((x - 0.004) / 0.002) ** 2))


def closed(reduced):
    return close_loop(Assembly(damper()), assign(reduced.records), NUMERICS, effects=EFFECTS)


def off_by(shape, true, own):
    """Root mean square of the difference in units of the band, beside the model's own terms."""
    difference, weight = shape.value - true, 1 / shape.sd
    beside, *_ = np.linalg.lstsq((own * weight).T, difference * weight, rcond=None)
    return float(np.sqrt(np.mean(((difference - beside @ own) * weight) ** 2)))


@pytest.mark.slow
def test_a_product_of_place_and_velocity_is_a_function_of_both(tmp_path):
    reduced = damper_campaign(tmp_path, lambda x, v, t: spring_damper_force(x, v, t) + valve(x, v))
    loop = closed(reduced)
    (accepted,) = [entry.accepted for entry in loop.rounds if entry.accepted]
    assert set(accepted.effect.removeprefix("nonparametric_").split("_and_")) == {
        "displacement", "velocity_of_displacement",
    }  # fmt: skip
    assert loop.verdict == schema.EFFECT_ADDED
    assert loop.final.hold_errors.worst_ratio() < 0.3 * loop.first.hold_errors.worst_ratio()
    assert accepted.closest
    assert max(cosine**2 for _, cosine in accepted.closest) < 0.95
    (shape,) = shapes(loop.final)
    place = dict(zip((axis.name for axis in shape.axes), shape.places, strict=True))
    x, v = place["displacement"], place["velocity of displacement"]
    inside = (np.abs(x) < 0.006) & (np.abs(v) < 0.05)
    own = np.stack([x, x**3, v, np.ones_like(x)])[:, inside]
    part = replace(shape, value=shape.value[inside], sd=shape.sd[inside])
    assert off_by(part, valve(x, v)[inside], own) < 2.0


def swept(folder):
    """Displacements that nothing repeats: sums of sines of frequencies without a common one."""
    runs = []
    for k, role in enumerate(("fit", "fit", "hold-out", "hold-out")):
        rng = np.random.default_rng(k)
        time = np.arange(0.0, 12.0, 0.005)
        omega, phase = 2 * np.pi * rng.uniform(0.3, 2.0, 5), rng.uniform(0, 6, 5)
        x = 0.004 * np.sin(np.outer(time, omega) + phase).sum(axis=1)
        v = 0.004 * (np.cos(np.outer(time, omega) + phase) @ omega)
        force = spring_damper_force(x, v, time) + bump(x)
        samples = {"displacement": x, "force": force + 0.5 * rng.standard_normal(time.size)}
        runs.append(SimulatedRun(f"{k}", time, samples, role=role, kind="transient"))
    write_campaign(
        folder, name="swept", channels=DAMPER_CHANNELS, runs=runs, controlled="displacement"
    )
    return reduce_campaign(load_campaign(folder), jobs=1)


@pytest.mark.slow
def test_transients_show_a_bump_along_the_stroke_with_its_shape(tmp_path):
    loop = closed(swept(tmp_path))
    assert loop.effects == ("nonparametric_displacement",)
    # A name that helped at first may have been removed again.
    *_, accepted = [entry.accepted for entry in loop.rounds if entry.accepted]
    assert accepted.closest
    (shape,) = shapes(loop.final)
    x = shape.places[0]
    own = np.stack([x, x**3, np.ones_like(x)])
    assert off_by(shape, bump(x), own) < 2.0
    assert loop.final.hold_errors.worst_ratio() < 0.4 * loop.first.hold_errors.worst_ratio()
