"""A transient that Newton's method does not solve at once is solved step by step."""

from __future__ import annotations

import numpy as np
import pytest
from periodic_problems import friction_oscillator

from bayesoleo.model import Dof, Model, Parameter
from bayesoleo.model._kernels import kernels
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._mesh import equidistant, tableau
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import Boundary
from bayesoleo.solvers._transient import _carried, newton, solve_transient

STEPS, TIME = 1024, 40.0


@pytest.fixture(
    scope="module", params=[("numpy", "radau3"), ("numba", "radau3"), ("numba", "gauss3")], ids=str
)
def problem(request):
    model = friction_oscillator().with_values({"slope": 300.0, "amplitude": 1.0})
    backend, method = request.param
    equations = kernels(model, backend=backend)
    derived = equations.derived
    scheme = Collocation(tableau(method), derived.orders, equidistant(STEPS))
    time = TIME * scheme.phases(STEPS)
    force = [1.5 * np.cos(1.7 * time + 0.5 * order * np.pi) * 1.7**order for order in range(3)]
    inputs = np.array([force[order] for _, order in derived.inputs])
    boundary = Boundary(equations, scheme, TIME, inputs, 0, len(derived.active))
    nominal = {str(item): value for item, value in model.nominal().items()}
    return boundary, np.array([[nominal[name] for name in derived.constants]])


def test_a_bad_start_leads_to_the_same_motion(problem):
    boundary, p = problem
    width = boundary.scheme.width
    rng = np.random.default_rng(2)
    rest = np.zeros((1, STEPS, width))
    wild = 30.0 * rng.standard_normal((1, STEPS, width))
    wild[:, 0, : boundary.scheme.state_size] = 0.0
    solved = solve_transient(boundary, p, rest)
    assert solved.status[0] == Status.CONVERGED.value
    again = newton(boundary, p, solved.x)
    np.testing.assert_allclose(again.x, solved.x, atol=1e-10)
    assert newton(boundary, p, wild).status[0] != Status.CONVERGED.value  # so that it is walked
    walked = solve_transient(boundary, p, wild)
    assert walked.status[0] == Status.CONVERGED.value
    np.testing.assert_allclose(walked.x, solved.x, atol=1e-8 * np.abs(solved.x).max())
    # A step begins where the last one leads to: a few iterations each.
    assert walked.iterations[0] < 8 * STEPS


def test_a_step_that_leaves_the_region_of_the_equations_is_told():
    model = Model(
        "filling",
        inputs={"flow": "m/s"},
        dofs={"level": Dof("m", initial="0")},
        parameters={"gain": Parameter(1.0, sd=0.1)},
        equations={"level": "dot(level) - gain*flow*sqrt(1 - level)"},
        outputs={"y": "level"},
        admissible=["1 - level"],
    )
    equations = kernels(model, backend="numba")
    derived = equations.derived
    scheme = Collocation(tableau("radau3"), derived.orders, equidistant(64))
    inputs = np.ones((len(derived.inputs), scheme.phases(64).size))

    def solved(duration):
        boundary = Boundary(equations, scheme, duration, inputs, 1, len(derived.active))
        start = np.zeros((1, 64, scheme.width))
        return solve_transient(boundary, np.ones((1, len(derived.constants))), start)

    # The level is 1 - (1 - t / 2)**2: full, and no longer defined, after two seconds.
    assert solved(1.5).status[0] == Status.CONVERGED.value
    assert solved(4.0).status[0] == Status.INADMISSIBLE.value


def test_without_a_force_a_velocity_moves_on_and_a_state_of_first_order_stays():
    """Rows of a motion whose highest derivatives are zero: each is the next one's integral."""
    start = np.array([[[0.3, -1.0], [2.0, 0.5], [7.0, 4.0]]])  # position, velocity, temperature
    time = np.array([0.0, 0.5, 3.0])
    position, velocity, force, heat, rate = np.moveaxis(_carried((2, 1), time, start)[0], 0, 0)
    np.testing.assert_allclose(position, start[0, 0, :, None] + start[0, 1, :, None] * time)
    np.testing.assert_allclose(velocity, np.repeat(start[0, 1, :, None], 3, axis=1))
    np.testing.assert_allclose(heat, np.repeat(start[0, 2, :, None], 3, axis=1))
    assert not force.any()
    assert not rate.any()
