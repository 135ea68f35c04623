"""Problems on which an iteration could take itself for converged, and is nowhere near."""

import numpy as np
import pytest

from bayesoleo.model import Model, Parameter
from bayesoleo.prediction.orbits import periodic_orbit
from bayesoleo.prediction.simulate import RunPlan, motion
from bayesoleo.prediction.stability import count_unstable
from bayesoleo.solvers.status import Status


def parameters(*names: str) -> dict[str, Parameter]:
    return {name: Parameter(1.0, "", sd=1.0) for name in names}


STOP = Model(
    "stop",
    inputs={"force": "N"},
    dofs={"q": "m"},
    parameters=parameters("c", "K", "gap"),
    equations={"q": "ddot(q) + c*dot(q) + q + K*max(q - gap, 0) - force"},
    outputs={"y": "q"},
)
FRICTION = Model(
    "preloaded friction",
    inputs={"force": "N"},
    dofs={"q": "m"},
    parameters=parameters("s", "weight"),
    equations={
        "q": "350*ddot(q) + 500*dot(q) + 3.5e4*q + 100*tanh(s*dot(q)) + weight - force",
    },
    outputs={"y": "q"},
)


@pytest.mark.parametrize("backend", ["numba", "numpy"])
def test_iterations_that_come_back_from_far_away_have_not_arrived(backend):
    # Plain Newton steps wander to 1e58 m here; the way back looked small beside that.
    plan = RunPlan("a", 0.05, {"force": motion(0.0, [1.0])})
    values = {"c": 1.958, "K": 1e5, "gap": 0.4}
    orbit = periodic_orbit(STOP, plan, values, steps=64, backend=backend)
    # The stop is free to fail; what it must not do is answer a newton with kilometres.
    if orbit.status[0] == Status.CONVERGED.value:
        assert np.abs(orbit.outputs(np.arange(64) / 64)["y"]).max() < 2.0


@pytest.mark.parametrize("backend", ["numba", "numpy"])
def test_first_steps_from_rest_are_no_contraction(backend):
    plan = RunPlan("a", 0.1, {"force": motion(0.0, [1.0])})
    values = {"c": 1.0, "K": 1e8, "gap": -0.05}
    orbit = periodic_orbit(STOP, plan, values, steps=800, backend=backend)
    if orbit.status[0] == Status.CONVERGED.value:
        # A newton moves a spring of 1e8 N/m by 1e-8 m.
        assert orbit.outputs(np.arange(800) / 800)["y"].max() < -0.05 + 1e-6


@pytest.mark.parametrize("name", ["thesis", "radau3"])
def test_a_preload_does_not_hide_a_small_motion(name):
    plan = RunPlan("a", 2.0, {"force": motion(0.0, [120.0])})
    swings = []
    for weight in (0.0, 3433.0):
        orbit = periodic_orbit(FRICTION, plan, {"s": 1e4, "weight": weight}, steps=128, scheme=name)
        assert orbit.status[0] == Status.CONVERGED.value
        swings.append(np.ptp(orbit.outputs(np.arange(128) / 128)["y"]))
    # The weight shifts the motion and changes nothing else: the spring is linear.
    assert swings[1] == pytest.approx(swings[0], rel=1e-8)


def test_multipliers_below_the_rounding_of_a_huge_one_are_not_counted():
    multipliers = np.array([[1e18, 30.0], [1e18, 1e-5], [3.0, 2.0]], dtype=complex)
    np.testing.assert_array_equal(count_unstable(multipliers), [1, 1, 2])
