"""The loop on small systems whose missing effect is known, simulated without the package."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitted_states import NUMERICS
from scipy import stats
from small_campaigns import (
    DAMPER_RUNS,
    DRAG,
    FRICTION,
    HARDENING,
    SPRING,
    STIFFNESS,
    damper,
    damper_campaign,
    oscillator_campaign,
    spring_damper_force,
)

from bayesoleo import _schema as schema
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._loop import close_loop
from bayesoleo.discovery._summary import summarise
from bayesoleo.effects import find_effect
from bayesoleo.systems import system

#: A cut through the catalogue: the loop's logic needs no more, and whole ones are marked slow.
EFFECTS = tuple(
    map(
        find_effect,
        (
            "coulomb_friction", "stribeck_friction", "quadratic_damping", "cubic_stiffness",
            "quintic_stiffness", "mass_error", "constant_force", "sensor_lag", "varies_by_run",
        ),
    )
)  # fmt: skip
ABOUT = {"campaign": "small", "model": "small", "drive": "displacement", "seed": 0}


def close(reduced, model, effects=EFFECTS, **options):
    return close_loop(
        Assembly(model), assign(reduced.records), NUMERICS, effects=effects, **options
    )


@pytest.fixture(scope="module")
def with_friction(tmp_path_factory):
    """Dry friction in the data, not in the model; force offsets of each run."""
    offsets = {"a": 3.0, "b": -2.0, "c": 1.0, "d": 5.0, "e": -4.0}
    reduced = damper_campaign(tmp_path_factory.mktemp("friction"), offsets=offsets)
    return close(reduced, damper(offsets=True)), offsets


@pytest.mark.slow
def test_friction_missing_in_a_force_law_is_found(with_friction):
    loop, _ = with_friction
    assert loop.effects == ("coulomb_friction",)
    assert loop.verdict == schema.EFFECT_ADDED
    assert loop.final.worst_ratio < 1.3
    assert loop.first.worst_ratio > 5
    value = loop.final.fit.values["coulomb_friction"]
    sd = loop.final.fit.point.sd[loop.final.fit.problem.names.index("coulomb_friction")]
    # The data hold sign(v): the smooth law's limit, which it reaches to a part in a hundred.
    assert abs(value - FRICTION) < 4 * sd + 0.02 * FRICTION


@pytest.mark.slow
def test_the_last_round_accepts_nothing_and_every_other_one_does(with_friction):
    loop, _ = with_friction
    assert all(entry.accepted is not None for entry in loop.rounds[:-1])
    assert loop.rounds[-1].accepted is None
    assert loop.rounds[0].before is loop.first
    assert all(entry.reason for entry in loop.rounds)


def test_ranking_puts_what_was_estimated_first_and_is_ordered(with_friction):
    loop, _ = with_friction
    for entry in loop.rounds:
        keys = [(not item.refitted, -item.gain) for item in entry.ranking]
        assert keys == sorted(keys)
        assert all(0 <= item.p_value <= 1 for item in entry.ranking)


def test_offsets_by_run_are_estimated_again_on_hold_out_and_counted(with_friction):
    loop, offsets = with_friction
    for state in (loop.first, loop.final):
        for prediction in state.held_out:
            assert prediction.re_estimated == 1
            label = prediction.record.label
            if state is loop.final:
                assert prediction.theta[f"offset[{label}]"] == pytest.approx(
                    offsets[label], abs=5 * 0.5 / np.sqrt(prediction.record.time.size) + 0.02
                )
            for name, value in state.fit.shared.items():
                assert prediction.theta[name] == value
    summary = summarise(loop, None, ABOUT)
    assert summary["re_estimated"] == 1
    assert "2 declared hold-out runs" in summary["hold_out"]


def test_the_summary_says_what_happened(with_friction):
    loop, _ = with_friction
    summary = summarise(loop, None, ABOUT)
    assert summary["effects"] == ["coulomb_friction"]
    assert summary["targets"] == [loop.rounds[0].accepted.target] == ["force"]
    assert summary["rounds"][0]["accepted_target"] == "force"
    assert summary["rounds"][-1]["accepted"] is None
    assert summary["rounds"][-1]["accepted_target"] is None
    assert summary["rounds"][0]["candidates"][0]["effect"] == "coulomb_friction"
    before, after = (summary[k]["hold-out"]["force"] for k in ("error_before", "error_after"))
    assert after["repeating"] < 0.2 * before["repeating"]
    for run in summary["rounds"][0]["error"]["force"].values():
        assert run["ratio_to_noise"] == pytest.approx(run["repeating"] / run["noise"])
    unit = {name: entry["unit"] for name, entry in summary["parameters"].items()}
    assert unit["damping"] == "N*s/m"
    assert unit["offset[a]"] == "N"


def test_a_cubic_spring_missing_in_an_oscillator_is_found_first(tmp_path):
    def restoring(x, v):
        return SPRING * x + DRAG * v + HARDENING * x**3

    reduced = oscillator_campaign(tmp_path, restoring=restoring)
    loop = close(reduced, system("linear_oscillator"))
    assert loop.effects == ("cubic_stiffness",)
    assert loop.final.worst_ratio < 1.15
    names = loop.final.fit.problem.names
    for name, true in {"cubic_stiffness": HARDENING, "stiffness": SPRING, "damping": DRAG}.items():
        k = names.index(name)
        assert abs(loop.final.fit.point.theta[k] - true) < 4 * loop.final.fit.point.sd[k]
    summary = summarise(loop, None, ABOUT)
    assert summary["branch_jumps"] == {"estimate": 0, "posterior": None}
    damping, mass = loop.final.fit.point["damping"], 1.0
    for record in loop.roles.fitted:
        entry = summary["stability"][record.label]
        assert entry["stable"] is True
        values = np.array(entry["multipliers"]) @ [1, 1j]
        # Abel, Jacobi and Liouville: the damping is linear whatever the spring.
        expected = np.exp(-damping / mass / record.frequency)
        assert np.prod(values).real == pytest.approx(expected, rel=1e-5)
    assert set(summary["stability"]) == {
        r.label for r in (*loop.roles.fitted, *loop.roles.held_out)
    }


@pytest.mark.slow
def test_two_effects_are_found_one_after_the_other(tmp_path):
    def force(x, v, t):
        return 200 * v + 1000 * x + 2e6 * x**3 + FRICTION * np.sign(v)

    loop = close(damper_campaign(tmp_path, force), damper(cubic=False))
    assert sorted(loop.effects) == ["coulomb_friction", "cubic_stiffness"]
    assert loop.verdict == schema.EFFECT_ADDED


def test_nothing_is_added_where_nothing_is_missing(tmp_path):
    loop = close(damper_campaign(tmp_path, spring_damper_force), damper())
    assert loop.verdict == schema.NOTHING_MISSING
    assert loop.effects == ()
    assert loop.final is loop.first
    assert len(loop.rounds) == 1


def disturbed(x, v, t):
    """With a force at the seventh harmonic, whatever the motion: nothing named is like it."""
    cycles = 8 * t / t[-1] * (t.size - 1) / (8 * 100.37)
    return spring_damper_force(x, v, t) + 3.0 * np.cos(2 * np.pi * 7 * cycles + 1.0)


@pytest.mark.slow
def test_an_effect_outside_the_catalogue_leaves_a_remainder(tmp_path):
    loop = close(damper_campaign(tmp_path, disturbed), damper())
    assert loop.verdict == schema.UNEXPLAINED
    assert loop.final.worst_ratio > 3
    for entry in loop.rounds:
        if entry.accepted is not None:
            assert entry.accepted.gain < 0.5


@pytest.mark.slow
def test_what_the_hold_out_runs_contradict_is_not_added(tmp_path):
    """Friction in the fitted runs; the others have the damping that a fit without it finds."""

    def damped(x, v, t):
        return spring_damper_force(x, v, t) + 100.0 * v

    for name in ("rubbing", "damped"):
        (tmp_path / name).mkdir()
    rubbing = damper_campaign(tmp_path / "rubbing")
    other = damper_campaign(tmp_path / "damped", damped)
    records = [r if r.role == "fit" else other.record(r.label) for r in rubbing.records]
    loop = close(replace(rubbing, records=tuple(records)), damper())
    assert loop.effects == ()
    assert "raises the error on hold-out runs: the weighted squared" in loop.rounds[0].reason


def test_no_effect_to_look_for_is_no_failure(tmp_path):
    loop = close(damper_campaign(tmp_path), damper(), effects=(), nonparametric=False)
    assert loop.effects == ()
    assert loop.verdict == schema.UNEXPLAINED
    assert loop.rounds[0].ranking == ()


def test_at_most_as_many_effects_as_allowed(tmp_path):
    loop = close(damper_campaign(tmp_path), damper(cubic=False), max_effects=1)
    assert len(loop.effects) <= 1
    assert (
        "the largest allowed number of effects" in loop.rounds[-1].reason
        or loop.final.worst_ratio < 1.15
    )


def test_a_round_that_only_ranks_says_so(tmp_path):
    loop = close(damper_campaign(tmp_path), damper(cubic=False), max_effects=0)
    assert loop.effects == ()
    assert loop.rounds[0].ranking[0].gain > 0.5
    assert loop.rounds[0].reason == "effects were to be ranked only, not added"


def test_without_hold_out_it_leaves_one_run_out_and_says_so(tmp_path):
    runs = [run for run in DAMPER_RUNS if run[3] == "fit"]
    loop = close(damper_campaign(tmp_path, runs=runs), damper())
    assert any("leave-one-run-out" in note for note in loop.notes)
    assert loop.effects == ("coulomb_friction",)
    assert {p.record.label for p in loop.final.held_out} == {"a", "b", "c"}
    for prediction in loop.final.held_out:
        assert prediction.theta["damping"] != loop.final.fit.values["damping"]


def test_a_single_run_is_split_and_says_so(tmp_path):
    loop = close(damper_campaign(tmp_path, runs=DAMPER_RUNS[:1]), damper())
    assert any("first half" in note for note in loop.notes)
    assert loop.effects[:1] == ("coulomb_friction",)


def test_the_same_seed_gives_the_same_loop_whatever_the_threads(tmp_path):
    reduced = damper_campaign(tmp_path)
    roles = assign(reduced.records)
    one, two = (
        close_loop(
            Assembly(damper()), roles, replace(NUMERICS, jobs=jobs), effects=EFFECTS[:4], seed=3
        )
        for jobs in (1, 2)
    )
    assert summarise(one, None, ABOUT) == summarise(two, None, ABOUT)


def test_a_wrong_constant_known_to_a_tolerance_is_estimated_rather_than_explained(tmp_path):
    model = damper()
    wrong = replace(model.parameters["stiffness"], value=700.0, fixed=True)
    loop = close(
        damper_campaign(tmp_path, spring_damper_force), model.with_parameters(stiffness=wrong)
    )
    assert loop.effects == ()
    assert loop.verdict == schema.NOTHING_MISSING
    table = summarise(loop, None, ABOUT)["parameters"]
    assert table["stiffness"]["tolerance"] == {"value": 800.0, "sd": 3000.0}
    assert table["damping"]["tolerance"] is None
    # Held, the stiffness would be 250 N/m off.
    assert abs(table["stiffness"]["estimate"] - STIFFNESS) < 4 * table["stiffness"]["sd"] < 50


def false_additions(folder, seeds, **options) -> int:
    found = 0
    for seed in seeds:
        reduced = damper_campaign(folder, spring_damper_force, seed=seed, **options)
        found += bool(close(reduced, damper()).effects)
    return found


@pytest.mark.statistical
@pytest.mark.parametrize(
    "noise", [{}, {"coloured": 0.7}, {"input_noise": 2e-4}], ids=["white", "coloured", "input"]
)
def test_false_additions_are_no_more_frequent_than_stated(tmp_path, noise):
    count, level = 20, 0.01
    added = false_additions(tmp_path, range(100, 100 + count), **noise)
    # More than two have a chance of one in a thousand at the stated level.
    assert stats.binom.sf(2, count, level) == pytest.approx(1e-3, rel=0.01)
    assert added <= 2


@pytest.mark.slow
def test_with_the_whole_catalogue_the_truth_is_first_or_in_its_class(tmp_path):
    loop = close(damper_campaign(tmp_path), damper(), effects=None)
    first = loop.rounds[0].ranking[0]
    assert "coulomb_friction" in (first.effect, *first.same)
    assert loop.effects == (first.effect,)
    assert loop.final.worst_ratio < 1.15


@pytest.mark.slow
def test_with_the_whole_catalogue_an_oscillators_spring_is_found(tmp_path):
    def restoring(x, v):
        return SPRING * x + DRAG * v + HARDENING * x**3

    reduced = oscillator_campaign(tmp_path, restoring=restoring)
    loop = close(reduced, system("linear_oscillator"), effects=None)
    assert loop.effects == ("cubic_stiffness",)
    assert loop.final.worst_ratio < 1.15


@pytest.mark.slow
def test_with_the_whole_catalogue_what_is_outside_it_is_not_named_as_certain(tmp_path):
    loop = close(damper_campaign(tmp_path, disturbed), damper(), effects=None)
    assert loop.verdict == schema.UNEXPLAINED
