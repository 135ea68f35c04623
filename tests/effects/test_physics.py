"""Effects say what the physics says: against closed forms and against the fuller model."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from bayesoleo.effects import find_effect
from bayesoleo.effects._places import damping_terms, force_places
from bayesoleo.model import Model, Parameter
from bayesoleo.model._expressions import derivative_symbol, symbol, total_derivative
from bayesoleo.systems import system


def test_solubility_and_heat_exchange_make_the_thermomechanical_gas_law(scales):
    """Exponent one, kappa one and sigma = theta_7 T_0 turn f16n1 into f16n2, by algebra."""
    full, model = system("f16n2d2"), system("f16n1d2")
    for id_ in ("heat_exchange", "gas_solubility"):
        effect = find_effect(id_)
        model = effect.extend(model, effect.places(model)[0], scales).model
    names = ("initial_volume", "ambient_temperature", "gas_constant", "solubility")
    volume, ambient, constant, solubility = map(symbol, names)
    table = {
        symbol("gas_exponent"): sp.Integer(1),
        symbol("heat_exchange"): sp.Integer(1),
        symbol("gas_solubility"): -solubility * constant * ambient / volume,
        symbol("heat_exchange_conduction"): symbol("heat_conduction"),
        symbol("heat_exchange_swept"): sp.Integer(1),
        symbol("heat_exchange_specific_heat"): symbol("specific_heat"),
        symbol("heat_exchange_gas_constant"): symbol("specific_gas_constant"),
    }
    for name in ("stroke", "temperature"):
        difference = model.equation(name).subs(table) - full.equation(name)
        assert sp.simplify(difference) == 0


def test_absolute_work_is_p_dv(scales):
    model = system("f16n2d2")
    extended = find_effect("absolute_pressure_work").extend(model, "gas_power", scales).model
    power = extended.expand(symbol("gas_power")).subs(symbol("absolute_pressure_work"), 1)
    work = symbol("piston_area") * model.expand(symbol("gas_pressure")) * symbol("dot(stroke)")
    assert sp.simplify(power - work) == 0


def test_wall_keeps_the_energy(scales):
    """tau = r C makes the wall's equation r times C dT/dt = Q - (T_w - T_0)/r."""
    extended = find_effect("wall_heat_capacity").extend(system("f16n2d2"), "heat_loss", scales)
    equation = extended.model.equations["wall_excess"]
    resistance, capacity = symbol("wall_heat_capacity_resistance"), symbol("C")
    total = sp.Add(*equation.values()) / resistance
    total = total.subs(symbol("wall_heat_capacity_time_constant"), resistance * capacity)
    wall = symbol("wall_excess")
    expected = capacity * symbol("dot(wall_excess)") + wall / resistance - symbol("heat_loss")
    assert sp.simplify(total - expected) == 0


def test_only_orifice_damping_counts_as_damping():
    model = system("f16n2d2")
    place = force_places(model)["stroke"]
    assert set(damping_terms(model, place)) == {"damping"}


def test_direction_dependent_damping_acts_in_extension_only(scales):
    effect = find_effect("direction_dependent_damping")
    model = effect.extend(system("f16n1d1"), "stroke", scales).model
    term = model.equations["stroke"]["damping"].subs(symbol("direction_dependent_damping"), 0.6)
    velocity, coefficient = symbol("dot(stroke)"), symbol("orifice_damping")
    assert term.subs(velocity, 2).subs(coefficient, 1) == pytest.approx(4.0)
    assert term.subs(velocity, -2).subs(coefficient, 1) == pytest.approx(-6.4)


@pytest.mark.parametrize("side", ["lower", "upper"])
def test_end_stop_pushes_back(side, scales):
    effect = find_effect(f"end_stop_{side}")
    model = effect.extend(system("duffing"), "position", scales).model
    term = model.equations["position"][effect.id].subs(
        {symbol(n): p.value for n, p in model.parameters.items() if n != effect.id}
    )
    force = term.subs(symbol(effect.id), 1.0)
    inside, outside = (0.13, 0.0) if side == "lower" else (0.13, 0.26)
    assert force.subs(symbol("position"), inside) == 0
    # A resisting force: negative below the lower stop, positive above the upper one.
    assert (force.subs(symbol("position"), outside) < 0) == (side == "lower")


def test_sign_of_the_inertia_carries_over(scales):
    """A balance written the other way round gets the resisting force the other way round."""
    model = Model(
        "reversed",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={"m": Parameter(1.0, "kg", fixed=True)},
        equations={"q": {"force": "force", "inertia": "-m*ddot(q)"}},
        outputs={"y": "q"},
    )
    extended = find_effect("linear_stiffness").extend(model, "q", scales).model
    assert extended.equations["q"]["linear_stiffness"] == -symbol("linear_stiffness") * symbol("q")


def test_first_order_systems_get_effects_of_position_only(scales):
    lorenz = system("lorenz")
    assert find_effect("cubic_stiffness").places(lorenz) == ("x", "y", "z")
    assert find_effect("viscous_damping").places(lorenz) == ()


def test_memory_and_temperature_are_no_places_for_forces(scales):
    assert find_effect("cubic_stiffness").places(system("f16n2d2")) == ("stroke",)
    damper = find_effect("dahl_friction").extend(system("viscous_damper"), "force", scales).model
    assert find_effect("cubic_stiffness").places(damper) == ("force",)


def test_series_compliance_of_a_damper_is_a_maxwell_element(scales):
    """F = d (dx/dt - c dF/dt), with F as measured at the harmonics of x."""
    effect = find_effect("frame_compliance")
    model = effect.extend(system("viscous_damper"), "force", scales).model
    given = symbol("frame_compliance") * symbol("dot(force_within_displacement)")
    law = symbol("damping") * (symbol("dot(displacement)") - given) + symbol("force_offset")
    assert sp.expand(model.output("force") - law) == 0
    assert model.inputs["force_within_displacement"] == "N"


@pytest.mark.parametrize("compliance", ["oil_compressibility", "cylinder_expansion"])
def test_work_on_the_gas_does_not_depend_on_the_order_of_effects(scales, compliance):
    heat, give = find_effect("heat_exchange"), find_effect(compliance)
    plain = system("f16n1d2")
    one = give.extend(heat.extend(plain, "temperature_ratio", scales).model, "volume_ratio", scales)
    other = heat.extend(
        give.extend(plain, "volume_ratio", scales).model, "temperature_ratio", scales
    )
    added = f"dot({compliance}_ratio)"
    first, second = (
        model.expand(model.equation("temperature")) for model in (one.model, other.model)
    )
    assert first.has(symbol(added)), "the volume that pressure adds does work too"
    assert sp.simplify(first - second) == 0


def test_work_is_pressure_times_the_rate_of_the_volume(scales):
    """Along a motion the power is what differences of the volume give, added volume included."""
    heat, give = find_effect("heat_exchange"), find_effect("oil_compressibility")
    model = give.extend(
        heat.extend(system("f16n1d2"), "temperature_ratio", scales).model, "volume_ratio", scales
    ).model
    numbers = {
        **model.nominal(),
        symbol("oil_compressibility"): 3e-12,
        symbol("initial_pressure"): 5e5,
        symbol("ambient_temperature"): 293.0,
    }
    added, rate = symbol("oil_compressibility_ratio"), symbol("dot(oil_compressibility_ratio)")

    def at(time):
        now = numbers | {
            symbol("stroke"): 0.05 + 0.1 * time,
            symbol("dot(stroke)"): 0.1,
            symbol("temperature"): 320.0 + 40.0 * time,
            symbol("dot(temperature)"): 40.0,
        }
        equation = model.expand(model.equation(added.name)).xreplace(now)
        now[added] = sp.nsolve(equation, added, 1e-4, prec=30)
        slope = total_derivative(model.equation(added.name), (*model.dofs, *model.inputs))
        now[rate] = sp.solve(slope.xreplace(now), rate)[0]
        return [
            model.expand(symbol(name)).xreplace(now)
            for name in ("volume_ratio", "gas_pressure", "gas_power", "initial_volume")
        ]

    step = sp.Float("1e-8", 30)
    later, before = at(step)[0], at(-step)[0]
    _, pressure, power, volume = at(sp.Integer(0))
    gauge = pressure - numbers[symbol("ambient_pressure")]
    assert float(power) == pytest.approx(
        float(-gauge * volume * (later - before) / (2 * step)), rel=1e-6
    )


def test_a_channel_that_lags_shows_what_was(scales):
    """Of a sine that lags by a tenth of a radian the fourth order is left, and dry friction that
    switches within the lag switches later, as sharply."""
    model = Model(
        "force law",
        inputs={"position": "m"},
        parameters={"stiffness": Parameter(1.0, "N/m", sd=1.0)},
        outputs={"force": "stiffness*position + 0.5*atan(100*dot(position))"},
    )
    output = find_effect("sensor_lag").extend(model, "force", scales).model.output("force")
    lag, phase = 0.1, np.linspace(0.0, 2 * np.pi, 500)
    rates = [np.sin(phase + k * np.pi / 2) for k in range(5)]
    names = [derivative_symbol("position", k) for k in range(5)]
    law = sp.lambdify([*names, symbol("stiffness"), symbol("sensor_lag_force")], output, "numpy")
    then = np.sin(phase - lag) + 0.5 * np.arctan(100 * np.cos(phase - lag))
    left = np.abs(law(*rates, 1.0, lag) - then)
    assert left.max() < 50 * 1.1 * lag**4 / 24  # friction passes on the error of velocity
    smooth = np.abs(np.cos(phase - lag)) > 0.3
    assert left[smooth].max() == pytest.approx(lag**4 / 24, rel=0.1)
    old = np.sin(phase) + 0.5 * np.arctan(100 * np.cos(phase))
    assert np.allclose(law(*rates, 1.0, 0.0), old, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("channel", ["position", "force"])
def test_a_lag_of_an_input_and_of_the_output_are_one(scales, channel):
    """What was measured late is taken forward as far as the other channel is taken back: of a sine
    that lags by a tenth of a radian the third order is left of an input."""
    model = Model(
        "force law",
        inputs={"position": "m"},
        parameters={"mass": Parameter(1.0, "kg", sd=1.0)},
        outputs={"force": "mass*ddot(position)"},
    )
    output = find_effect("sensor_lag").extend(model, channel, scales).model.output("force")
    lag, phase = 0.1, np.linspace(0.0, 2 * np.pi, 500)
    names = [derivative_symbol("position", k) for k in range(6)]
    sign = 1.0 if channel == "position" else -1.0  # a force that leads is a position that lags
    law = sp.lambdify([*names, symbol("mass"), symbol(f"sensor_lag_{channel}")], output, "numpy")
    late = [np.sin(phase - lag + k * np.pi / 2) for k in range(6)]
    left = np.abs(law(*late, 1.0, sign * lag) + np.sin(phase))
    assert left.max() < 1.05 * lag**3 / 6


def test_a_gain_reaches_all_that_a_lag_brings(scales):
    """A sensor that lags and amplifies: every derivative is divided."""
    model = Model(
        "force law",
        inputs={"position": "m"},
        parameters={"mass": Parameter(1.0, "kg", sd=1.0)},
        outputs={"force": "mass*ddot(position)"},
    )
    late = find_effect("sensor_lag").extend(model, "position", scales).model
    both = find_effect("sensor_gain").extend(late, "position", scales).model
    gain = symbol("sensor_gain_position")
    expected = late.output("force") / (1 + gain)
    assert sp.simplify(both.output("force") - expected) == 0


def test_a_lag_takes_a_temperature_back_by_its_balance(scales):
    """Of a first-order state that answers a sine the third order in the lag is left."""
    model = Model(
        "heated",
        inputs={"power": "W"},
        dofs={"warmth": "K"},
        parameters={"loss": Parameter(0.5, "W/K", sd=1.0)},
        equations={"warmth": "2*dot(warmth) + loss*warmth - power"},
        outputs={"temperature": "warmth"},
    )
    output = find_effect("sensor_lag").extend(model, "temperature", scales).model
    lag, phase = 0.1, np.linspace(0.0, 2 * np.pi, 50)
    answer = 1 / (2j + 0.5) * np.exp(1j * phase)  # to a unit cosine at one radian per second
    values = {
        symbol("warmth"): answer.real,
        derivative_symbol("warmth", 1): (1j * answer).real,
        symbol("power"): np.cos(phase),
        derivative_symbol("power", 1): -np.sin(phase),
        symbol("loss"): 0.5,
        symbol("sensor_lag_temperature"): lag,
    }
    law = sp.lambdify(list(values), output.output("temperature"), "numpy")
    left = np.abs(law(*values.values()) - (answer * np.exp(-1j * lag)).real)
    assert left.max() == pytest.approx(lag**3 / 6 * abs(answer[0]), rel=0.05)
