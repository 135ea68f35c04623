"""A channel of a transient that shows nothing but its sensor's noise moves no model."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.data import (
    SimulatedRun,
    data_warnings,
    load_campaign,
    reduce_campaign,
    write_campaign,
)

NOISE, STEP, SIZE = 0.02, 1e-3, 1500
TIME = STEP * np.arange(SIZE)
#: What the force of a transient is beside its noise, and whether it stays.
SIGNALS = {
    "nothing": (lambda rng: np.zeros(SIZE), False),
    "an offset": (lambda rng: np.full(SIZE, 0.3), False),
    "a random force": (lambda rng: 3 * NOISE * rng.standard_normal(SIZE), True),
    "a sine of twice the noise's size": (lambda rng: 2 * NOISE * np.sin(40 * TIME), True),
    "a blow": (lambda rng: np.exp(-(((TIME - 0.2) / 0.01) ** 2)), True),
    "slow drift": (lambda rng: 0.1 * TIME, True),
}


def campaign(folder, rng, signal, *, others):
    """A transient of a body with this force, beside runs that tell the noise of its channel."""

    def run(label, force, motion, frequency=None):
        noisy = {
            "force": force + NOISE * rng.standard_normal(SIZE),
            "place": motion + 1e-3 * rng.standard_normal(SIZE),
        }
        kind = "periodic" if frequency else "transient"
        return SimulatedRun(label, TIME, noisy, frequency, kind=kind)

    runs = [run("decay", signal, np.exp(-3 * TIME) * np.cos(60 * TIME))]
    turn = 2 * np.pi * 10 * TIME
    if others == "periodic":
        runs.append(run("sine", 5 * np.sin(turn), np.sin(turn), 10.0))
    if others == "transient":
        runs.append(run("sweep", 5 * np.sin(turn * (1 + TIME)), np.sin(turn)))
    channels = {"force": ("F", "N"), "place": ("x", "mm")}
    write_campaign(folder, name="quiet", channels=channels, runs=runs)
    return reduce_campaign(load_campaign(folder), jobs=1)


def force_of(reduced):
    record = next(one for one in reduced.records if one.label == "decay")
    return record, record.signals["force"].evaluate(record.position, record.rate)


@pytest.mark.slow
@pytest.mark.parametrize("others", ["periodic", "transient"])
@pytest.mark.parametrize("name", SIGNALS)
def test_only_what_is_noise_alone_counts_as_constant(tmp_path, name, others):
    make, stays = SIGNALS[name]
    for seed in range(5):
        rng = np.random.default_rng(seed)
        signal = make(rng)
        reduced = campaign(tmp_path / str(seed), rng, signal, others=others)
        record, force = force_of(reduced)
        told = [text for text in data_warnings(reduced.records) if "counts as constant" in text]
        assert bool(told) is not stays
        if stays:
            assert np.std(force) > 0.5 * np.std(signal)
            continue
        assert "run decay: force shows nothing but the noise" in told[0]
        # The mean of so many samples, five standard deviations of it.
        assert force == pytest.approx(np.full(SIZE, signal[0]), abs=5 * NOISE / np.sqrt(SIZE))
        assert np.std(record.samples["force"]) > 0.9 * NOISE  # what was measured stays
        # Noise of a sample by some hundred differences.
        assert record.signal_noise["force"] == pytest.approx(NOISE, rel=0.15)


def test_alone_a_flat_spectrum_may_be_that_of_a_force(tmp_path):
    rng = np.random.default_rng(1)
    reduced = campaign(tmp_path, rng, np.zeros(SIZE), others="none")
    _, force = force_of(reduced)
    assert np.std(force) > 0.9 * NOISE
    assert not any("counts as constant" in text for text in data_warnings(reduced.records))


@pytest.mark.parametrize("repeats", [10.0, 9.5], ids=["settled", "not periodic"])
def test_a_random_force_below_the_noise_of_stronger_runs_stays(tmp_path, repeats):
    """The noise of a run with a large force may be of its amplifier: the smallest one counts. What
    does not repeat where the motion does not is no noise."""
    rng = np.random.default_rng(2)

    def run(label, force, noise, frequency=None, repeats=10.0):
        samples = {
            "force": force + noise * rng.standard_normal(SIZE),
            "place": np.sin(2 * np.pi * repeats * TIME) + 1e-3 * rng.standard_normal(SIZE),
        }
        kind = "periodic" if frequency else "transient"
        return SimulatedRun(label, TIME, samples, frequency, kind=kind)

    turn = 2 * np.pi * 10 * TIME
    runs = [
        run("decay", 0.3 * rng.standard_normal(SIZE), NOISE),
        run("weak", np.sin(turn), NOISE, 10.0, repeats),
    ]
    if repeats == 10.0:
        runs.append(run("strong", 50 * np.sin(turn), 50 * NOISE, 10.0))
        runs.append(run("stronger", 99 * np.sin(turn), 99 * NOISE, 10.0))
    channels = {"force": ("F", "N"), "place": ("x", "mm")}
    write_campaign(tmp_path, name="levels", channels=channels, runs=runs)
    record, force = force_of(reduce_campaign(load_campaign(tmp_path), jobs=1))
    assert np.std(force) == pytest.approx(np.std(record.samples["force"]), rel=1e-6)
