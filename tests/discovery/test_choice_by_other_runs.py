"""Of effects that are as good on fitted runs, the one is taken that predicts the others."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from fitted_states import NUMERICS

from bayesoleo.discovery import _round as rounds
from bayesoleo.discovery._fit_difference import Undecided


def estimated(worth, reached=True):
    candidate = SimpleNamespace(family="friction")
    return SimpleNamespace(
        worth=worth, reached=reached, inflation=1.0, unusual=False, share=0.9, size=1,
        policy=NUMERICS.policy,
        score=SimpleNamespace(option=SimpleNamespace(candidate=candidate)),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("worths", "at_floor", "taken"),
    [
        ((168.0, 161.0), {"a": False, "b": True}, "b"),
        ((168.0, 161.0), {"a": False, "b": False}, "a"),
        ((168.0, 161.0), {"a": True, "b": True}, "a"),
        ((168.0, 120.0), {"a": False, "b": True}, "a"),  # fitted runs tell them apart
        ((168.0, 161.0), {"b": True}, "b"),  # the first is refused
    ],
)
def test_the_one_that_predicts_the_runs_held_out(monkeypatch, worths, at_floor, taken):
    results = dict(zip("ab", map(estimated, worths), strict=True))
    ranking = [
        SimpleNamespace(
            effect=name,
            score=result.score,
            refitted=True,
            gain=0.9,
            absorbs=False,
            may_be_tried=lambda level: level > 1e-9,
        )
        for name, result in results.items()
    ]
    refits = {id(result.score): result for result in results.values()}

    def confirmed(_, item, *__, on_trial, **___):
        assert on_trial
        after = SimpleNamespace(at_floor=at_floor[item.effect]) if item.effect in at_floor else None
        return after, item.effect

    monkeypatch.setattr(rounds, "confirmed", confirmed)
    monkeypatch.setattr(rounds, "undecided", lambda *_: Undecided(NUMERICS.policy.equal_likelihood))
    item, after, _ = rounds._choose(None, None, ranking, refits, None, NUMERICS, print)
    assert item.effect == taken
    assert after is not None
