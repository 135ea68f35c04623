"""Every number that decides stands in one object, which is passed to where it decides."""

from __future__ import annotations

import ast
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import NUMERICS, fitted
from small_campaigns import damper, damper_campaign

import bayesoleo
from bayesoleo._workflow.settings import Settings
from bayesoleo.discovery._fit_and_hold_out_error import limit
from bayesoleo.discovery._policy import SearchPolicy, policy_table
from bayesoleo.discovery._round import _stopping_reason

PACKAGE = Path(bayesoleo.__file__).parent
#: Callers of the search's functions. A prediction is made from a stored result, without a policy.
CALLERS = [
    path
    for folder in ("discovery", "_workflow")
    for path in (PACKAGE / folder).glob("*.py")
    if path.name != "predicting.py"
]


def test_the_documented_table_is_made_from_the_fields():
    document = PACKAGE.parent / "docs" / "loop.md"
    assert policy_table() in document.read_text(encoding="utf-8")


def test_every_field_says_what_it_decides_and_on_what_it_rests():
    for item in fields(SearchPolicy):
        assert item.metadata["decides"].endswith(".")
        assert item.metadata["basis"]
        assert item.metadata["outcome"]


def test_every_field_is_read():
    source = "\n".join(path.read_text(encoding="utf-8") for path in CALLERS)
    unused = [item.name for item in fields(SearchPolicy) if f".{item.name}" not in source]
    # Read by the two properties.
    read = (PACKAGE / "discovery" / "_policy.py").read_text(encoding="utf-8")
    assert [name for name in unused if f"self.{name}" not in read] == []


def _optional(path: Path) -> set[str]:
    """Functions that use the default policy unless they are given one."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {
        node.name
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        and any(argument.arg == "policy" for argument in node.args.kwonlyargs)
    }


def test_no_caller_forgets_the_policy():
    names = set().union(*map(_optional, CALLERS))
    assert {"limit", "compared", "classes"} <= names
    forgotten = [
        f"{path.name}:{node.lineno}"
        for path in CALLERS
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in names
        and all(keyword.arg != "policy" for keyword in node.keywords)
    ]
    assert forgotten == []


def test_the_settings_hand_it_on_to_the_fit_and_what_is_compared_with_it(tmp_path):
    policy = SearchPolicy(floor_ratio=3.0, significance=0.05)
    assert Settings(policy=policy).numerics.policy is policy
    reduced = damper_campaign(tmp_path, lambda x, v, t: 1000 * x + 200 * v)
    state = fitted(reduced, damper(cubic=False), numerics=replace(NUMERICS, policy=policy))
    assert state.policy is policy
    assert state.base().policy is policy
    assert limit(state.fit_errors.entries, policy=state.policy) == 3.0


def test_a_floor_that_is_higher_leaves_nothing_to_look_for(tmp_path):
    """Of a model without its cubic spring, by the limit alone."""
    reduced = damper_campaign(tmp_path, lambda x, v, t: 1000 * x + 4e6 * x**3 + 200 * v)
    state = fitted(reduced, damper(cubic=False))
    lenient = SearchPolicy(floor_ratio=2.0 * state.worst_ratio)
    numerics = replace(state.fit.numerics, policy=lenient)
    assert not state.at_floor
    assert replace(state, fit=replace(state.fit, numerics=numerics)).at_floor


def test_only_what_was_changed_is_stored():
    assert SearchPolicy().changed() == {}
    assert SearchPolicy(compared=2).changed() == {"compared": 2}


@pytest.mark.parametrize(("odds", "scale"), [(20.0, 2 * np.log(20.0)), (np.e, 2.0)])
def test_the_scale_of_equal_likelihood(odds, scale):
    assert SearchPolicy(equal_odds=odds).equal_likelihood == pytest.approx(scale)


def test_what_confirms_exceeds_its_error_as_often_as_is_asked_for():
    assert SearchPolicy().confirming_errors == pytest.approx(1.96, abs=1e-3)


def test_the_best_share_is_stated_as_exactly_as_in_the_report():
    state = SimpleNamespace(worst_ratio=1.04, at_floor=True)
    reason = _stopping_reason(state, [SimpleNamespace(gain=0.0517)], 10.0, SearchPolicy())
    assert reason is not None
    assert reason.endswith("no effect explains more than 5.2 % of the excess")
