"""Terms that cannot be added are refused; units that an equation fixes are filled in."""

from __future__ import annotations

from dataclasses import replace

import pytest

from bayesoleo._units import dimensions, unit_of_dimensions
from bayesoleo.errors import ModelError
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.model._dimensions import check_dimensions
from bayesoleo.systems import system, systems

UNITS = {"mass": "kg", "damping": "N*s/m", "stiffness": "N/m", "cubic": "N/m**3"}
EQUATION = {
    "inertia": "mass*ddot(position)",
    "damping": "damping*dot(position)",
    "spring": "stiffness*position + cubic*position**3",
    "excitation": "-force",
}


def oscillator(units=(), shown: str = "m", equation=(), dof: str = "m") -> Model:
    return Model(
        "oscillator",
        inputs={"force": "N"},
        dofs={"position": Dof(dof)},
        parameters={k: Parameter(1.0, u, sd=1.0) for k, u in {**UNITS, **dict(units)}.items()},
        equations={"position": {**EQUATION, **dict(equation)}},
        outputs={"displacement": Output("position", shown)},
    )


@pytest.mark.parametrize("name", [getattr(item, "name", item) for item in systems()])
def test_built_in_systems_agree_with_themselves(name):
    model = system(name)
    assert check_dimensions(model) == model


@pytest.mark.parametrize(
    ("model", "message"),
    [
        (
            oscillator({"damping": "N*s"}),
            r"equation 'position': term 'damping' \(damping\*dot\(position\)\) is in .*, term"
            r" 'inertia'.* in N.*damping would have to be in N\*s/m",
        ),
        (oscillator({"cubic": "N/m**2"}), r"(cubic\*pos|stiff).* is in .*, (stiff|cubic\*pos)"),
        (oscillator(shown="m/s"), r"output 'displacement'.*position.* is in m, the output in m/s"),
        (
            oscillator(equation={"excitation": "-force*dot(position)"}),
            r"term 'excitation' .* is in W, term 'inertia'.* in N",
        ),
    ],
)
def test_what_cannot_be_added_is_refused_with_terms_and_units(model, message):
    with pytest.raises(ModelError, match=message):
        check_dimensions(model)


@pytest.mark.parametrize("left_out", [*UNITS, "all"])
def test_a_unit_that_the_equation_fixes_is_filled_in(left_out):
    units = dict.fromkeys(UNITS if left_out == "all" else [left_out], "")
    # In a sum within a term nothing stands alone.
    equation = {"spring": "stiffness*position", "hardening": "cubic*position**3"}
    found = check_dimensions(oscillator(units, equation=equation))
    for name, unit in UNITS.items():
        assert dimensions(found.parameters[name].unit) == dimensions(unit)
        assert found.parameters[name].prior == oscillator().parameters[name].prior


@pytest.mark.parametrize(
    "equation",
    [
        {"weight": "9.81*mass"},
        {"spring": "stiffness*(position - 0.1)"},
        {"damping": "unknown*tanh(dot(position)/0.01)"},
        {"spring": "1/2*stiffness*position*2"},
        {"spring": "unknown*position**exponent"},
        {"spring": "stiffness*abs(position) + max(stiffness*position, 0)"},
        {"friction": "unknown*sign(dot(position))"},
    ],
)
def test_what_is_not_known_agrees_with_everything(equation):
    model = oscillator({"unknown": "", "exponent": ""}, equation=equation)
    assert check_dimensions(model).parameters["mass"].unit == "kg"


def test_numbers_without_units_stay_numbers():
    plain = oscillator(dict.fromkeys(UNITS, ""), shown="", dof="")
    plain = replace(plain, inputs={"force": ""})
    assert check_dimensions(plain) == plain


@pytest.mark.parametrize("unit", ["N/m", "W/K", "kg*m**2", "mol/Pa", "N/m**1.5", "V", "1/s"])
def test_a_unit_is_written_from_its_dimensions(unit):
    assert dimensions(unit_of_dimensions(dimensions(unit))) == pytest.approx(dimensions(unit))
    assert unit_of_dimensions({}) == ""
