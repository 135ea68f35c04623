"""Classes of effects are looked at again with everything else in the model."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import NUMERICS, options
from small_campaigns import damper, damper_campaign

from bayesoleo.discovery import _refit as refits, _review as review
from bayesoleo.discovery._alternatives import followed, leads_as_far
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._fit_difference import Undecided
from bayesoleo.discovery._kept_progress import Kept
from bayesoleo.discovery._loop import SearchOptions, close_loop, searched
from bayesoleo.discovery._nonparametric_round import (
    _several_in_one_balance,
    _stands_by_itself,
    with_nonparametric,
)
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._ranking import Ranked, rank
from bayesoleo.discovery._refit import fall_from, refit
from bayesoleo.discovery._round import Progress, Round
from bayesoleo.discovery._score_tests import score_all
from bayesoleo.discovery._state import fit_state
from bayesoleo.effects import find_effect
from bayesoleo.effects._forces import ARCTANGENT, HYPERBOLIC

POLICY = SearchPolicy()


def accepted(effect, same):
    candidate = SimpleNamespace(effect=effect, target="stroke", family="friction")
    score = SimpleNamespace(option=SimpleNamespace(candidate=candidate, key=(effect, "stroke")))
    return Ranked(score, 1e-6, 0.9, True, same)


def progress_of(*found, corner=ARCTANGENT):
    """Rounds that accepted these one after the other, one that accepted none, and their model, with
    a corner of friction."""
    keys = [(item.effect, item.target) for item in found]

    def state(count):
        steps = [
            SimpleNamespace(effect=SimpleNamespace(id=e, family="friction"), target=t)
            for e, t in keys[:count]
        ]
        added, last = tuple(keys[:count]), count == len(found)
        known = corner if last else ARCTANGENT
        return SimpleNamespace(assembly=SimpleNamespace(steps=steps, added=added, corner=known))

    rounds = [
        Round(state(k), (item,), {}, item, state(k + 1), "", 60.0) for k, item in enumerate(found)
    ]
    last = Round(state(len(found)), (), {}, None, None, "nothing is missing", 60.0)
    return Progress(state(0), state(len(found)), (*rounds, last))


def test_what_was_found_before_the_last_effect_gets_the_class_that_it_has_beside_it(monkeypatch):
    first = accepted("cubic_stiffness", ("quintic_stiffness", "play"))
    found = progress_of(first, accepted("coulomb_friction", ("dahl_friction",)))
    estimate = object()
    own = replace(first, same=("play", "preload"), refit=estimate)
    place = SimpleNamespace(number=0, own=own, better=(), rivals=())
    monkeypatch.setattr(review, "place_of", lambda *_, **__: place)
    told = review.reviewed(found, None, None, None, lambda _: None, replacing=False).rounds
    assert told[0].accepted.same == ("play", "preload")
    assert told[0].accepted.beside is estimate
    assert told[0].ranking == (told[0].accepted,)
    # It was judged with everything else in: there is nothing to look at again.
    assert told[1] is found.rounds[1]
    assert told[2] is found.rounds[2]


@pytest.mark.parametrize("same", [(), ("play",)])
def test_a_single_effect_is_not_looked_at_again(monkeypatch, same):
    found = progress_of(accepted("cubic_stiffness", same))
    monkeypatch.setattr(review, "place_of", lambda *_: pytest.fail("asked again"))
    assert review.reviewed(found, None, None, None, lambda _: None) is found


def test_a_single_effect_is_looked_at_again_where_friction_got_another_corner(monkeypatch):
    found = progress_of(accepted("power_law_damping", ()), corner=HYPERBOLIC)
    asked = []
    place = SimpleNamespace(number=0, own=found.rounds[0].accepted, better=(), rivals=())
    monkeypatch.setattr(review, "place_of", lambda *_, **__: asked.append(1) or place)
    review.reviewed(found, None, None, None, lambda _: None)
    assert asked


def test_laws_of_one_family_are_compared_however_many_score_higher():
    def score(effect, fall, family="friction"):
        candidate = SimpleNamespace(effect=effect, target="stroke", family=family)
        option = SimpleNamespace(candidate=candidate, key=(effect, "stroke"))
        return SimpleNamespace(option=option, fall=fall)

    own, kin = score("power_law_damping", 100.0), score("quadratic_damping", 80.0)
    others = [score(f"other_{k}", 90.0 + k, "stiffness") for k in range(POLICY.review_rivals)]
    chosen = review._worth_estimating(own, [*others, kin], (), False, POLICY)
    assert chosen[:-1] == others[::-1]
    assert chosen[-1] is kin
    known = review._worth_estimating(own, [*others, kin], (), True, POLICY)
    assert known == []


NAMES = (
    "coulomb_friction", "stroke_dependent_damping", "cubic_stiffness", "quintic_stiffness",
    "quadratic_damping", "end_stop_upper", "hertzian_contact_upper", "constant_force",
)  # fmt: skip
EFFECTS = tuple(map(find_effect, NAMES))


def cubic_and_friction(x, v, _):
    return 1000 * x + 4e6 * x**3 + 200 * v + 5 * np.sign(v)


def added_first(roles, name):
    """A search that added one effect, whatever the others would have done."""
    state = fit_state(Assembly(damper(cubic=False)), roles, NUMERICS)
    base = state.base()
    scores = score_all(base, options(state, NAMES), jobs=1)[0]
    score = next(one for one in scores if one.option.key[0] == name)
    result = refit(base, score, NUMERICS)
    after = fit_state(result.assembly, roles, NUMERICS)
    item = next(one for one in rank(scores, 40.0, {id(score): result}) if one.effect == name)
    return Progress(state, after, (Round(state, (item,), {}, item, after, "", 40.0),))


@pytest.mark.slow
def test_what_is_nearer_beside_the_others_replaces_a_first_effect_that_was_not(tmp_path):
    """A quintic spring is taken first on purpose: it is a cubic one that is there."""
    roles = assign(damper_campaign(tmp_path, cubic_and_friction, per_period=60.3).records)
    begun = added_first(roles, "quintic_stiffness")
    loop = close_loop(
        Assembly(damper(cubic=False)), roles, NUMERICS, effects=EFFECTS, known=begun, max_effects=2
    )
    assert set(loop.effects) == {"cubic_stiffness", "coulomb_friction"}
    told = [entry.reason for entry in loop.rounds if "; it replaces " in entry.reason]
    assert len(told) == 1
    assert "it replaces quintic_stiffness" in told[0]
    assert "±" in told[0]
    assert loop.final.at_floor


def cubic(x, v, _):
    return 1000 * x + 4e6 * x**3 + 200 * v


def test_an_effect_that_varies_by_run_gives_way_with_its_variation(tmp_path):
    """A quintic spring of each run's own imitates the cubic one that is there."""
    roles = assign(damper_campaign(tmp_path, cubic, per_period=60.3).records)
    begun = added_first(roles, "quintic_stiffness")
    state, base = begun.state, begun.state.base()
    scores = score_all(base, options(state, ("varies_by_run",)), jobs=1)[0]
    score = next(one for one in scores if one.option.key[1] == "quintic_stiffness")
    result = refit(base, score, NUMERICS)
    after = fit_state(result.assembly, roles, NUMERICS)
    item = next(one for one in rank(scores, 40.0, {id(score): result}) if one.score is score)
    entry = Round(state, (item,), {}, item, after, "", 40.0)
    loop = close_loop(
        Assembly(damper(cubic=False)),
        roles,
        NUMERICS,
        effects=(*EFFECTS, find_effect("varies_by_run")),
        known=Progress(begun.first, after, (*begun.rounds, entry)),
        max_effects=2,
    )
    assert loop.effects == ("cubic_stiffness",)
    assert loop.final.at_floor


@pytest.mark.slow
def test_another_first_effect_is_followed_only_where_it_leads_as_far(tmp_path):
    """Friction and a cubic spring are there: damping of another law beside either leaves more."""
    roles = assign(damper_campaign(tmp_path, cubic_and_friction, per_period=60.3).records)
    begun = added_first(roles, "cubic_stiffness")
    second = added_first(roles, "coulomb_friction").rounds[0].accepted
    third = added_first(roles, "quadratic_damping").rounds[0].accepted
    found = [
        leads_as_far(begun_with_two(begun, roles), item, roles, NUMERICS, EFFECTS, lambda _: None)
        for item in (second, third)
    ]
    assert found == [True, False]


def begun_with_two(begun, roles):
    """A search that went on from its first effect."""
    search = SearchOptions(roles, NUMERICS, EFFECTS, 0, 2, False, Kept(), lambda _: None)
    found = searched(begun, search)
    assert set(found.state.assembly.added) == {
        ("cubic_stiffness", "force"), ("coulomb_friction", "force")
    }  # fmt: skip
    return found


def test_rivals_are_compared_with_the_estimate_that_the_final_model_has(tmp_path, monkeypatch):
    """Estimated anew in its place, an effect may end at a worse optimum; a rival does not gain."""
    roles = assign(damper_campaign(tmp_path, cubic_and_friction, per_period=60.3).records)
    found = begun_with_two(added_first(roles, "cubic_stiffness"), roles)

    def poorly(base, score, numerics):
        result = refit(base, score, numerics)
        poor = 0.5 if score.option.key[0] == "cubic_stiffness" else 1.0
        return replace(result, fall=poor * result.fall, share=poor * result.share)

    monkeypatch.setattr(refits, "refit", poorly)
    step = found.state.assembly.steps[0]
    place = review.place_of(found, step, 0, roles, NUMERICS, EFFECTS)
    own, base = place.own.refit, place.base
    assert own.fall == pytest.approx(fall_from(base, found.state.fit))
    assert own.fall > max(rival.refit.fall for rival in place.rivals)
    assert own.excludes_null()
    assert not place.better


@pytest.mark.parametrize(
    ("gap", "remaining", "reached", "replaced"),
    [
        (100.0, 5000.0, False, False),  # decisive by the noise, and two per cent of what is left
        (100.0, 5000.0, True, True),  # with it noise alone is left
        (1000.0, 5000.0, False, True),
        (3.0, 5.0, True, False),
    ],
)
def test_what_replaces_an_effect_explains_a_good_part_of_what_that_leaves(
    monkeypatch, gap, remaining, reached, replaced
):
    monkeypatch.setattr(review, "_dispersion", lambda *_: 1.0)
    monkeypatch.setattr(review, "undecided", lambda *_: Undecided(POLICY.equal_likelihood))

    def item(name, worth, left, at_noise):
        estimate = SimpleNamespace(
            worth=worth, inflation=1.0, remaining=left, reached=at_noise, policy=POLICY
        )
        return replace(accepted(name, ()), refit=estimate)

    own = item("dahl_friction", 1000.0, remaining, False)
    rival = item("lugre_friction", 1000.0 + gap, remaining - gap, reached)
    assert review.Place(0, None, own, (rival,)).better == ((rival,) if replaced else ())


def test_first_effects_that_were_nearly_as_good_are_followed():
    names = ("near", "alike", "nearer", "far", "by_run")
    worths = (93.0, 99.5, 99.0, 50.0, 120.0)
    ranking = []
    for name, worth in zip(names, worths, strict=True):
        item = replace(accepted(name, ()), refit=SimpleNamespace(worth=worth, share=0.5))
        item.score.option.candidate.family = "run-to-run" if name == "by_run" else "friction"
        ranking.append(item)
    taken = replace(accepted("taken", ("alike",)), refit=SimpleNamespace(worth=100.0, share=0.5))
    added = [("taken", "stroke"), ("second", "stroke")]

    def search(at_floor, found, first=taken):
        families = ["run-to-run" if effect == "by_run" else "friction" for effect, _ in found]
        steps = [SimpleNamespace(effect=SimpleNamespace(family=item)) for item in families]
        assembly = SimpleNamespace(added=tuple(found), steps=steps)
        state = SimpleNamespace(at_floor=at_floor, assembly=assembly)
        opening = Round(None, (taken, *ranking), {}, first, None, "", 60.0)
        return SimpleNamespace(rounds=(opening,), state=state)

    def names_of(progress):
        return [item.effect for item in followed(progress, POLICY)]

    assert names_of(search(True, added)) == ["nearer"], "at the noise only what is nearly tied"
    assert names_of(search(False, added[:1])) == ["nearer", "near"]
    assert names_of(search(True, added[:1])) == [], "one effect led to the noise"
    assert names_of(search(True, [])) == [] == names_of(search(True, [], None))
    # What merely varies from run to run is a symptom: causes are followed beside it.
    by_run = ranking[-1]
    assert names_of(search(True, [("by_run", "stroke")], by_run)) == ["taken", "nearer"]


def test_no_function_is_looked_for_where_noise_alone_is_left():
    """A name that explained the excess by itself led to the floor: nothing is left to explain."""
    opening = Round(
        SimpleNamespace(assembly=SimpleNamespace(steps=())),
        (), {}, accepted("stribeck_friction", ()), None, "", 60.0,
    )  # fmt: skip
    step = SimpleNamespace(effect=SimpleNamespace(family="friction"), target="stroke")
    state = SimpleNamespace(at_floor=True, assembly=SimpleNamespace(steps=(step,)))
    last = Round(state, (), {}, None, None, "nothing is missing", 60.0)
    told: list[str] = []
    assert with_nonparametric(last, opening, None, NUMERICS, callback=told.append) is last
    assert not told


@pytest.mark.parametrize(
    ("family", "gain", "reached", "alone"),
    [
        ("friction", 0.95, False, True),
        ("friction", 0.85, True, False),
        ("run-to-run", 0.95, False, False),
        ("run-to-run", 0.95, True, True),
    ],
)
def test_what_takes_up_a_part_of_everything_stands_by_itself_only_at_the_noise(
    family, gain, reached, alone
):
    found = replace(accepted("found", ()), gain=gain, refit=SimpleNamespace(reached=reached))
    found.score.option.candidate.family = family
    assert _stands_by_itself(Round(None, (found,), {}, found, None, "", 60.0), POLICY) is alone


@pytest.mark.parametrize(
    ("steps", "several"),
    [
        ([("friction", "stroke"), ("stiffness", "stroke")], True),
        ([("friction", "stroke"), ("thermal", "heat_loss")], False),
        ([("friction", "stroke"), ("run-to-run", "stroke")], False),
    ],
)
def test_names_come_together_in_one_balance(steps, several):
    """What varies by run is no part of one law; another balance has another."""
    made = [
        SimpleNamespace(effect=SimpleNamespace(family=family), target=target)
        for family, target in steps
    ]
    assert _several_in_one_balance(made, POLICY) is several


@pytest.mark.parametrize(("gap", "replaced"), [(-4.0, True), (-8.0, False), (8.0, True)])
def test_a_cause_that_is_as_likely_stands_instead_of_what_varies_by_run(monkeypatch, gap, replaced):
    monkeypatch.setattr(review, "_dispersion", lambda *_: 1.0)
    monkeypatch.setattr(review, "undecided", lambda *_: Undecided(POLICY.equal_likelihood))

    def item(name, family, worth):
        found = accepted(name, ())
        found.score.option.candidate.family = family
        estimate = SimpleNamespace(
            worth=worth, inflation=1.0, remaining=0.0, reached=True, policy=POLICY
        )
        return replace(found, refit=estimate)

    by_run, cause = item("varies_by_run", "run-to-run", 100.0), item("drag", "damping", 100.0 + gap)
    assert bool(review.Place(0, None, by_run, (cause,)).better) == replaced
    # The other way round nothing that varies by run stands instead of a cause.
    assert not review.Place(0, None, cause, (by_run,)).better


def test_the_next_rival_is_asked_where_runs_speak_against_the_best(monkeypatch):
    found = progress_of(accepted("varies_by_run", ()), accepted("sensor_lag", ()))
    asked = []

    def replaced(progress, step, place, better, *_):
        asked.append(better)
        return progress if better == "friction" else None

    place = SimpleNamespace(number=0, own=found.rounds[0].accepted, better=("drag", "friction"))
    monkeypatch.setattr(review, "place_of", lambda *_, **__: place)
    monkeypatch.setattr(review, "_replaced", replaced)
    assert review.reviewed(found, None, None, None, lambda _: None) is found
    assert asked == ["drag", "friction"]


@pytest.mark.parametrize(
    ("grid", "first", "expected"),
    [
        ((1.0, 2.0), 1.0, []),
        ((1.0, 2.0), 2.0, [1.0]),
        ((1.0, 2.0, 3.0, 4.0, 5.0), 3.0, [2.0, 4.0]),
    ],
)
def test_an_estimate_is_repeated_from_each_other_shape_once(monkeypatch, grid, first, expected):
    """Of a scan of few values several parts are the same one."""
    tried = []

    def refit(_, score, __):
        tried.append(score.shapes["r"])
        return SimpleNamespace(share=-np.inf)

    monkeypatch.setattr(review, "refit", refit)
    monkeypatch.setattr(review, "replace", lambda _, *, shapes: SimpleNamespace(shapes=shapes))
    candidate = SimpleNamespace(shapes={"r": grid})
    score = SimpleNamespace(shapes={"r": first}, option=SimpleNamespace(candidate=candidate))
    base = SimpleNamespace(policy=SearchPolicy())
    assert review._restarted((base, None, 100.0), (score, 0.0, 1.0)) is None
    assert tried == expected


def held_out(*runs):
    """A state by whether each hold-out run was solved, and its parameters that the run tells."""
    found = [SimpleNamespace(status=SimpleNamespace(ok=ok), re_estimated=own) for ok, own in runs]
    return SimpleNamespace(held_out=found, hold_errors=SimpleNamespace(entries=found))


@pytest.mark.parametrize(
    ("before", "after", "fall", "raises"),
    [
        ([(True, 0), (True, 0)], [(True, 0), (True, 0)], 5.0, False),
        ([(True, 0), (True, 0)], [(True, 0), (True, 0)], -5.0, True),
        ([(True, 0), (True, 0)], [(True, 0), (False, 0)], 5.0, True),
        ([(False, 0), (True, 0)], [(True, 0), (True, 0)], 5.0, False),
        # Of a run that a model is fitted to it predicts more than it knows.
        ([(True, 1)], [(True, 0)], -5.0, False),
        ([], [], -5.0, False),
    ],
    ids=["lower", "higher", "unsolved", "solved", "of the run", "none"],
)
def test_a_rival_that_leaves_more_than_noise_predicts_as_well(
    monkeypatch, before, after, fall, raises
):
    monkeypatch.setattr(review, "judged", lambda *states: states)
    monkeypatch.setattr(review, "fall_on_hold_out", lambda *_: SimpleNamespace(value=fall))
    assert review._raises(held_out(*before), held_out(*after), 1.0) is raises
