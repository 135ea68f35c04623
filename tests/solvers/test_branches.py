"""Branches through folds and doublings, and limit cycles, against independent integration."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from periodic_problems import duffing, harmonics, problem, rest
from scipy.integrate import solve_ivp

from bayesoleo.model._kernels import kernels
from bayesoleo.solvers import _branches as branches
from bayesoleo.solvers._branches import follow, solve_limit_cycle
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import Boundary, solve_periodic
from bayesoleo.solvers._schemes import scheme
from bayesoleo.systems import system

N = 96


def forced(model, amplitude, frequency=None, **options):
    """Family of a harmonically forced model along its frequency, or along its amplitude."""
    force = harmonics(h1=1.0)
    base, p = problem(model, force, 0.1, n=N, **options)

    def family(value):
        f, a = (value, amplitude) if frequency is None else (frequency, value)
        rows = [
            a * force.evaluate(base.scheme.phases(N), f, order)
            for _, order in base.equations.derived.inputs
        ]
        return replace(base, period=1 / f, inputs=np.stack(rows)), p[0]

    return family


def period_map(state, frequency, amplitude, damping, stiffness, cubic):
    """State after a period, and its derivatives, by an integrator that knows nothing of this."""
    rate = 2 * np.pi * frequency

    def motion(t, s):
        q, v, *columns = s
        slope = -stiffness - 3 * cubic * q**2
        force = amplitude * np.cos(rate * t) - damping * v - stiffness * q - cubic * q**3
        a, b, c, d = columns
        return [v, force, c, d, slope * a - damping * c, slope * b - damping * d]

    s = solve_ivp(
        motion, (0, 1 / frequency), [*state, 1, 0, 0, 1], rtol=1e-11, atol=1e-12, method="DOP853"
    ).y[:, -1]
    return s[:2], s[2:].reshape(2, 2)


@pytest.fixture(scope="module")
def hardening():
    family = forced(duffing(damping=0.1), 0.5)
    first, p = family(0.08)
    start = solve_periodic(first, p[None], rest(first, N))
    return family, follow(family, start.x[0], 0.08, (0.06, 0.45))


def test_both_folds_of_duffing_have_a_multiplier_of_one(hardening):
    _, branch = hardening
    assert branch.status is Status.CONVERGED
    folds = branch.of_kind("fold")
    assert len(folds) == 2
    assert not branch.of_kind("doubling")
    for fold in folds:
        end, monodromy = period_map(fold.x[0, :2], fold.value, 0.5, 0.1, 1.0, 1.0)
        # 96 steps of order five.
        np.testing.assert_allclose(end, fold.x[0, :2], atol=2e-5)
        assert np.abs(np.linalg.eigvals(monodromy) - 1.0).min() < 1e-4
        assert np.abs(fold.multipliers - 1.0).min() < 1e-9
    # Abel, Jacobi and Liouville: the product of the multipliers is exp(-damping * period).
    for point in branch.points[::7]:
        expected = np.exp(-0.1 / point.value)
        assert np.prod(point.multipliers).real == pytest.approx(expected, rel=1e-4)


def test_three_orbits_between_the_folds_and_the_middle_one_is_unstable(hardening):
    family, branch = hardening
    low, high = sorted(fold.value for fold in branch.of_kind("fold"))
    middle = 0.5 * (low + high)
    values = branch.values
    assert values.max() > 0.45
    passes = np.flatnonzero(np.diff(np.sign(values - middle)))
    assert [branch.points[k].unstable for k in passes] == [0, 1, 0]
    sizes = []
    for k in passes:
        first, p = family(middle)
        again = solve_periodic(first, p[None], branch.points[k].x[None])
        assert again.status[0] == Status.CONVERGED
        sizes.append(np.ptp(again.x[0, :, 0]))
    assert sizes[0] > 1.05 * sizes[1]
    assert sizes[1] > 1.5 * sizes[2]


def test_a_branch_followed_backward_is_the_same(hardening):
    family, branch = hardening
    last = branch.points[-1]
    back = follow(family, last.x, 0.44, (0.06, 0.45), forward=False)
    assert back.status is Status.CONVERGED
    ends = sorted(point.value for point in back.of_kind("fold"))
    expected = sorted(point.value for point in branch.of_kind("fold"))
    np.testing.assert_allclose(ends, expected, rtol=1e-8)


def test_a_branch_prints_its_ends_and_special_orbits(hardening):
    _, branch = hardening
    head, columns, *rows = repr(branch).splitlines()
    assert head == f"branch of {len(branch.points)} orbits, converged"
    assert columns.split() == ["value", "unstable", "largest", "multiplier"]
    assert [row.split()[0] for row in rows] == ["start", "fold", "fold", "end"]
    shown = [branch.points[0], *branch.of_kind("fold"), branch.points[-1]]
    for row, point in zip(rows, shown, strict=True):
        assert row.split()[1:3] == [f"{point.value:.6g}", str(point.unstable)]


def test_a_period_doubles_where_a_multiplier_is_minus_one():
    """Double well, damping 0.3, rate 1.2: motion in one well, its period doubled by more force."""
    model, frequency = duffing(damping=0.3, stiffness=-1.0), 1.2 / (2 * np.pi)
    family = forced(model, None, frequency)
    first, p = family(0.05)
    start = solve_periodic(first, p[None], rest(first, N, 1.0))
    branch = follow(family, start.x[0], 0.05, (0.0, 0.32))
    doubling = branch.of_kind("doubling")[0]
    state = doubling.x[0, :2]
    end, monodromy = period_map(state, frequency, doubling.value, 0.3, -1.0, 1.0)
    np.testing.assert_allclose(end, state, atol=2e-5)
    assert np.abs(np.linalg.eigvals(monodromy) + 1.0).min() < 1e-3
    assert 0.2 < doubling.value < 0.32
    before = [point.unstable for point in branch.points if point.value < doubling.value]
    assert set(before) == {0}
    assert branch.points[-1].unstable == 1


def test_a_branch_without_an_orbit_says_why():
    family = forced(duffing(), 0.5)
    nowhere = follow(family, np.full((N, 5), np.nan), 0.1, (0.05, 0.2))
    assert nowhere.status is Status.NOT_FINITE
    assert nowhere.points == ()
    assert str(nowhere) == "branch of 0 orbits, not finite"


def van_der_pol(mu, steps, guess):
    """The cycle from a motion that has settled, and its problem."""
    model = system("van_der_pol")
    equations = kernels(model, backend="numpy")
    method = scheme("radau3", equations.derived.orders)
    points = method.phases(steps)
    boundary = Boundary(equations, method, 1.0, np.zeros((1, points.size)), 0, 1)
    way = solve_ivp(
        lambda t, s: [s[1], mu * (1 - s[0] ** 2) * s[1] - s[0]],
        (0, 80),
        [2.0, 0.0],
        rtol=1e-8,
        dense_output=True,
    )

    def rows(phase):
        q, v = way.sol(60 + guess * phase)
        return np.stack([q, v, mu * (1 - q**2) * v - q])[None]

    x = method.from_motion(rows(np.arange(steps) / steps), rows(points))[0]
    return boundary, x


# At mu = 1 the period is 6.6632868593 (Andersen and Geer 1982, SIAM J. Applied Mathematics 42).
@pytest.mark.parametrize(("mu", "steps", "guess"), [(1.0, 256, 6.6), (5.0, 768, 11.5)])
def test_period_of_van_der_pol_and_its_derivative(mu, steps, guess):
    boundary, x = van_der_pol(mu, steps, guess)
    cycles = [
        solve_limit_cycle(boundary, np.array([value]), x, guess)
        for value in (mu, mu + 1e-4, mu - 1e-4)
    ]
    cycle = cycles[0]
    # Solved for, without a look at finer steps.
    assert cycle.orbit.status is Status.NO_ERROR_ESTIMATE
    assert cycle.own == pytest.approx(1.0, abs=1e-7)
    assert cycle.stable
    period = return_time(mu, cycle.orbit.states[0])
    assert cycle.orbit.period == pytest.approx(period, rel=1e-7)
    if mu == 1.0:
        assert cycle.orbit.period == pytest.approx(6.6632868593, rel=1e-9)
    difference = (cycles[1].orbit.period - cycles[2].orbit.period) / 2e-4
    assert cycle.period_theta[0] == pytest.approx(difference, rel=1e-6)


def return_time(mu, state):
    """Time between two upward passages of zero by an explicit integrator of order eight."""

    def upward(t, s):
        return s[0]

    upward.direction = 1
    way = solve_ivp(
        lambda t, s: [s[1], mu * (1 - s[0] ** 2) * s[1] - s[0]],
        (0, 60),
        state,
        rtol=1e-12,
        atol=1e-13,
        method="DOP853",
        events=upward,
    )
    return np.diff(way.t_events[0])[-1]


def test_the_period_has_the_order_of_the_scheme():
    errors = []
    for steps in (32, 64):
        boundary, x = van_der_pol(1.0, steps, 6.6)
        cycle = solve_limit_cycle(boundary, np.array([1.0]), x, 6.6)
        errors.append(abs(cycle.orbit.period - 6.66328685932))
    assert np.log2(errors[0] / errors[1]) == pytest.approx(5.0, abs=0.5)


def test_no_cycle_at_rest():
    boundary, x = van_der_pol(1.0, 64, 6.6)
    still = solve_limit_cycle(boundary, np.array([1.0]), np.zeros_like(x), 6.3)
    assert still.orbit.status is Status.SINGULAR
    assert np.isnan(still.period_theta).all()


def test_the_slope_of_a_gap_is_its_derivative(monkeypatch):
    """By central differences; a branch's direction and the period's derivatives rest on it."""

    def gap(family, x, value):
        return SimpleNamespace(gap=np.array([np.sin(value), value**2])), None

    monkeypatch.setattr(branches, "sweep", gap)
    slope = branches._gap_by_value(None, None, 1.3)
    # Differences over 8e-6: their error is the square.
    np.testing.assert_allclose(slope, [np.cos(1.3), 2.6], rtol=1e-8)


@pytest.mark.parametrize(
    ("multipliers", "stable"),
    [([1.0, 0.3], True), ([1.0 - 1e-9, -0.99], True), ([3.0, 1.0 - 1e-9], False),
     ([1.0 + 1e-9, -1.2], False), ([1.0, 0.6 + 0.7j, 0.6 - 0.7j], True),
     ([1.0 - 1e-9, 0.8 + 0.7j, 0.8 - 0.7j], False)],
)  # fmt: skip
def test_a_cycle_is_stable_by_the_multipliers_beside_its_own(multipliers, stable):
    orbit = SimpleNamespace(multipliers=np.array(multipliers), status=Status.CONVERGED)
    cycle = branches.LimitCycle(None, orbit, np.zeros(0))
    assert cycle.stable is stable
    assert abs(cycle.own - 1.0) < 1e-8


def test_a_doubling_is_where_a_multiplier_passes_minus_one():
    """Not where one passes plus one, whatever the other is."""

    def at(*multipliers):
        point = branches.BranchPoint(0.0, np.zeros((1, 2)), np.array(multipliers), np.zeros(3))
        return branches.TESTS["doubling"](point)

    assert at(-0.99, 0.4) > 0 > at(-1.01, 0.4)
    assert at(-1.0, 0.4) == 0.0
    assert at(0.99, 0.4) * at(1.01, 0.4) > 0
