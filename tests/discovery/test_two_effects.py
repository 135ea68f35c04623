"""Effects that predict new runs only together, and what is done where none do."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bayesoleo.discovery import _two_effects as two_effects
from bayesoleo.discovery._hold_out_confirmation import Fall
from bayesoleo.discovery._policy import SearchPolicy

POLICY = SearchPolicy()


def ranked(name, share=0.5, *, absorbs=False, p_value=1e-6, refitted=True, excludes=True):
    result = SimpleNamespace(
        share=share, policy=POLICY, excludes_null=lambda: excludes, assembly=name,
        fit=SimpleNamespace(point=SimpleNamespace(theta=None)), inflation=1.0,
    )  # fmt: skip
    item = SimpleNamespace(
        effect=name, gain=share, p_value=p_value, absorbs=absorbs, refitted=refitted,
        score=SimpleNamespace(),
    )  # fmt: skip
    return item, result


def looked(monkeypatch, items, then, falls):
    """What is found where each effect is followed by another one with a fall of both."""
    refits = {id(item.score): result for item, result in items}
    followed = []

    def state(assembly, *_, **__):
        return SimpleNamespace(name=assembly)

    def follow(one):
        followed.append(one.name)
        other = then.get(one.name)
        if other is None:
            return SimpleNamespace(accepted=None, after=None)
        after = SimpleNamespace(
            hold_errors=SimpleNamespace(entries=[1]), worst_ratio=2.0, first=one.name
        )
        accepted = SimpleNamespace(effect=other, absorbs=other == "varies by run")
        return SimpleNamespace(accepted=accepted, after=after)

    monkeypatch.setattr(two_effects, "fit_state", state)
    monkeypatch.setattr(two_effects, "judged", lambda before, after: (before, after))
    monkeypatch.setattr(
        two_effects, "fall_on_hold_out", lambda _, after, __: Fall(falls[after.first], 1.0, 9.0)
    )
    numerics = SimpleNamespace(policy=POLICY)
    found = two_effects.confirmed_together(
        SimpleNamespace(), [item for item, _ in items], refits, None, numerics, follow, str
    )
    return found, followed


def test_the_pair_that_predicts_best_is_begun(monkeypatch):
    items = [ranked("backlash"), ranked("friction"), ranked("drag")]
    then = {"backlash": "drag", "friction": "drag", "drag": "offset"}
    found, followed = looked(
        monkeypatch, items, then, {"backlash": 20.0, "friction": 90.0, "drag": 30.0}
    )
    assert followed == ["backlash", "friction", "drag"]
    item, state, reason = found
    assert (item.effect, state.name) == ("friction", "friction")
    assert "with drag lowers the error on hold-out runs, which it does not alone" in reason


@pytest.mark.parametrize(
    ("then", "falls"),
    [
        ({}, {}),
        ({"friction": "varies by run"}, {"friction": 90.0}),
        ({"friction": "drag"}, {"friction": 1.0}),
        ({"friction": "drag"}, {"friction": -90.0}),
    ],
)
def test_nothing_is_begun_that_new_runs_do_not_confirm(monkeypatch, then, falls):
    found, followed = looked(monkeypatch, [ranked("friction")], then, falls)
    assert found is None
    assert followed == ["friction"]


def test_only_a_few_that_name_a_cause_are_followed(monkeypatch):
    items = [
        ranked("varies by run", 0.9, absorbs=True),
        ranked("hardly", POLICY.fair_share / 2),
        ranked("not estimated", np.nan),
        ranked("perhaps zero", excludes=False),
        ranked("by chance", p_value=0.9),
        ranked("only scored", refitted=False),
        *(ranked(f"named {k}") for k in range(5)),
    ]
    _, followed = looked(monkeypatch, items, {}, {})
    assert followed == ["named 0", "named 1", "named 2"]
