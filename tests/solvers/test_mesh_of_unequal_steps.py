"""Steps of different lengths: the order stays, equal steps stay what they were, transients end."""

import numpy as np
import pytest
from periodic_problems import coupled, duffing, harmonics, problem, relaxation, rest
from scipy.integrate import solve_ivp

from bayesoleo.errors import InputError
from bayesoleo.solvers._mesh import Mesh, equidistant, graded, halved, joined
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import sensitivities, solve_periodic
from bayesoleo.solvers._schemes import scheme

FORCE = harmonics(h0=0.1, h1=0.8, h2=0.2 - 0.1j)
SYSTEMS = {
    "duffing": (duffing(), 0.2),
    "relaxation": (relaxation(), 0.25),
    "coupled": (coupled(), 0.2),
}
#: Steps between eight common phases, on meshes in the asymptotic range above round-off.
STEPS = {"radau2": (8, 16), "radau3": (4, 8), "gauss2": (4, 8), "gauss3": (3, 6)}
ORDER = {"radau2": 3, "radau3": 5, "gauss2": 4, "gauss3": 6}


def uneven(seed: int, each: int) -> Mesh:
    """Random phases, the same for every ``each``, with ``each`` equal steps between them.

    Steps next to each other differ by factors up to ten.
    """
    lengths = np.exp(np.random.default_rng(seed).uniform(np.log(0.1), 0.0, 8))
    coarse = np.concatenate([[0.0], np.cumsum(lengths) / lengths.sum()])
    coarse[-1] = 1.0
    fine = np.interp(np.arange(8 * each + 1) / each, np.arange(9), coarse)
    return Mesh(fine)


def states(model, frequency, name, mesh):
    boundary, p = problem(model, FORCE, frequency, name, mesh.steps, mesh=mesh)
    solution = solve_periodic(boundary, p, rest(boundary, mesh.steps))
    assert solution.status[0] == Status.CONVERGED
    return boundary, p, solution


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("name", ORDER)
def test_order_of_convergence_on_a_random_mesh(name, system):
    model, frequency = SYSTEMS[system]
    exact = states(model, frequency, "gauss3", uneven(5, 48))[2].x[0, ::48, 0]
    errors = []
    for each in STEPS[name]:
        found = states(model, frequency, name, uneven(5, 2 * each))[2].x[0, :: 2 * each, 0]
        errors.append(np.sqrt(np.mean((found - exact) ** 2)))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(ORDER[name], abs=0.25)


@pytest.mark.parametrize("name", ORDER)
def test_a_mesh_of_equal_steps_is_no_mesh(name):
    n = 48
    phase = np.random.default_rng(2).uniform(0, 1, 100)
    answers = []
    for mesh in (None, equidistant(n)):
        boundary, p = problem(coupled(), FORCE, 0.2, name, n, mesh=mesh)
        solution = solve_periodic(boundary, p, rest(boundary, n))
        _, x_p, monodromy = sensitivities(boundary, p, solution)
        between = boundary.scheme.sample(x_p, boundary.scheme.plan(phase, n), boundary.step(n))
        answers.append((solution.x, x_p, monodromy, between))
    for one, other in zip(*answers, strict=True):
        # Lengths differ in the last bit; the closure's condition is below 100.
        np.testing.assert_allclose(one, other, atol=1e-12 * np.abs(one).max())


def test_samples_join_at_the_edges_and_meet_the_nodes():
    mesh = uneven(7, 12)
    boundary, _, solution = states(*SYSTEMS["coupled"], "radau3", mesh)
    n, step = mesh.steps, boundary.step(mesh.steps)
    x = solution.x[..., None]

    def sampled(phase):
        return boundary.scheme.sample(x, boundary.scheme.plan(phase, n), step)[0, :, 0]

    at = sampled(mesh.edges[:-1])
    np.testing.assert_allclose(at[[0, 1, 3]], solution.x[0, :, :3].T, atol=1e-14)
    below = sampled(mesh.edges[1:] - 1e-13)
    np.testing.assert_allclose(below[[0, 1, 3]], np.roll(at[[0, 1, 3]], -1, axis=1), atol=1e-11)


def test_derivatives_on_a_random_mesh_are_those_of_the_solution():
    mesh, step = uneven(3, 6), 1e-5
    boundary, p, solution = states(*SYSTEMS["coupled"], "radau3", mesh)
    _, x_p, _ = sensitivities(boundary, p, solution)
    for k in range(boundary.active):
        ends = []
        for sign in (1, -1):
            moved = p.copy()
            moved[0, k] += sign * step
            ends.append(solve_periodic(boundary, moved, solution.x).x[0])
        difference = (ends[0] - ends[1]) / (2 * step)
        # Differences err by step**2 times a third derivative and by 1e-14 / step of round-off.
        np.testing.assert_allclose(x_p[0, ..., k], difference, atol=2e-6 * np.abs(difference).max())


def newton_from(boundary, p, first, n):
    """A transient by Newton's method on the scheme's linear maps, the first state held."""
    scheme, step, lanes = boundary.scheme, boundary.step(n), np.array([0])
    x = np.zeros((1, n, scheme.width))
    x[0, :, : first.size] = first
    z = np.empty((1, first.size + len(scheme.orders), boundary.inputs.shape[1]))
    g = np.empty((1, len(scheme.orders), z.shape[2]))
    gz = np.empty((1, len(scheme.orders), *z.shape[1:]))
    for _ in range(20):
        scheme.rows(x, lanes, step, z)
        boundary.equations.jacobian(z, boundary.inputs, p, lanes, g, gz)
        dx, _, ok = scheme.linear(gz, g[:, :, None], x, lanes, step, initial=True)
        assert ok[0]
        x += dx[..., 0]
    return x


@pytest.mark.parametrize("name", ["radau3", "gauss3"])
def test_a_transient_on_a_graded_mesh_holds_its_start_and_ends_where_integration_does(name):
    edges = np.linspace(0.0, 1.0, 65) ** 2
    boundary, p = problem(duffing(), FORCE, 0.2, name, 64, mesh=Mesh(edges))
    first = np.array([0.7, -1.5])
    x = newton_from(boundary, p, first, 64)
    np.testing.assert_array_equal(x[0, 0, :2], first)

    def rates(t, y):
        force = FORCE.evaluate(np.array([0.2 * t]), 0.2)[0]
        return [y[1], force - 0.3 * y[1] - y[0] - y[0] ** 3]

    run = solve_ivp(
        rates, (0, 5.0), first, t_eval=5.0 * edges, method="DOP853", rtol=1e-11, atol=1e-12
    )
    # The longest step is 0.16 s at a rate of about 2 rad/s: (0.3)**5 / 7200 and less.
    np.testing.assert_allclose(x[0, :, :2], run.y.T[:-1], atol=2e-6)
    plan = boundary.scheme.plan(np.array([1.0]), 64, initial=True)
    end = boundary.scheme.sample(x[..., None], plan, boundary.step(64))[0, :2, 0, 0]
    np.testing.assert_allclose(end, run.y[:, -1], atol=2e-6)


@pytest.mark.parametrize(
    "edges", [[0.0, 0.5, 0.5, 1.0], [0.0, 0.6, 0.4, 1.0], [0.1, 0.5, 1.0], [0.0, 2.0], [1.0]]
)
def test_edges_that_do_not_rise_from_zero_to_one_are_refused(edges):
    with pytest.raises(InputError, match="must rise from 0 to 1"):
        Mesh(np.array(edges))


def test_what_cannot_use_a_mesh_says_so():
    with pytest.raises(InputError, match=r"differences need equal steps.*use radau3"):
        scheme("thesis", (2,), equidistant(8))
    with pytest.raises(InputError, match="the mesh has 8"):
        scheme("radau3", (2,), equidistant(8)).phases(16)


@pytest.mark.parametrize("steps", [1, 2, 7, 64])
@pytest.mark.parametrize("times", [1, 2])
def test_joined_steps_end_where_some_of_the_others_did(steps, times):
    rng = np.random.default_rng(steps)
    edges = np.concatenate([[0.0], np.sort(rng.uniform(0.01, 0.99, steps - 1)), [1.0]])
    found = joined(Mesh(edges), times)
    assert found.steps == int(np.ceil(steps / 2**times))
    assert set(found.edges) <= set(edges)
    np.testing.assert_array_equal(joined(halved(Mesh(edges), times), times).edges, edges)


@pytest.mark.parametrize("ratio", [1.5, 2.0, 3.0])
def test_neighbouring_steps_of_a_graded_mesh_are_alike(ratio):
    """A kink in the middle of long steps: from there they grow by the ratio at most."""
    edges = np.concatenate([np.linspace(0.0, 0.5, 9), 0.5 + 1e-6 * np.arange(1, 4), [0.6, 1.0]])
    found = graded(Mesh(edges), ratio)
    assert set(edges) <= set(found.edges)
    lengths = np.diff(found.edges)
    grown = lengths[1:] / lengths[:-1]
    # Where pieces from both sides meet, one may be what is left.
    assert np.maximum(grown, 1.0 / grown).max() < 3.0 * ratio
    # On either side of the kink steps of one length grow to the next, and no others are cut.
    growing = int(np.ceil(np.log(0.1 / 1e-6) / np.log(ratio)))
    assert found.steps < 2 * growing + 2 * edges.size
