"""Effects that predict new runs only together, and what is done where none do."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import NUMERICS

from bayesoleo.discovery import _loop as loop, _two_effects as two_effects
from bayesoleo.discovery._assembly import Roles
from bayesoleo.discovery._hold_out_confirmation import Fall
from bayesoleo.discovery._kept_progress import Kept
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._round import JUDGED, Progress, Round

POLICY = SearchPolicy()


def ranked(
    name, share=0.5, *, absorbs=False, p_value=1e-6, refitted=True, excludes=True, unusual=False
):
    result = SimpleNamespace(
        share=share, policy=POLICY, unusual=unusual, excludes_null=lambda: excludes, assembly=name,
        fit=SimpleNamespace(point=SimpleNamespace(theta=None)), inflation=1.0,
    )  # fmt: skip
    item = SimpleNamespace(
        effect=name, gain=share, absorbs=absorbs, refitted=refitted, score=SimpleNamespace(),
        may_be_tried=lambda level: p_value < level,
    )  # fmt: skip
    return item, result


def looked(monkeypatch, items, then, falls, held=(1,), known=()):
    """What is found where each effect is followed by another one with a fall of both; models with
    some effects may be known."""
    refits = {id(item.score): result for item, result in items}
    followed = []

    def fitted(assembly, *_, **__):
        return SimpleNamespace(name=assembly, worst_ratio=np.nan if "unsolved" in assembly else 2.0)

    def follow(one):
        followed.append(one.name)
        other = then.get(one.name)
        if other is None:
            return None, None
        after = SimpleNamespace(
            hold_errors=SimpleNamespace(entries=[1]), worst_ratio=2.0, first=one.name
        )
        accepted = SimpleNamespace(effect=other, absorbs=other == "varies by run", refit=None)
        return accepted, after

    monkeypatch.setattr(two_effects, "fit_state", fitted)
    monkeypatch.setattr(
        two_effects,
        "lacks_input",
        lambda result, _: "no first harmonic" if result.assembly == "clock" else None,
    )
    monkeypatch.setattr(two_effects, "judged", lambda before, after: (before, after))
    monkeypatch.setattr(
        two_effects,
        "fall_on_hold_out",
        lambda _, after, __: Fall(falls[after.first], 1.0, 9.0, policy=POLICY),
    )
    numerics = SimpleNamespace(policy=POLICY)
    found = two_effects.confirmed_together(
        SimpleNamespace(hold_errors=SimpleNamespace(entries=held)),
        [item for item, _ in items],
        refits,
        None,
        numerics,
        follow,
        str,
        {id(result): one for result, one in known},
    )
    return found, followed


def test_what_hold_out_runs_lack_an_input_for_is_not_followed(monkeypatch):
    items = [ranked("clock"), ranked("friction")]
    then = {"clock": "drag", "friction": "drag"}
    _, followed = looked(monkeypatch, items, then, {"clock": 90.0, "friction": 20.0})
    assert followed == ["friction"]


def test_the_pair_that_predicts_best_is_begun(monkeypatch):
    items = [ranked("backlash"), ranked("friction"), ranked("drag")]
    then = {"backlash": "drag", "friction": "drag", "drag": "offset"}
    found, followed = looked(
        monkeypatch, items, then, {"backlash": 20.0, "friction": 90.0, "drag": 30.0}
    )
    assert followed == ["backlash", "friction", "drag"]
    item, state, reason = found
    assert (item.effect, state.name) == ("friction", "friction")
    assert "with drag lowers the error on hold-out runs" in reason


def test_a_model_that_was_fitted_to_be_confirmed_is_not_fitted_again(monkeypatch):
    items = [ranked("friction"), ranked("drag")]
    known = SimpleNamespace(name="known", worst_ratio=2.0)
    then, falls = {"known": "drag"}, {"known": 90.0}
    found, followed = looked(monkeypatch, items, then, falls, known=[(items[0][1], known)])
    assert followed == ["known", "drag"]
    assert found[1] is known


def test_a_round_that_was_looked_at_ahead_is_not_searched_again(monkeypatch):
    """Unless it is another model, or its noise is another."""
    before, other = SimpleNamespace(), SimpleNamespace()
    noise = {("1", "y"): 1.0}
    ahead = Round(before, (), {}, None, SimpleNamespace(), "", 1.0), SimpleNamespace(measured=noise)
    same, changed = SimpleNamespace(measured=dict(noise)), SimpleNamespace(measured={})
    assert loop._looked_at(ahead, before, same) is ahead[0]
    assert loop._looked_at(ahead, other, same) is None
    assert loop._looked_at(ahead, before, changed) is None
    assert loop._looked_at(None, before, same) is None


@pytest.mark.parametrize(
    ("then", "falls"),
    [
        ({}, {}),
        ({"friction": "varies by run"}, {"friction": 90.0}),
        ({"friction": "drag"}, {"friction": 1.0}),
        # More than two standard errors, but three pairs of two effects are tried.
        ({"friction": "drag"}, {"friction": 10.0}),
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
        ranked("negative mass", unusual=True),
        *(ranked(f"named {k}") for k in range(5)),
    ]
    _, followed = looked(monkeypatch, items, {}, {})
    assert followed == ["named 0", "named 1", "named 2"]


def test_nothing_is_followed_without_runs_that_were_held_out(monkeypatch):
    found, followed = looked(monkeypatch, [ranked("friction")], {}, {}, held=())
    assert found is None
    assert not followed


def test_a_model_with_a_run_that_has_no_solution_is_not_begun(monkeypatch):
    then = {"unsolved friction": "drag"}
    items = [ranked("unsolved friction")]
    found, followed = looked(monkeypatch, items, then, {"unsolved friction": 90.0})
    assert found is None
    assert not followed


def test_an_effect_on_trial_is_taken_back_where_no_other_one_is_confirmed(monkeypatch):
    """The search goes on as if it had not looked ahead, and does not look again."""
    looks = []

    def state(name):
        errors = SimpleNamespace(record_noise=None)
        return SimpleNamespace(name=name, assembly=SimpleNamespace(steps=[]), errors=errors)

    declared = state("declared")
    answers = {
        ("declared", True): ("backlash", True),
        ("declared", False): ("varies by run", False),
    }

    def examine(one, *_, ahead, **__):
        looks.append((one.name, ahead))
        name, trial = answers.get((one.name, ahead), (None, False))
        accepted = name and SimpleNamespace(absorbs=name == "varies by run")
        after = name and state(name)
        return Round(one, (), {}, accepted, after, "", 1.0, on_trial=trial)

    monkeypatch.setattr(loop, "examine", examine)
    monkeypatch.setattr(loop, "eliminated", lambda after, *_: after)
    monkeypatch.setattr(loop, "cornered", lambda after, *_: after)
    monkeypatch.setattr(loop, "least_noise", lambda *_: None)
    monkeypatch.setattr(loop, "_with_noise", lambda roles, _: roles)
    monkeypatch.setattr(loop, "_ratios", lambda _: "")
    monkeypatch.setattr(loop, "_limit", lambda *_: "")
    monkeypatch.setattr(loop, "judged_together", lambda one, *_: one)
    search = loop.SearchOptions(
        Roles((), (), "declared", ""), NUMERICS, None, 0, 4, False, Kept(), str
    )
    found = loop._rounds(Progress(declared, declared), search)
    assert looks == [
        ("declared", True), ("backlash", True), ("declared", False), ("varies by run", True),
    ]  # fmt: skip
    assert found.state.name == "varies by run"
    assert [entry.on_trial for entry in found.rounds] == [False, False]
    assert found.finished


def test_what_is_not_confirmed_beside_the_others_goes_and_is_not_sought_again(monkeypatch):
    """Once no further effect is found; what is left then is ranked only."""
    looks = []

    def state(name):
        assembly = SimpleNamespace(steps=[], added=())
        errors = SimpleNamespace(record_noise=None)
        return SimpleNamespace(name=name, assembly=assembly, errors=errors, at_floor=False)

    declared, with_two, with_one = state("declared"), state("two"), state("one")

    def examine(one, *_, limit, **__):
        looks.append((one.name, limit))
        after = with_two if one is declared else None
        return Round(one, (), {}, SimpleNamespace(absorbs=False), after, limit, 1.0)

    def together(one, *arguments):
        arguments[3].append("a note")
        return with_one if one is with_two else one

    monkeypatch.setattr(loop, "examine", examine)
    monkeypatch.setattr(loop, "eliminated", lambda after, *_: after)
    monkeypatch.setattr(loop, "cornered", lambda after, *_: after)
    monkeypatch.setattr(loop, "least_noise", lambda *_: None)
    monkeypatch.setattr(loop, "_with_noise", lambda roles, _: roles)
    monkeypatch.setattr(loop, "_ratios", lambda _: "")
    monkeypatch.setattr(loop, "_limit", lambda *_: "")
    monkeypatch.setattr(loop, "judged_together", together)
    roles = Roles((), (), "declared", "")
    search = loop.SearchOptions(roles, NUMERICS, None, 0, 4, False, Kept(), str)
    found = loop._rounds(Progress(declared, declared), search)
    assert looks == [("declared", ""), ("two", ""), ("one", JUDGED)]
    assert found.state is with_one
    assert found.finished
    assert found.notes == ("a note",)
