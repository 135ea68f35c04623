"""Records on a grid, trends over a record, and what reduce warns of."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from small_campaigns import damper_campaign

from bayesoleo.data import (
    SimulatedRun,
    data_warnings,
    drift,
    load_campaign,
    on_grid,
    period_search,
    reduce_campaign,
    write_campaign,
)
from bayesoleo.data._data_warnings import (
    frequency_warnings,
    motions_per_period,
    periods_per_motion,
)
from bayesoleo.errors import InputError

PER_PERIOD, PERIODS = 200.37, 6
FREQUENCY = 2.0
STEP = 1 / (PER_PERIOD * FREQUENCY)
TIME = STEP * np.arange(int(PERIODS * PER_PERIOD))


def signal(phase):
    return 1.0 + np.sin(2 * np.pi * phase) + 0.3 * np.cos(6 * np.pi * phase)


def test_band_limited_map_is_exact():
    grid = on_grid(signal(FREQUENCY * TIME), STEP, FREQUENCY, 800)
    np.testing.assert_allclose(grid, signal(np.arange(800) / 800), atol=1e-9)


@pytest.mark.parametrize("period", [0, 2, PERIODS - 1])
def test_linear_map_errs_by_the_square_of_the_interval(period):
    errors = []
    for finer in (1, 2):
        step = STEP / finer
        time = step * np.arange(int(np.ceil(PERIODS / (FREQUENCY * step))))
        values = signal(FREQUENCY * time)
        grid = on_grid(values, step, FREQUENCY, 800, method="linear", period=period)
        errors.append(np.abs(grid - signal(np.arange(800) / 800)).max())
    # second derivative 150 per cycle squared, over eight samples a period squared
    assert errors[0] < 150 / 8 / PER_PERIOD**2
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.5)


def test_unknown_map_and_missing_period_are_named():
    values = signal(FREQUENCY * TIME)
    with pytest.raises(InputError, match="use 'band-limited' or 'linear'"):
        on_grid(values, STEP, FREQUENCY, 10, method="spline")
    with pytest.raises(InputError, match="it holds 5"):
        on_grid(values[:-150], STEP, FREQUENCY, 10, method="linear", period=5)


def noisy(rng, mean=0.0, amplitude=0.0, coefficient=0.0):
    trend = TIME / TIME[-1] - 0.5
    swing = signal(FREQUENCY * TIME) - 1
    white = rng.standard_normal(TIME.size)
    if coefficient:
        for k in range(1, TIME.size):
            white[k] += coefficient * white[k - 1]
        white *= np.sqrt(1 - coefficient**2)
    return 1 + (1 + amplitude * trend) * swing + mean * trend + 0.05 * white


def test_trends_are_measured_within_their_errors():
    rng = np.random.default_rng(0)
    found = [drift(noisy(rng, 0.04, -0.03), STEP, FREQUENCY) for _ in range(40)]
    for key, true in (("mean", 0.04), ("amplitude", -0.03)):
        scores = [(getattr(d, key) - true) / getattr(d, f"{key}_sd") for d in found]
        # 40 standard normal scores: mean within 3 / sqrt(40), sd within 3 / sqrt(80)
        assert abs(np.mean(scores)) < 0.48
        assert np.std(scores) == pytest.approx(1.0, abs=0.34)
    assert np.median([d.p_value for d in found]) < 1e-3
    assert found[0].noise == pytest.approx(0.05, rel=0.1)


@pytest.mark.statistical
@pytest.mark.parametrize("coefficient", [0.0, 0.7])
def test_without_trend_probabilities_are_those_of_chance(coefficient):
    rng = np.random.default_rng(1)
    scores = []
    for _ in range(300):
        found = drift(noisy(rng, coefficient=coefficient), STEP, FREQUENCY)
        scores.append(found.mean / found.mean_sd)
    # Kolmogorov's distance of 300 draws exceeds 0.094 once in a hundred; the smoothed spectrum of
    # coloured noise is low at its left end by a few per cent
    assert stats.kstest(scores, "norm").statistic < 0.12


def reduced(folder, build, frequency=FREQUENCY, force=signal, noise=0.1):
    rng = np.random.default_rng(3)
    x = build(rng)
    force = 3 * force(FREQUENCY * TIME) + noise * rng.standard_normal(TIME.size)
    run = SimulatedRun("only", TIME, {"displacement": x, "force": force}, frequency)
    channels = {"displacement": ("x_m", "m"), "force": ("f_N", "N")}
    write_campaign(folder, name="one", channels=channels, runs=[run])
    return reduce_campaign(load_campaign(folder), jobs=1)


def test_drift_is_told_with_its_size(tmp_path):
    (sentence,) = data_warnings(reduced(tmp_path, lambda rng: noisy(rng, mean=0.1)).records)
    assert sentence.startswith("run only: displacement drifts, its mean moves by 0.")
    assert "cut the run with start or stop" in sentence


def test_settled_record_gives_no_sentence(tmp_path):
    assert data_warnings(reduced(tmp_path, noisy).records) == []


def test_half_the_frequency_is_found_out(tmp_path):
    (record,) = reduced(tmp_path, noisy, frequency=FREQUENCY / 2).records
    assert motions_per_period(record) == 2
    (sentence,) = data_warnings([record])
    assert sentence.startswith("run only: the motion repeats 2 times in a declared period")
    assert sentence.endswith("write frequency = 2")


@pytest.mark.parametrize("part", [2, 3])
def test_a_part_of_the_frequency_is_found_out_under_noise(tmp_path, part):
    """A harmonic that noise lifts over the threshold once in a while is no motion."""
    for noise in (0.3, 1.0):
        (record,) = reduced(tmp_path / f"{noise}", noisy, FREQUENCY / part, noise=noise).records
        assert motions_per_period(record) == part


def test_advice_on_a_frequency_does_not_contradict_itself(tmp_path):
    """Of a motion with half the declared frequency and four times it, one sentence is right."""

    def both(cycles):
        return np.sin(2 * np.pi * 4 * cycles) + 0.4 * np.sin(2 * np.pi * 0.5 * cycles)

    def build(rng):
        return both(FREQUENCY * TIME) + 0.02 * rng.standard_normal(TIME.size)

    (record,) = reduced(tmp_path, build, force=both, noise=0.02).records
    assert motions_per_period(record) == 4
    (sentence,) = frequency_warnings([record])
    assert "repeats only after 2 declared periods" in sentence
    assert sentence.endswith(f"write frequency = {FREQUENCY / 2:.4g}")


def test_twice_the_frequency_does_not_repeat(tmp_path):
    with pytest.raises(InputError, match=r"does not repeat near the declared .*about 1.99. Hz"):
        reduced(tmp_path, noisy, frequency=2 * FREQUENCY)


def test_twice_the_frequency_is_found_out_where_one_channel_does_repeat(tmp_path):
    """A pressure over a stroke that goes both ways has even harmonics only."""

    def even(phase):
        return np.cos(4 * np.pi * phase)

    (record,) = reduced(tmp_path, noisy, 2 * FREQUENCY, even).records
    assert record.frequency == pytest.approx(2 * FREQUENCY, rel=1e-3)
    assert periods_per_motion(record) == (2, "displacement")
    (sentence,) = data_warnings([record])
    assert "displacement repeats only after 2 declared periods" in sentence
    assert sentence.endswith("write frequency = 2")


def test_noise_does_not_repeat_after_two_periods_either(tmp_path):
    def red(rng):
        return noisy(rng, coefficient=0.9)

    (record,) = reduced(tmp_path, red).records
    assert periods_per_motion(record) == (1, "")


def test_a_channel_in_which_nothing_repeats_is_named(tmp_path):
    def wandering(rng):
        return np.cumsum(rng.standard_normal(TIME.size))

    sentences = data_warnings(reduced(tmp_path, wandering).records)
    assert "run only: nothing in displacement repeats at 2 Hz above its noise" in sentences[0]
    assert not any("force" in sentence for sentence in sentences)


def test_a_start_that_dies_out_slowly_is_no_longer_period(tmp_path):
    """Free motion at two thirds of the frequency, a hundredth as large, comes back every third
    period."""
    time = STEP * np.arange(int(12 * PER_PERIOD))
    free = 0.01 * np.exp(-0.02 * time) * np.cos(4 / 3 * np.pi * FREQUENCY * time)
    answer = np.sin(2 * np.pi * FREQUENCY * time) + free
    samples = {"displacement": answer, "force": np.cos(2 * np.pi * FREQUENCY * time)}
    run = SimulatedRun("only", time, samples, FREQUENCY)
    channels = {"displacement": ("x_m", "m"), "force": ("f_N", "N")}
    write_campaign(tmp_path, name="one", channels=channels, runs=[run])
    (record,) = reduce_campaign(load_campaign(tmp_path), jobs=1).records
    assert record.periods >= 6
    assert periods_per_motion(record) == (1, "")


def test_rounding_of_samples_without_noise_is_no_longer_period(tmp_path):
    """Rounding repeats in some longer period, as a wrong frequency would make a motion do."""
    assert data_warnings(damper_campaign(tmp_path).records) == []


def test_parabola_ends_in_the_period():
    rng = np.random.default_rng(5)
    search = period_search(noisy(rng), STEP, 1.02 * FREQUENCY)
    assert search.frequency == pytest.approx(FREQUENCY, rel=1e-3)
    # eqs. B.1 and B.2 are two sides of one: residual = 2 (variance - covariance) away from the ends
    one = np.searchsorted(search.shifts, 100)
    expected = 2 * (np.var(noisy(rng)) - search.covariance[one])
    assert search.residual[one] == pytest.approx(expected, rel=0.05)
