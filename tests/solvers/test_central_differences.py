"""Central differences work where inertia rules, and fail where damping or friction does."""

import numpy as np
import pytest
from periodic_problems import coupled, duffing, harmonics, problem, relaxation, rest

from bayesoleo.errors import InputError
from bayesoleo.model import Model, Parameter
from bayesoleo.model._kernels import kernels
from bayesoleo.solvers._mesh import equidistant
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import Boundary, sensitivities, solve_from_guess, solve_periodic
from bayesoleo.solvers._schemes import scheme

FORCE = harmonics(h0=0.1, h1=0.8, h2=0.2 - 0.1j)
ORDER = {"central": 2, "central-velocity": 2, "central-acceleration": 2, "central-euler": 1}
#: What mass / h**2 and damping / h put up against a motion that alternates from node to node, from
#: the sums of the stencils' weights with alternating signs.
AGAINST_ALTERNATION = {
    "central": (-4.0, 0.0),
    "central-velocity": (12.0, 0.0),
    "central-acceleration": (-4.0, 4.0),
    "central-euler": (-4.0, 2.0),
    "thesis": (12.0, 4.0),
}


def oscillator(mass: float, damping: float, stiffness: float, friction: float = 0.0) -> Model:
    values = {"mass": mass, "damping": damping, "stiffness": stiffness, "friction": friction}
    return Model(
        "oscillator",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={name: Parameter(value, fixed=True) for name, value in values.items()},
        equations={
            "q": "mass*ddot(q) + damping*dot(q) + stiffness*q + friction*atan(300*dot(q)) - force"
        },
        outputs={"displacement": "q"},
    )


def nodes(model, name, n):
    boundary, p = problem(model, FORCE, 0.2, name, n)
    solution = solve_periodic(boundary, p, rest(boundary, n))
    assert solution.status[0] == Status.CONVERGED
    return solution.x[0, :: n // 8, 0]


@pytest.mark.parametrize("model", [duffing(), coupled()], ids=lambda model: model.name)
@pytest.mark.parametrize("name", ORDER)
def test_order_of_convergence_where_inertia_rules(name, model):
    exact = nodes(model, "gauss3", 256)
    coarse, fine = (np.sqrt(np.mean((nodes(model, name, n) - exact) ** 2)) for n in (512, 1024))
    assert np.log2(coarse / fine) == pytest.approx(ORDER[name], abs=0.25)
    assert scheme(name, (2,)).order == ORDER[name]


@pytest.mark.parametrize("name", AGAINST_ALTERNATION)
def test_an_alternating_force_meets_what_the_stencils_leave_of_mass_and_damping(name):
    """Central first differences do not see it: only the spring holds it where there is no mass."""
    mass, damping, stiffness, n = 0.3, 0.7, 2.0, 16
    boundary, p = problem(oscillator(mass, damping, stiffness), harmonics(h8=1.0), 0.2, name, n)
    h = boundary.step(n)
    with_mass, with_damping = AGAINST_ALTERNATION[name]
    against = with_mass * mass / h**2 + with_damping * damping / h + stiffness
    answer = solve_periodic(boundary, p, rest(boundary, n)).x[0, :, 0]
    np.testing.assert_allclose(answer, (-1.0) ** np.arange(n) / against, rtol=1e-12)


@pytest.mark.parametrize(("name", "damping"), [("central", 0.9), ("central-acceleration", None)])
def test_singular_where_alternation_meets_nothing(name, damping):
    """Inertia with the wrong sign balances the spring, or the damping, at one length of step."""
    n, stiffness, mass = 64, 2.0, 0.5
    h = 5.0 / n
    if damping is None:
        damping = h * (mass * 4.0 / h**2 - stiffness) / 4.0
    else:
        stiffness = 4.0 * mass / h**2
    model = oscillator(mass, damping, stiffness)
    for method, status in ((name, Status.SINGULAR), ("thesis", Status.CONVERGED)):
        boundary, p = problem(model, FORCE, 0.2, method, n)
        assert solve_periodic(boundary, p, rest(boundary, n)).status[0] == status


def test_odd_and_even_nodes_of_a_first_order_equation_do_not_know_each_other():
    """``q' = q - q**3`` has three motions at rest. Central differences add six in which odd nodes
    rest elsewhere than even ones; at an odd number of nodes they cannot."""
    bistable = Model(
        "bistable",
        dofs={"q": "m"},
        parameters={"rate": Parameter(1.0, sd=1.0)},
        equations={"q": "dot(q) - rate*q + q**3"},
        outputs={"displacement": "q"},
    )
    alternates = {}
    for name in ("central", "thesis"):
        for n in (32, 33):
            boundary, p = problem_without_input(bistable, name, n)
            start = np.where(np.arange(n) % 2 == 0, 0.9, -0.9)[None, :, None]
            solution = solve_periodic(boundary, p, start, monotone=False)
            q = solution.x[0, :, 0]
            settled = solution.status[0] == Status.CONVERGED
            alternates[name, n] = bool(settled and np.allclose(np.abs(np.diff(q)), 2.0))
    assert alternates == {
        ("central", 32): True,
        ("central", 33): False,
        ("thesis", 32): False,
        ("thesis", 33): False,
    }


def problem_without_input(model, name, n):
    equations = kernels(model, backend="numpy")
    method = scheme(name, equations.derived.orders)
    return Boundary(equations, method, 2.0, np.zeros((0, n)), 0, 1), np.ones((1, 1))


@pytest.mark.parametrize("name", ["central-acceleration", "central-euler"])
def test_friction_that_outweighs_inertia_is_too_much(name):
    """A velocity that looks back and an acceleration that looks ahead: where the friction's slope
    times the step passes the mass, no motion is found that backward differences find."""
    n, model = 512, oscillator(0.01, 0.05, 1.5, 0.4)
    force = harmonics(h1=2.0)
    exact, p = problem(model, force, 0.2, "radau3", 1024)
    exact = solve_from_guess(exact, p, rest(exact, 1024)).x[0, ::2, 0]
    errors = {}
    for method in (name, "thesis", "central"):
        boundary, p = problem(model, force, 0.2, method, n)
        solution = solve_from_guess(boundary, p, rest(boundary, n))
        found = solution.status[0] == Status.CONVERGED
        errors[method] = np.abs(solution.x[0, :, 0] - exact).max() if found else np.inf
    assert errors["thesis"] < 3e-3 * np.abs(exact).max()
    assert errors["central"] < 3e-3 * np.abs(exact).max()
    assert errors[name] > np.abs(exact).max()


@pytest.mark.parametrize("name", ORDER)
def test_sensitivities_are_differences_of_solutions(name):
    boundary, p = problem(relaxation(), FORCE, 0.2, name, 65)
    solution = solve_periodic(boundary, p, rest(boundary, 65))
    _, x_theta, monodromy = sensitivities(boundary, p, solution)
    assert np.isnan(monodromy).all()
    step = 1e-5
    for k in range(2):
        sides = [p + sign * step * np.eye(2)[k] for sign in (1, -1)]
        above, below = (solve_periodic(boundary, side, solution.x).x for side in sides)
        # Central differences of step 1e-5 err by its square, and by round-off over it.
        np.testing.assert_allclose(x_theta[..., k], (above - below) / (2 * step), atol=1e-9)


def test_unequal_steps_are_refused():
    with pytest.raises(InputError, match=r"differences need equal steps.*central"):
        scheme("central", (2,), equidistant(8))
