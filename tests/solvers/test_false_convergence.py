"""Problems on which an iteration could take itself for converged, and is nowhere near."""

import numpy as np
import pytest
from periodic_problems import harmonics, problem, rest

from bayesoleo.model import Model, Parameter
from bayesoleo.prediction._orbits import periodic_orbit
from bayesoleo.prediction._simulate import RunPlan, motion
from bayesoleo.prediction._stability import count_unstable
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import Boundary, solve_from_guess


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


def next_step(boundary: Boundary, p: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Newton's next step from unknowns ``x (1, n, w)``, by the general code."""
    lanes, scheme = np.arange(1), boundary.scheme
    d, points = len(scheme.orders), boundary.inputs.shape[1]
    nz, step = scheme.state_size + d, boundary.step(x.shape[1])
    z, g, gz = np.zeros((1, nz, points)), np.zeros((1, d, points)), np.zeros((1, d, nz, points))
    scheme.rows(x, lanes, step, z)
    boundary.equations.jacobian(z, boundary.inputs, p, lanes, g, gz)
    return scheme.linear(gz, g[:, :, None], x, lanes, step)[0][..., 0]


@pytest.mark.parametrize("backend", ["numba", "numpy"])
@pytest.mark.parametrize("slope", [1e4, 1e6, 1e7])
@pytest.mark.parametrize("name", ["thesis", "radau3"])
def test_a_preload_does_not_hide_a_small_motion(name, slope, backend):
    # Friction that sticks most of the time: the motion is a ten-thousandth of the preload.
    model = FRICTION.with_values({"s": slope, "weight": 3433.0})
    boundary, p = problem(model, harmonics(h1=120.0), 2.0, name, 64, backend)
    solution = solve_from_guess(boundary, p, rest(boundary, 64, -3433.0 / 3.5e4))
    if solution.status[0] == Status.CONVERGED.value:
        swing = np.ptp(solution.x[0, :, 0])
        left = np.abs(next_step(boundary, p, solution.x)[0, :, 0]).max()
        assert left < 1e-6 * swing
    else:  # the steepest may fail, not the others
        assert slope > 1e4


def test_multipliers_below_the_rounding_of_a_huge_one_are_not_counted():
    multipliers = np.array([[1e18, 30.0], [1e18, 1e-5], [3.0, 2.0]], dtype=complex)
    np.testing.assert_array_equal(count_unstable(multipliers), [1, 1, 2])
