"""Where effects can be: an effect that needs a drive has one, and a force has its motion."""

from __future__ import annotations

import pytest
import sympy as sp

from bayesoleo.effects import catalogue, find_effect
from bayesoleo.effects._nonparametric import balance_places
from bayesoleo.effects._parts import Scales
from bayesoleo.effects._places import TargetUnits, force_places
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.model._expressions import derivative_symbol


def law(output: tuple[str, str], terms: str, **inputs: str) -> Model:
    """An output that follows inputs; ``a`` and ``b`` are its parameters."""
    name, unit = output
    used = {letter: Parameter(1.0, sd=1.0) for letter in "ab" if letter in terms}
    return Model("law", inputs=inputs, parameters=used, outputs={name: Output(terms, unit)})


def oscillator(force: str = "") -> Model:
    inputs = {"force": "N"} if force else {}
    return Model(
        "oscillator",
        inputs=inputs,
        dofs={"position": Dof("m")},
        parameters={"stiffness": Parameter(100.0, "N/m", sd=10.0)},
        equations={"position": f"ddot(position) + stiffness*position{force}"},
        outputs={"displacement": Output("position", "m")},
    )


def offered(model: Model) -> set[str]:
    return {effect.id for effect in catalogue() if effect.places(model)}


def test_nothing_hums_or_turns_where_nothing_drives():
    clocks = {"humming_force", "periodic_force"}
    assert clocks <= offered(oscillator(" - force"))
    free = offered(oscillator())
    assert not clocks & free
    assert {"coulomb_friction", "cubic_stiffness", "drifting_force"} <= free


@pytest.mark.parametrize(
    ("model", "places"),
    [
        (law(("force", "N"), "a*dot(x) + b*p", x="m", p="Pa"), ["force/x"]),
        (law(("force", "N"), "a*dot(x) + b*i", x="m", i="A"), ["force/x"]),
        (law(("torque", "N*m"), "a*dot(x) + b*t", x="rad", t="K"), ["torque/x"]),
        (law(("force", "N"), "a*x + b*y", x="m", y="m"), ["force/x", "force/y"]),
        (law(("force", "N"), "a*x", x="m"), ["force"]),
        (law(("pressure", "Pa"), "a*x", x="m"), ["pressure"]),
        (law(("pressure", "Pa"), "a*x", x="m**3"), ["pressure"]),
        (law(("stress", "Pa"), "a*x", x="m/m"), ["stress"]),
        (law(("restoring", "m/s**2"), "a*x", x="m"), ["restoring"]),
        (law(("voltage", "V"), "a*x", x="C"), ["voltage"]),
        # raw readings, and units that nobody stated
        (law(("force", "V"), "a*x", x="V"), ["force"]),
        (law(("force", ""), "a*x + b*y", x="m", y=""), ["force/x", "force/y"]),
        # a velocity, a current and a force are no motion
        (law(("force", "N"), "a*x", x="m/s"), []),
        (law(("voltage", "V"), "a*x", x="A"), []),
        (law(("shown", "m"), "a*x", x="N"), []),
        (law(("force", "N"), "a*p", p="Pa"), []),
    ],
)  # fmt: skip
def test_a_force_acts_on_a_motion(model, places):
    assert list(force_places(model)) == places
    for effect in catalogue():
        if effect.family in ("damping", "friction", "stiffness", "contact", "force", "compliance"):
            assert set(effect.places(model)) <= set(places), effect.id
    # A curve without a name needs no motion, and an output is a channel anyway.
    assert balance_places(model)
    assert "sensor_offset" in offered(model)


@pytest.mark.parametrize(
    ("model", "side"),
    [
        (law(("force", "N"), "a*dot(x) + b*x", x="m"), 1),
        # What a load cell on the other body shows is added in the same sense.
        (law(("force", "N"), "-a*dot(x) - b*x", x="m"), 1),
        (law(("force", "N"), "a*dot(x) + b*dot(x)**2*tanh(dot(x))", x="m"), 1),
        (law(("force", "N"), "a*dot(x) - b*dot(x)*abs(x)", x="m"), 0),  # nobody knows
        (law(("force", "N"), "a*dot(x) + b*ddot(x)", x="m"), 0),  # what is stated may be too large
        (law(("force", "N"), "a*x", x="m"), 0),
    ],
)
def test_a_law_without_inertia_can_only_lack_some(model, side):
    """A mass that is less than none looks like a spring."""
    assert find_effect("mass_error").side(model, "force") == side


def test_the_mass_of_an_oscillator_may_be_wrong_either_way():
    assert find_effect("mass_error").side(oscillator(" - force"), "position") == 0


def test_the_first_order_keeps_what_needs_no_velocity():
    thermal = Model(
        "thermal",
        inputs={"heat": "W"},
        dofs={"temperature": Dof("K")},
        parameters={"loss": Parameter(1.0, "W/K", sd=1.0)},
        equations={"temperature": "dot(temperature) + loss*temperature - heat"},
        outputs={"reading": Output("temperature", "K")},
    )
    found = offered(thermal)
    assert {"cubic_stiffness", "constant_force"} <= found
    assert not {"viscous_damping", "coulomb_friction", "mass_error"} & found


@pytest.mark.parametrize(
    ("name", "right", "wrong", "effect"),
    [
        ("gravity", "m/s**2", "N", "gravity_error"),
        ("initial_volume", "m**3", "m", "extra_volume"),
        ("initial_pressure", "Pa", "N", "initial_pressure_error"),
    ],
)
def test_a_name_alone_is_not_the_quantity(name, right, wrong, effect):
    def with_unit(unit: str) -> Model:
        constant = {name: Parameter(1.0, unit, fixed=True)}
        return oscillator(" - force").with_parameters(**constant)

    assert effect in offered(with_unit(right))
    assert effect in offered(with_unit(""))
    assert effect not in offered(with_unit(wrong))


def _law(sense: str) -> Model:
    terms = {"damping": "damping*dot(x)", "spring": "stiffness*x + cubic*x**3"}
    known = {"damping": 200.0, "stiffness": 1e3, "cubic": 2e6}
    units = {"damping": "N*s/m", "stiffness": "N/m", "cubic": "N/m**3"}
    return Model(
        "law",
        inputs={"x": "m"},
        parameters={n: Parameter(v, units[n], relative_sd=0.5) for n, v in known.items()},
        outputs={"force": Output({n: f"{sense}({t})" for n, t in terms.items()}, "N")},
    )


@pytest.mark.parametrize(
    "effect",
    [
        effect
        for effect in catalogue()
        if effect.family in ("damping", "friction", "stiffness", "contact", "compliance")
        and "force" in effect.places(_law(""))
    ],
    ids=lambda effect: effect.id,
)
def test_a_load_cell_on_the_other_body_shows_every_effect_reversed(effect):
    """Of the force that the specimen exerts instead of the one that it feels only the sign differs,
    so that what only resists is found with either."""
    scales = Scales({"x": (-0.01, 0.01)}, {"x": 0.1}, {"force": 50.0}, 1.0, 1.0)
    felt, exerted = (effect.extend(_law(sense), "force", scales) for sense in ("", "-"))
    fed_back = [derivative_symbol("force_within_x", order) for order in range(3)]
    turned = {one: -one for one in fed_back}
    whole = felt.model.expand(felt.model.output("force")).subs(turned, simultaneous=True)
    other = exerted.model.expand(exerted.model.output("force"))
    assert sp.simplify(whole + other) == 0
    assert (felt.sign, felt.usual) == (exerted.sign, exerted.usual)


def test_a_spring_alone_says_in_which_sense_a_load_cell_reads():
    spring = Model(
        "spring",
        inputs={"x": "m"},
        parameters={"stiffness": Parameter(1e3, "N/m", relative_sd=0.5)},
        outputs={"force": Output("-stiffness*x", "N")},
    )
    assert [place.sign for place in spring.coordinates()] == [-1]


def test_a_term_that_is_not_real_everywhere_says_nothing_of_the_sense():
    """A contact beyond the stroke: the force of a negative compression has no real value."""
    law = Model(
        "spring and contact",
        inputs={"x": "m"},
        parameters={
            "stiffness": Parameter(1e3, "N/m", relative_sd=0.5),
            "contact": Parameter(1e4, "N/m**1.5", relative_sd=0.5),
        },
        outputs={"force": Output("-stiffness*x - positive(contact*(x - 2)**1.5 + 0.1)", "N")},
    )
    assert [place.sign for place in law.coordinates()] == [-1]


@pytest.mark.parametrize(
    ("force", "position", "text", "expected"),
    [
        ("V/s", "V", "force/position", "1/s"),
        ("m/s**2", "m", "force/position**3", "1/m**2/s**2"),
        ("N", "m", "force/(position/s)", "N/(m/s)"),
        ("N", "m", "force/position**3", "N/m**3"),
    ],
)
def test_what_cancels_in_a_unit_is_left_out(force, position, text, expected):
    assert TargetUnits({"force": force, "position": position}).resolve(text) == expected
