"""Inputs that are held from one sample to the next act half a sample after a line between them."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.data import SimulatedRun, load_campaign, reduce_campaign, write_campaign
from bayesoleo.data._held_inputs import between_samples, count_steps, held_harmonics
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._state import fit_state
from bayesoleo.errors import DataWarning
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction._records import Harmonics

STEP, LAG, NOISE = 0.05, 0.4, 1e-4


def command(rng, size=600):
    """A random telegraph signal."""
    return np.where(np.cumsum(rng.random(size) < 0.08) % 2, 1.0, -1.0)


def answered(u):
    """Of a first-order lag whose input is held between samples: exact."""
    y, decay = np.zeros(u.size), np.exp(-STEP / LAG)
    for k in range(1, u.size):
        y[k] = decay * y[k - 1] + (1.0 - decay) * u[k - 1]
    return y


def model():
    return Model(
        "actuator",
        dofs={"y": Dof("m")},
        inputs={"u": "V"},
        parameters={
            "lag": Parameter(0.3, "s", relative_sd=0.5),
            "gain": Parameter(1.0, "m/V", fixed=True),
        },
        equations={"y": "lag*dot(y) + y - gain*u"},
        outputs={"travel": Output("y", "m")},
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    rng, place = np.random.default_rng(3), tmp_path_factory.mktemp("held")
    runs = []
    for label, role in (("a", "fit"), ("b", "fit"), ("c", "hold-out")):
        u = command(rng)
        y = answered(u) + NOISE * rng.standard_normal(u.size)
        samples = {"u": u + 1e-3 * rng.standard_normal(u.size), "travel": y}
        time = STEP * np.arange(u.size)
        runs.append(SimulatedRun(label, time, samples, None, role=role, kind="transient"))
    channels = {"u": ("u_V", "V"), "travel": ("y_m", "m")}
    write_campaign(place, name="held", channels=channels, runs=runs, overwrite=True)
    return place


def declared(folder, held):
    file = folder / "campaign.toml"
    text = file.read_text().replace("held = true\n", "")
    text = text.replace("[channels.u]\n", "[channels.u]\nheld = true\n") if held else text
    file.write_text(text)
    return reduce_campaign(load_campaign(folder), jobs=1)


@pytest.mark.slow
def test_a_held_input_acts_half_a_sample_later(folder):
    found = {}
    for held in (True, False):
        state = fit_state(
            Assembly(model(), "u", starts=True), assign(declared(folder, held).records),
            Numerics(jobs=1, backend="numpy"),
        )  # fmt: skip
        found[held] = state.fit.values["lag"], state.worst_ratio
    # What steps hold above half the sampling rate is left out: a thirtieth of a sample.
    assert found[True][0] == pytest.approx(LAG, abs=0.05 * STEP)
    assert found[False][0] == pytest.approx(LAG + 0.5 * STEP, abs=0.1 * STEP)
    assert found[False][1] > 3.0 * found[True][1]


def test_harmonics_of_a_held_input_are_those_of_its_steps():
    """Against a fine sampling of the steps themselves."""
    rng, size, fine = np.random.default_rng(0), 64, 2048
    values = rng.standard_normal(size)
    orders = np.arange(6)
    sampled = np.fft.rfft(values)[orders] / size
    held = np.repeat(values, fine)
    # The mean of a step lies in its middle, half a fine step after its first sample.
    exact = np.fft.rfft(held)[orders] / held.size * np.exp(-1j * np.pi * orders / held.size)
    item = Harmonics(orders, sampled, np.ones(6))
    found = held_harmonics(item, 1.0, 1.0 / size)
    np.testing.assert_allclose(found.coefficients, exact, atol=1e-6)
    assert found.variances[0] == 1.0
    assert (np.diff(found.variances) < 0).all()


@pytest.mark.parametrize("noise", [0.0, 0.02])
def test_steps_are_told_from_what_moves_smoothly(noise):
    rng = np.random.default_rng(1)
    time = STEP * np.arange(1000)
    steps = command(rng, 1000)
    dither = noise * rng.standard_normal(1000)
    assert count_steps(steps + dither) == np.count_nonzero(np.diff(steps))
    single = np.where(time > 20.0, 1.0, 0.0)
    assert count_steps(single + dither) == 1
    pulse = np.exp(-0.5 * ((time - 25.0) / 0.2) ** 2)
    for smooth in (np.sin(3.0 * time), rng.standard_normal(1000), np.zeros(1000), time, pulse):
        assert count_steps(smooth + dither) == 0


def test_samples_of_a_held_course_are_those_of_its_harmonics():
    """Inside a record they are delayed and weakened as its harmonics are."""
    time = np.arange(400)
    for frequency in (0.01, 0.05, 0.1):
        found = between_samples(np.cos(2 * np.pi * frequency * time))
        expected = np.sinc(frequency) * np.cos(2 * np.pi * frequency * (time - 0.5))
        # The next term of the series is 3e-3 at a tenth of the sampling rate.
        error = np.abs(found - expected)[2:-2].max()
        assert error < 30.0 * frequency**4
    assert between_samples(np.full(5, 2.0)) == pytest.approx(2.0)


@pytest.mark.slow
def test_a_warning_says_what_steps_may_feign(folder):
    with pytest.warns(DataWarning, match=r"held = true under \[channels\.u\].*0\.025 s, half"):
        prepare(declared(folder, False), model(), Settings(jobs=1))
    prepare(declared(folder, True), model(), Settings(jobs=1))  # a warning would be an error


def test_held_is_true_or_false(folder):
    declared(folder, True)
    file = folder / "campaign.toml"
    file.write_text(file.read_text().replace("held = true", 'held = "yes"'))
    with pytest.raises(Exception, match=r"channels\.u\.held.*true or false"):
        load_campaign(folder)
    file.write_text(file.read_text().replace('held = "yes"\n', ""))


@pytest.mark.parametrize("frequency", [0.02, 0.2, 3.0])
@pytest.mark.parametrize("digit", [0.002, 0.03])
@pytest.mark.parametrize("noise", [0.0, 0.1, 0.3, 1.0])
def test_digits_of_a_converter_are_no_steps(frequency, digit, noise):
    rng, time = np.random.default_rng(0), 0.01 * np.arange(4000)
    values = np.sin(2 * np.pi * frequency * time) + noise * digit * rng.standard_normal(time.size)
    assert count_steps(np.round(values / digit) * digit) == 0


@pytest.mark.parametrize("noise", [0.0, 0.001, 0.02])
@pytest.mark.parametrize("levels", [2, 3, 5])
def test_steps_between_a_few_levels_are_counted(levels, noise):
    rng = np.random.default_rng(0)
    values = (np.cumsum(rng.random(4000) < 0.05) * (levels - 1) % levels).astype(float)
    steps = np.count_nonzero(np.diff(values))
    assert count_steps(values + noise * rng.standard_normal(4000)) == steps


@pytest.mark.parametrize("jump", [0.03, 0.3, 1.0])
@pytest.mark.parametrize("noise", [0.001, 0.01])
def test_jumps_of_a_course_that_goes_on_are_no_steps(jump, noise):
    """A measured force jumps where friction turns its sign, and moves between."""
    rng, time = np.random.default_rng(0), np.linspace(0.0, 1.0, 4000)
    for cycles in (1, 4):
        angle = 2 * np.pi * cycles * time
        values = np.sin(angle) + jump * np.sign(np.cos(angle))
        assert count_steps(values + noise * rng.standard_normal(time.size)) == 0


@pytest.mark.parametrize("length", [5, 20, 100])
@pytest.mark.parametrize("noise", [0.02, 0.05])
@pytest.mark.parametrize("levels", ["normal", "uniform", "two"])
def test_steps_of_any_height_are_seen_beside_noise(length, noise, levels):
    """Small steps drown in it, and levels on both sides are taken for one."""
    seen = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        count = 4000 // length
        heights = {
            "normal": rng.standard_normal(count),
            "uniform": rng.uniform(-1.7, 1.7, count),
            "two": rng.choice([-1.0, 1.0], count),
        }[levels]
        seen += count_steps(np.repeat(heights, length) + noise * rng.standard_normal(4000)) > 0
    assert seen >= 8
