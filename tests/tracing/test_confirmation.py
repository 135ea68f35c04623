"""What confirms an effect on runs that were not used: laws of parameters that belong to one run."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import NUMERICS
from small_campaigns import DAMPER_RUNS, damper, damper_campaign

from bayesoleo.effects import find_effect
from bayesoleo.tracing.deciding.confirmation import confirmed, fall_on_hold_out, judged
from bayesoleo.tracing.deciding.loop import close_loop
from bayesoleo.tracing.deciding.state import fit_state
from bayesoleo.tracing.errors.holdout import crossed
from bayesoleo.tracing.fitting.assembly import Assembly
from bayesoleo.tracing.fitting.roles import assign

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


def test_what_fits_noise_is_charged_for_it(tmp_path):
    """On its own samples a parameter gains one on average; across halves it costs two."""
    own, across = [], []
    for seed in range(25):
        before, after = states(tmp_path / str(seed), seed)
        own.append(fall_on_hold_out(before, after)[0])
        old, new = judged(before, after)
        assert old.held_out == before.held_out, "nothing of its own is estimated on it"
        assert all(p.re_estimated == 0 for p in new.held_out)
        across.append(fall_on_hold_out(old, new)[0])
    # Two runs; each fall is a chi-square, so that the mean of 25 sums scatters by 0.4 and 0.8.
    assert np.mean(own) == pytest.approx(2.0, abs=1.6)
    assert np.mean(across) == pytest.approx(-4.0, abs=3.2)


def test_an_offset_of_a_run_is_confirmed(tmp_path):
    before, after = states(tmp_path, 0, {"a": 1.0, "d": -2.0, "e": 3.0})
    fall, error = fall_on_hold_out(*judged(before, after))
    assert fall > 5 * error


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
        unnamed=False,
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
    result = SimpleNamespace(share=share, reached=reached, excludes_null=lambda: False)
    after, reason = confirmed(None, item, result, None, NUMERICS, print)
    assert after is None
    assert ("does not exclude its null" in reason) is enough
    assert (f"would explain only {100 * share:.0f} %" in reason) is not enough
