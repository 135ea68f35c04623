"""Derivatives with respect to parameters are exact, through ``|v|`` and steep friction too."""

import mpmath
import numpy as np
import pytest
from periodic_problems import coupled, duffing, friction_oscillator, harmonics, problem, rest

from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import linear_by_column, sensitivities, solve_periodic

FORCE = harmonics(h0=0.1, h1=0.8, h2=0.2 - 0.1j)
FREQUENCY = 0.2


@pytest.mark.parametrize("name", ["radau2", "radau3", "gauss2", "gauss3", "thesis"])
@pytest.mark.parametrize(
    "model", [duffing(quadratic=0.4), friction_oscillator(), coupled()], ids=lambda m: m.name
)
def test_against_differences_of_solutions(model, name):
    n, step = 48, 1e-5
    boundary, p = problem(model, FORCE, FREQUENCY, name, n)
    solution = solve_periodic(boundary, p, rest(boundary, n))
    solution, x_p, _ = sensitivities(boundary, p, solution)
    assert solution.status[0] == Status.CONVERGED
    for k in range(boundary.active):
        ends = []
        for sign in (1, -1):
            moved = p.copy()
            moved[0, k] += sign * step
            ends.append(solve_periodic(boundary, moved, solution.x).x[0])
        difference = (ends[0] - ends[1]) / (2 * step)
        # Differences err by step**2 times a third derivative, and by 1e-14 / step of round-off;
        # where a point sits within a step of the kink of |v|, by the step itself.
        np.testing.assert_allclose(x_p[0, ..., k], difference, atol=2e-6 * np.abs(difference).max())


def test_against_high_precision_differences():
    """The thesis's scheme written again with 40 digits: what is left is the package's round-off."""
    n, model = 8, friction_oscillator()
    boundary, p = problem(model, FORCE, FREQUENCY, "thesis", n)
    solution = solve_periodic(boundary, p, rest(boundary, n))
    _, x_p, _ = sensitivities(boundary, p, solution)
    step = mpmath.mpf(1) / (n * mpmath.mpf(FREQUENCY))
    force = [mpmath.mpf(float(value)) for value in boundary.inputs[0]]

    def residual(parameters):
        damping, quadratic, stiffness, amplitude, slope = parameters

        def equations(*q):
            values = []
            for m in range(n):
                v = (3 * q[m] - 4 * q[m - 1] + q[m - 2]) / (2 * step)
                a = (2 * q[m] - 5 * q[m - 1] + 4 * q[m - 2] - q[m - 3]) / step**2
                friction = amplitude * mpmath.atan(slope * v) + quadratic * v * abs(v)
                offset = mpmath.mpf(0.1) - force[m]
                values.append(a + damping * v + stiffness * q[m] + friction + offset)
            return values

        return equations

    with mpmath.workdps(40):
        nominal = [mpmath.mpf(float(value)) for value in p[0, :5]]
        start = [mpmath.mpf(float(value)) for value in solution.x[0, :, 0]]
        small = mpmath.mpf(10) ** -12
        for k in range(5):
            ends = []
            for sign in (1, -1):
                moved = list(nominal)
                moved[k] += sign * small
                ends.append(mpmath.findroot(residual(moved), start, tol=1e-50, maxsteps=60))
            exact = np.array([float((a - b) / (2 * small)) for a, b in zip(*ends, strict=True)])
            np.testing.assert_allclose(x_p[0, :, 0, k], exact, atol=1e-12 * np.abs(exact).max())


def test_failed_solutions_have_no_sensitivities():
    boundary, p = problem(duffing(), FORCE, FREQUENCY)
    solution = solve_periodic(boundary, p, rest(boundary, 64), max_iterations=1)
    judged, x_p, _ = sensitivities(boundary, p, solution)
    assert judged.status[0] == Status.NO_CONVERGENCE
    assert not x_p.any()


@pytest.mark.parametrize("name", ["radau3", "thesis", "central"])
@pytest.mark.parametrize("moved", [(), (1,), (0, 2)])
def test_columns_that_move_nothing_are_left_out_and_change_no_other(name, moved):
    """A parameter that acts on the outputs alone moves no state; with none at all the monodromy is
    still there."""
    n, model = 24, duffing()
    boundary, p = problem(model, FORCE, FREQUENCY, name, n)
    solution = solve_periodic(boundary, p, rest(boundary, n))
    lanes, d, points = np.array([0]), len(boundary.scheme.orders), boundary.inputs.shape[1]
    nz = boundary.scheme.state_size + d
    z, g = np.zeros((1, nz, points)), np.zeros((1, d, points))
    gz, right = np.zeros((1, d, nz, points)), np.zeros((1, d, 3, points))
    boundary.scheme.rows(solution.x, lanes, boundary.step(n), z)
    boundary.equations.jacobian(z, boundary.inputs, p, lanes, g, gz)
    for k in moved:
        right[:, :, k] = np.cos(k + np.arange(points))
    expected = boundary.scheme.linear(gz, right, None, lanes, boundary.step(n))
    found = linear_by_column(boundary.scheme, gz, right, lanes, boundary.step(n))
    assert found[0].any(axis=(0, 1, 2)).tolist() == [k in moved for k in range(3)]
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)  # the same arithmetic, column by column
