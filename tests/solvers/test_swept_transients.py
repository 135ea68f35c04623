"""Straight-line code solves an initial value problem like the general iteration, lane by lane."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.model import Dof, Model, Parameter
from bayesoleo.model._kernels import kernels
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._mesh import Mesh, tableau
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import Boundary, solve_from_state
from bayesoleo.solvers._transient import newton, solve_transient

TIME = 6.0
RATES = {"a": Parameter(1.3, sd=0.1), "b": Parameter(0.4, sd=0.1)}
MODELS = {
    "first order": ({"x": "1"}, {"x": "dot(x) + a*x + b*x**3 - u"}),
    "second order": ({"x": "1"}, {"x": "ddot(x) + b*dot(x) + a*sin(x) - u"}),
    "leaving": ({"x": "1"}, {"x": "dot(x) - a*x + 3*b*x/(1 + x**2) - u"}),
    "a mass and a store": (
        {"x": "1", "z": "1"},
        {"x": "ddot(x) + b*dot(x) + a*x - z", "z": "dot(z) + 2*z - u*x - u"},
    ),
}


def problem(name, steps, time=TIME, backend="numba", admissible=()):
    """A problem on unequal steps, its constants, and a start from rest."""
    dofs, equations = MODELS[name]
    model = Model(
        name,
        inputs={"u": "1"},
        dofs={dof: Dof(unit, initial="0") for dof, unit in dofs.items()},
        parameters=RATES,
        equations=equations,
        outputs={"y": "x"},
        admissible=list(admissible),
    )
    made = kernels(model, backend=backend)
    edges = np.linspace(0.0, 1.0, steps + 1) ** 1.5
    scheme = Collocation(tableau("radau3"), made.derived.orders, Mesh(edges))
    u = np.sin(2.0 * time * scheme.phases(steps))
    boundary = Boundary(made, scheme, time, u[None], len(admissible), len(made.derived.active))
    nominal = {str(item): value for item, value in model.nominal().items()}
    p = np.array([[nominal[item] for item in made.derived.constants]])
    return boundary, p, np.zeros((1, steps, scheme.width))


@pytest.mark.parametrize("steps", [8, 37, 200])
@pytest.mark.parametrize("name", MODELS)
def test_it_is_the_solution_of_the_general_iteration(name, steps):
    boundary, p, start = problem(name, steps)
    start[:, 0, 0] = 0.7  # not at rest
    found, expected = solve_from_state(boundary, p, start, 12), newton(boundary, p, start)
    assert found.status[0] == expected.status[0] == Status.CONVERGED.value
    assert (
        found.x[0, 0, : boundary.scheme.state_size] == start[0, 0, : boundary.scheme.state_size]
    ).all()
    np.testing.assert_allclose(found.x, expected.x, atol=1e-11)
    assert not (start[:, 1:]).any()  # the start is left alone


def test_lanes_do_not_know_of_each_other():
    boundary, p, start = problem("a mass and a store", 60)
    several = p * (1.0 + 0.1 * np.arange(4)[:, None])
    together = solve_transient(boundary, several, np.repeat(start, 4, axis=0))
    for lane in range(4):
        alone = solve_transient(boundary, several[lane : lane + 1], start)
        np.testing.assert_array_equal(alone.x[0], together.x[lane])


def test_what_grows_out_of_all_bounds_is_solved_too():
    """By 10**35. Late chunks, which are swept beside the early ones, only take over their end."""
    boundary, p, start = problem("first order", 400, time=70.0)
    constants = boundary.equations.derived.constants
    p[0, constants.index("a")], p[0, constants.index("b")] = -1.3, 0.0
    solved = solve_transient(boundary, p, start)
    assert solved.status[0] == Status.CONVERGED.value
    x, time = solved.x[0, :, 0], 70.0 * boundary.scheme.nodes(400)
    # The growing part of the solution from rest, beside which the rest is nothing in the end.
    exact = 2.0 / (1.3**2 + 4.0) * np.exp(1.3 * time)
    assert exact[-1] > 1e35
    np.testing.assert_allclose(x[300:], exact[300:], rtol=1e-3)


def test_arrays_have_no_straight_line_code():
    boundary, p, start = problem("first order", 20, backend="numpy")
    assert solve_from_state(boundary, p, start, 12) is None
    assert solve_transient(boundary, p, start).status[0] == Status.CONVERGED.value


@pytest.mark.parametrize("time", [5.0, 20.0, 40.0])
def test_early_errors_of_what_grows_are_not_hidden_by_late_terms(time):
    """They are carried to the end, in proportion."""
    boundary, p, start = problem("leaving", 400, time=time)
    start[:, :, 0] = 2.0
    found, expected = solve_from_state(boundary, p, start, 12), newton(boundary, p, start)
    assert found.status[0] == expected.status[0] == Status.CONVERGED.value
    np.testing.assert_allclose(found.x[0, :, 0], expected.x[0, :, 0], rtol=1e-9)


def test_where_a_condition_is_not_a_number_there_is_no_solution():
    """The equations themselves go on beyond it."""
    boundary, p, start = problem("second order", 100, admissible=["sqrt(x + 1/100) + 1"])
    found = solve_from_state(boundary, p, start, 12)
    assert found.status[0] in (Status.NOT_FINITE.value, Status.NO_CONVERGENCE.value)
    assert solve_transient(boundary, p, start).status[0] == Status.INADMISSIBLE.value


def test_a_lane_that_is_given_up_is_solved_step_by_step_and_alone():
    boundary, p, start = problem("second order", 200)
    wild = 1e3 * np.random.default_rng(1).standard_normal(start.shape)
    wild[:, 0, :2] = 0.0
    both = np.concatenate([start, wild, start])
    swept = solve_from_state(boundary, np.repeat(p, 3, axis=0), both, 2)
    assert swept.status[1] != Status.CONVERGED.value
    solved = solve_transient(boundary, np.repeat(p, 3, axis=0), both)
    assert (solved.status == Status.CONVERGED.value).all()
    np.testing.assert_array_equal(solved.x[0], solved.x[2])
    np.testing.assert_allclose(solved.x[1], solved.x[0], atol=1e-9)
