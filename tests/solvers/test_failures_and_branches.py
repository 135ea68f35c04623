"""Failures have names, neighbours do not matter, and of two stable motions both are found."""

from dataclasses import replace

import numpy as np
import pytest
from periodic_problems import coupled, duffing, gas_spring, harmonics, problem, relaxation, rest

from bayesoleo.model import Model, Parameter
from bayesoleo.solvers._orbit import Status, count
from bayesoleo.solvers._periodic import sensitivities, solve_from_guess, solve_periodic

FORCE = harmonics(h0=0.1, h1=0.8, h2=0.2 - 0.1j)
END_STOP = harmonics(h0=23.0, h1=20.0)


def test_a_start_beyond_the_end_of_the_gas_law_is_inadmissible():
    boundary, p = problem(gas_spring(), END_STOP, 1.0, n=256)
    solution = solve_periodic(boundary, p, rest(boundary, 256, 1.2))
    assert Status(solution.status[0]) is Status.INADMISSIBLE
    assert "admissible" in Status.INADMISSIBLE.message


def test_the_end_stop_orbit_is_that_of_the_digest():
    """Verbeek (1993), section 4.3.3, theta = 100: q(0) from 60 periods of LSODA at rtol 1e-9."""
    boundary, p = problem(gas_spring(), END_STOP, 1.0, n=800)
    solution = solve_from_guess(boundary, p, rest(boundary, 800, 0.5))
    assert solution.status[0] == Status.CONVERGED
    # The stop's kink costs the high order: third order in h, with stiffness 100.
    np.testing.assert_allclose(solution.x[0, 0, :2], [0.78113832, 3.26503319], atol=1e-6)
    assert solution.x[0, :, 0].min() == pytest.approx(-0.21221, abs=1e-4)


def test_every_other_failure_has_a_name():
    boundary, p = problem(duffing(), FORCE, 0.2)
    tired = solve_periodic(boundary, p, rest(boundary, 64), max_iterations=2)
    assert Status(tired.status[0]) is Status.NO_CONVERGENCE
    lost = solve_periodic(boundary, p, rest(boundary, 64, np.nan))
    assert Status(lost.status[0]) is Status.NOT_FINITE
    free = Model(
        "free mass",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={"mass": Parameter(1.0, sd=0.1)},
        equations={"q": "mass*ddot(q) - force"},
        outputs={"displacement": "q"},
    )
    boundary, p = problem(free, FORCE, 0.2)
    adrift = solve_periodic(boundary, p, rest(boundary, 64))
    assert Status(adrift.status[0]) is Status.SINGULAR
    drift = replace(relaxation(), equations={"q": "dot(q) + 0*rate*cubic - force"})
    boundary, p = problem(drift, FORCE, 0.2)
    # Its multiplier is one but for round-off, which must not pass for a way to close the period.
    assert Status(solve_periodic(boundary, p, rest(boundary, 64)).status[0]) is Status.SINGULAR
    everything = np.concatenate([tired.status, lost.status, adrift.status, [0, 0]])
    assert count(everything) == {
        "converged": 2,
        "no_convergence": 1,
        "not_finite": 1,
        "singular": 1,
    }


@pytest.mark.parametrize("name", ["radau3", "thesis"])
def test_lanes_do_not_see_each_other(name):
    """Good, failing and slow lanes together give bit for bit what each gives alone."""
    n = 64
    boundary, p = problem(coupled(), FORCE, 0.2, name, n)
    rng = np.random.default_rng(4)
    many = p * (1 + 0.3 * rng.standard_normal((7, p.shape[1])))
    many[3] = np.nan
    start = np.repeat(rest(boundary, n), 7, axis=0)
    start[5] += 0.1 * rng.standard_normal(start[5].shape)
    together = solve_periodic(boundary, many, start)
    assert together.status[3] != Status.CONVERGED
    counted = count(together.status)
    assert counted["not_finite"] == 1
    assert counted["converged"] >= 4
    order = rng.permutation(7)
    mixed = solve_periodic(boundary, many[order], start[order])
    for lane in range(7):
        alone = solve_periodic(boundary, many[lane : lane + 1], start[lane : lane + 1])
        row = np.flatnonzero(order == lane)[0]
        assert alone.status[0] == together.status[lane] == mixed.status[row]
        assert alone.iterations[0] == together.iterations[lane] == mixed.iterations[row]
        if alone.status[0] == Status.CONVERGED:
            assert alone.x[0].tobytes() == together.x[lane].tobytes() == mixed.x[row].tobytes()


def test_both_stable_motions_inside_the_fold_of_duffing():
    """Hardening spring above resonance: a large and a small motion, each from a start like it."""
    model, frequency, n = duffing(damping=0.1), 0.3, 128
    boundary, p = problem(model, harmonics(h1=0.5), frequency, n=n)
    small = solve_periodic(boundary, p, rest(boundary, n))
    phase = 2 * np.pi * boundary.scheme.phases(n)
    nodes, rate = 2 * np.pi * np.arange(n) / n, 2 * np.pi * frequency
    # Backbone: rate**2 = 1 + 3/4 A**2, in quadrature with the force.
    amplitude = np.sqrt((rate**2 - 1) * 4 / 3)

    def rows(angle):
        motion = [np.sin(angle), rate * np.cos(angle), -(rate**2) * np.sin(angle)]
        return amplitude * np.stack(motion)[None]

    large = solve_periodic(boundary, p, boundary.scheme.from_motion(rows(nodes), rows(phase)))
    sizes = []
    for solution in (small, large):
        assert solution.status[0] == Status.CONVERGED
        _, _, monodromy = sensitivities(boundary, p, solution)
        assert np.abs(np.linalg.eigvals(monodromy[0])).max() < 1, "stable"
        sizes.append(np.ptp(solution.x[0, :, 0]) / 2)
    assert sizes[0] < 0.4
    assert sizes[1] > 1.0


def test_continuation_reaches_what_newton_alone_does_not():
    boundary, p = problem(gas_spring(), END_STOP, 1.0, n=128)
    start = rest(boundary, 128, -3.0)
    solution = solve_from_guess(boundary, p, start)
    assert solution.status[0] == Status.CONVERGED
    reference = solve_from_guess(boundary, p, rest(boundary, 128, 0.5))
    np.testing.assert_allclose(solution.x, reference.x, atol=1e-9)


def test_back_ends_agree_to_round_off():
    for model in (relaxation(), gas_spring(), coupled()):
        force = END_STOP if model.name == "end stop" else FORCE
        answers = []
        for backend in ("numpy", "numba"):
            boundary, p = problem(model, force, 1.0, n=96, backend=backend)
            solution = solve_from_guess(boundary, p, rest(boundary, 96, 0.4))
            solution, x_p, _ = sensitivities(boundary, p, solution)
            assert solution.status[0] == Status.CONVERGED
            answers.append((solution.x, x_p))
        for one, other in zip(*answers, strict=True):
            # Last bits differ in powers; the closure's condition lifts them by less than 1e3.
            np.testing.assert_allclose(one, other, atol=1e-12 * np.abs(one).max())
