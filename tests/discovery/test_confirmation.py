"""What confirms an effect on runs that were not used: laws of parameters that belong to one run."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import NUMERICS, motion
from scipy import signal, stats
from small_campaigns import DAMPER_RUNS, damper, damper_campaign

from bayesoleo.discovery import _hold_out_confirmation as confirmation
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._hold_out_confirmation import (
    Fall,
    _RunFall,
    confirmed,
    fall_on_hold_out,
    judged,
    surrogate_variance,
    with_error,
)
from bayesoleo.discovery._loop import close_loop
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._run_predictions import crossed
from bayesoleo.discovery._state import fit_state
from bayesoleo.effects import find_effect

#: A model without inputs, and a campaign without runs that are held out.
PLAIN = SimpleNamespace(model=lambda: SimpleNamespace(inputs=()))
NO_RUNS = SimpleNamespace(held_out=())
RUNS = (("a", 0.5, 0.010, "fit"), ("d", 0.8, 0.008, "hold-out"), ("e", 1.6, 0.006, "hold-out"))


def plain(x, v, _):
    return 2.0e4 * x + 200.0 * v


def states(folder, seed, offsets=None):
    """The model without and with an offset of each run."""
    reduced = damper_campaign(folder, plain, runs=RUNS, per_period=40.3, seed=seed, offsets=offsets)
    roles = assign(reduced.records)
    return [
        fit_state(Assembly(damper(cubic=False, offsets=some)), roles, NUMERICS)
        for some in (False, True)
    ]


@pytest.mark.slow
def test_what_fits_noise_is_charged_for_it(tmp_path):
    """On its own samples a parameter gains one on average, which is charged; across halves it
    costs two."""
    own, across = [], []
    for seed in range(25):
        before, after = states(tmp_path / str(seed), seed)
        own.append(fall_on_hold_out(before, after).value)
        old, new = judged(before, after)
        assert old.held_out == before.held_out, "nothing of its own is estimated on it"
        assert all(p.re_estimated == 0 for p in new.held_out)
        across.append(fall_on_hold_out(old, new).value)
    # Two runs; each fall is a chi-square, so that the mean of 25 sums scatters by 0.4 and 0.8.
    assert np.mean(own) == pytest.approx(0.0, abs=1.6)
    assert np.mean(across) == pytest.approx(-4.0, abs=3.2)


def test_an_offset_of_a_run_is_confirmed(tmp_path):
    before, after = states(tmp_path, 0, {"a": 1.0, "d": -2.0, "e": 3.0})
    fall = fall_on_hold_out(*judged(before, after))
    assert fall.value > 5 * fall.error
    # The effect is exactly right: what it lowers the error by is the square of what it changes.
    assert fall.value == pytest.approx(fall.expected, abs=3 * fall.error)


def test_across_halves_predictions_keep_their_place(tmp_path):
    """Without noise both halves say the same, and the prediction is the one of the whole run."""
    reduced = damper_campaign(
        tmp_path, plain, runs=RUNS, per_period=40.3, noise=1e-6, offsets={"d": -2.0, "e": 3.0}
    )
    state = fit_state(
        Assembly(damper(cubic=False, offsets=True)), assign(reduced.records), NUMERICS
    )
    for prediction in state.held_out:
        np.testing.assert_allclose(crossed(prediction).y, prediction.y, atol=1e-5)


def test_a_run_that_has_no_halves_is_left_as_it_is(tmp_path):
    _, after = states(tmp_path, 0)
    short = replace(after.held_out[0].record, periods=1)
    assert crossed(replace(after.held_out[0], record=short)) is None


#: The strokes of fitted runs end at 10 mm and more, those of runs held out at 8 mm at most.
STOP_AT = 0.0085


def with_stop(stiffness):
    """A spring and a damper, with a stop that only fitted runs reach."""
    return lambda x, v, _: plain(x, v, _) + stiffness * np.maximum(x - STOP_AT, 0.0)


@pytest.mark.parametrize(("stiffness", "found"), [(200.0, ("end_stop_upper",)), (0.0, ())])
def test_a_stop_that_runs_held_out_do_not_reach(tmp_path, stiffness, found):
    """Nobody held out has seen it: the other half of the periods decides, and says so."""
    runs = [run for run in DAMPER_RUNS if run[3] == "fit"] + list(RUNS[1:])
    reduced = damper_campaign(tmp_path, with_stop(stiffness), runs=runs, per_period=60.3)
    loop = close_loop(
        Assembly(damper(cubic=False)),
        assign(reduced.records),
        NUMERICS,
        effects=[find_effect("end_stop_upper")],
        nonparametric=False,
    )
    assert loop.effects == found
    if found:
        assert "the second half of fitted ones" in loop.rounds[0].reason


@pytest.mark.parametrize(
    ("share", "reached", "enough"),
    [(0.04, True, False), (0.06, True, True), (0.10, False, False), (0.13, False, True)],
)
def test_what_leaves_more_than_noise_must_explain_more(share, reached, enough):
    """A share that is enough is asked for its posterior next, which here excludes nothing."""
    item = SimpleNamespace(effect="play", gain=share)
    result = SimpleNamespace(
        share=share,
        reached=reached,
        excludes_null=lambda: False,
        fall=324.0,
        inflation=62.5,
        size=1,
    )
    after, reason = confirmed(None, item, result, None, NUMERICS, print)
    assert after is None
    assert ("does not exclude its null" in reason) is enough
    assert (f"would explain only {100 * share:.0f} %" in reason) is not enough
    assert "by 320 ± 270" in reason, "a fall is never said without its error"


def test_runs_without_a_solution_are_not_said_to_speak_against_an_effect(monkeypatch):
    item = SimpleNamespace(effect="play", gain=0.5)
    point = SimpleNamespace(theta=np.zeros(1))
    result = SimpleNamespace(
        share=0.5, reached=True, excludes_null=lambda: True, inflation=1.0, assembly=PLAIN,
        noise=SimpleNamespace(on_trial=1.0), fit=SimpleNamespace(point=point),
    )  # fmt: skip
    after = SimpleNamespace(hold_errors=SimpleNamespace(entries=[1]))
    monkeypatch.setattr(confirmation, "fit_state", lambda *_, **__: after)
    monkeypatch.setattr(confirmation, "judged", lambda *_: (None, None))
    monkeypatch.setattr(confirmation, "fall_on_hold_out", lambda *_: Fall(0.0, 0.0, 0.0))
    found, reason = confirmed(None, item, result, NO_RUNS, NUMERICS, print)
    assert found is None
    assert reason == "play cannot be confirmed: it changes no hold-out run that is solved"


ITEM = SimpleNamespace(effect="play", gain=0.5)
HALF = Fall(500.0, 50.0, 500.0)


@pytest.mark.parametrize(
    ("fall", "other", "said"),
    [
        (Fall(324.0, 30.0, 300.0), None,
         "and lowers the error on hold-out runs: the weighted squared error falls by 324 ± 30"),
        # Significant although a real effect might have been missed.
        (Fall(324.0, 30.0, 300.0, 400.0), HALF,
         "and lowers the error on hold-out runs: the weighted squared error falls by 324 ± 30; on"
         " the second half of fitted ones it falls by 500 ± 50"),
        (Fall(32.0, 30.0, 20.0), HALF,
         "; the error is not significantly different on hold-out runs: the weighted squared error"
         " falls by 32 ± 30, but these runs would often miss a real effect, which lowers it by 20"
         " on average; on the second half of fitted ones it falls by 500 ± 50, and both together"
         " confirm it"),
        (Fall(-12.0, 30.0, 20.0, 40.0), HALF, "the weighted squared error rises by 12 ± 40, but"),
    ],
)  # fmt: skip
def test_a_confirmation_is_told_by_the_result(fall, other, said):
    text = confirmation._confirming(ITEM, fall, other)
    assert text.startswith("play explains 50 % of the excess")
    assert said in text


@pytest.mark.parametrize(
    ("fall", "other", "said"),
    [
        (Fall(90.0, 670.0, 3000.0), None,
         "play does not lower the error on hold-out runs significantly: the weighted squared error"
         " falls by 90 ± 670; 1.96 standard errors are required (false alarms 2.5 %)"),
        (Fall(-1070.0, 150.0, 5000.0, 300.0), None,
         "play raises the error on hold-out runs: the weighted squared error rises by 1070 ± 300"),
        (Fall(-400.0, 150.0, 5000.0, 300.0), None, "error rises by 400 ± 300; 1.96 standard"),
        (Fall(9.0, 14.0, 20.0), Fall(3.0, 5.0, 5.0),
         "significantly together with the second half of fitted ones: the weighted squared error"
         " falls by 9 ± 14; on the second half of fitted ones it falls by 3.0 ± 5.0; 1.96"),
        (Fall(0.25, 0.017, 1.0), None, "1.96 standard errors, and a fall of 3.84 are required"),
    ],
)  # fmt: skip
def test_a_refusal_is_told_by_the_result(fall, other, said):
    assert said in confirmation._refusing(ITEM, fall, other)


def test_a_fall_of_about_its_error_confirms_nothing():
    fall = Fall(324.0, 300.0, 5000.0)
    assert not fall.confirms
    assert not fall.undecided, "a real effect of this size would have been confirmed"
    assert Fall(324.0, 300.0, 900.0).undecided
    assert Fall(8.03e4, 1.8e4, 7.1e4).confirms


def test_what_hardly_shows_an_effect_hardly_counts():
    """A run that another missing effect swamps must not hide what quiet runs show."""
    swamped, quiet = Fall(-2000.0, 9000.0, 400.0), Fall(500.0, 50.0, 480.0)
    both = swamped.and_by(quiet)
    assert both.confirms
    assert both.value == pytest.approx(500.0, rel=1e-3)
    again = quiet.and_by(swamped)
    assert (again.value, again.error) == (both.value, both.error)
    # No other weights would show a real effect more surely.
    power = both.expected / both.error
    assert power == pytest.approx(np.hypot(400 / 9000, 480 / 50))
    # Two that say as much count alike, and one that contradicts is heard.
    against = Fall(-480.0, 50.0, 480.0)
    assert quiet.and_by(against).value == pytest.approx(20.0)
    assert not quiet.and_by(against).confirms
    # Runs that could not be solved, or that the effect does not change, say nothing.
    alone = quiet.and_by(Fall(0.0, 0.0, 0.0))
    assert (alone.value, alone.error, alone.expected) == (500.0, 50.0, 480.0)
    assert not Fall(0.0, 0.0, 0.0).and_by(Fall(0.0, 0.0, 0.0)).confirms


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (324.4, 300.2, "320 ± 300"),
        (-12.346, 0.678, "-12.35 ± 0.68"),
        (8.027e6, 1.77e4, "8.03e+06 ± 1.8e+04"),
        (0.0, 0.0, "0 ± 0"),
    ],
)
def test_a_value_has_the_digits_that_its_error_leaves(value, error, text):
    assert with_error(value, error) == text


@pytest.mark.parametrize("left_by", ["the model with the effect", "the model without it"])
@pytest.mark.parametrize("colour", [0.0, 0.9, 0.97])
def test_noise_of_a_transient_scatters_a_fall_as_much_as_is_said(monkeypatch, colour, left_by):
    """The size of a sample's noise is that of its innovations; what the residual holds counts."""
    monkeypatch.setattr(confirmation, "input_columns", lambda *_: np.zeros((1, 0, 400)))
    rng, size = np.random.default_rng(5), 400
    change = np.sin(2 * np.pi * np.arange(size) / 60) * np.exp(-np.arange(size) / 150)
    drawn, said, inflation = [], [], []
    for _ in range(400):
        # As large as the innovations, which is all that differences of neighbours see.
        noise = 0.5 * signal.lfilter([1.0], [1.0, -colour], rng.standard_normal(size + 300))[300:]
        without = left_by == "the model without it"
        fall = on_one_run(change, noise - change * without, ratio=1.0, periodic=False)
        drawn.append(fall.value - (-1 if without else 1) * fall.expected)
        said.append(fall.variance)
        inflation.append(fall.inflation)
    # A variance from 400 draws scatters by 7 %. Averages over lines give a line on a steep slope
    # some of the power of slower ones, and a larger residual where the change acts counts, a
    # smaller one does not: what is said is half as large again at most, and not too small.
    assert 0.8 < np.mean(said) / np.var(drawn) < 1.7
    # White noise is judged no smaller than it is; slow noise has here over ten times its power.
    assert (1.0 <= np.mean(inflation) < 1.4) if colour == 0.0 else np.mean(inflation) > 10


@pytest.mark.parametrize("size", [200, 201])
def test_a_remainder_with_random_phases_scatters_as_computed(size):
    rng = np.random.default_rng(3)
    t = np.arange(size) / size
    left = 0.3 + np.sin(2 * np.pi * 3 * t) + 0.5 * np.cos(2 * np.pi * 9 * t + 1.0)
    change = 0.2 + np.sin(2 * np.pi * 3 * t + 2.0) + np.cos(2 * np.pi * 5 * t)
    lines = np.abs(np.fft.rfft(left))
    drawn = []
    for _ in range(4000):
        turned = lines * np.exp(2j * np.pi * rng.uniform(size=lines.size))
        turned[0] = lines[0] * rng.choice([-1.0, 1.0])
        drawn.append(float(change @ np.fft.irfft(turned, size)))
    # A variance from 4000 draws scatters by 2 %, by less where draws are bounded.
    assert surrogate_variance(change, left) == pytest.approx(np.mean(np.square(drawn)), rel=0.08)


@pytest.mark.slow
def test_noise_of_the_input_scatters_a_fall_as_much_as_is_said(tmp_path):
    """The input's noise moves a fall along with the output's; each is counted once."""
    pulls = []
    for seed in range(30):
        reduced = damper_campaign(
            tmp_path / str(seed), plain, seed=seed, input_noise=3e-5, noise=0.05,
            per_period=30.3, periods=4,
        )  # fmt: skip
        state = fit_state(Assembly(damper(cubic=False)), assign(reduced.records), NUMERICS)

        def with_damping(value, state=state):
            found = []
            for prediction in state.held_out:
                x, v = motion(prediction.record)
                found.append(replace(prediction, y=plain(x, v, None)[None] + (value - 200.0) * v))
            return replace(state, held_out=found)

        fall = fall_on_hold_out(with_damping(199.0), with_damping(200.0))
        pulls.append((fall.value - fall.expected) / fall.error)
    # Thirty standard normal draws: their mean square scatters by a quarter.
    assert 0.4 < np.mean(np.square(pulls)) < 1.9


@pytest.mark.slow
def test_errors_of_the_parameters_scatter_a_fall_as_much_as_is_said(tmp_path):
    """Small fitted runs know little of what a large one does: the noise alone is a tenth of it."""
    small = (("a", 1.0, 0.001, "fit"), ("b", 2.0, 0.001, "fit"), ("d", 1.5, 0.01, "hold-out"))
    pulls, ratios = [], []
    for seed in range(30):
        reduced = damper_campaign(
            tmp_path / str(seed), plain, seed=seed, runs=small, per_period=30.3, periods=4
        )
        state = fit_state(Assembly(damper(cubic=False)), assign(reduced.records), NUMERICS)
        changed = []
        for prediction in state.held_out:
            _, v = motion(prediction.record)
            changed.append(replace(prediction, y=prediction.y + 5.0 * v))
        fall = fall_on_hold_out(state, replace(state, held_out=changed))
        # Nothing is there of what was added: the fall is minus its square, on average.
        pulls.append((fall.value + fall.expected) / fall.error)
        ratios.append(fall.error / (2.0 * np.sqrt(fall.expected)))
    assert np.median(ratios) > 2.0
    # Thirty standard normal draws: their mean square scatters by a quarter.
    assert 0.4 < np.mean(np.square(pulls)) < 1.9


@pytest.mark.parametrize(
    ("absorbs", "reached", "asked"),
    [(False, False, True), (False, True, True), (True, True, True), (True, False, False)],
)
def test_halves_of_a_run_do_not_say_that_it_differs_from_others(
    monkeypatch, absorbs, reached, asked
):
    """They share what is odd in it: a parameter of its own always repeats there."""
    refit = SimpleNamespace(
        share=0.5, reached=reached, inflation=1.0, noise=SimpleNamespace(on_trial=1.0), fall=50.0,
        size=1, assembly=PLAIN,
        fit=SimpleNamespace(point=SimpleNamespace(theta=None)), excludes_null=lambda: True,
    )  # fmt: skip
    after = SimpleNamespace(hold_errors=SimpleNamespace(entries=[1]))
    seen = []
    monkeypatch.setattr(confirmation, "fit_state", lambda *_, **__: after)
    monkeypatch.setattr(confirmation, "judged", lambda *_: (None, None))
    monkeypatch.setattr(confirmation, "_on_halves", lambda *_: seen.append(1) or (None, None))
    monkeypatch.setattr(confirmation, "in_halves", lambda _: "halves")
    falls = iter([Fall(9.0, 14.0, 20.0), Fall(500.0, 50.0, 500.0)])
    monkeypatch.setattr(confirmation, "fall_on_hold_out", lambda *_: next(falls))
    item = SimpleNamespace(effect="varies_by_run", gain=0.5, absorbs=absorbs)
    found, _ = confirmation.confirmed(None, item, refit, NO_RUNS, NUMERICS, lambda _: None)
    assert (found is not None) == bool(seen) == asked


def test_runs_that_speak_against_an_effect_are_not_outvoted():
    """Halves of the fitted runs are asked where the others say little, not where they object."""
    against = Fall(-1070.0, 150.0, 5000.0, 300.0)
    assert against.contradicts
    assert not Fall(-100.0, 150.0, 5000.0).contradicts
    assert not Fall(-400.0, 150.0, 5000.0, 300.0).contradicts


def test_next_to_nothing_confirms_nothing_however_sure():
    assert not Fall(2.5e-4, 1.7e-5, 1e-3).confirms
    assert Fall(100.0, 13.0, 100.0).confirms


def on_one_run(change, left, *, ratio, inflation=1.0, periodic=True):
    """Fall, its mean and its variance in one run with noise of 0.5, by ``_of_run``."""
    samples = left + change
    record = SimpleNamespace(
        label="a", samples={"y": samples}, kept=None, time=np.arange(left.size), periodic=periodic
    )
    entry = SimpleNamespace(
        output="y",
        average=SimpleNamespace(sigma=0.5),
        input_scale=1.0,
        ratio_to_expected=ratio,
        spectrum=None,
    )
    state = SimpleNamespace(hold_errors=SimpleNamespace(at=lambda *_: entry), at_floor=False)
    predictor = SimpleNamespace(outputs=("y",), runs=[None], constants=lambda *_: np.zeros((1, 1)))
    old, new = (
        SimpleNamespace(predictor=predictor, record=record, vector=np.zeros(1), y=y[None])
        for y in (np.zeros(left.size), change)
    )
    return confirmation._of_run(state, state, old, new, inflation)


@pytest.mark.parametrize("inflation", [1.0, 2.5])
def test_white_noise_scatters_a_fall_by_twice_the_root_of_its_mean(monkeypatch, inflation):
    """``4 d' w d`` times the inflation, drawn; noise that is expected leaves no remainder."""
    monkeypatch.setattr(confirmation, "input_columns", lambda *_: np.zeros((1, 0, 60)))
    rng = np.random.default_rng(4)
    change = np.sin(2 * np.pi * np.arange(60) / 20)
    drawn, said = [], []
    for _ in range(2000):
        left = 0.5 * np.sqrt(inflation) * rng.standard_normal(60)
        fall = on_one_run(change, left, ratio=1.0, inflation=inflation)
        drawn.append(fall.value - fall.expected)
        said.append(fall.variance)
    assert np.ptp(said) == pytest.approx(0.0, abs=1e-9)
    # A variance from 2000 draws scatters by 3 %.
    assert said[0] == pytest.approx(np.var(drawn), rel=0.13)
    # What exceeds the expected error thrice repeats: eight parts more at most.
    left = 1.5 * np.sqrt(2) * change
    more = on_one_run(change, left, ratio=3.0, inflation=inflation).variance
    assert said[0] < more < 10 * said[0]


def test_a_parameter_of_a_run_is_charged_with_the_noise_that_it_absorbs():
    """By coloured noise of so many times the variance, it lowers the sum by as many on average."""

    def state(of_its_own):
        unsolved = SimpleNamespace(
            re_estimated=of_its_own, status=SimpleNamespace(ok=False), record=None
        )
        fit = SimpleNamespace(
            problem=SimpleNamespace(names=()),
            point=SimpleNamespace(covariance=np.zeros((0, 0))),
        )
        return SimpleNamespace(held_out=[unsolved], fit=fit, policy=SearchPolicy())

    assert fall_on_hold_out(state(0), state(2)).value == -2.0
    assert fall_on_hold_out(state(1), state(2), inflation=3.0).value == -3.0


def test_errors_of_the_parameters_move_a_fall_by_twice_their_pull(monkeypatch):
    """The fall of ``(y - a)^2`` changes by ``2 d' w J`` for each unit of a parameter in ``a``."""
    status, names = SimpleNamespace(ok=True), ("one", "two")
    rng = np.random.default_rng(0)
    sensitivity, change, noise = rng.standard_normal((2, 30)), rng.standard_normal(30), 0.7
    spread = np.array([[0.04, 0.01], [0.01, 0.09]])
    pull = sensitivity @ change / noise**2

    def state(known):
        prediction = SimpleNamespace(re_estimated=0, status=status, y=np.zeros((1, 30)))
        fit = SimpleNamespace(
            problem=SimpleNamespace(names=names),
            point=SimpleNamespace(covariance=known),
            all_periodic=True,
        )
        return SimpleNamespace(held_out=[prediction], fit=fit, policy=SearchPolicy())

    monkeypatch.setattr(confirmation, "_of_run", lambda *_: _RunFall(0.0, 1.0, 0.0, 1.0))
    monkeypatch.setattr(confirmation, "_pull", lambda *_: pull)
    found = fall_on_hold_out(state(spread), state(np.zeros((2, 2))))
    errors = rng.multivariate_normal(np.zeros(2), spread, 20_000)
    left = rng.standard_normal(30)

    def fall(wrong):
        before = left + change - wrong @ sensitivity
        return np.sum(before**2 - (before - change) ** 2) / noise**2

    # The fall is linear in the error here; a deviation from 20 000 draws scatters by 0.5 %.
    assert found.error == pytest.approx(np.std([fall(wrong) for wrong in errors]), rel=0.025)
    assert found.scatter == 0.0, "the other model's parameters are known"


@pytest.mark.parametrize("scatter", [100.0, 400.0])
def test_runs_decide_where_a_real_effect_would_seldom_be_missed(scatter):
    policy = SearchPolicy()
    for expected in np.linspace(100.0, 2500.0, 25):
        fall = Fall(0.0, 200.0, expected, scatter)
        missed = stats.norm.cdf(policy.confirming_errors * fall.error, expected, scatter)
        assert fall.undecided == (missed > policy.missed_confirmation)


@pytest.mark.parametrize("size", [16, 17])
def test_the_highest_line_of_an_even_number_of_samples_is_alone(size):
    """Where change and remainder alternate, signs are the only phases: the fall is all or minus."""
    sign = (-1.0) ** np.arange(size)
    lines = np.fft.rfft(sign)
    exact = np.sum(np.abs(np.fft.fft(sign)) ** 4) / size**2  # one term for each of all lines
    assert surrogate_variance(sign, sign) == pytest.approx(exact, rel=1e-12)
    if size % 2 == 0:
        assert np.count_nonzero(np.abs(lines) > 1e-9) == 1
        assert surrogate_variance(sign, sign) == pytest.approx(float(sign @ sign) ** 2)
