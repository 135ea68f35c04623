"""Where a velocity of first order stands, effects of velocities act, and the same in any form."""

from __future__ import annotations

import pytest
import sympy as sp

from bayesoleo.effects import Scales, catalogue, find_effect
from bayesoleo.effects._nonparametric import balance_places
from bayesoleo.effects._places import (
    between_places,
    force_places,
    parse_unit,
    storing_places,
    target_units,
)
from bayesoleo.model import Model, Output, Parameter
from bayesoleo.model._expressions import derivative_symbol, symbol


def offered(model: Model, target: str) -> set[str]:
    return {effect.id for effect in catalogue() if target in effect.places(model)}


def motor(*, current: bool = False) -> Model:
    """A free shaft that a torque drives, or the current of a coil."""
    parameters = {
        "inertia": Parameter(2e-3, "kg*m**2", relative_sd=0.5),
        "viscous": Parameter(4e-3, "N*m*s/rad", relative_sd=0.5),
    }
    dofs = {"speed": "rad/s"}
    equations = {"speed": {"inertia": "inertia*dot(speed)", "viscous": "viscous*speed"}}
    if current:
        dofs["coil"] = "A"
        for name, unit in {"k": "N*m/A", "L": "H", "R": "ohm"}.items():
            parameters[name] = Parameter(1.0, unit, relative_sd=0.5)
        equations["speed"]["motor"] = "-k*coil"
        equations["coil"] = {"all": "L*dot(coil) + R*coil + k*speed - voltage"}
    else:
        equations["speed"]["drive"] = "-torque"
    return Model(
        "motor",
        inputs={"voltage": "V"} if current else {"torque": "N*m"},
        dofs=dofs,
        parameters=parameters,
        equations=equations,
        outputs={"shown": Output("speed", "rad/s")},
    )


#: What a free shaft may have, and what needs a place.
OF_VELOCITY = {
    "viscous_damping", "quadratic_damping", "power_law_damping", "direction_dependent_damping",
    "compression_damping", "coulomb_friction", "asymmetric_friction", "stribeck_friction",
    "dahl_friction", "bouc_wen_friction", "lugre_friction", "constant_force",
    "force_offset_by_run", "periodic_force", "humming_force", "drifting_force", "mass_error",
}  # fmt: skip
OF_POSITION = {
    "linear_stiffness", "cubic_stiffness", "stroke_dependent_friction", "backlash_friction",
    "stroke_dependent_damping", "end_stop_lower", "end_stop_upper", "hertzian_contact_upper",
    "play", "preload",
}  # fmt: skip


@pytest.mark.parametrize("current", [False, True])
def test_a_free_shaft_has_friction_and_no_spring_stop_or_brim(current):
    model = motor(current=current)
    assert list(force_places(model)) == ["speed"]
    found = offered(model, "speed")
    assert found >= OF_VELOCITY
    assert not found & (OF_POSITION | {"load_dependent_friction", "frame_compliance", "overflow"})
    assert not storing_places(model)
    # A function without a name may still act on the current.
    assert list(balance_places(model)) == list(model.dofs)


def test_units_at_a_free_shaft():
    """The damping that is added has the unit of that which is there, and an angle is in rad."""
    model = motor()
    units = target_units(model, "speed")
    assert units.resolve("position") == "rad"
    scales = Scales({"speed": (0.0, 50.0)}, {"speed": 30.0}, {"shown": 60.0}, 0.5, 2.0)
    for effect, unit in {
        "coulomb_friction": "N*m", "viscous_damping": "N*m/(rad/s)", "mass_error": "N*m/(rad/s**2)"
    }.items():  # fmt: skip
        candidate = find_effect(effect).extend(model, "speed", scales)
        (name,) = candidate.parameters
        assert parse_unit(candidate.model.parameters[name].unit) == parse_unit(unit)
    # The transition is scanned below the largest velocity, not the largest acceleration.
    (shape,) = find_effect("coulomb_friction").shapes
    assert max(shape.grid(model, "speed", scales)) == pytest.approx(30.0 / 4)


UNITS = {"m": "kg", "c": "N*s/m", "k": "N/m", "m2": "kg", "kc": "N/m", "cc": "N*s/m"}


def chain(bodies: int, *, states: bool) -> Model:
    """One mass or two, of second order, or each with a velocity of its own."""
    terms = {
        1: {"x": {"inertia": "m*{a}", "damping": "c*{v}", "spring": "k*{x}", "drive": "-force"}},
        2: {
            "x": {
                "inertia": "m*{a}", "damping": "c*{v}", "spring": "k*{x}", "drive": "-force",
                "coupling": "kc*({x} - {y}) + cc*({v} - {w})",
            },
            "y": {"inertia": "m2*{b}", "coupling": "-kc*({x} - {y}) - cc*({v} - {w})"},
        },
    }[bodies]  # fmt: skip
    plain = {"x": "x", "v": "dot(x)", "a": "ddot(x)", "y": "y", "w": "dot(y)", "b": "ddot(y)"}
    first = {"x": "x", "v": "v", "a": "dot(v)", "y": "y", "w": "w", "b": "dot(w)"}
    rate = {"x": "v", "y": "w"}
    dofs, equations = {}, {}
    for place, balance in terms.items():
        written = {n: t.format(**(first if states else plain)) for n, t in balance.items()}
        dofs[place] = "m"
        if states:
            dofs[rate[place]] = "m/s"
            equations[place] = f"dot({place}) - {rate[place]}"
            equations[rate[place]] = written
        else:
            equations[place] = written
    used = list(UNITS)[: 3 if bodies == 1 else None]
    return Model(
        "chain",
        inputs={"force": "N"},
        dofs=dofs,
        parameters={name: Parameter(1.0, UNITS[name], relative_sd=0.5) for name in used},
        equations=equations,
        outputs={"displacement": Output("x", "m")},
    )


PAIRS = {1: {"x": "v"}, 2: {"x": "v", "y": "w", "x-y": "v-w"}}
SCALES = Scales(
    dict.fromkeys(("x", "y", "x-y", "v", "w", "v-w"), (-0.1, 0.2)),
    dict.fromkeys(("x", "y", "x-y", "v", "w", "v-w"), 3.0),
    {"displacement": 0.3},
    1.0,
    1.0,
)
#: States in terms of the positions.
RATES = {
    derivative_symbol(v, n): derivative_symbol(x, n + 1) for x, v in PAIRS[2].items()
    for n in range(2)
}  # fmt: skip


@pytest.mark.parametrize("bodies", [1, 2])
def test_the_form_of_a_model_does_not_change_what_may_be_missing(bodies):
    plain, states = chain(bodies, states=False), chain(bodies, states=True)
    for place, velocity in PAIRS[bodies].items():
        found = offered(plain, place)
        assert offered(states, velocity) == found
        assert {"coulomb_friction", "cubic_stiffness", "end_stop_upper"} <= found
        assert not storing_places(states)
    terms = {
        (effect.id, target.split(".")[1])
        for effect in catalogue()
        for target in effect.places(plain)
        if effect.family == "dependence"
    }
    assert terms == {
        (effect.id, target.split(".")[1])
        for effect in catalogue()
        for target in effect.places(states)
        if effect.family == "dependence"
    }


@pytest.mark.slow
@pytest.mark.parametrize("effect", catalogue(), ids=lambda effect: effect.id)
def test_an_effect_is_the_same_law_in_either_form(effect):
    plain, states = chain(2, states=False), chain(2, states=True)
    for place, velocity in PAIRS[2].items():
        if place not in effect.places(plain):
            continue
        one, other = effect.extend(plain, place, SCALES), effect.extend(states, velocity, SCALES)
        assert dict(zip(one.parameters, other.parameters, strict=True))
        for a, b in zip(one.parameters, other.parameters, strict=True):
            assert one.model.parameters[a].unit == other.model.parameters[b].unit
        renamed = {symbol(b): symbol(a) for a, b in zip(names(one), names(other), strict=True)}
        for dof, rate in {"x": "v", "y": "w"}.items():
            first = one.model.expand(one.model.equation(dof))
            second = other.model.expand(other.model.equation(rate)).xreplace(RATES)
            assert sp.expand(first - second.xreplace(renamed)) == 0
        assert [*one.sign.values()] == [*other.sign.values()]
        assert [*one.usual.values()] == [*other.usual.values()]


def names(candidate) -> list[str]:
    """New parameters and states, in their order."""
    model = candidate.model
    own = [*chain(2, states=True).dofs, *UNITS]
    return [name for name in (*model.parameters, *model.dofs) if name not in own]


def test_friction_between_two_inertias_is_felt_by_both():
    model = Model(
        "slipping clutch",
        inputs={"torque": "N*m"},
        dofs={"engine": "rad/s", "wheel": "rad/s"},
        parameters={name: Parameter(2.0, "kg*m**2", relative_sd=0.5) for name in ("J1", "J2")},
        equations={"engine": "J1*dot(engine) - torque", "wheel": "J2*dot(wheel)"},
        outputs={"shown": Output("wheel", "rad/s")},
    )
    (place,) = between_places(model).values()
    assert (place.name, place.position) == ("engine-wheel", None)
    found = offered(model, place.name)
    assert {"coulomb_friction", "viscous_damping", "dahl_friction"} <= found
    assert not found & (OF_POSITION | {"mass_error"})
    added = find_effect("viscous_damping").extend(
        model, place.name, Scales({}, {place.name: 1.0}, {}, 1.0, 1.0)
    )
    (c,) = map(symbol, added.parameters)
    slip = symbol("engine") - symbol("wheel")
    for dof, sign in {"engine": 1, "wheel": -1}.items():
        force = added.model.equation(dof) - model.equation(dof)
        assert sp.expand(force - sign * c * slip) == 0


@pytest.mark.parametrize("turned", [False, True])
def test_a_shaft_that_twists_may_be_stiffer_than_stated(turned):
    """The twist is that of the first less the second inertia, or the other way round."""
    sign = "-" if turned else ""
    model = Model(
        "drive train",
        inputs={"torque": "N*m"},
        dofs={"engine": "rad/s", "twist": "rad", "wheel": "rad/s"},
        parameters={
            "J1": Parameter(2.0, "kg*m**2", relative_sd=0.5),
            "J2": Parameter(2.0, "kg*m**2", relative_sd=0.5),
            "k": Parameter(2.0, "N*m/rad", relative_sd=0.5),
        },
        equations={
            "engine": f"J1*dot(engine) + {sign}k*twist - torque",
            "twist": f"dot(twist) + {sign}(wheel - engine)",
            "wheel": f"J2*dot(wheel) - {sign}k*twist",
        },
        outputs={"shown": Output("wheel", "rad/s")},
    )
    assert set(force_places(model)) == {"engine", "wheel"}
    (target,) = between_places(model)
    assert target == ("wheel-engine" if turned else "engine-wheel")
    scales = Scales({target: (-0.1, 0.1)}, {target: 1.0}, {}, 1.0, 1.0)
    added = find_effect("cubic_stiffness").extend(model, target, scales)
    (k3,) = added.parameters
    assert parse_unit(added.model.parameters[k3].unit) == parse_unit("N*m/rad**3")
    # It stands wherever the linear spring stands, with the same sign.
    cube = symbol(k3) * symbol("twist") ** 3
    for dof in ("engine", "wheel"):
        spring = sp.diff(model.equation(dof), symbol("twist")) / symbol("k")
        assert sp.expand(added.model.equation(dof) - model.equation(dof) - spring * cube) == 0


def test_a_sensor_s_lag_is_no_body():
    lagging = find_effect("first_order_lag").extend(
        motor(), "shown", Scales({"speed": (0.0, 1.0)}, {"speed": 1.0}, {"shown": 1.0}, 1.0, 1.0)
    )
    assert list(force_places(lagging.model)) == ["speed"]
