"""Foreign lines, coarse steps and ends that are cut off are found, and only where they are."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from small_campaigns import damper_campaign, spring_damper_force

from bayesoleo.data import data_warnings
from bayesoleo.data._harmonics import foreign_line, foreign_lines
from bayesoleo.data._sample_quality import (
    clipped,
    repeating_rounding,
    rounding_that_repeats,
    step_of,
)
from bayesoleo.prediction._records import transient_record

FREQUENCY, STEP, SAMPLES = 2.0, 1 / 1000.0, 5000


def signal(rng, noise=0.1):
    t = STEP * np.arange(SAMPLES)
    return t, np.sin(2 * np.pi * FREQUENCY * t) + noise * rng.standard_normal(SAMPLES)


def test_a_foreign_line_is_found_with_its_frequency_and_amplitude():
    t, x = signal(np.random.default_rng(1))
    line = foreign_line(x + 0.05 * np.sin(2 * np.pi * 50.3 * t), STEP, FREQUENCY)
    assert line is not None
    assert line.frequency == pytest.approx(50.3, abs=1 / (SAMPLES * STEP))
    # Between two lines of the spectrum 2 / pi of an amplitude is left.
    assert 0.6 * 0.05 < line.amplitude < 1.1 * 0.05
    assert line.p_value < 1e-6


@pytest.mark.statistical
def test_noise_has_a_line_no_oftener_than_said():
    rng = np.random.default_rng(2)
    lines = [foreign_line(signal(rng)[1], STEP, FREQUENCY) for _ in range(200)]
    few = sum(line is not None and line.p_value < 0.05 for line in lines)
    # Ten are expected; more than twenty come once in 1000 times.
    assert few <= 20


def test_a_line_at_a_harmonic_is_not_foreign():
    t, x = signal(np.random.default_rng(3))
    line = foreign_line(x + 0.05 * np.sin(2 * np.pi * 50.0 * t), STEP, FREQUENCY)
    assert line is None or line.p_value > 1e-3


@pytest.mark.parametrize("step", [0.02, 1 / 3])
def test_the_step_of_a_grid(step):
    x = signal(np.random.default_rng(4), 0.01)[1] * 4
    assert step_of(np.round(x / step) * step) == pytest.approx(step, rel=1e-6)
    assert step_of(x) == 0.0


def test_rounding_that_repeats_is_what_is_measured():
    """Against a simulation: the mean of many roundings of the same values with new noise."""
    rng, step = np.random.default_rng(5), 1.0
    values = rng.uniform(0, 50, 4000)
    for noise in (0.0, 0.2, 0.35):
        mean = np.zeros_like(values)
        for _ in range(800):
            mean += np.round(values + noise * rng.standard_normal(values.size)) / 800
        left = float(np.std(mean - values))
        # What noise leaves of an average over 800, and the scatter of a standard deviation.
        floor = np.sqrt(noise**2 + step**2 / 12) / np.sqrt(800)
        expected = np.hypot(repeating_rounding(step, noise), floor if noise else 0.0)
        assert left == pytest.approx(expected, rel=0.06)


@pytest.mark.parametrize("noise", [0.0, 0.1, 0.2, 0.4])
def test_rounding_that_repeats_follows_from_what_scatters(noise):
    """The same phases in 400 periods: what the mean is off by, by the scatter about it alone."""
    rng, step = np.random.default_rng(6), 0.5
    clean = 10 * np.sin(2 * np.pi * np.arange(997) / 997) + 0.123
    rounded = step * np.round((clean + step * noise * rng.standard_normal((400, 997))) / step)
    mean = rounded.mean(axis=0)
    scatter = float(np.sqrt(np.sum((rounded - mean) ** 2) / 399 / 997))
    off = np.mean((mean - clean) ** 2) - scatter**2 / 400
    found = rounding_that_repeats(step, scatter)
    # A thousand errors of rounding, each known to the noise of a mean.
    assert found**2 == pytest.approx(off, rel=0.05, abs=0.15 * scatter**2 / 400)


def test_findings_name_what_is_wrong_with_a_channel(tmp_path):
    reduced = damper_campaign(tmp_path, spring_damper_force, periods=16)
    records, units = reduced.records, reduced.campaign.units
    assert data_warnings(records, units) == []
    record = records[0]
    force, t = record.samples["force"], record.time
    cut = replace(record, samples={**record.samples, "force": np.minimum(force, 10.0)})
    (text,) = data_warnings([cut], units)
    assert "force is cut off at its highest value, 10 N," in text
    coarse = replace(record, samples={**record.samples, "force": np.round(force / 2.0) * 2.0})
    (text,) = data_warnings([coarse], units)
    assert "force goes in steps of 2 N," in text
    hum = replace(record, samples={**record.samples, "force": force + np.sin(2 * np.pi * 17.3 * t)})
    (text,) = data_warnings([hum], units)
    assert re.search(r"force has a line at 17\.3\d* Hz with the amplitude \S+ N, ", text)


@pytest.mark.parametrize("held", [1, 5, 40])
def test_a_signal_that_is_switched_is_not_cut_off(tmp_path, held):
    record = damper_campaign(tmp_path, spring_damper_force).records[0]
    rng = np.random.default_rng(4)
    for levels in ([-1.0, 1.0], [0.0, 1.0, 2.0, 3.0]):
        values = np.repeat(rng.choice(levels, record.time.size), held)[: record.time.size]
        if held == 1:  # the random binary signal of a converter: four in a row do occur
            assert np.any(np.convolve(np.abs(np.diff(values)), np.ones(3), "valid") == 0.0)
        assert clipped(replace(record, samples={"force": values})) == ()
    # A rounded signal that creeps up to where it is cut off does not jump there.
    slow = np.round(50 * np.sin(np.linspace(0.0, 12.0, record.time.size)))
    (found,) = clipped(replace(record, samples={"force": np.minimum(slow, 40.0)}))
    assert found.end == "highest"


def test_rounding_of_a_signal_without_noise_has_no_line(tmp_path):
    record = damper_campaign(tmp_path, spring_damper_force, periods=16).records[0]
    clean = 30.0 * np.sin(2 * np.pi * record.frequency * record.time)
    line = 1e-11 * np.sin(2 * np.pi * 17.3 * record.time)
    noise = {**record.signal_noise, "force": 1e-12}
    assert foreign_lines(replace(record, samples={"force": clean + line}, signal_noise=noise)) == ()
    loud = replace(record, samples={"force": clean + 1e6 * line}, signal_noise=noise)
    assert len(foreign_lines(loud)) == 1


def decay(rng, noise):
    """A swing that dies away, cut in two, on one clock."""
    t, _ = signal(rng)
    x = np.exp(-0.2 * t) * np.cos(2 * np.pi * FREQUENCY * t) + noise * rng.standard_normal(t.size)
    return [(t[:2500], x[:2500]), (t[2500:], x[2500:])]


def about_pieces(*records):
    made = [transient_record(f"{k + 1}", t, {"x": x}) for k, (t, x) in enumerate(records)]
    return [text for text in data_warnings(made) if "pieces of one record" in text]


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_pieces_of_one_record_are_said_to_be_so(noise):
    first, second = decay(np.random.default_rng(3), noise)
    other = first[0], 2.0 * first[1]
    for several in ((first, second), (first, second, other)):
        (said,) = about_pieces(*several)
        assert said.startswith("runs 1, 2 seem to be pieces of one record")
    (said,) = about_pieces(second, first)
    assert said.startswith("runs 2, 1 seem to be pieces of one record")


def test_records_of_their_own_are_no_pieces():
    first, second = decay(np.random.default_rng(3), 0.001)
    anew = second[0] - second[0][0], second[1]  # a clock of its own
    elsewhere = second[0], second[1] + 0.5  # it was let go again
    later = second[0] + 3 * STEP, second[1]
    for other in (anew, elsewhere, later, first):
        assert not about_pieces(first, other)


@pytest.mark.slow
def test_what_rests_or_is_noise_alone_goes_on_nowhere():
    rng, t = np.random.default_rng(4), STEP * np.arange(1000)
    for still in (np.full(1000, 2.0), rng.standard_normal(1000)):
        assert not about_pieces((t[:500], still[:500]), (t[500:], still[500:]))
