"""Driving by another channel exchanges roles and keeps the law."""

from __future__ import annotations

import pytest
import sympy as sp
from hypothesis import given, settings, strategies as st

from bayesoleo.errors import ModelError
from bayesoleo.model import Model, Output, Parameter, driven_by, possible_drives
from bayesoleo.model._expressions import derivative_symbol, symbol
from bayesoleo.systems import system


def residual_after_answer(name: str, motion: tuple[float, ...], temperature: float) -> float:
    """Native equation of motion with the force that the driven model answers."""
    model = system(name)
    driven = driven_by(model, "displacement")
    dof = next(iter(model.dofs))
    numbers = model.nominal() | {symbol("temperature"): temperature}
    channel = {derivative_symbol("displacement", n): x for n, x in enumerate(motion)}
    force = driven.output("force").subs(numbers).subs(channel)
    state = {derivative_symbol(dof, n): x for n, x in enumerate(motion)}
    balance = model.equation(dof).subs(numbers).subs(state).subs(symbol("force"), force)
    return float(balance) / max(1.0, abs(float(force)))


@settings(max_examples=15, deadline=None)
@given(
    st.sampled_from(["f16n1d2", "f16n2d2", "duffing", "end_stop"]),
    st.tuples(st.floats(0.02, 0.2), st.floats(-0.2, 0.2), st.floats(-5.0, 5.0)),
    st.floats(280.0, 320.0),
)
def test_answer_balances_the_native_equation(name, motion, temperature):
    assert residual_after_answer(name, motion, temperature) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("name", ["f16n2d2", "duffing", "viscous_damper"])
def test_own_drive_changes_nothing(name):
    model = system(name)
    assert driven_by(model, next(iter(model.inputs))) is model


def test_channels_are_exchanged():
    driven = driven_by(system("f16n2d2"), "displacement")
    assert set(driven.inputs) == {"displacement"}
    assert set(driven.outputs) == {"force", "pressure"}
    assert set(driven.dofs) == {"temperature"}
    assert driven.outputs["force"].unit == "N"


def test_impossible_drive_lists_the_possible():
    with pytest.raises(ModelError, match=r"driven by 'voltage'.*force, displacement, pressure"):
        driven_by(system("f16n2d2"), "voltage")


@pytest.mark.parametrize("name", ["lorenz", "viscous_damper", "gas_spring"])
def test_models_without_another_drive(name):
    model = system(name)
    assert possible_drives(model) == tuple(model.inputs)


def oscillator(output: str, drive: str = "-force") -> Model:
    return Model(
        "o",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={"k": Parameter(2.0, sd=1.0), "e": Parameter(0.0, sd=1.0)},
        equations={"q": {"inertia": "ddot(q)", "spring": "k*q", "drive": drive}},
        outputs={"y": Output(output, "m")},
    )


@pytest.mark.parametrize(
    ("output", "inverse"), [("q", "y"), ("(1 + e)*q", "y/(1 + e)"), ("q + e", "y - e")]
)
def test_linear_maps_are_inverted(output, inverse):
    driven = driven_by(oscillator(output), "y")
    position = sp.sympify(inverse, locals={"y": symbol("y"), "e": symbol("e")})
    slope = sp.diff(position, symbol("y"))
    expected = slope * derivative_symbol("y", 2) + symbol("k") * position
    assert driven.dofs == {}
    assert sp.simplify(driven.output("force") - expected) == 0


@pytest.mark.parametrize("output", ["q + e*force", "q - e*dot(q)", "q + e*q**3"])
def test_other_maps_keep_the_dof(output):
    driven = driven_by(oscillator(output), "y")
    assert set(driven.dofs) == {"q"}
    at_null = driven.equation("q").subs(symbol("e"), 0)
    assert at_null == symbol("q") - symbol("y")


def test_input_with_its_rate_becomes_a_state():
    driven = driven_by(oscillator("q", "-(force + e*dot(force))"), "y")
    state = symbol("force_answer")
    expected = derivative_symbol("y", 2) + symbol("k") * symbol("y") - state
    expected -= symbol("e") * derivative_symbol("force_answer", 1)
    assert sp.expand(driven.equation("force_answer") - expected) == 0
    answer = driven.output("force").subs(symbol("e"), 0)
    assert answer == derivative_symbol("y", 2) + symbol("k") * symbol("y")
    assert sp.expand(driven.output("force") - state - driven.equation("force_answer")) == 0


def test_drifting_channel_is_no_drive():
    assert possible_drives(oscillator("q + e*time")) == ("force",)
