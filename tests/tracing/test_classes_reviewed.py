"""Classes of effects are looked at again with everything else in the model."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest

from bayesoleo.tracing.deciding import review
from bayesoleo.tracing.deciding.rounds import Ranked, Round
from bayesoleo.tracing.deciding.unnamed_round import (
    _several_in_one_balance,
    _stands_by_itself,
    with_unnamed,
)


def accepted(effect, same):
    candidate = SimpleNamespace(effect=effect, target="stroke", family="friction")
    score = SimpleNamespace(option=SimpleNamespace(candidate=candidate, key=(effect, "stroke")))
    return Ranked(score, 1e-6, 0.9, True, same)


def loop_of(*found):
    """Rounds that accepted these, one that accepted none, and the final model."""
    rounds = [Round(None, (item,), {}, item, None, "", 60.0) for item in found]
    steps = [
        SimpleNamespace(effect=SimpleNamespace(id=item.effect), target=item.target)
        for item in found
    ]
    last = Round(None, (), {}, None, None, "nothing is missing", 60.0)
    return [*rounds, last], SimpleNamespace(assembly=SimpleNamespace(steps=steps))


def test_what_was_found_before_the_last_effect_keeps_its_true_rivals_only(monkeypatch):
    first = accepted("cubic_stiffness", ("quintic_stiffness", "play"))
    second = accepted("coulomb_friction", ("dahl_friction",))
    rounds, final = loop_of(first, second)
    monkeypatch.setattr(review, "_still_alike", lambda item, step, *_: ("play",))
    told = review.reviewed(rounds, final, None, None, None, lambda _: None)
    assert told[0].accepted.same == ("play",)
    assert told[0].ranking == (told[0].accepted,)
    # It was judged with everything else in: there is nothing to look at again.
    assert told[1] is rounds[1]
    assert told[2] is rounds[2]


@pytest.mark.parametrize("same", [(), ("play",)])
def test_a_single_effect_is_not_looked_at_again(monkeypatch, same):
    rounds, final = loop_of(accepted("cubic_stiffness", same))
    monkeypatch.setattr(review, "_still_alike", lambda *_: pytest.fail("asked again"))
    assert review.reviewed(rounds, final, None, None, None, lambda _: None) == tuple(rounds)


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
    assert with_unnamed(last, opening, None, None, say=told.append) is last
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
    assert _stands_by_itself(Round(None, (found,), {}, found, None, "", 60.0)) is alone


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
    assert _several_in_one_balance(made) is several
