"""The noise of a channel that jumps is that beside its jumps; other signals keep theirs."""

from __future__ import annotations

from math import comb

import numpy as np
import pytest
from scipy.signal import chirp, lfilter

from bayesoleo.data import SimulatedRun, load_campaign, reduce_campaign, write_campaign
from bayesoleo.data._noise import jumps, noise_beside_jumps, scatter_about_levels
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._state import fit_state
from bayesoleo.model import Model, Output, Parameter

NOISE, SIZE = 0.01, 4000
TIME = np.arange(SIZE)


def switched(rng, levels, part, size=SIZE):
    """One of few levels, another after each sample with this probability."""
    moves = (rng.random(size) < part) * rng.integers(1, len(levels), size)
    return np.array(levels)[np.cumsum(moves) % len(levels)]


def of_squares(values):
    """The noise by the mean square of differences, whatever the signal does."""
    found = []
    for order in range(2, 9):
        found.append(np.sqrt(np.mean(np.diff(values, order) ** 2) / comb(2 * order, order)))
        if len(found) > 1 and found[-1] > 0.98 * found[-2]:
            break
    return min(found)


def force_with_friction(rng):
    return np.sin(TIME / 32) + 0.3 * np.sign(np.cos(TIME / 32))


JUMPING = {
    "three levels": lambda rng: switched(rng, [-6.0, 0.0, 6.0], 0.01),
    "two levels, often": lambda rng: switched(rng, [0.0, 5.0], 0.2),
    "low steps": lambda rng: switched(rng, [0.0, 0.15], 0.02),
    "a filter before the converter": lambda rng: np.convolve(
        switched(rng, [0.0, 5.0], 0.01), [0.25, 0.5, 0.25], "same"
    ),
    "levels of any height": lambda rng: np.repeat(rng.standard_normal(SIZE // 20), 20),
    "current that decays": lambda rng: lfilter(
        [1, -1], [1, -0.97], switched(rng, [0.0, 5.0], 0.01)
    ),
    "friction": force_with_friction,
    "charge behind a switch": lambda rng: lfilter(
        [0.04], [1, -0.96], switched(rng, [0.0, 20.0], 0.01)
    ),
}
OTHERS = {
    "sine": lambda rng: np.sin(TIME / 32),
    "seven samples a period": lambda rng: np.sin(2 * np.pi * TIME / 7.3),
    "sweep": lambda rng: chirp(TIME, 5e-4, SIZE, 0.1),
    "sweep to a third of the sampling rate": lambda rng: chirp(TIME, 5e-4, SIZE, 0.3),
    "broadband": lambda rng: rng.standard_normal(SIZE),
    "low-pass": lambda rng: lfilter([0.05], [1, -0.95], rng.standard_normal(SIZE)),
    "random walk": lambda rng: np.cumsum(rng.standard_normal(SIZE)),
    "coloured": lambda rng: lfilter([1], [1, -0.9], rng.standard_normal(SIZE)),
    "heavy tails": lambda rng: 0.1 * rng.standard_t(3, SIZE),
    "outliers": lambda rng: np.where(rng.random(SIZE) < 0.005, 1.0, 0.0),
    "bursts": lambda rng: np.where(TIME // 50 % 2, 1.0, 0.02) * rng.standard_normal(SIZE),
    "pulse": lambda rng: np.exp(-0.5 * (TIME - 2000.3) ** 2),
    "decay": lambda rng: np.exp(-TIME / 50) * np.cos(TIME / 5),
    "triangle": lambda rng: np.abs(TIME / 100 % 2 - 1),
}


@pytest.mark.parametrize("kind", JUMPING)
@pytest.mark.parametrize("seed", range(3))
def test_jumps_are_no_noise(kind, seed):
    rng = np.random.default_rng(seed)
    values = JUMPING[kind](rng) + NOISE * rng.standard_normal(SIZE)
    # About a thousand differences of order two at least: known to 4 %; three times that.
    assert noise_beside_jumps(values) == pytest.approx(NOISE, rel=0.12)
    assert of_squares(values) > 1.2 * NOISE


@pytest.mark.parametrize("kind", OTHERS)
@pytest.mark.parametrize("size", [40, 400, SIZE])
@pytest.mark.parametrize("seed", range(3))
def test_what_does_not_jump_keeps_its_noise(kind, size, seed):
    rng = np.random.default_rng(seed)
    values = (OTHERS[kind](rng) + NOISE * rng.standard_normal(SIZE))[:size]
    assert not jumps(values).any()
    assert noise_beside_jumps(values) == pytest.approx(of_squares(values), rel=1e-12)


@pytest.mark.parametrize("noise", [0.0, 0.3, 1.0])
def test_digits_of_a_converter_are_no_jumps(noise):
    digit, rng = 0.05, np.random.default_rng(0)
    values = np.sin(TIME / 64) + noise * digit * rng.standard_normal(SIZE)
    assert not jumps(np.round(values / digit) * digit).any()
    assert scatter_about_levels(np.round(values / digit) * digit) == np.inf


@pytest.mark.parametrize("levels", [[0.0, 5.0], [-6.0, 0.0, 6.0]])
@pytest.mark.parametrize("part", [0.01, 0.5, 0.9, 1.0])
def test_scatter_about_levels_is_the_noise_however_often_they_change(levels, part):
    rng = np.random.default_rng(1)
    values = switched(rng, levels, part) + NOISE * rng.standard_normal(SIZE)
    assert scatter_about_levels(values) == pytest.approx(NOISE, rel=0.04)


@pytest.mark.parametrize("kind", OTHERS)
def test_other_signals_have_no_levels(kind):
    rng = np.random.default_rng(2)
    assert scatter_about_levels(OTHERS[kind](rng) + NOISE * rng.standard_normal(SIZE)) == np.inf


@pytest.mark.slow
def test_noise_of_a_held_channel_in_a_record(tmp_path):
    """Switched at leisure, switched at every sample, and a command of any value at every sample."""
    rng, size = np.random.default_rng(3), 1000
    samples = {
        "slow": switched(rng, [-6.0, 0.0, 6.0], 0.02, size) + NOISE * rng.standard_normal(size),
        "fast": switched(rng, [-6.0, 0.0, 6.0], 0.95, size) + NOISE * rng.standard_normal(size),
        "any": rng.standard_normal(size),
        "sine": np.sin(np.arange(size) / 32) + NOISE * rng.standard_normal(size),
    }
    channels = {name: (name, "V") for name in samples}
    run = SimulatedRun("a", 0.01 * np.arange(size), samples, None, kind="transient")
    write_campaign(tmp_path, name="n", channels=channels, runs=[run])
    free = reduce_campaign(load_campaign(tmp_path)).records[0].signal_noise
    file = tmp_path / "campaign.toml"
    text = file.read_text()
    for name in samples:
        text = text.replace(f"[channels.{name}]", f"[channels.{name}]\nheld = true")
    file.write_text(text)
    held = reduce_campaign(load_campaign(tmp_path)).records[0].signal_noise
    for name in ("slow", "fast", "sine"):
        # Also the lowest part of the spectrum, which is the lowest of eight.
        assert free[name] == pytest.approx(NOISE, rel=0.15)
        assert held[name] == free[name]
    # White noise on nothing, or a command: only who declares it knows.
    assert free["any"] == pytest.approx(1.0, rel=0.15)
    assert np.isnan(held["any"])


TIME_CONSTANT, STEP, INPUT_NOISE = 0.1, 1e-3, 7e-3


def circuit(seed, size=3000):
    """A resistor and a capacitor behind a switch that a controller holds, exactly."""
    rng = np.random.default_rng(seed)
    u = switched(rng, [0.0, 5.0], 0.01, size)
    decay = np.exp(-STEP / TIME_CONSTANT)
    charge = lfilter([0.0, 1.0 - decay], [1.0, -decay], u)
    samples = {
        "u": u + INPUT_NOISE * rng.standard_normal(size),
        "uc": charge + 2e-3 * rng.standard_normal(size),
    }
    return SimulatedRun(str(seed), STEP * np.arange(size), samples, None, kind="transient")


@pytest.mark.slow
def test_noise_of_a_switched_input_is_expected_at_the_output(tmp_path):
    """A right model was said to lack something: it answers to the noise of its measured input."""
    channels = {"u": ("u", "V"), "uc": ("uc", "V")}
    write_campaign(tmp_path, name="rc", channels=channels, runs=[circuit(k) for k in range(3)])
    file = tmp_path / "campaign.toml"
    file.write_text(file.read_text().replace("[channels.u]", "[channels.u]\nheld = true"))
    records = reduce_campaign(load_campaign(tmp_path)).records
    for record in records:
        assert record.smoothed["u"].noise == record.signal_noise["u"]
        assert record.signal_noise["u"] == pytest.approx(INPUT_NOISE, rel=0.1)
    model = Model(
        "circuit",
        inputs={"u": "V"},
        dofs={"charge": "V"},
        parameters={"tau": Parameter(0.15, "s", relative_sd=0.5)},
        equations={"charge": "tau*dot(charge) + charge - u"},
        outputs={"uc": Output("charge", "V")},
    )
    state = fit_state(Assembly(model, None), assign(records), Numerics(jobs=1))
    squares = [entry.ratio_to_expected**2 for entry in state.fit_errors.entries]
    ratio = float(np.sqrt(np.mean(squares)))
    # Noise through a lag has some hundred independent values in a run, known to a tenth in three;
    # without the noise of the input the ratio is 1.3.
    assert ratio == pytest.approx(1.0, abs=0.15)
