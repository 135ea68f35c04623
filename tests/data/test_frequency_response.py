"""Frequency response of multisines: noise, stochastic, even and odd distortion, each by itself."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import scipy.io
from multisines import (
    FREQUENCY,
    ODD_GRID,
    PER_PERIOD,
    campaign,
    multisine,
    multisine_campaign,
    resonance,
    run,
)
from scipy import stats

from bayesoleo.data import CampaignData, ReducedCampaign, frequency_response, reduce_campaign
from bayesoleo.data._frequency_response import EXCITED, excited_orders, has_multisine, line_kinds
from bayesoleo.errors import InputError

NOISE = 0.02


def at_excited(data, name, level=0):
    lines = data["kind"].values[level] == EXCITED
    return data[name].values[0, level, lines]


def p_of(data, parity, level=0):
    return float(data["distortion_p"].sel(parity=parity).values[0, level])


def reduced(*runs, controlled="force") -> ReducedCampaign:
    return reduce_campaign(campaign(runs, controlled), jobs=1)


def static(curve):
    """One period of the answer of a law without memory."""
    return curve


# -- what the input excites -----------------------------------------------------------------------


def test_excited_lines_are_found_in_the_input():
    data = frequency_response(multisine_campaign(resonance, noise=NOISE, input_noise=0.01))
    lines = data["kind"].values[0] == EXCITED
    assert tuple(data["order"].values[lines]) == ODD_GRID
    np.testing.assert_allclose(data["frequency"].values[0, lines], FREQUENCY * np.array(ODD_GRID))
    assert data["input_rms"].values == pytest.approx([1.0], rel=1e-2)


@pytest.mark.parametrize(
    ("excited", "others", "even", "odd", "rest"),
    [
        ((1, 5), (), (2, 4, 6), (3, 7), ()),
        ((2, 6), (), (4,), (), (1, 3, 5, 7)),  # the period is twice that of the input
        ((3,), (), (6,), (), (1, 2, 4, 5, 7)),
        ((1, 2), (), (), (), ()),  # both parities are excited: all others are mixed
        ((1, 5), (2,), (), (), ()),
    ],
)
def test_kinds_of_lines(excited, others, even, odd, rest):
    kinds = line_kinds(7, np.array(excited), np.array(others, dtype=int))
    assert tuple(np.flatnonzero(kinds == "even")) == even
    assert tuple(np.flatnonzero(kinds == "odd")) == odd
    assert tuple(np.flatnonzero(kinds == "subharmonic")) == rest
    assert tuple(np.flatnonzero(kinds == EXCITED)) == excited
    assert tuple(np.flatnonzero(kinds == "other input")) == others
    assert kinds[0] == ""


def test_lines_of_a_nonlinearity_fall_where_the_kinds_say():
    """Brute force: harmonics of powers of an input, which no line of another kind may have."""
    rng = np.random.default_rng(0)
    for excited, power in product(((1, 5, 7), (2, 6, 10), (3, 9)), (2, 3, 4, 5)):
        u = multisine(excited, rng, samples=256)
        size = np.abs(np.fft.rfft(u**power)) / 128
        kinds = line_kinds(60, np.array(excited), np.empty(0, dtype=int))
        loud = set(kinds[1:][size[1:61] > 1e-9]) - {EXCITED}
        assert loud <= ({"even"} if power % 2 == 0 else {"odd"})


def test_a_weak_line_or_one_in_the_noise_is_not_excited():
    size = np.zeros(60)
    size[[1, 3, 5, 7, 50]] = 1.0, 0.5, 0.09, 0.2, 0.02
    assert excited_orders(size, np.zeros(60)).tolist() == [1, 3, 7, 50]
    noise = np.full(60, 0.03)
    assert excited_orders(size, noise).tolist() == [1, 3]
    # Of a single period no noise is known.
    assert excited_orders(size, np.full(60, np.nan)).tolist() == [1, 3, 7, 50]


def test_given_lines_are_taken_as_they_are():
    reduced = multisine_campaign(resonance, noise=NOISE, realisations=1)
    data = frequency_response(reduced, excited=ODD_GRID[:10])
    assert tuple(data["order"].values[data["kind"].values[0] == EXCITED]) == ODD_GRID[:10]


# -- what a linear system shows -------------------------------------------------------------------


def test_a_linear_system_has_its_response_and_its_noise():
    found = multisine_campaign(resonance, noise=NOISE, periods=8, realisations=4)
    data = frequency_response(found)
    ratio = np.array(ODD_GRID) / 40.0
    true = 1.0 / (1.0 - ratio**2 + 0.1j * ratio)
    away = np.abs(at_excited(data, "response") - true) / at_excited(data, "noise_sd")
    # Mean square of one, of as many complex normal numbers as there are lines.
    assert np.mean(away**2) == pytest.approx(1.0, abs=5.0 / np.sqrt(len(ODD_GRID)))
    # 2 sigma / sqrt(samples) on a harmonic, over its amplitude and the root of the realisations.
    expected = 2.0 * NOISE / np.sqrt(8 * PER_PERIOD) * np.sqrt(len(ODD_GRID) / 2) / 2.0
    np.testing.assert_allclose(np.median(at_excited(data, "noise_sd")), expected, rtol=0.1)


@pytest.mark.parametrize(
    "more",
    [
        {"periods": 2},
        {"periods": 5},
        {"periods": 4, "input_noise": 0.02},
    ],
)
@pytest.mark.statistical
def test_probabilities_of_a_linear_system_are_uniform(more):
    seeds, pooled, lines = 60, [], []
    for seed in range(seeds):
        data = frequency_response(
            multisine_campaign(resonance, 3000 + seed, noise=NOISE, realisations=3, **more)
        )
        pooled.append([p_of(data, "even"), p_of(data, "odd"), float(data["stochastic_p"][0, 0])])
        p = data["p_value"].values
        lines.append(p[np.isfinite(p)])
    for column in np.transpose(pooled):
        # Nine of these tests: at 1e-3 each, one in a hundred sets of seeds would fail.
        assert stats.kstest(column, "uniform").pvalue > 1e-3
    every = np.concatenate(lines)
    share = np.mean(every < 0.01)
    # Lines share their noise with neighbours: twice the error of independent ones, five times over.
    assert share == pytest.approx(0.01, abs=10 * np.sqrt(0.01 / every.size))


def test_noise_of_the_input_is_counted():
    """Without it the scatter of the realisations would look like a distortion."""
    data = frequency_response(
        multisine_campaign(static, noise=0.0005, input_noise=0.05, realisations=10, seed=3)
    )
    assert float(data["stochastic_p"][0, 0]) > 1e-3
    output_alone = 2 * 0.0005 / np.sqrt(4 * PER_PERIOD) * np.sqrt(len(ODD_GRID) / 2 / 10)
    assert np.median(at_excited(data, "noise_sd")) > 50 * output_alone


def test_noise_that_input_and_output_share_takes_no_part():
    """A disturbance that acts on the input, and is measured there, is no noise of the response."""
    rng = np.random.default_rng(0)
    u = multisine(ODD_GRID, rng)
    one = run("a", u, u, rng, periods=6)
    noise = 0.1 * rng.standard_normal(one.time.size)
    samples = {name: values + noise for name, values in one.samples.items()}
    data = frequency_response(reduced(replace(one, samples=samples)))
    assert at_excited(data, "noise_sd").max() < 1e-6
    assert np.abs(at_excited(data, "response") - 1.0).max() < 1e-9


# -- what a nonlinear system shows ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("law", "loud", "quiet"),
    [(lambda u: u + 0.05 * u**2, "even", "odd"), (lambda u: u + 0.05 * u**3, "odd", "even")],
)
def test_even_and_odd_distortion_fall_on_their_lines(law, loud, quiet):
    rng, levels = np.random.default_rng(1), (0.5, 1.0)
    # The same phases at both levels, so that their ratio has no scatter but noise.
    shapes = [multisine(ODD_GRID, rng) for _ in range(5)]
    runs = [
        run(f"{size} {k}", size * u, law(size * u), rng, noise=0.01, input_noise=1e-4)
        for size, (k, u) in product(levels, enumerate(shapes))
    ]
    data = frequency_response(reduced(*runs))
    assert data["realisations"].values.tolist() == [5, 5]
    assert data["input_rms"].values == pytest.approx(levels, rel=1e-3)
    for level in (0, 1):
        assert p_of(data, loud, level) < 1e-6
        assert p_of(data, quiet, level) > 1e-3
    # An odd law scatters from realisation to realisation, an even one not.
    assert (float(data["stochastic_p"][0, 1]) < 1e-6) == (loud == "odd")
    noise = data["distortion_noise"].sel(parity=loud).values[0]
    excess = np.sqrt(data["distortion"].sel(parity=loud).values[0] ** 2 - noise**2)
    # Twice the input, four or eight times the distortion.
    assert excess[1] / excess[0] == pytest.approx(4.0 if loud == "even" else 8.0, rel=0.1)


def ratios(law, inputs, lines):
    """Y / U by discrete Fourier transforms alone, shape (realisations, lines)."""
    return np.array([np.fft.rfft(law(u))[lines] / np.fft.rfft(u)[lines] for u in inputs])


@pytest.mark.slow
def test_best_linear_approximation_of_a_cubic_is_that_of_its_volterra_series():
    """Of y = u + a u^3 under random phases and F lines 1 + 3 a sigma^2 (1 - 1 / 2F), exactly."""
    a, rms, lines, rng = 0.05, 1.3, list(range(1, 20, 2)), np.random.default_rng(5)
    law = lambda u: u + a * u**3  # noqa: E731
    inputs = [multisine(lines, rng, rms, samples=256) for _ in range(20_000)]
    means = ratios(law, inputs, lines).mean(axis=1)
    error = means.real.std() / np.sqrt(means.size)
    expected = 1.0 + 3.0 * a * rms**2 * (1.0 - 0.5 / len(lines))
    assert means.mean().real == pytest.approx(expected, abs=4 * error)
    # Without the 1 / 2F it would be off by far more.
    assert 3.0 * a * rms**2 * 0.5 / len(lines) > 20 * error
    some = inputs[:40]
    runs = [run(str(k), u, law(u), rng, noise=0.01, input_noise=1e-4) for k, u in enumerate(some)]
    found = frequency_response(reduced(*runs))
    assert found["realisations"].item() == 40
    direct = ratios(law, some, lines)
    away = np.abs(at_excited(found, "response") - direct.mean(axis=0))
    assert (away < 4 * at_excited(found, "noise_sd")).all()
    total = np.std(direct, axis=0, ddof=1) / np.sqrt(40)
    np.testing.assert_allclose(at_excited(found, "total_sd"), total, rtol=0.03)


@pytest.mark.slow
def test_stochastic_distortion_of_a_cubic_is_that_of_brute_force():
    law, lines = (lambda u: u + 0.05 * u**3), list(range(1, 40, 2))
    rng = np.random.default_rng(11)
    inputs = [multisine(lines, rng, samples=256) for _ in range(2000)]
    true = np.sqrt(np.mean(np.var(ratios(law, inputs, lines), axis=0)))
    made = multisine_campaign(law, 2, noise=0.01, realisations=40, orders=lines)
    found = np.sqrt(np.mean(at_excited(frequency_response(made), "distortion_sd") ** 2))
    # 20 lines of 39 degrees of freedom each, whose scatter is correlated between lines.
    assert found == pytest.approx(true, rel=0.1)


@pytest.mark.slow
def test_total_variance_falls_with_realisations_and_not_with_periods():
    def sizes(realisations, periods):
        law = lambda u: u + 0.05 * u**3  # noqa: E731
        data = frequency_response(
            multisine_campaign(law, 4, noise=0.05, realisations=realisations, periods=periods)
        )
        names = ("total_sd", "noise_sd")
        return [float(np.sqrt(np.mean(at_excited(data, name) ** 2))) for name in names]

    few, long, many = sizes(8, 3), sizes(8, 27), sizes(32, 3)
    assert long[0] / few[0] == pytest.approx(1.0, abs=0.1)
    assert long[1] / few[1] == pytest.approx(1 / 3, rel=0.1)
    assert many[0] / few[0] == pytest.approx(0.5, rel=0.15)
    assert many[1] / few[1] == pytest.approx(0.5, rel=0.1)


def test_a_single_sine_shows_its_harmonics():
    law = lambda u: u + 0.1 * u**2  # noqa: E731
    data = frequency_response(multisine_campaign(law, orders=(1,), realisations=1, noise=0.01))
    kinds = data["kind"].values[0]
    assert (kinds == EXCITED).sum() == 1
    assert p_of(data, "even") < 1e-6 < 1e-3 < p_of(data, "odd")
    amplitude = data["output_amplitude"].values[0, 0]
    assert amplitude[1] == pytest.approx(0.1, rel=0.02)  # a (sqrt(2))^2 / 2
    assert np.isnan(data["total_sd"].values).all()


def test_the_part_of_a_distorted_input_is_removed():
    """A linear system whose input has a hundredth at the detection lines: no distortion."""
    rng = np.random.default_rng(3)
    runs = []
    for label in "abc":
        u = multisine(ODD_GRID, rng)
        u = u + 0.01 * u**2
        runs.append(run(label, u, static(u) * 2.0, rng, noise=NOISE))
    data = frequency_response(reduced(*runs))
    assert float(data["input_share"][0]) == pytest.approx(0.01, abs=0.003)
    assert p_of(data, "even") > 1e-3
    even = (data["kind"].values[0] == "even") & (data["order"].values < ODD_GRID[-1])
    part = data["input_part"].values[0, 0, even]
    assert np.sqrt(np.mean(part**2)) > 3 * np.median(data["output_noise"].values[0, 0, even])


# -- levels, realisations, and what takes no part --------------------------------------------------


def test_a_repeated_realisation_is_one_wherever_its_record_begins():
    rng = np.random.default_rng(0)
    u, other = multisine(ODD_GRID, rng), multisine(ODD_GRID, rng)
    runs = [
        run("a", u, u, rng, noise=NOISE),
        run("later", np.roll(u, 317), np.roll(u, 317), rng, noise=NOISE),
        run("other", other, other, rng, noise=NOISE),
    ]
    twice = frequency_response(reduced(*runs[:2]))
    once = frequency_response(reduced(runs[0]))
    assert twice["realisations"].item() == once["realisations"].item() == 1
    assert np.isnan(twice["total_sd"].values).all()
    assert np.isnan(twice["stochastic_p"].values).all()
    ratio = np.median(at_excited(twice, "noise_sd") / at_excited(once, "noise_sd"))
    assert ratio == pytest.approx(np.sqrt(0.5), rel=0.1)
    assert frequency_response(reduced(*runs))["realisations"].item() == 2


@pytest.mark.parametrize(
    "other",
    [
        {"group": "second strut"},
        {"conditions": {"pressure": 2.0}},
        {"frequency": 1.01 * FREQUENCY},
    ],
)
def test_runs_of_other_circumstances_are_no_realisations(other):
    rng = np.random.default_rng(0)
    u, v = multisine(ODD_GRID, rng), multisine(ODD_GRID, rng)
    first = {"conditions": {"pressure": 1.0}} if "conditions" in other else {}
    runs = run("a", u, u, rng, **first), run("b", v, v, rng, **other)
    assert frequency_response(reduced(*runs)).sizes["level"] == 2


def test_a_transient_and_a_run_without_excited_lines_are_left_out_with_the_reason():
    rng = np.random.default_rng(0)
    u = multisine(ODD_GRID, rng)
    still = run("still", 0.0 * u, u, rng, input_noise=0.1)
    shot = replace(run("shot", u, u, rng, noise=0.1), kind="transient", frequency=None)
    found = frequency_response(reduced(run("a", u, u, rng), still, shot))
    left = json.loads(found.attrs["left_out"])
    assert left["shot"] == "a transient"
    assert left["still"] == "no line of force stands out of its noise"
    assert json.loads(str(found["runs"].values[0])) == ["a"]
    with pytest.raises(InputError, match="no periodic run has an excited line"):
        frequency_response(reduced(shot))


def test_of_one_period_there_is_no_noise_and_realisations_still_differ():
    law = lambda u: u + 0.05 * u**3  # noqa: E731
    several = multisine_campaign(law, periods=2, realisations=3)
    records = tuple(
        replace(
            record,
            periods=1,
            time=record.time[:PER_PERIOD],
            samples={name: x[:PER_PERIOD] for name, x in record.samples.items()},
        )
        for record in several.records
    )
    data = frequency_response(ReducedCampaign(several.campaign, records))
    for name in ("noise_sd", "distortion_sd", "output_noise", "p_value", "distortion_p"):
        assert np.isnan(data[name].values).all()
    assert np.isfinite(at_excited(data, "total_sd")).all()
    assert tuple(data["order"].values[data["kind"].values[0] == EXCITED]) == ODD_GRID


def with_second(one, values):
    return replace(one, samples={**one.samples, "second": values})


def test_two_inputs_on_lines_of_their_own_and_on_the_same_ones():
    rng = np.random.default_rng(0)
    mine, yours = ODD_GRID[::2], ODD_GRID[1::2]
    u, v = multisine(mine, rng), multisine(yours, rng)
    one = run("a", u, resonance(u) + 3.0 * v, rng, noise=NOISE)
    apart = reduced(with_second(one, np.tile(v, 4)))
    data = frequency_response(apart, "force", "displacement", others=("second",))
    kinds = data["kind"].values[0]
    assert (kinds == "other input").sum() == len(yours)
    assert p_of(data, "even") > 1e-3
    assert p_of(data, "odd") > 1e-3
    # Taken for detection lines they would be a distortion.
    alone = frequency_response(apart, "force", "displacement")
    assert p_of(alone, "odd") < 1e-6
    together = reduced(with_second(one, np.tile(multisine(mine, rng), 4)))
    with pytest.raises(InputError, match=r"force and another input \(second\) share lines"):
        frequency_response(together, "force", "displacement", others=("second",))


def test_samples_that_are_masked_take_no_part():
    rng = np.random.default_rng(0)
    u = multisine(ODD_GRID, rng)
    one = run("a", u, resonance(u), rng, noise=NOISE, periods=8)
    hit = {name: values.copy() for name, values in one.samples.items()}
    hit["displacement"][2000:2400] += 10.0
    masked = replace(one, samples=hit, mask=((one.time[2000], one.time[2399]),))
    clean, bridged = (frequency_response(reduced(item)) for item in (one, masked))
    away = at_excited(bridged, "response") - at_excited(clean, "response")
    assert np.abs(away).max() < 5 * at_excited(clean, "noise_sd").max()
    ratio = np.median(at_excited(bridged, "noise_sd") / at_excited(clean, "noise_sd"))
    assert ratio == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("per_period", [1000.37, 313.9])
def test_a_period_needs_no_whole_number_of_samples(per_period):
    rng, lines = np.random.default_rng(0), range(1, 60, 2)
    phases = 2 * np.pi * rng.random(len(lines))
    time = np.arange(int(5 * per_period)) / per_period
    u = sum(np.cos(2 * np.pi * k * time + p) for k, p in zip(lines, phases, strict=True))
    one = run("a", u, u, rng, periods=1)
    noisy = {"force": u, "displacement": 2.0 * u + NOISE * rng.standard_normal(u.size)}
    one = replace(one, time=time, samples=noisy, frequency=1.0)
    data = frequency_response(reduced(one))
    assert tuple(data["order"].values[data["kind"].values[0] == EXCITED]) == tuple(lines)
    assert p_of(data, "even") > 1e-3
    away = np.abs(at_excited(data, "response") - 2.0) / at_excited(data, "noise_sd")
    assert np.mean(away**2) == pytest.approx(1.0, abs=5.0 / np.sqrt(len(lines)))


def test_a_channel_that_is_not_there_is_named():
    made = multisine_campaign(static, realisations=1)
    with pytest.raises(InputError, match="voltage"):
        frequency_response(made, "voltage")
    with pytest.raises(InputError, match="voltage"):
        frequency_response(made, "force", "voltage")
    undeclared = replace(made.campaign, controlled=None)
    assert isinstance(undeclared, CampaignData)
    with pytest.raises(InputError, match="force"):
        frequency_response(ReducedCampaign(undeclared, made.records))


def test_a_multisine_is_known_before_anything_is_computed():
    assert has_multisine(multisine_campaign(static, realisations=1, noise=NOISE).records, "force")
    sine = multisine_campaign(lambda u: u, orders=(1,), realisations=1, noise=NOISE)
    assert not has_multisine(sine.records, "force")


def test_the_silverbox_is_even_a_little(data_set):
    """Schroeder multisine on a circuit whose spring is cubic, and slightly quadratic."""
    file = scipy.io.loadmat(data_set("measured/silverbox") / "Schroeder80mV.mat")
    rate, runs = 1e7 / 2**14, []
    for label, first, last in (("a", 10592, 21850), ("b", 119375, 130634)):
        u, y = (file[name].ravel() for name in ("V1", "V2"))
        made = run(label, u, y, np.random.default_rng(0), periods=1, frequency=rate / 1024)
        samples = {"force": u[first:last], "displacement": y[first:last]}
        runs.append(replace(made, time=np.arange(last - first) / rate, samples=samples))
    data = frequency_response(reduced(*runs))
    lines = data["order"].values[data["kind"].values[0] == EXCITED]
    assert lines.tolist() == list(range(1, 336, 2))
    # Both blocks are the same signal.
    assert data["realisations"].item() == 1
    assert p_of(data, "even") < 1e-6
    ratio = float((data["distortion"] / data["distortion_noise"]).sel(parity="even")[0, 0])
    assert 3.0 < ratio < 5.0
