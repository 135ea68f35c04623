"""Corner of dry friction at zero velocity: an arctangent, or another smooth sign."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from bayesoleo.effects import Effect, Scales, catalogue, find_effect, force_effect
from bayesoleo.effects._forces import (
    ARCTANGENT,
    CORNERS,
    HYPERBOLIC,
    has_corner,
    smooth_sign,
    with_corner,
)
from bayesoleo.model import Model, Parameter
from bayesoleo.model._expressions import symbol
from bayesoleo.systems import system

SCALES = Scales(
    position={"position": (-0.01, 0.01)},
    velocity={"position": 0.1},
    output={"displacement": 0.02},
    shortest_period=0.5,
    longest_period=2.0,
)
RUBBING = ("coulomb_friction", "asymmetric_friction", "stribeck_friction")


def extended(effect: Effect, corner: str, model: Model | None = None) -> Model:
    there = model or system("linear_oscillator")
    return with_corner(effect, corner).extend(there, "position", SCALES).model


def term(effect: Effect, corner: str, model: Model | None = None) -> sp.Expr:
    return extended(effect, corner, model).equations["position"][effect.id]


@pytest.mark.parametrize("corner", CORNERS)
def test_a_corner_is_a_sign_that_is_one_half_at_its_velocity(corner):
    v, over = symbol("v"), symbol("over")
    sign = sp.lambdify((v, over), smooth_sign(system("linear_oscillator"), v, over, corner))
    assert sign(0.02, 0.02) == pytest.approx(0.5, abs=1e-12)
    assert sign(-0.02, 0.02) == pytest.approx(-0.5, abs=1e-12)
    # An arctangent is a part of 2/(1000 pi) below one there.
    assert sign(20.0, 0.02) == pytest.approx(1.0, abs=1e-3)
    # But for round-off where it is level.
    assert np.all(np.diff(sign(np.linspace(-0.1, 0.1, 41), 0.02)) > -1e-12)


@pytest.mark.parametrize("name", RUBBING)
def test_another_corner_has_the_same_parameters(name):
    usual, other = (extended(find_effect(name), corner) for corner in (ARCTANGENT, HYPERBOLIC))
    assert dict(usual.parameters) == dict(other.parameters)
    assert usual.equations != other.equations
    assert term(find_effect(name), HYPERBOLIC).has(sp.tanh)
    assert not term(find_effect(name), HYPERBOLIC).has(sp.atan)


def test_the_usual_corner_is_that_of_the_catalogue():
    effect = find_effect("coulomb_friction")
    assert with_corner(effect, ARCTANGENT) is effect
    again = with_corner(with_corner(effect, HYPERBOLIC), ARCTANGENT)
    assert (again.change, again.formula) == (effect.change, effect.formula)
    expected = "coulomb_friction*2/pi*atan(velocity/coulomb_friction_transition)"
    assert sp.simplify(term(effect, ARCTANGENT).subs(_velocity()) - sp.sympify(expected)) == 0


def _velocity():
    place = system("linear_oscillator").coordinates()[0]
    return {place.velocity: sp.Symbol("velocity")} | {
        symbol(name): sp.Symbol(name)
        for name in ("coulomb_friction", "coulomb_friction_transition")
    }


def test_a_formula_shows_the_corner():
    effect = find_effect("coulomb_friction")
    assert "arctan" in effect.formula
    assert r"\tanh" in with_corner(effect, HYPERBOLIC).formula
    assert "arctan" not in with_corner(effect, HYPERBOLIC).formula


def test_a_friction_that_the_model_declares_keeps_its_corner():
    slope = {"friction_slope": Parameter(100.0, "s/m", fixed=True)}
    model = system("linear_oscillator").with_parameters(**slope)
    breakaway = find_effect("stribeck_friction")
    assert not has_corner(breakaway, model)
    assert term(breakaway, HYPERBOLIC, model) == term(breakaway, ARCTANGENT, model)
    # Coulomb friction has a velocity of its own.
    assert has_corner(find_effect("coulomb_friction"), model)


def test_an_effect_of_a_user_has_a_corner_where_it_has_a_direction():
    model = system("linear_oscillator")
    rubbing = force_effect("rubbing", "friction", "rubbing*direction", {"rubbing": "force"})
    assert has_corner(rubbing, model)
    assert term(rubbing, HYPERBOLIC).has(sp.tanh)
    drag = force_effect("drag", "damping", "drag*velocity", {"drag": "force/(position/s)"})
    assert not has_corner(drag, model)


def test_effects_without_a_direction_stay_as_they_are():
    model = system("linear_oscillator")
    cornered = {effect.id for effect in catalogue() if has_corner(effect, model)}
    friction = {"pressure_dependent_friction", "stroke_dependent_friction"}
    assert cornered == {*RUBBING, *friction, "load_dependent_friction"}
    for effect in catalogue():
        if effect.id in cornered or "position" not in effect.places(model):
            continue
        usual, other = (extended(effect, corner) for corner in (ARCTANGENT, HYPERBOLIC))
        assert usual.equations == other.equations
