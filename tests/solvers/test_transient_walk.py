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
from bayesoleo.solvers._transient import moved_from_start, newton, solve_transient

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


def test_changes_of_the_start_move_the_motion_as_differences_do(problem):
    """Also beside a column that changes nothing, which stays zero."""
    boundary, p = problem
    size, step, lanes = 1e-6, boundary.step(STEPS), np.zeros(1, dtype=np.int64)
    first = np.array([0.2, 0.5])

    def solved(state):
        start = np.zeros((1, STEPS, boundary.scheme.width))
        start[0, :, :2] = state
        found = solve_transient(boundary, p, start)
        assert found.status[0] == Status.CONVERGED.value
        return found.x

    x, points = solved(first), boundary.inputs.shape[1]
    z, g = np.zeros((1, 3, points)), np.zeros((1, 1, points))
    gz, right = np.zeros((1, 1, 3, points)), np.zeros((1, 1, 3, points))
    boundary.scheme.rows(x, lanes, step, z)
    boundary.equations.jacobian(z, boundary.inputs, p, lanes, g, gz)
    start_p = np.array([[[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    moved, _, ok = moved_from_start(boundary, STEPS, gz, right, start_p, lanes)
    assert ok.all()
    assert not moved[..., 1].any()
    for column, state in ((0, 0), (2, 1)):
        change = size * np.eye(2)[state]
        expected = (solved(first + change) - solved(first - change)) / (2 * size)
        # Differences of a motion with friction this steep, over their largest.
        error = np.abs(moved[..., column] - expected).max(axis=(0, 1))
        assert (error < 1e-4 * np.abs(expected).max(axis=(0, 1))).all()


def test_without_a_force_a_velocity_moves_on_and_a_state_of_first_order_stays():
    """States of a motion whose highest derivatives are zero: each is the next one's integral."""
    scheme = Collocation(tableau("radau3"), (2, 1), equidistant(4))
    boundary = Boundary(None, scheme, 3.0, np.zeros((0, scheme.phases(4).size)), 0, 2)
    gz = np.zeros((1, 2, 5, scheme.phases(4).size))
    gz[0, 0, 2] = gz[0, 1, 4] = 1.0  # highest derivatives
    start = np.array([[[0.3, -1.0], [2.0, 0.5], [7.0, 4.0]]])  # position, velocity, temperature
    x, transition, _ = moved_from_start(
        boundary, 4, gz, np.zeros((1, 2, 2, gz.shape[3])), start, np.zeros(1, dtype=np.int64)
    )
    time = 3.0 * np.arange(4)[:, None] / 4
    np.testing.assert_allclose(x[0, :, 0], start[0, 0] + start[0, 1] * time)
    np.testing.assert_allclose(x[0, :, 1], np.repeat(start[0, 1][None], 4, axis=0))
    np.testing.assert_allclose(x[0, :, 2], np.repeat(start[0, 2][None], 4, axis=0))
    assert not x[0, :, 3:].any()
    np.testing.assert_allclose(transition[0], [[1, 3, 0], [0, 1, 0], [0, 0, 1]], atol=1e-12)
