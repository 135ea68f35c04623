"""Built-in systems: listed, described, consistent, and as the thesis has them."""

from __future__ import annotations

import json

import pytest
import sympy as sp
from matplotlib.mathtext import MathTextParser

from bayesoleo.effects._places import parse_unit, unit_of
from bayesoleo.errors import InputError
from bayesoleo.model import driven_by
from bayesoleo.model._expressions import parse, symbol
from bayesoleo.systems import describe, system, systems

DIMENSIONLESS = ("van_der_pol", "lorenz", "rossler")


@pytest.mark.slow
@pytest.mark.parametrize("name", systems())
def test_description_is_json_and_its_formulas_render(name):
    listed = json.loads(json.dumps(describe(system(name)), allow_nan=False))
    assert listed["name"] == name
    assert listed["description"]
    parser = MathTextParser("path")
    for line in listed["equations_latex"]:
        parser.parse(f"${line}$")


@pytest.mark.parametrize("name", systems())
def test_text_of_equations_reads_back(name):
    model = system(name)
    known = {str(item): item for item in sp.Add(*map(model.output, model.outputs)).free_symbols}
    names = (*model.inputs, *model.dofs, *model.parameters, *model.conditions, *model.definitions)
    known |= {item: symbol(item) for item in names}
    lines = describe(model)["equations"]
    for dof in model.dofs:
        text = lines[dof].removesuffix(" = 0")
        whole = sp.Add(*model.equations[dof].values())
        again = parse(text, known, (*model.dofs, *model.inputs), "here")
        assert sp.simplify(again - whole) == 0


@pytest.mark.parametrize("name", [name for name in systems() if name not in DIMENSIONLESS])
def test_units_are_consistent(name):
    model = system(name)
    for dof in model.dofs:
        unit_of(model.equation(dof), model)
    for channel, output in model.outputs.items():
        assert unit_of(model.output(channel), model) == parse_unit(output.unit)


def test_unknown_system_names_the_closest():
    with pytest.raises(InputError, match=r"unknown system.*f16n2d3.*did you mean f16n2d"):
        system("f16n2d3")


def pressure(name: str, stroke: float, **changes: float) -> float:
    """Absolute pressure in bar at ambient temperature."""
    model = system(name)
    numbers = model.nominal() | {symbol("stroke"): stroke, symbol("temperature"): 293.0}
    numbers |= {symbol(key): value for key, value in changes.items()}
    return float(model.expand(symbol("gas_pressure")).subs(numbers)) / 1e5


@pytest.mark.parametrize(("stroke", "expected"), [(0.249, 52.0), (0.254, 64.0), (0.259, 84.0)])
def test_isothermal_pressure_of_the_thermomechanical_oleo(stroke, expected):
    """Verbeek (1993), section 6 with theta_7 > 0 and theta_6 = -3.787 1/m."""
    assert pressure("f16n2d2_thesis", stroke) == pytest.approx(expected, abs=0.6)
    assert pressure("f16n2d2", stroke) == pytest.approx(expected, abs=0.8)


@pytest.mark.parametrize("name", ["f16n2d2", "f16n2d2_thesis", "f16n2d2_thesis_printed"])
def test_pressure_at_rest_is_the_initial_pressure(name):
    assert pressure(name, 0.0) == pytest.approx(4.9)


@pytest.mark.parametrize(
    ("name", "expected"), [("f16n2d1_thesis", 1742), ("f16n2d1_thesis_printed", 1603)]
)
def test_theta_5_of_either_sign(name, expected):
    model = system(name)
    assert float(model.definitions["theta_5"].subs(model.nominal())) == pytest.approx(
        expected, abs=1
    )


def test_heat_capacity_is_theta_15():
    model = system("f16n2d2")
    theta_15 = model.expand(symbol("heat_capacity")).subs(model.nominal())
    assert float(theta_15) == pytest.approx(3.85, abs=0.01)


@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("dofs", [1, 2])
def test_thesis_variant_estimates_three_theta(dofs, outputs):
    model = system(f"f16n{dofs}d{outputs}_thesis")
    last = "theta_7" if dofs == 1 else "theta_16"
    assert set(model.estimated()) == {"theta_4", "theta_6", last}
    for name in model.estimated():
        parameter = model.parameters[name]
        assert parameter.prior.sd == pytest.approx(0.1 * abs(parameter.value))


def test_thesis_variant_is_the_physical_one_at_nominal_values():
    """To the four digits in which the thesis gives its theta."""
    state = {symbol("stroke"): 0.1, symbol("dot(stroke)"): 0.1, symbol("ddot(stroke)"): 0.3}
    state |= {symbol("temperature"): 300.0, symbol("dot(temperature)"): 2.0, symbol("force"): 0.0}
    for dof in ("stroke", "temperature"):
        physical, thesis = (
            float(m.equation(dof).subs(m.nominal()).subs(state))
            for m in (system("f16n2d1"), system("f16n2d1_thesis"))
        )
        assert thesis == pytest.approx(physical, rel=2e-3)


def test_oleo_can_be_driven_by_displacement():
    assert set(driven_by(system("f16n2d2_thesis"), "displacement").dofs) == {"temperature"}
