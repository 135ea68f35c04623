"""Periodic motions by shooting: the thesis's end stop, discretisation, invariants, failures."""

import numpy as np
import pytest
from periodic_problems import (
    coupled,
    duffing,
    friction_oscillator,
    gas_spring,
    harmonics,
    problem as discretised,
    rest,
)
from test_initial_value import FORCE, FREQUENCY, dynamics

from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import solve_from_guess
from bayesoleo.solvers._shooting import solve_shooting
from bayesoleo.systems import system

END_STOP = harmonics(h0=23.0, h1=20.0)
#: Verbeek (1993), section 4.3.3: q(0), q'(0) and min q from 60 periods of LSODA at rtol 1e-9.
TABLE = {
    0.0: (-0.1191663, 4.69243733, -0.64326),
    100.0: (0.78113832, 3.26503319, -0.21221),
    2500.0: (0.83680069, 0.77678702, -0.04372),
    1e5: (0.82009573, 1.08562218, -6.889e-3),
    1e8: (0.8157393, 1.211127, -2.1704e-4),
    1e11: (0.8155908, 1.2154198, -6.862e-6),
}


@pytest.mark.reference
@pytest.mark.parametrize("stages", [3, 5])
@pytest.mark.parametrize("stiffness", TABLE)
def test_end_stop(stiffness, stages):
    field, p = dynamics(
        system("end_stop").with_values({"stop_stiffness": stiffness}), END_STOP, 1.0
    )
    shot = solve_shooting(field, p, 1.0, np.array([0.5, 0.0]), stages=stages)
    assert shot.status.ok
    q, v, least = TABLE[stiffness]
    # Digits of the table, and of an integrator at rtol 1e-9.
    assert shot.start[0] == pytest.approx(q, abs=5e-8)
    assert shot.start[1] == pytest.approx(v, abs=1e-6)
    times = shot.trajectory.times
    inside = times[:-1, None] + np.diff(times)[:, None] * np.linspace(0, 1, 20)
    assert shot.sample(inside.ravel())[0].min() == pytest.approx(least, rel=2e-3)
    assert np.abs(np.linalg.eigvals(shot.monodromy)).max() < 1
    assert shot.orbit().stable
    # The integrator bounds errors of steps, not of the motion.
    assert shot.orbit().status is Status.NO_ERROR_ESTIMATE


@pytest.mark.parametrize("model", [duffing(), friction_oscillator(), coupled()])
def test_agrees_with_discretisation(model):
    """From rest: on the Duffing oscillator Newton's method needs the motion to settle first."""
    boundary, constants = discretised(model, FORCE, FREQUENCY, "gauss3", 512)
    solution = solve_from_guess(boundary, constants, rest(boundary, 512))
    field, p = dynamics(model)
    shot = solve_shooting(field, p, 1 / FREQUENCY, np.zeros(field.size), tolerance=1e-10)
    assert shot.status.ok
    # Discretisation errs at the kink of |v|, by the step cubed.
    np.testing.assert_allclose(shot.start, solution.x[0, 0, : field.size], atol=1e-8)


def test_a_shift_of_phase_shifts_the_motion():
    shift = 0.3
    turned = FORCE.coefficients * np.exp(2j * np.pi * FORCE.orders * shift)
    later = harmonics(**{f"h{k}": c for k, c in zip(FORCE.orders, turned, strict=True)})
    shots = []
    for force in (FORCE, later):
        field, p = dynamics(coupled(), force)
        shots.append(solve_shooting(field, p, 1 / FREQUENCY, np.zeros(3), tolerance=1e-11))
    phases = np.linspace(0, 1, 50, endpoint=False)
    np.testing.assert_allclose(
        shots[0].sample(phases + shift)[[0, 1, 3]], shots[1].sample(phases)[[0, 1, 3]], atol=1e-8
    )


def test_work_done_equals_what_is_dissipated():
    field, p = dynamics(duffing(quadratic=0.5))
    shot = solve_shooting(field, p, 1 / FREQUENCY, np.zeros(2), tolerance=1e-11)
    path = shot.trajectory
    x, w = np.polynomial.legendre.leggauss(8)
    h = np.diff(path.times)
    times = (path.times[:-1, None] + h[:, None] * (x + 1) / 2).ravel()
    weights = (h[:, None] / 2 * w).ravel()
    v, force = path.sample(times)[1], FORCE.evaluate(times * FREQUENCY, FREQUENCY)
    work, lost = weights @ (force * v), weights @ (0.3 * v**2 + 0.5 * np.abs(v) ** 3)
    assert work > 0.1
    assert work == pytest.approx(lost, rel=1e-9)


def test_sensitivities_against_differences():
    field, p = dynamics(friction_oscillator())

    def solved(constants):
        return solve_shooting(
            field, constants, 1 / FREQUENCY, np.zeros(2), tolerance=1e-12, sensitivities=True
        )

    shot, phases, small = solved(p), np.linspace(0, 1, 20), 1e-4
    by_theta = shot.sample_theta(phases)
    for k in range(field.active):
        move = small * np.eye(p.size)[k]
        difference = solved(p + move).sample(phases) - solved(p - move).sample(phases)
        # The difference's own error is the step squared times a third derivative of order ten.
        np.testing.assert_allclose(
            by_theta[:2, k], difference[:2] / (2 * small), atol=2e-6 * np.abs(by_theta[:2]).max()
        )


def test_a_neighbour_saves_passes():
    field, p = dynamics(coupled())
    first = solve_shooting(field, p, 1 / FREQUENCY, np.zeros(3), sensitivities=True)
    moved = p * 1.001
    near = first.start + first.start_theta @ (moved - p)[: field.active]
    warm = solve_shooting(field, moved, 1 / FREQUENCY, near, near=first)
    cold = solve_shooting(field, moved, 1 / FREQUENCY, np.zeros(3))
    assert warm.status.ok
    assert warm.evaluations < cold.evaluations / 2
    np.testing.assert_allclose(warm.start, cold.start, atol=1e-7)


def test_failures_have_names():
    field, p = dynamics(gas_spring(), END_STOP, 1.0)
    outside = solve_shooting(field, p, 1.0, np.array([1.2, 0.0]))
    assert outside.status is Status.INADMISSIBLE
    assert np.isnan(outside.orbit().multipliers).all()
    free, constants = dynamics(duffing(damping=0.0, stiffness=0.0, cubic=0.0))
    adrift = solve_shooting(free, constants, 1 / FREQUENCY, np.zeros(2))
    assert adrift.status is Status.SINGULAR
