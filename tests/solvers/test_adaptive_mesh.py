"""Adaptive meshes: the error asked for, kinks that cost no order, and ever stiffer end stops."""

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from periodic_problems import duffing, friction_oscillator, harmonics

from bayesoleo.model._kernels import kernels
from bayesoleo.prediction._orbits import periodic_orbit
from bayesoleo.prediction._periodic_solver import periodic_problem
from bayesoleo.prediction._simulate import RunPlan, motion, record_of
from bayesoleo.solvers import _adaptive_mesh as mesh_module
from bayesoleo.solvers._adaptive_mesh import compare, solve_adaptive
from bayesoleo.solvers._mesh import Mesh, equidistant, tableau
from bayesoleo.solvers._moving_edges import solve_on
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._switched import PeriodicProblem
from bayesoleo.systems import system

FORCE = harmonics(h0=0.1, h1=0.8, h2=0.2 - 0.1j)
END_STOP = RunPlan("end stop", 1.0, {"force": motion(23.0, [20.0])})
#: Verbeek (1993), section 4.3.3: state at t = 0 from 60 periods of LSODA at rtol 1e-9.
REFERENCE = {
    0.0: (-0.1191663, 4.69243733),
    100.0: (0.78113832, 3.26503319),
    2500.0: (0.83680069, 0.77678702),
    1e5: (0.82009573, 1.08562218),
    1e8: (0.8157393, 1.211127),
    1e11: (0.8155908, 1.2154198),
}

adaptive_orbit = partial(periodic_orbit, solver="adaptive", tolerance=1e-6, backend="numpy")

PLAN = RunPlan("run", 0.2, {"force": FORCE})


def end_stop(theta, **options):
    values = {"stop_stiffness": theta}
    return adaptive_orbit(system("end_stop"), END_STOP, values, **options)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["radau2", "radau3", "gauss2", "gauss3"])
@pytest.mark.parametrize("tolerance", [1e-3, 1e-6])
@pytest.mark.parametrize(
    "model", [duffing(quadratic=0.5), friction_oscillator()], ids=lambda m: m.name
)
def test_the_error_is_below_its_estimate_and_that_below_the_tolerance(model, method, tolerance):
    exact = adaptive_orbit(model, PLAN, tolerance=1e-9, scheme="gauss3").motions[0].solution
    found = adaptive_orbit(model, PLAN, tolerance=tolerance, scheme=method)
    assert found.orbits[0].status is Status.CONVERGED
    phase = np.linspace(0.0, 1.0, 2000)
    states = exact.motion(phase)[:2]
    size = np.abs(states).max(axis=1, keepdims=True)
    error = np.max(np.abs(found.motions[0].rows(phase)[:2] - states) / size)
    assert error < found.orbits[0].error <= tolerance


@pytest.mark.parametrize("theta", [0.0, 100.0, 2500.0])
def test_end_stop_agrees_with_long_integration(theta):
    answer = end_stop(theta)
    assert answer.orbits[0].status is Status.CONVERGED
    assert answer.orbits[0].stable
    # The reference's own error, which shows where the mesh is refined: 4e-8.
    np.testing.assert_allclose(answer.orbits[0].states[0], REFERENCE[theta], atol=1e-7)
    assert answer.orbits[0].states.shape[0] < 250


@pytest.mark.slow
@pytest.mark.parametrize("theta", [1e5, 1e8, 1e11])
def test_a_walk_along_the_stiffness_reaches_stiff_stops(theta):
    """Beyond 2500 Verbeek (1993) had to shoot. Wanted: 1e-4 in position, 1e-3 in velocity."""
    answer = end_stop(theta, stiffness="stop_stiffness")
    assert answer.orbits[0].status is Status.CONVERGED
    np.testing.assert_allclose(answer.orbits[0].states[0], REFERENCE[theta], atol=5e-7)
    # The stop is hit once; edges stand on the contact's ends and on both reversals of velocity.
    assert answer.motions[0].solution.level.kinks.phases.size == 4
    assert answer.orbits[0].states.shape[0] < 300


@pytest.mark.slow
def test_a_stiffer_contact_needs_no_more_steps():
    """The contact shrinks ten times and its steps with it: their number stays."""
    soft, stiff = (end_stop(theta, stiffness="stop_stiffness") for theta in (1e6, 1e8))
    assert stiff.orbits[0].states.shape[0] < 1.3 * soft.orbits[0].states.shape[0]
    shortest = [np.diff(item.motions[0].solution.mesh.edges).min() for item in (soft, stiff)]
    assert shortest[0] / shortest[1] == pytest.approx(10.0, rel=0.5)


def at_the_start(method, n, exact, kinks):
    """Error of the first state on ``n`` steps between kinks, or on as many equal steps."""
    problem = periodic_problem(system("end_stop"), record_of(system("end_stop"), END_STOP))
    mesh = equidistant(5 * n)
    if kinks is not None:
        ends = np.concatenate([[0.0], kinks.phases, [1.0]])
        mesh = Mesh(np.interp(np.arange(5 * n + 1) / n, np.arange(ends.size), ends))
    level = solve_on(problem, tableau(method), exact.p, mesh, exact.motion, kinks)
    assert level.status is Status.CONVERGED
    return np.abs(level.x[0, :2] - exact.motion(np.zeros(1))[:2, 0]).max()


def test_edges_on_kinks_keep_the_order_of_the_method():
    """Across a contact, which costs equal steps all of it."""
    exact = end_stop(2500.0, tolerance=1e-10, scheme="gauss3").motions[0].solution
    kinks = exact.level.kinks
    for method, order in {"radau2": 3, "radau3": 5, "gauss2": 4, "gauss3": 6}.items():
        coarse, fine = (at_the_start(method, n, exact, kinks) for n in (24, 48))
        assert np.log2(coarse / fine) == pytest.approx(order, abs=0.25)
    equal = at_the_start("gauss3", 48, exact, None)
    assert equal > 1e4 * fine


def test_kinks_that_are_not_declared_are_found_by_shorter_steps():
    model = system("end_stop")
    plain = kernels(model, backend="numpy")
    force = END_STOP.inputs["force"]
    problem = PeriodicProblem(
        plain, plain.derived.orders, 1.0, lambda phase: force.evaluate(phase, 1.0)[None], 1, 1
    )
    nominal = {str(item): value for item, value in model.nominal().items()}
    p = np.array([nominal[name] for name in plain.derived.constants])
    found = solve_adaptive(problem, p, end_stop(0.0).motions[0].rows, tolerance=1e-5)
    assert found.orbit.status is Status.CONVERGED
    assert found.level.kinks is None
    # Inside a step a kink makes the estimate optimistic: by less than ten here.
    np.testing.assert_allclose(found.orbit.states[0], REFERENCE[100.0], atol=1e-4)
    contact = found.mesh.locate(end_stop(100.0).motions[0].solution.level.kinks.phases[[1, 3]])[0]
    lengths = np.diff(found.mesh.edges)
    assert lengths[contact].max() < 0.2 * lengths.max()


def level_of(kinks, motion, steps):
    """A level as its comparison with a finer one sees it: one state and its rate."""
    scheme = SimpleNamespace(method=tableau("radau2"), orders=(1,))

    def inside(step, position):
        return motion(step, position) * np.ones((2, step.size))

    return SimpleNamespace(
        scheme=scheme, mesh=equidistant(steps), kinks=kinks, inside=inside,
    )  # fmt: skip


def test_a_contact_that_comes_later_is_an_error_of_its_time():
    coarse, fine = (
        level_of(SimpleNamespace(phases=np.array([0.3, place])), lambda *_: 1.0, steps)
        for place, steps in ((0.5, 8), (0.51, 16))
    )
    assert compare(coarse, fine).largest == pytest.approx(0.01)


def test_an_error_that_a_step_has_not_made_is_not_its_own():
    """All of the sixth step's change is there at its beginning; the third makes its own."""
    offset = np.zeros(16)
    offset[10:12] = 0.3  # the halves of the sixth step

    def finer(step, position):
        half = np.where(step % 2, 0.5, 0.0) + 0.5 * position
        return 1.0 + offset[step] + np.where(step // 2 == 2, 0.1 * half, 0.0)

    coarse = level_of(None, lambda *_: 1.0, 8)
    found = compare(coarse, level_of(None, finer, 16))
    expected = np.zeros(8)
    expected[2] = 0.1 / 1.3
    np.testing.assert_allclose(found.own, expected, atol=1e-12)
    assert found.largest == pytest.approx(0.3 / 1.3)


def test_lengths_of_steps_change_no_faster_than_allowed():
    """Around the period too, and nowhere are steps longer than was wanted."""
    rng = np.random.default_rng(0)
    phase = np.sort(rng.uniform(0, 1, 60))
    wanted = 10.0 ** rng.uniform(-4, 0, 60)
    graded = mesh_module._graded(phase, wanted)
    apart = np.abs(phase[:, None] - phase)
    apart = np.minimum(apart, 1.0 - apart)
    change = np.abs(graded[:, None] - graded)
    assert (change <= mesh_module.GROWTH * apart + 1e-12).all()
    assert (graded <= wanted + 1e-12).all()
    assert graded.min() == pytest.approx(wanted.min(), rel=1e-9)
