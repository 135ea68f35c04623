"""New parameters carry the units that make every balance consistent."""

from __future__ import annotations

import pytest

from bayesoleo.effects import find_effect
from bayesoleo.effects._places import balance_unit, parse_unit, unit_of, unit_text
from bayesoleo.errors import ModelError
from bayesoleo.model import Model, Parameter
from bayesoleo.systems import system


@pytest.mark.slow
def test_every_balance_of_an_extended_model_has_one_unit(united_model, offered):
    for candidate in offered(united_model):
        extended = candidate.model
        for dof in extended.dofs:
            unit_of(extended.equation(dof), extended)  # raises where summands differ
        for name, output in extended.outputs.items():
            assert unit_of(extended.output(name), extended) == parse_unit(output.unit)


@pytest.mark.parametrize(
    ("effect", "unit"),
    [("cubic_stiffness", "N/m**3"), ("viscous_damping", "N/(m/s)"), ("coulomb_friction", "N")],
)
def test_units_read_as_an_engineer_writes_them(effect, unit, scales):
    candidate = find_effect(effect).extend(system("duffing"), "position", scales)
    assert candidate.model.parameters[effect].unit == unit


def test_balance_without_a_usual_unit(scales):
    model = Model(
        "circuit",
        inputs={"drive": "V"},
        dofs={"voltage": "V"},
        parameters={"gain": Parameter(1.0, "1/s**2", sd=1.0)},
        equations={"voltage": "ddot(voltage) - gain*drive"},
        outputs={"response": "voltage"},
    )
    unit = parse_unit(balance_unit(model, "voltage"))
    assert unit == parse_unit("V/s**2")


def test_unknown_unit_is_named():
    with pytest.raises(ModelError, match=r"unknown unit.*furlongg"):
        parse_unit("furlongg")


def test_sum_of_different_units_is_refused():
    model = system("duffing")
    wrong = model.with_term("equation", "position", "slip", "stiffness")
    with pytest.raises(ModelError, match="summands differ in unit"):
        unit_of(wrong.equation("position"), wrong)


def test_unit_text_of_a_number_is_empty():
    assert unit_text(parse_unit("")) == ""
