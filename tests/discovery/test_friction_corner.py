"""Dry friction whose corner is not an arctangent is one effect, with another corner."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import cloudpickle
import numpy as np
import pytest
import sympy as sp
from fitted_states import NUMERICS, fitted, options, scored
from small_campaigns import damper, damper_campaign, oscillator_campaign, spring_damper_force
from test_velocities import motor, motor_campaign, oscillator

from bayesoleo.discovery import _corners as corners, _loop as loop_module
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._corners import beginning, cornered
from bayesoleo.discovery._loop import OTHER_CORNER, Progress, close_loop
from bayesoleo.discovery._refit import refit
from bayesoleo.discovery._score_tests import Score
from bayesoleo.discovery._state import State, fit_state
from bayesoleo.effects import catalogue, find_effect, force_effect
from bayesoleo.effects._forces import (
    ALGEBRAIC,
    ARCTANGENT,
    HYPERBOLIC,
    RATIONAL,
    SATURATION,
    smooth_sign,
    with_corner,
)
from bayesoleo.effects._parts import ShapeParameter, velocity_grid
from bayesoleo.model._expressions import symbol

FRICTION, AT = 5.0, 0.01
#: A hyperbolic tangent is one half there.
HALF = np.log(3.0) / 2.0


def with_tanh(x, v, t):
    return spring_damper_force(x, v, t) + FRICTION * np.tanh(v / AT)


def with_arctangent(x, v, t):
    return spring_damper_force(x, v, t) + FRICTION * 2 / np.pi * np.arctan(v / AT)


@pytest.fixture(scope="module")
def sharp(tmp_path_factory) -> State:
    """A force law without its friction, fitted to friction with the corner of a tangent."""
    folder = tmp_path_factory.mktemp("sharp")
    return fitted(damper_campaign(folder, with_tanh, noise=0.02), damper())


@pytest.fixture(scope="module")
def round_(tmp_path_factory) -> State:
    """The same with the corner of an arctangent."""
    folder = tmp_path_factory.mktemp("round")
    return fitted(damper_campaign(folder, with_arctangent, noise=0.02), damper())


def silent(_: str) -> None:
    """Receives messages."""


def white(*_: object) -> SimpleNamespace:
    """The noise along any change, over white noise."""
    return SimpleNamespace(value=1.0, on_trial=1.0)


def score_of(state: State, name: str = "coulomb_friction") -> Score:
    return scored(state, name)[name]


def counted(monkeypatch) -> list[str]:
    """Corners that are tried from now on."""
    tried, actual = [], corners.with_other_corner

    def counting(base, assembly, fit, corner, numerics):
        tried.append(corner)
        return actual(base, assembly, fit, corner, numerics)

    monkeypatch.setattr(corners, "with_other_corner", counting)
    return tried


def test_candidates_are_estimated_with_the_corner_of_the_model(sharp):
    """With the best of several corners for each, breakaway friction does what two effects do."""
    found = refit(sharp.base(), score_of(sharp), NUMERICS)
    assert found.assembly.corner == ARCTANGENT
    assert not found.reached


def test_an_effect_that_was_added_takes_the_corner_that_the_data_have(sharp, monkeypatch):
    first, roles = added(sharp, "coulomb_friction"), assign(sharp.fit.records)
    tried = counted(monkeypatch)
    found = cornered(first, roles, NUMERICS, silent)
    assert tried == [HYPERBOLIC, ALGEBRAIC, SATURATION, RATIONAL]
    assert found.assembly.corner == HYPERBOLIC
    assert found.at_floor
    names, theta, sd = found.fit.problem.names, found.fit.point.theta, found.fit.point.sd
    for name, true in {
        "coulomb_friction": FRICTION,
        "coulomb_friction_transition": HALF * AT,
    }.items():
        k = names.index(name)
        assert abs(theta[k] - true) < 4 * sd[k] < 0.02 * true


def test_where_noise_is_left_one_other_corner_is_tried(round_, monkeypatch):
    first, roles = added(round_, "coulomb_friction"), assign(round_.fit.records)
    assert first.at_floor
    tried = counted(monkeypatch)
    assert cornered(first, roles, NUMERICS, silent) is first
    assert tried == [HYPERBOLIC]


def test_a_corner_must_be_clearly_likelier(sharp, monkeypatch):
    first, roles = added(sharp, "coulomb_friction"), assign(sharp.fit.records)
    base = first.base()
    rises = iter([0.1 * base.feigned, 6.1, 5.9])

    def fallen(*_):
        nonlocal at
        at += next(rises, 0.0)
        return at / base.fall_back, []

    at = base.excess - 0.5 * base.feigned  # noise explains what is left
    monkeypatch.setattr(corners, "compare", fallen)
    monkeypatch.setattr(
        corners, "inflation_along", lambda *_: SimpleNamespace(value=1.0, on_trial=1.0)
    )
    monkeypatch.setattr(corners, "fit_state", lambda assembly, *_, **__: SimpleNamespace(
        assembly=assembly, at_floor=True, worst_ratio=1.0))  # fmt: skip
    found = cornered(first, roles, NUMERICS, silent)
    assert found.assembly.corner == ALGEBRAIC, "6.1 more than the first one, the next only 5.9"


def test_a_corner_that_leaves_more_than_noise_is_not_taken(sharp, monkeypatch):
    """Beside an effect that is missing it makes up for a part of that."""
    first, roles = added(sharp, "coulomb_friction"), assign(sharp.fit.records)
    base = first.base()
    monkeypatch.setattr(
        corners, "compare", lambda *_: ((base.excess - 1.1 * base.feigned) / base.fall_back, [])
    )
    monkeypatch.setattr(
        corners, "inflation_along", lambda *_: SimpleNamespace(value=1.0, on_trial=1.0)
    )
    assert cornered(first, roles, NUMERICS, silent) is first


def test_what_comes_later_has_the_same_corner(sharp):
    usual = refit(sharp.base(), score_of(sharp), NUMERICS).assembly
    found = usual.with_corner(HYPERBOLIC)
    state = replace(sharp, assembly=found)
    (option,) = options(state, ["stribeck_friction"])
    assert "tanh" in str(option.model.outputs) or "tanh" in str(option.assembly.native.outputs)
    scales = found.steps[0].scales
    again = found.option(find_effect("stribeck_friction"), "force", scales)
    less = again.assembly.without(again.assembly.steps[0])
    assert less.corner == HYPERBOLIC
    assert [effect for effect, _ in less.added] == ["stribeck_friction"]
    assert "atan" not in str(less.native.output_terms("force"))


def test_a_corner_can_be_changed_and_changed_back(sharp):
    usual = refit(sharp.base(), score_of(sharp), NUMERICS).assembly
    other = usual.with_corner(HYPERBOLIC)
    assert other.added == usual.added
    assert dict(other.model().parameters) == dict(usual.model().parameters)
    assert other.native.output_terms("force") != usual.native.output_terms("force")
    back = other.with_corner(ARCTANGENT)
    assert back.native.output_terms("force") == usual.native.output_terms("force")


@pytest.mark.parametrize("corner", [ARCTANGENT, ALGEBRAIC, SATURATION, RATIONAL])
def test_every_corner_is_tried_where_the_effect_was_chosen(tmp_path, corner):
    state = fitted(damper_campaign(tmp_path, rubbing_with(corner), noise=0.02), damper())
    found = cornered(added(state, "coulomb_friction"), assign(state.fit.records), NUMERICS, silent)
    assert found.assembly.corner == corner
    assert found.at_floor
    k = found.fit.problem.names.index("coulomb_friction_transition")
    assert abs(found.fit.point.theta[k] - AT) < 4 * found.fit.point.sd[k] < 0.02 * AT


def test_all_effects_are_tested_again_with_another_corner(monkeypatch):
    """An effect may have made up for the corner that the model had; it goes with it."""
    keys = ("coulomb_friction", "stroke"), ("stribeck_friction", "stroke")
    needed, turned, without = (
        SimpleNamespace(assembly=SimpleNamespace(added=keys[:count], corner=HYPERBOLIC))
        for count in (2, 1, 1)
    )
    told, notes = [], []

    def eliminated(state, before, *_, last_too=False):
        told.append((state, before, last_too))
        return without

    monkeypatch.setattr(loop_module, "eliminated", eliminated)
    monkeypatch.setattr(
        loop_module, "cornered", lambda state, *_: turned if state is needed else state
    )
    found = loop_module._in_corner(needed, "before", None, NUMERICS, notes, silent)
    assert found is without
    assert told == [(turned, "before", True)]
    assert len(notes) == 1
    assert "stribeck_friction at stroke" in notes[0]
    assert "coulomb_friction" not in notes[0]
    assert HYPERBOLIC in notes[0]


def test_a_corner_goes_with_its_friction(sharp):
    tanh = sharp.assembly.with_corner(HYPERBOLIC)
    scales, steps = score_of(sharp).option.assembly.steps[-1].scales, []
    for name in ("cubic_stiffness", "coulomb_friction"):
        tanh = tanh.option(find_effect(name), "force", scales).assembly
        steps.append(tanh.steps[-1])
    assert tanh.cornered == ["Coulomb friction"]
    assert tanh.fits(HYPERBOLIC)
    assert not tanh.fits(ARCTANGENT)
    assert tanh.without(steps[0]).corner == HYPERBOLIC
    assert tanh.without(steps[1]).corner == ARCTANGENT
    assert tanh.without(steps[1]).fits(HYPERBOLIC), "what has no dry friction fits any"


def test_a_formula_of_a_user_stays_as_it_is():
    own = "own*2/pi*atan(velocity/v0)"
    formula = r"k \frac{2}{\pi} \arctan(\dot q / v_0)"
    shape = ShapeParameter("v0", "position/s", "v_0", "velocity", velocity_grid(1 / 512, 1 / 4))
    mine = force_effect("mine", "friction", own, {"own": "force"}, shapes=(shape,), formula=formula)
    assert with_corner(mine, HYPERBOLIC) is mine


def test_no_corner_is_taken_that_other_runs_contradict(tmp_path, monkeypatch):
    """Nor one with which a run has no solution."""
    state = fitted(damper_campaign(tmp_path, with_tanh, noise=0.02), damper())
    roles, first = assign(state.fit.records), added(state, "coulomb_friction")
    calm = SimpleNamespace(assembly=first.assembly, fit=first.fit, base=first.base, at_floor=True)
    for ratio, floor, taken in ((1.0, True, True), (2.0, False, False), (np.nan, True, False)):
        other = SimpleNamespace(worst_ratio=ratio, at_floor=floor)
        monkeypatch.setattr(corners, "fit_state", lambda *_, other=other, **__: other)
        found = cornered(calm, roles, NUMERICS, silent)
        assert found is (other if taken else calm)


def rubbing_with(corner: str):
    """The force law with friction that has a corner."""
    v, over = symbol("v"), symbol("over")
    sign = sp.lambdify((v, over), smooth_sign(damper(), v, over, corner))
    return lambda x, v, t: spring_damper_force(x, v, t) + FRICTION * sign(v, AT)


def added(state: State, name: str) -> State:
    """The model with one more effect, with the corner that the model has, fitted."""
    found = refit(state.base(), score_of(state, name), NUMERICS)
    roles = assign(state.fit.records)
    return fit_state(found.assembly, roles, NUMERICS, start=found.fit.point.theta)


def test_the_corner_is_looked_at_again_when_another_effect_was_added(tmp_path):
    reduced = damper_campaign(tmp_path, with_tanh, noise=0.02)
    state = fitted(reduced, damper(cubic=False))
    roles = assign(state.fit.records)
    first = added(added(state, "coulomb_friction"), "cubic_stiffness")
    assert not first.at_floor
    found = cornered(first, roles, NUMERICS, silent)
    assert found.assembly.corner == HYPERBOLIC
    assert found.at_floor
    # It is right now.
    assert cornered(found, roles, NUMERICS, silent) is found


@pytest.mark.parametrize(("gain", "taken"), [(0.2, False), (5.9, False), (6.1, True)])
def test_an_effect_too_many_is_no_merit_of_another_corner(round_, monkeypatch, gain, taken):
    """With the present corner it is not worth its unknowns either."""
    both = added(added(round_, "coulomb_friction"), "stribeck_friction")

    def against(base, form, fit, corner, numerics):
        worth = 0.0 if len(form.steps) == 2 else 15.0 + gain * (corner == HYPERBOLIC)
        return corners._Tried(form.with_corner(corner), fit, worth)

    monkeypatch.setattr(corners, "_against", against)
    found = corners._likelier(both, NUMERICS)
    assert (found is not None) == taken
    assert not taken or found[0].corner == HYPERBOLIC


@pytest.mark.parametrize("second", ["stribeck_friction", "power_law_damping"])
def test_an_effect_that_made_up_for_the_corner_goes(sharp, second):
    """Both together leave nothing but noise, or little more."""
    roles = assign(sharp.fit.records)
    both = added(added(sharp, "coulomb_friction"), second)
    found = cornered(both, roles, NUMERICS, silent)
    assert found.assembly.corner == HYPERBOLIC
    assert [effect for effect, _ in found.assembly.added] == ["coulomb_friction"]
    assert found.at_floor


def test_structures_are_scored_with_the_corner_that_was_found(sharp):
    both = list(scored(sharp, "coulomb_friction", "cubic_stiffness", "quintic_stiffness").values())
    ranking = [SimpleNamespace(score=score) for score in both]
    usual, same = beginning(sharp, ranking, ARCTANGENT, 1)
    assert usual.corner == ARCTANGENT
    assert all(one is other for one, other in zip(same, both, strict=True))
    turned, found = beginning(sharp, ranking, HYPERBOLIC, 1)
    assert turned.corner == HYPERBOLIC
    for old, new in zip(both, found, strict=True):
        assert new.option.key == old.option.key
        rubs = old.option.key[0] == "coulomb_friction"
        assert (new is old) != rubs
        if rubs:
            assert new.share > old.share
            assert new.option.assembly.corner == HYPERBOLIC


def rubbing(x, v):
    return 400.0 * x + 0.8 * v + 0.5 * np.tanh(v / 0.01)


#: Families that can stand for friction and drag together.
FORCES = tuple(e for e in catalogue() if e.family in ("damping", "friction", "stiffness"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drag", "noise", "effects"), [(2.0, 2e-5, None), (8.0, 1e-5, FORCES)], ids=["all", "forces"]
)
def test_two_effects_with_the_usual_corner_are_not_one_with_another(tmp_path, drag, noise, effects):
    """Breakaway friction with a ratio to a root leaves only noise here as well."""

    def law(x, v):
        return 400.0 * x + 0.8 * v + 1.0 / np.pi * np.arctan(v / 0.01) + drag * v * abs(v)

    reduced = oscillator_campaign(tmp_path, restoring=law, noise=noise)
    assembly, roles = Assembly(oscillator(states=False), None), assign(reduced.records)
    loop = close_loop(assembly, roles, NUMERICS, effects=effects)
    assert loop.effects == ("coulomb_friction", "quadratic_damping")
    assert loop.final.assembly.corner == ARCTANGENT
    assert loop.structures is not None
    best = loop.structures.structures[0]
    assert {effect for effect, _ in best.effects} == set(loop.effects)


@pytest.mark.slow
def test_one_effect_is_found_on_an_oscillator(tmp_path):
    reduced = oscillator_campaign(tmp_path, restoring=rubbing)
    assembly, roles = Assembly(oscillator(states=False), None), assign(reduced.records)
    loop = close_loop(assembly, roles, NUMERICS)
    assert loop.effects == ("coulomb_friction",)
    assert loop.final.assembly.corner == HYPERBOLIC
    assert any(note.startswith(OTHER_CORNER) for note in loop.notes)
    assert loop.structures is not None
    best = loop.structures.structures[0]
    assert [effect for effect, _ in best.effects] == ["coulomb_friction"]
    assert not best.outside
    assert best.probability > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("corner", [ARCTANGENT, HYPERBOLIC])
def test_one_effect_is_found_on_a_motor(tmp_path, monkeypatch, corner):
    if corner == HYPERBOLIC:
        monkeypatch.setattr("test_velocities.np.arctan", lambda x: np.pi / 2 * np.tanh(x))
    monkeypatch.setattr("test_velocities.NOISE", 0.01)
    reduced = motor_campaign(tmp_path, 0.04)
    monkeypatch.undo()
    kept: list[Progress] = []
    assembly, roles = Assembly(motor(), None), assign(reduced.records)
    loop = close_loop(assembly, roles, NUMERICS, keep=kept.append)
    assert loop.effects == ("coulomb_friction",)
    assert loop.final.assembly.corner == corner
    # It is the same where it was stopped after its first round.
    known = cloudpickle.loads(cloudpickle.dumps(kept[1]))
    again = close_loop(assembly, roles, NUMERICS, known=known)
    assert again.effects == loop.effects
    assert again.final.assembly.corner == corner
    assert again.final.fit.point.theta == pytest.approx(loop.final.fit.point.theta, rel=1e-6)
