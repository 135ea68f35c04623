"""Dofs of first order that are velocities have a place, and the position that an equation names."""

from __future__ import annotations

import pytest

from bayesoleo.model import Model, Output, Parameter
from bayesoleo.model._expressions import symbol
from bayesoleo.model._model import velocities_of
from bayesoleo.model._velocity_dofs import is_velocity

UNITS = {
    "J": "kg*m**2", "J2": "kg*m**2", "b": "N*m*s/rad", "k": "N*m/rad", "tau": "s", "gain": "rad/s",
    "ratio": "", "rate": "1/s",
}  # fmt: skip


def shafts(dofs: dict[str, str], inputs: dict[str, str] | None = None, **equations: str) -> Model:
    """Rotating parts, with what they need of :data:`UNITS`."""
    used = {n: u for n, u in UNITS.items() if any(symbol_in(n, e) for e in equations.values())}
    return Model(
        "shafts",
        inputs={"torque": "N*m"} if inputs is None else inputs,
        dofs=dofs,
        parameters={name: Parameter(2.0, unit, relative_sd=0.5) for name, unit in used.items()},
        equations=equations,
        outputs={"shown": Output(" + ".join(dofs), "")},
    )


def symbol_in(name: str, text: str) -> bool:
    return name in text.replace("(", " ").replace(")", " ").replace("*", " ").split()


def places(model: Model) -> dict[str, tuple[object, object, object]]:
    return {c.target: (c.position, c.velocity, c.acceleration) for c in model.coordinates()}


FREE = "J*dot(w) + b*w - torque"


@pytest.mark.parametrize("unit", ["m/s", "rad/s", "V", "1/s", "K", "m", ""])
def test_the_unit_says_whether_a_dof_of_first_order_is_a_velocity(unit):
    (place,) = shafts({"w": unit}, w=FREE).coordinates()
    if is_velocity(unit):
        assert unit in ("m/s", "rad/s")
        assert (place.position, place.velocity) == (None, symbol("w"))
        assert place.acceleration == symbol("dot(w)")
    else:
        assert (place.position, place.velocity, place.acceleration) == (symbol("w"), None, None)


def test_a_dof_of_second_order_is_as_it_was():
    model = shafts({"w": "rad/s"}, w="J*ddot(w) + b*w - torque")
    assert places(model) == {"w": (symbol("w"), symbol("dot(w)"), symbol("ddot(w)"))}


@pytest.mark.parametrize(
    ("equation", "known"),
    [
        ("dot(q) - w", True),
        ("w - dot(q)", True),
        ("3*dot(q) - 3*w", True),
        ("ratio*(dot(q) - w)", True),
        ("dot(q) + w", False),  # it runs the other way
        ("dot(q) - 2*w", False),  # behind a gear
        ("dot(q) - ratio*w", False),
        ("dot(q) - w + rate*q", False),
        ("w*(dot(q) - w)", False),
    ],
)
def test_a_dof_whose_rate_is_a_velocity_is_its_position_and_no_place(equation, known):
    model = shafts({"q": "rad", "w": "rad/s"}, q=equation, w=FREE + " + k*q")
    found = places(model)
    assert found["w"] == (symbol("q") if known else None, symbol("w"), symbol("dot(w)"))
    assert ("q" in found) != known


@pytest.mark.parametrize("equation", ["dot(q) - w + w2", "2*w - 2*w2 - 2*dot(q)"])
def test_a_dof_whose_rate_is_a_difference_of_velocities_is_a_twist(equation):
    dofs = {"w": "rad/s", "q": "rad", "w2": "rad/s"}
    model = shafts(dofs, w=FREE + " + k*q", q=equation, w2="J2*dot(w2) - k*q")
    assert {name: place[0] for name, place in places(model).items()} == {"w": None, "w2": None}
    assert velocities_of(model).position_of("w", "w2") == "q"
    assert velocities_of(model).position_of("w2", "w") is None


@pytest.mark.parametrize(
    ("equation", "body"),
    [
        ("tau*dot(s) + s - w", False),
        ("dot(s) + rate*(s - w)", False),
        ("tau*dot(s) + s - gain*torque/torque", True),  # a fan of its own
        ("J2*dot(s) + b*(s - w)", True),
    ],
)
def test_what_only_follows_a_motion_is_no_body(equation, body):
    """A filter, or what a slow sensor shows."""
    model = shafts({"w": "rad/s", "s": "rad/s"}, w=FREE, s=equation)
    assert velocities_of(model).velocities == ({"w", "s"} if body else {"w"})
    assert {place.name for place in model.coordinates()} == {"w", "s"}
    other = next(place for place in model.coordinates() if place.name == "s")
    assert (other.velocity is not None) == body


def test_two_bodies_over_their_inertias_act_on_one_another():
    model = shafts(
        {"w": "rad/s", "s": "rad/s"},
        w="dot(w) + rate*(w - s) - gain*rate",
        s="dot(s) - rate*(w - s)",
    )
    assert velocities_of(model).velocities == {"w", "s"}


def test_a_servo_that_follows_a_command_is_a_body_where_nothing_else_moves():
    servo = {"w": "tau*dot(w) + w - command"}
    inputs = {"command": "rad/s"}
    assert velocities_of(shafts({"w": "rad/s"}, inputs, **servo)).velocities == {"w"}
    beside = shafts({"w": "rad/s", "q": "rad"}, inputs, **servo, q="J*ddot(q) + k*(q - w*tau)")
    assert not velocities_of(beside).velocities


def test_units_that_are_filled_in_later_count():
    """They tell a filter from a body."""
    model = shafts({"w": "rad/s", "s": "rad/s"}, w=FREE, s="tau*dot(s) + s - w")
    undeclared = model.with_parameters(tau=Parameter(2.0, "", relative_sd=0.5))
    filled = undeclared.with_parameters(tau=Parameter(2.0, "s", relative_sd=0.5))
    assert velocities_of(filled).velocities == {"w"}
