"""What must hold for a solution on any mesh, independent codes, and failures by their names."""

from functools import partial

import numpy as np
import pytest
from periodic_problems import coupled, duffing, friction_oscillator, harmonics, relaxation
from scipy.integrate import solve_bvp, solve_ivp

from bayesoleo.errors import InputError
from bayesoleo.model import Model, Parameter
from bayesoleo.prediction._orbits import periodic_orbit
from bayesoleo.prediction._simulate import RunPlan, motion
from bayesoleo.solvers._mesh import equidistant
from bayesoleo.solvers._moving_edges import SAME, extrapolate, warp_between
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._switched import Crossings, find_crossings, state_rows
from bayesoleo.systems import system

FORCE = harmonics(h0=0.1, h1=0.8, h2=0.2 - 0.1j)
FREQUENCY, PERIOD = 0.2, 5.0
adaptive_orbit = partial(periodic_orbit, solver="adaptive", tolerance=1e-6, backend="numpy")


def answer(model, phase=0.0, **options):
    found = adaptive_orbit(
        model, RunPlan("run", FREQUENCY, {"force": FORCE}, phase=phase), **options
    )
    assert found.orbits[0].status is Status.CONVERGED
    return found


@pytest.mark.parametrize(
    "model", [duffing(quadratic=0.5), coupled(), relaxation()], ids=lambda m: m.name
)
def test_a_shift_of_phase_shifts_the_solution(model):
    shift, phase = 0.37, np.linspace(0.0, 1.0, 500)
    here, later = answer(model), answer(model, phase=shift)
    moved, other = (
        here.motions[0].rows(phase + shift),
        later.motions[0].rows(phase),
    )
    kept = state_rows(here.motions[0].solution.level.scheme.orders)
    size = np.abs(moved).max(axis=1)[kept, None]
    # Both are good to 1e-6, on meshes that differ.
    np.testing.assert_allclose((moved[kept] - other[kept]) / size, 0.0, atol=2e-6)


@pytest.mark.parametrize(
    "model", [duffing(quadratic=0.5), friction_oscillator()], ids=lambda m: m.name
)
def test_work_done_equals_what_is_dissipated(model):
    found = answer(model, tolerance=1e-7)
    phase = (np.arange(20000) + 0.5) / 20000
    velocity = found.dof("q", phase, 1)[0]
    force = FORCE.evaluate(phase, FREQUENCY)
    lost = 0.3 * velocity**2 + 0.5 * np.abs(velocity) ** 3
    if model.name == "friction":
        lost, force = lost + 0.4 * velocity * np.arctan(3 * velocity), force - 0.1
    work = np.mean(force * velocity)
    assert work > 0.02
    # The midpoint rule errs by 1e-9 at most, velocities by 1e-7 of theirs.
    assert work == pytest.approx(np.mean(lost), rel=1e-6)


def test_floquet_multipliers_obey_liouville_across_a_contact():
    """Their product is the exponential of the integral of the trace, contacts or not."""
    plan = RunPlan("end stop", 1.0, {"force": motion(23.0, [20.0])})
    found = adaptive_orbit(system("end_stop"), plan, {"stop_stiffness": 2500.0})
    phase = (np.arange(100_000) + 0.5) / 100_000
    trace = np.mean(-2.0 * np.abs(found.dof("stroke", phase, 1)[0]))
    product = np.prod(found.orbits[0].multipliers)
    assert abs(product.imag) < 1e-12
    assert product.real == pytest.approx(np.exp(trace), rel=1e-5)


def rates(t, y):
    force = FORCE.evaluate(np.atleast_1d(FREQUENCY * t), FREQUENCY).reshape(np.shape(t))
    q, v = y
    return np.array([v, force - 0.3 * v - 0.5 * v * np.abs(v) - q - q**3])


@pytest.mark.reference
def test_agrees_with_a_boundary_value_solver_and_with_integration():
    found = answer(duffing(quadratic=0.5), tolerance=1e-8)
    times = np.linspace(0.0, PERIOD, 101)
    run = solve_ivp(rates, (0, 40 * PERIOD), np.zeros(2), method="LSODA", rtol=1e-10, atol=1e-11)
    # The integrator's own error is some ten times its tolerance.
    np.testing.assert_allclose(found.orbits[0].states[0], run.y[:, -1], atol=5e-8)
    other = solve_bvp(
        rates,
        lambda a, b: a - b,
        times,
        found.motions[0].rows(times / PERIOD)[:2] * 0.9,
        tol=1e-7,
    )
    assert other.status == 0
    np.testing.assert_allclose(
        found.motions[0].rows(times / PERIOD)[:2], other.sol(times), atol=1e-6
    )


@pytest.mark.parametrize("model", [duffing(quadratic=0.5), coupled()], ids=lambda m: m.name)
def test_sensitivities_are_those_of_the_solution(model):
    found, step = answer(model, tolerance=1e-8), 1e-4
    rows = found.motions[0].solution.level.scheme.orders
    by = found.motions[0].solution.sensitivities[0]
    for k, name in enumerate(model.estimated()):
        nominal = model.parameters[name].value
        ends = [
            answer(model, tolerance=1e-10, values={name: nominal + sign * step}).orbits[0].states[0]
            for sign in (1, -1)
        ]
        difference = (ends[0] - ends[1]) / (2 * step)
        # Differences err by 1e-10 / 1e-4 of the solutions and by step**2.
        np.testing.assert_allclose(by[: sum(rows), k], difference, atol=1e-5)


def test_failures_have_names():
    plan = RunPlan("end stop", 1.0, {"force": motion(23.0, [20.0])})
    model = system("end_stop")
    few = adaptive_orbit(model, plan, {"stop_stiffness": 2500.0}, tolerance=1e-9, max_steps=100)
    assert few.orbits[0].status is Status.TOLERANCE_NOT_MET
    assert few.orbits[0].error > 1e-9
    assert "tolerance" in few.orbits[0].status.message
    stiff = adaptive_orbit(model, plan, {"stop_stiffness": 1e8})
    assert stiff.orbits[0].status is Status.NO_CONVERGENCE
    assert np.isnan(stiff.orbits[0].multipliers).all()
    assert not stiff.orbits[0].stable
    free = Model(
        "free mass",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={"mass": Parameter(1.0, sd=0.1)},
        equations={"q": "mass*ddot(q) - force"},
        outputs={"displacement": "q"},
    )
    adrift = adaptive_orbit(free, RunPlan("run", FREQUENCY, {"force": FORCE}))
    assert adrift.orbits[0].status is Status.SINGULAR


def test_wrong_names_are_told():
    plan, model = RunPlan("run", FREQUENCY, {"force": FORCE}), duffing()
    with pytest.raises(
        InputError, match=r"key masss: no such parameter; parameters there are: mass"
    ):
        adaptive_orbit(model, plan, {"masss": 1.0})
    with pytest.raises(InputError, match=r"key stiffness: no such parameter .got .stif.."):
        adaptive_orbit(model, plan, stiffness="stif")
    with pytest.raises(InputError, match=r"needs the input 'force'"):
        adaptive_orbit(model, RunPlan("run", FREQUENCY, {}))
    with pytest.raises(InputError, match=r"no such dof.*there are q"):
        answer(model).dof("x", np.zeros(1))


def test_crossings_are_found_wherever_they_are():
    """Both zeros of a shifted cosine, of a function that touches zero none."""

    def values(phase):
        turn = 2 * np.pi * phase
        return np.stack([np.cos(turn) - 0.5, 1.0 + np.cos(turn), np.sin(turn) + 2.0])

    found = find_crossings(values, equidistant(10))
    np.testing.assert_allclose(found.phases, [1 / 6, 5 / 6], atol=1e-14)
    assert found.labels == (((0, False),), ((0, True),))
    np.testing.assert_array_equal(
        found.modes(np.array([0.0, 0.5, 0.9])), [[1, 0, 1], [1, 1, 1], [1, 1, 1]]
    )


def kinks(*phases):
    return Crossings(
        np.array(phases), tuple(((0, k % 2 == 1),) for k in range(len(phases))), (True,)
    )


def test_a_warp_moves_kinks_onto_kinks_and_back():
    warp = warp_between(kinks(0.2, 0.4), kinks(0.3, 0.35))
    np.testing.assert_allclose(
        warp.forward(np.array([0.0, 0.2, 0.3, 0.4, 1.0])), [0, 0.3, 0.325, 0.35, 1]
    )
    phase = np.linspace(0, 1, 50)
    np.testing.assert_allclose(warp.back(warp.forward(phase)), phase, atol=1e-15)
    assert warp_between(kinks(0.2, 0.4), kinks(0.2)) is SAME


def test_contacts_are_extrapolated_in_geometric_proportion():
    """A contact between 0.5 and 0.5 + d shrinks from 0.04 to 0.02; next comes 0.01."""
    next_ = extrapolate(kinks(0.5, 0.54), kinks(0.5, 0.52), 1.0)
    contact = np.diff(next_.forward(np.array([0.5, 0.52])))[0]
    assert contact == pytest.approx(0.01, rel=0.02)


@pytest.mark.parametrize("shift", [0.0, 0.25, 0.5, 0.731])
def test_what_repeats_crosses_zero_as_often_up_as_down(shift):
    """The end of a period is its beginning, also where a zero stands on it."""

    def values(phase):
        return np.sin(2 * np.pi * (phase - shift))[None]

    found = find_crossings(values, equidistant(7))
    expected = sorted([(shift % 1.0, True), ((shift + 0.5) % 1.0, False)])
    assert sorted(label for group in found.labels for label in group) == [(0, False), (0, True)]
    gaps = np.abs(np.sort(found.phases) - [phase for phase, _ in expected])
    assert np.minimum(gaps, 1.0 - gaps).max() < 1e-12
    place = np.array([0.11, 0.37, 0.62, 0.93])
    np.testing.assert_array_equal(found.modes(place)[0], values(place)[0] > 0)
