"""Laws of forces between two bodies, of terms that follow a further quantity, of backlash, lags."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

from bayesoleo.effects import Scales, candidates, catalogue, find_effect
from bayesoleo.effects._catalogue import with_titles
from bayesoleo.effects._places import between_places, parse_unit, unit_of
from bayesoleo.effects._terms import terms_of
from bayesoleo.model import Condition, Dof, Model, Output, Parameter
from bayesoleo.model._expressions import derivative_symbol, symbol
from bayesoleo.systems import system

PLACES = ("upper", "lower", "upper-lower", "road", "upper-road", "lower-road")
SIZES = Scales(
    position=dict.fromkeys(PLACES, (-0.01, 0.01)),
    velocity=dict.fromkeys(PLACES, 0.5),
    output={},
    shortest_period=0.1,
    longest_period=1.0,
)


def masses(
    *, joined: bool = True, divided: bool = False, unit: str = "m", road: bool = False
) -> Model:
    """Two masses on springs, by heights; as accelerations where both balances are divided."""
    spring = "coupling*(upper - lower)"
    ground = "ground*(lower - road)" if road else "ground*lower"
    upper = {"inertia": "upper_mass*ddot(upper)", "own": "own*upper"}
    lower = {"inertia": "-lower_mass*ddot(lower)", "ground": f"-{ground}", "excitation": "force"}
    if joined:
        upper["spring"], lower["spring"] = spring, spring
    parameters = {
        "upper_mass": Parameter(2.0, "kg", fixed=True),
        "lower_mass": Parameter(3.0, "kg", fixed=True),
        "ground": Parameter(2e4, "N/m", sd=1.0),
        "own": Parameter(1e3, "N/m", sd=1.0),
    }
    if joined:
        parameters["coupling"] = Parameter(1e4, "N/m", sd=1.0)
    if divided:
        upper = {name: f"({text})/upper_mass" for name, text in upper.items()}
        lower = {name: f"({text})/lower_mass" for name, text in lower.items()}
    return Model(
        "masses",
        inputs={"force": "N", **({"road": "m"} if road else {})},
        dofs={"upper": Dof("m"), "lower": Dof(unit)},
        parameters=parameters,
        equations={"upper": upper, "lower": lower},
        outputs={"shown": Output("upper", "m"), "other": Output("lower", unit)},
    )


def test_a_difference_that_the_model_follows_is_a_place():
    (place,) = between_places(masses()).values()
    assert (place.name, place.target, place.other) == ("upper-lower", "upper", "lower")


def test_differences_of_one_unit_are_places_and_others_not():
    assert list(between_places(masses(joined=False))) == ["upper-lower"]
    assert not between_places(masses(joined=False, unit="rad"))
    # Nobody knows by what each balance was divided where nothing joins them.
    assert not between_places(masses(joined=False, divided=True))
    assert not between_places(system("f16n2d2"))


def test_an_input_that_a_spring_follows_is_the_other_end():
    found = between_places(masses(road=True))
    assert set(found) == {"upper-lower", "lower-road"}
    assert found["lower-road"].share == 0


@pytest.mark.parametrize("divided", [False, True])
@pytest.mark.parametrize(
    "id_", ["cubic_stiffness", "viscous_damping", "coulomb_friction", "play", "dahl_friction"]
)
def test_a_force_between_bodies_is_equal_and_opposite(id_, divided):
    """Newton's third law, whatever sign a balance is written in and whatever it is divided by."""
    model = masses(divided=divided)
    extended = find_effect(id_).extend(model, "upper-lower", SIZES).model
    upper, lower = (extended.equations[name][id_] for name in ("upper", "lower"))
    masses_of = symbol("upper_mass"), symbol("lower_mass")
    on_upper, on_lower = (
        (one * mass for one, mass in zip((upper, lower), masses_of, strict=True))
        if divided
        else (upper, lower)
    )
    # The lower balance has the opposite sign of inertia, so that equal terms are opposite forces.
    assert on_upper != 0
    assert sp.simplify(on_upper - on_lower) == 0


@pytest.mark.parametrize("id_", ["coulomb_friction", "viscous_damping", "quadratic_damping"])
def test_what_resists_between_bodies_takes_power_out(id_):
    model = find_effect(id_).extend(masses(), "upper-lower", SIZES).model
    rng = np.random.default_rng(0)
    upper, lower = (derivative_symbol(name, 1) for name in ("upper", "lower"))
    values = {symbol(n): p.value or 1.0 for n, p in model.parameters.items()}
    for v, w in rng.normal(size=(20, 2)):
        now = {**values, upper: v, lower: w}
        forces = [model.equations[name][id_].subs(now) for name in ("upper", "lower")]
        assert forces[0] * v - forces[1] * w > 0


def test_units_between_bodies_are_those_of_the_balance():
    found = find_effect("cubic_stiffness").extend(masses(), "upper-lower", SIZES)
    assert found.parameters == ("cubic_stiffness_upper_lower",)
    assert found.model.parameters[found.parameters[0]].unit == "N/m**3"


def test_an_effect_may_act_on_a_body_and_between_bodies():
    cubic, model = find_effect("cubic_stiffness"), masses()
    for target in ("upper-lower", "upper", "lower"):
        model = cubic.extend(model, target, SIZES).model
    powers = [sp.Poly(model.equation(n), symbol("upper")).degree() for n in ("upper", "lower")]
    assert powers == [3, 3]
    own = [k for k in model.parameters if k.startswith("cubic_stiffness")]
    assert len(own) == 3
    assert all(any(model.equation(n).has(symbol(k)) for n in ("upper", "lower")) for k in own)


def test_inertia_and_weight_are_of_a_body():
    found = {c.effect for c in candidates(masses(), SIZES) if c.target == "upper-lower"}
    assert not found & {"mass_error", "constant_force", "force_offset_by_run", "periodic_force"}
    assert {"cubic_stiffness", "coulomb_friction", "viscous_damping", "play"} <= found


# -- terms -----------------------------------------------------------------------------------------


def test_terms_are_those_that_follow_a_motion():
    assert list(terms_of(system("f16n2d2"))) == [
        "stroke.damping",
        "stroke.gas_spring",
        "stroke.friction",
    ]
    assert list(terms_of(masses())) == ["upper.own", "lower.ground", "upper-lower.spring"]


@pytest.mark.parametrize(
    ("id_", "targets"),
    [
        ("direction_dependent_term", ["stroke.friction"]),
        ("stroke_dependent_term", ["stroke.friction.stroke"]),
        ("pressure_dependent_term", ["stroke.damping.gas_pressure"]),
        (
            "temperature_dependent_term",
            [
                "stroke.damping.ambient_temperature",
                "stroke.friction.temperature",
                "stroke.friction.ambient_temperature",
            ],
        ),
        ("input_dependent_term", []),
    ],
)
def test_a_term_gets_what_no_other_effect_says(id_, targets):
    """The gas's own force belongs to the gas, the only damping to the effects of damping."""
    assert list(find_effect(id_).places(system("f16n2d2"))) == targets


def test_a_term_is_scaled_in_each_direction(scales):
    effect = find_effect("direction_dependent_term")
    found = effect.extend(system("f16n2d2"), "stroke.friction", scales)
    old = system("f16n2d2").equations["stroke"]["friction"]
    new = found.model.equations["stroke"]["friction"].subs(symbol(found.parameters[0]), 0.2)
    velocity = symbol("dot(stroke)")
    for sense in (1, -1):
        ratio = (new / old).subs(velocity, sense * 0.1)
        assert float(sp.simplify(ratio)) == pytest.approx(1 + 0.2 * sense)


def test_a_term_changes_with_temperature_about_the_ambient(scales):
    effect = find_effect("temperature_dependent_term")
    sizes = replace(scales, conditions={"ambient_temperature": 290.0})
    found = effect.extend(system("f16n2d2"), "stroke.friction.temperature", sizes)
    old = system("f16n2d2").equations["stroke"]["friction"]
    amplitude = symbol(found.parameters[0])
    whole = found.model.equations["stroke"]["friction"]
    slope = sp.diff(whole, amplitude) / old
    value = slope.subs(found.model.nominal()).subs(symbol("temperature"), 319.0)
    assert float(sp.simplify(value)) == pytest.approx(0.1)


def test_a_force_between_bodies_changes_in_both_balances():
    model = masses()
    found = find_effect("stroke_dependent_term").places(model)
    assert not found  # a spring that changes along its stroke is a quadratic one
    damped = model.with_term("equation", "upper", "damper", "ground*(dot(upper) - dot(lower))")
    damped = damped.with_term("equation", "lower", "damper", "ground*(dot(upper) - dot(lower))")
    effect = find_effect("direction_dependent_term")
    assert effect.places(damped) == ("upper-lower.damper",)
    extended = effect.extend(damped, "upper-lower.damper", SIZES).model
    upper, lower = (extended.equations[name]["damper"] for name in ("upper", "lower"))
    assert upper == lower
    assert upper.has(sp.sign)


def test_a_definition_is_taken_apart():
    model = Model(
        "parts",
        inputs={"x": "m"},
        conditions={"oil_temperature": Condition("K", 300.0)},
        parameters={"a": Parameter(1.0, "N*s/m", sd=1.0), "b": Parameter(1.0, "N", sd=1.0)},
        definitions={"drag": "a*dot(x) + b*tanh(100*dot(x))"},
        outputs={"force": Output({"resistance": "drag"}, "N")},
    )
    effect = find_effect("temperature_dependent_term")
    targets = effect.places(model)
    assert targets == ("force.drag_1.oil_temperature", "force.drag_2.oil_temperature")
    sizes = Scales(
        {"x": (-1.0, 1.0)}, {"x": 1.0}, {}, 1.0, 1.0, conditions={"oil_temperature": 3e2}
    )
    for target in targets:
        found = effect.extend(model, target, sizes).model
        assert found.expand(found.output("force")).has(symbol("oil_temperature"))


def test_terms_that_follow_quantities_keep_their_units(scales):
    for name in ("f16n1d2", "f16n2d2"):
        model = system(name)
        for effect in catalogue():
            if effect.family == "dependence":
                for target in effect.places(model):
                    found = effect.extend(model, target, scales).model
                    terms = found.equations["stroke"]
                    assert all(unit_of(t, found) == parse_unit("N") for t in terms.values())


def test_places_of_terms_and_between_bodies_read_as_such():
    text = "cubic_stiffness @ upper-lower was added, stroke_dependent_term @ a-b.c.d - too"
    titles = {"cubic_stiffness": "Cubic stiffness", "stroke_dependent_term": "Changes"}
    said = "cubic stiffness (upper-lower) was added, changes (a-b.c.d) - too"
    assert with_titles(text, titles) == said


# -- backlash, lags, gains -------------------------------------------------------------------------


def _slider_values(model: Model, gap: float, rise: float) -> dict[sp.Symbol, float]:
    """Constants of a slider of unit friction, and of the motion that it was made for."""
    fixed = {name: item.value for name, item in model.parameters.items() if item.fixed}
    own = {"": 1.0, "_gap": gap, "_rise": rise}
    own = {f"backlash_friction{name}": value for name, value in own.items()}
    return {symbol(name): value for name, value in (fixed | own).items()}


def _friction_along(x, v, times, gap: float, rise: float):
    """Force over its amplitude along a motion, by SciPy from the effect's own equation."""
    model = find_effect("backlash_friction").extend(system("duffing"), "position", POSITION).model
    values = _slider_values(model, gap, rise)
    state, velocity = symbol("backlash_friction_memory"), symbol("dot(position)")
    equation = model.equation("backlash_friction_memory").xreplace(values)
    rate = sp.lambdify([state, velocity], -equation.subs(derivative_symbol(state.name, 1), 0))
    found = solve_ivp(
        lambda t, z: [rate(z[0], v(t))], (0, times[-1]), [0.0], "LSODA", times, rtol=1e-8,
        atol=1e-10, max_step=1e-3,
    )  # fmt: skip
    force = sp.lambdify([state], model.equations["position"]["backlash_friction"].xreplace(values))
    return np.array([force(z) for z in found.y[0]])


POSITION = Scales({"position": (-0.01, 0.01)}, {"position": 0.06}, {}, 1.0, 1.0)


def test_friction_behind_a_gap_does_the_work_of_its_path():
    """Over a cycle of swing A the slider moves 4 (A - g - d/2) under its friction F, and what the
    spring of the slider holds is given back: W = 4 F (A - g) less the elastic path."""
    amplitude, gap, rise, omega = 0.01, 0.003, 1e-4, 2 * np.pi
    times = np.linspace(0.0, 2.0, 8001)
    v = lambda t: amplitude * omega * np.cos(omega * t)  # noqa: E731
    force = _friction_along(None, v, times, gap, rise)
    last = times >= 1.0
    work = np.trapezoid(force[last] * v(times[last]), times[last])
    # The leak is a thousandth, and the corner an eighth of the rise.
    assert work == pytest.approx(4 * (amplitude - gap - rise), rel=0.01)
    assert np.abs(force[last]).max() == pytest.approx(1.0, abs=0.005)
    reversal = (times > 1.25 + 1e-9) & (amplitude * (1 - np.sin(omega * times)) < 1.9 * gap)
    inside = reversal & (times < 1.75) & (amplitude * (1 - np.sin(omega * times)) > 2 * rise)
    assert np.abs(force[inside]).max() < 1e-9


def _marched(x, friction: float, gap: float, rise: float):
    """Force of an elastic slider behind a gap: both deflect by the motion until it slides."""
    deflection, z = np.zeros(x.size), 0.0
    for k in range(1, x.size):
        z = float(np.clip(z + x[k] - x[k - 1], -gap - rise, gap + rise))
        deflection[k] = z
    return friction * (deflection - np.clip(deflection, -gap, gap)) / rise


LIMITS = [(0.003, 1e-3), (0.0, 2e-3), (1e-7, 5e-4), (0.002, 1e-5), (0.003, 0.0), (0.0, 0.0)]


@pytest.mark.parametrize(("gap", "rise"), LIMITS)
def test_backlash_is_its_slider_without_gap_and_without_rise(gap, rise):
    """Neither limit is singular: no gap leaves the Jenkins element, no rise a rigid slider."""
    amplitude, omega = 0.01, 2 * np.pi
    times = np.linspace(0.0, 1.5, 6001)
    x = amplitude * np.sin(omega * times)
    v = lambda t: amplitude * omega * np.cos(omega * t)  # noqa: E731
    force = _friction_along(x, v, times, gap, rise)
    # A rigid slider is one whose rise is far below the motion between samples, 1e-5: here a
    # hundred-thousandth of the range.
    error = force - _marched(x, 1.0, gap, max(rise, 2e-7))
    # Where a stiff slider is caught or let go, a sample's instant is a visible part of the rise.
    assert np.mean(np.abs(error)) < 2e-3


def test_backlash_without_gap_and_rise_has_a_force_and_derivatives():
    """It is Coulomb friction: zero over zero before."""
    model = find_effect("backlash_friction").extend(system("duffing"), "position", POSITION).model
    force = model.equations["position"]["backlash_friction"]
    equation = model.equation("backlash_friction_memory")
    values = _slider_values(model, 0.0, 0.0)
    shapes = [symbol("backlash_friction_gap"), symbol("backlash_friction_rise")]
    state = symbol("backlash_friction_memory")
    at = {state: 0.5, symbol("dot(position)"): 0.1, derivative_symbol(state.name, 1): 0.0}
    for expression in (force, equation):
        for one in (expression, *(sp.diff(expression, name) for name in (*shapes, state))):
            found = complex(one.xreplace(values).xreplace(at).doit())
            assert np.isfinite(found)
    assert float(force.xreplace(values).xreplace(at)) == pytest.approx(0.5)


def test_a_first_order_lag_answers_a_sine_as_it_should(scales):
    """At the amplitude one the channel is the answer of tau ds/dt + s = y, however long tau is."""
    model = Model(
        "law",
        inputs={"position": "m"},
        parameters={"stiffness": Parameter(1.0, "N/m", sd=1.0)},
        outputs={"force": "stiffness*position"},
    )
    extended = find_effect("first_order_lag").extend(model, "force", scales).model
    tau, omega = 25.0, 0.2
    phase = np.linspace(0.0, 2 * np.pi, 50)
    drive = np.exp(1j * phase)
    answer = drive / (1 + 1j * omega * tau)
    values = {
        symbol("stiffness"): 1.0,
        symbol("first_order_lag_force"): 1.0,
        symbol("first_order_lag_time_constant_force"): tau,
        symbol("position"): drive.real,
        symbol("force_reading"): answer.real,
        symbol("dot(force_reading)"): (1j * omega * answer).real,
    }
    equation = sp.lambdify(list(values), extended.equation("force_reading"), "numpy")
    assert np.abs(equation(*values.values())).max() < 1e-12
    shown = sp.lambdify(list(values), extended.output("force"), "numpy")
    assert np.allclose(shown(*values.values()), answer.real, atol=1e-12)


def test_a_sensor_lags_and_does_not_lead(scales):
    """A gas that loses heat answers quick strokes more stiffly than slow ones: a sensor that did
    so would show more than there is."""
    model = Model(
        "law",
        inputs={"position": "m"},
        parameters={"stiffness": Parameter(1.0, "N/m", sd=1.0)},
        outputs={"force": "stiffness*position"},
    )
    found = find_effect("first_order_lag").extend(model, "force", scales)
    assert found.sign["first_order_lag_force"] == 1


def test_a_gauge_that_senses_the_absolute_pressure(scales):
    effect = find_effect("absolute_pressure_gain")
    model = system("f16n2d2")
    assert effect.places(model) == ("pressure",)
    assert effect.places(system("duffing")) == ()
    extended = effect.extend(model, "pressure", scales).model
    gain, ambient = symbol("absolute_pressure_gain_pressure"), symbol("ambient_pressure")
    shown, true = (one.expand(one.output("pressure")) for one in (extended, model))
    assert sp.simplify(shown + ambient - (1 + gain) * (true + ambient)) == 0
