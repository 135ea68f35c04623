"""Water that runs over the brim of a tank is described, and so is a tank that catches it."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.effects import Scales, find_effect
from bayesoleo.effects._places import storing_places
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import transient_record
from bayesoleo.solvers._orbit import Status

STEP, COUNT, BRIM, CAUGHT = 4.0, 120, 4.0, 0.5
GAIN, UPPER, LOWER = 0.05, 0.08, 0.07

TANKS = Model(
    "two tanks",
    inputs={"pump": "V"},
    dofs={"upper": Dof("V", initial="3"), "lower": Dof("V", initial="3")},
    parameters={
        "pump_gain": Parameter(GAIN, "1/s", relative_sd=1.0),
        "upper_outflow": Parameter(UPPER, "V**0.5/s", relative_sd=1.0),
        "lower_outflow": Parameter(LOWER, "V**0.5/s", relative_sd=1.0),
    },
    equations={
        "upper": "dot(upper) + upper_outflow*sqrt(positive(upper)) - pump_gain*pump",
        "lower": "dot(lower) + lower_outflow*sqrt(positive(lower))"
        " - upper_outflow*sqrt(positive(upper))",
    },
    outputs={"level": Output("lower", "V")},
)

#: Sizes of a motion of which the brim is the upper end, but for a fifth.
SCALES = Scales({"upper": (0.0, 1.2 * BRIM)}, {}, {}, 100.0, 1000.0)


def levels(pump: np.ndarray, caught: float, cuts: int = 40) -> np.ndarray:
    """Level of the lower tank, by Euler steps; the content of the upper one ends at its brim."""
    upper, lower, found = 3.0, 3.0, []
    time = np.arange(pump.size) * STEP
    fine = np.interp(np.arange(pump.size * cuts) * STEP / cuts, time, pump)
    for k, flow in enumerate(GAIN * fine):
        if k % cuts == 0:
            found.append(lower)
        between = UPPER * np.sqrt(upper)
        full = upper + STEP / cuts * (flow - between)
        upper = min(full, BRIM)
        lower += STEP / cuts * (between - LOWER * np.sqrt(max(lower, 0.0))) + caught * (
            full - upper
        )
    return np.array(found)


def error(model: Model, pump: np.ndarray, level: np.ndarray) -> float:
    """Root mean square of what a model's simulation at its own values is off, V."""
    record = transient_record("run", STEP * np.arange(COUNT), {"pump": pump, "level": level})
    made = Predictor(model, [record], backend="numpy")
    theta = made.layout.start(model)
    assert made.set_anchor(theta)[0] is Status.CONVERGED
    return float(np.sqrt(np.mean((made.simulate(theta[None], 0).y[0, 0] - level) ** 2)))


@pytest.mark.parametrize(("caught", "name"), [(0.0, "overflow"), (CAUGHT, "overflow_below")])
def test_overflow_is_that_of_a_tank_with_a_brim(caught, name):
    knots = np.random.default_rng(5).uniform(0.5, 5.5, 6)
    pump = np.interp(np.arange(COUNT), np.linspace(0, COUNT, 6), knots)
    level = levels(pump, caught)
    candidate = find_effect(name).extend(TANKS, "upper", SCALES)
    # A weir that passes all that the pump brings at a few hundredths of a volt above the brim.
    values = dict(zip(candidate.parameters, (3.0, 3.0 * caught), strict=False))
    assert error(candidate.model, pump, level) > 0.3
    (depth,) = candidate.shapes
    overflows = candidate.model.with_values({**values, depth: 0.2 * BRIM})
    assert error(overflows, pump, level) < 0.05


def damped(unit: str) -> Model:
    """A state of first order whose rate has a factor in this unit."""
    return Model(
        "first order",
        inputs={"u": ""},
        dofs={"q": "m"},
        parameters={
            "a": Parameter(1.0, unit, fixed=True),
            "b": Parameter(1.0, f"{unit}/s", sd=1.0),
        },
        equations={"q": "a*dot(q) + b*q"},
        outputs={"y": Output("q", "m")},
    )


@pytest.mark.parametrize(("unit", "stores"), [("N*s/m", False), ("m**2", True), ("kg/m", True)])
def test_a_damped_motion_is_no_store(unit, stores):
    model = damped(unit)
    assert bool(storing_places(model)) == stores
    assert bool(find_effect("overflow").places(model)) == stores
    assert bool(find_effect("end_stop_upper").places(model)) != stores


def warm(guess: float | str) -> Model:
    """A heated body that loses heat to its surroundings."""
    return Model(
        "kiln",
        inputs={"heater": "W"},
        dofs={"body": Dof("K", guess=guess)},
        parameters={
            "capacity": Parameter(400.0, "J/K", sd=100.0),
            "loss": Parameter(2.0, "W/K", sd=1.0),
            "ambient": Parameter(293.0, "K", fixed=True),
        },
        equations={
            "body": {
                "store": "capacity*dot(body)",
                "loss": "loss*(body - ambient)" if guess else "loss*body",
                "heat": "-heater",
            }
        },
        outputs={"temperature": Output("body", "K")},
    )


def test_a_temperature_has_no_level_above_which_it_runs_over():
    assert not storing_places(warm("ambient"))
    assert not find_effect("overflow").places(warm("ambient"))


@pytest.mark.parametrize(("guess", "varies"), [("ambient", True), (320.0, True), (0.0, False)])
def test_a_loss_of_heat_may_change_with_the_body_s_own_temperature(guess, varies):
    """As radiation does, about the surroundings; an excess, which starts at zero, has no ratio."""
    effect, model = find_effect("temperature_dependent_term"), warm(guess)
    assert effect.places(model) == (("body.loss.body",) if varies else ())
    if varies:
        sizes = Scales({"body": (293.0, 400.0)}, {}, {}, 100.0, 1000.0)
        extended = effect.extend(model, "body.loss.body", sizes).model
        start = 293.0 if guess == "ambient" else guess
        reference = next(p for name, p in extended.parameters.items() if "reference" in name)
        assert reference.value == start


def test_only_a_store_that_feeds_another_overflows_into_it():
    assert find_effect("overflow").places(TANKS) == ("upper", "lower")
    assert find_effect("overflow_below").places(TANKS) == ("upper",)
