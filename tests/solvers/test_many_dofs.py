"""Compiled loops for many dofs against a dense solution of the same equations, in NumPy."""

from __future__ import annotations

import ctypes
from functools import cache

import numpy as np
import pytest
from periodic_problems import harmonics, problem, rest

from bayesoleo._compiled import _Callback
from bayesoleo.model import Model, Parameter
from bayesoleo.solvers import (
    _period_arrangement as arrangement,
    _periodic as periodic,
    _unrolled_program as program,
)
from bayesoleo.solvers._mesh import tableau
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import sensitivities, solve_periodic

FORCE, FREQUENCY = harmonics(h0=0.1, h1=0.5 + 0.1j, h2=0.1j), 0.2
NOMINAL = np.array([0.3, 0.7, 0.5])


def linked(d: int, ties: str) -> np.ndarray:
    """Which masses are tied to each other."""
    apart = abs(np.subtract.outer(np.arange(d), np.arange(d)))
    one = np.minimum.outer(np.arange(d), np.arange(d)) == 0
    return {"next": apart == 1, "all": apart > 0, "first": one & (apart > 0)}[ties]


@cache
def chain(d: int, ties: str = "next") -> Model:
    """Masses on cubic springs, each tied to the next, to all others, or to the first; the first is
    driven."""
    names = [f"q{k}" for k in range(d)]
    equations = {}
    for k, q in enumerate(names):
        others = [o for i, o in enumerate(names) if linked(d, ties)[k, i]]
        terms = [f"ddot({q}) + damping*dot({q}) + {q} + cubic*{q}**3"]
        terms += [f"tie*({q} - {o})" for o in others] + (["-force"] if k == 0 else [])
        equations[q] = " + ".join(terms)
    names_of = ("damping", "cubic", "tie")
    return Model(
        f"chain{d}",
        inputs={"force": "N"},
        dofs=dict.fromkeys(names, "m"),
        parameters={
            name: Parameter(float(value), sd=0.1)
            for name, value in zip(names_of, NOMINAL, strict=True)
        },
        equations=equations,
        outputs={"displacement": "q0"},
    )


class Dense:
    """The same as a system of first order, all steps in one matrix: ``y' = f(y)``, with values
    before velocities, and unknowns ``(n, 1 + s, 2 d)`` of nodes and stages."""

    def __init__(self, d: int, n: int, ties: str = "next", name: str = "radau3"):
        self.d, self.n, self.method = d, n, tableau(name)
        pairs = linked(d, ties)
        self.ties = np.diag(pairs.sum(axis=1)) - pairs
        self.h = 1.0 / FREQUENCY / n
        phases = ((np.arange(n)[:, None] + self.method.c) / n).ravel()
        self.force = FORCE.evaluate(phases, FREQUENCY, 0).reshape(n, -1)

    def rates(self, y, p):
        """Of ``y (n, s, 2 d)``, with derivatives by ``y`` and by the parameters."""
        damping, cubic, tie = p
        q, v = y[..., : self.d], y[..., self.d :]
        f, eye = np.zeros_like(y), np.eye(self.d)
        f[..., : self.d] = v
        f[..., self.d :] = -damping * v - q - cubic * q**3 - tie * q @ self.ties
        f[..., self.d] += self.force
        by_y = np.zeros((*y.shape, 2 * self.d))
        by_y[..., : self.d, self.d :] = eye
        by_y[..., self.d :, self.d :] = -damping * eye
        by_y[..., self.d :, : self.d] = -(1 + 3 * cubic * q**2)[..., None] * eye - tie * self.ties
        by_p = np.zeros((*y.shape, 3))
        by_p[..., self.d :, :] = -np.stack([v, q**3, q @ self.ties], axis=-1)
        return f, by_y, by_p

    def equations(self, x, p):
        """Residual ``(N,)``, and its derivatives ``(N, N)`` and ``(N, 3)``."""
        n, s, D = self.n, self.method.stages, 2 * self.d
        a, b, h = self.method.a, self.method.b, self.h
        node, stage = x[:, 0], x[:, 1:]
        f, by_y, by_p = self.rates(stage, p)
        left = np.empty_like(x)
        left[:, 1:] = stage - node[:, None] - h * np.einsum("ij,mjk->mik", a, f)
        left[:, 0] = np.roll(node, -1, axis=0) - node - h * np.einsum("j,mjk->mk", b, f)
        matrix = np.zeros((n, 1 + s, D, n, 1 + s, D))
        moved = np.zeros((n, 1 + s, D, 3))
        moved[:, 1:] = -h * np.einsum("ij,mjkp->mikp", a, by_p)
        moved[:, 0] = -h * np.einsum("j,mjkp->mkp", b, by_p)
        for m in range(n):
            matrix[m, 0, :, (m + 1) % n, 0] += np.eye(D)
            for i in range(1 + s):
                matrix[m, i, :, m, 0] -= np.eye(D)
                weights = b if i == 0 else a[i - 1]
                for j in range(s):
                    matrix[m, i, :, m, 1 + j] -= h * weights[j] * by_y[m, j]
                if i:
                    matrix[m, i, :, m, i] += np.eye(D)
        return left.ravel(), matrix.reshape(x.size, -1), moved.reshape(x.size, 3)

    def solved(self, p):
        """Values and velocities at the nodes ``(n, 2 d)``, and their derivatives by parameters."""
        x = np.zeros((self.n, 1 + self.method.stages, 2 * self.d))
        for _ in range(12):
            left, matrix, _ = self.equations(x, p)
            x -= np.linalg.solve(matrix, left).reshape(x.shape)
        left, matrix, moved = self.equations(x, p)
        assert abs(left).max() < 1e-13
        return x[:, 0], -np.linalg.solve(matrix, moved).reshape(*x.shape, 3)[:, 0]


def discretised(d, n, ties="next"):
    boundary, p = problem(chain(d, ties), FORCE, FREQUENCY, "radau3", n, "numba")
    assert boundary.arranged is not None, "the loops are what is tested"
    return boundary, p


def in_order(d):
    """Values, then velocities, among components of the state."""
    return [*range(0, 2 * d, 2), *range(1, 2 * d, 2)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("d", "ties", "n"),
    [
        (3, "next", 13),
        (3, "all", 24),
        (4, "next", 16),
        (5, "first", 9),
        (6, "next", 11),
        (6, "all", 8),
    ],
)
def test_motion_and_derivatives_are_those_of_a_dense_solution(d, ties, n):
    """Where equations couple few dofs: the first in a chain, whose elimination couples no others,
    and one to which all are tied, whose elimination couples all."""
    boundary, p = discretised(d, n, ties)
    solution = solve_periodic(boundary, p, rest(boundary, n))
    assert solution.status[0] == Status.CONVERGED
    _, by_p, _ = sensitivities(boundary, p, solution)
    values, slopes = Dense(d, n, ties).solved(NOMINAL)
    found = solution.x[0, :, : 2 * d][:, in_order(d)]
    np.testing.assert_allclose(found, values, rtol=0, atol=1e-12)
    np.testing.assert_allclose(by_p[0][:, in_order(d)], slopes, rtol=0, atol=1e-11)


def test_order_of_convergence():
    """Five at the nodes of Radau's method of three stages."""
    d, meshes = 4, (16, 32, 64, 512)
    nodes = []
    for n in meshes:
        boundary, p = discretised(d, n)
        solution = solve_periodic(boundary, p, rest(boundary, n))
        nodes.append(solution.x[0, :: n // 16, : 2 * d])
    errors = [abs(values - nodes[-1]).max() for values in nodes[:-1]]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders[-1] == pytest.approx(5.0, abs=0.4)


@pytest.mark.parametrize("d", [2, 3, 6])
def test_lanes_do_not_know_each_other(d):
    """Not by one bit, whether steps with old derivatives suffice or not, and in whatever place."""
    n = 40
    boundary, p = discretised(d, n)
    settled = solve_periodic(boundary, p, rest(boundary, n)).x
    many = p * np.linspace(0.5, 1.5, 9)[:, None]
    many[4] = np.nan  # a failure leaves nothing behind
    start = settled * np.geomspace(1e-6, 1.0, 9)[:, None, None] + settled
    together = solve_periodic(boundary, many, start)
    assert together.status[4] == Status.NOT_FINITE
    order = np.random.default_rng(7).permutation(9)
    mixed = solve_periodic(boundary, many[order], start[order])
    np.testing.assert_array_equal(mixed.x, together.x[order])
    np.testing.assert_array_equal(mixed.status, together.status[order])
    for lane in range(9):
        alone = solve_periodic(boundary, many[lane : lane + 1], start[lane : lane + 1])
        np.testing.assert_array_equal(alone.x[0], together.x[lane])


@pytest.mark.parametrize("d", [2, 3, 4])
def test_first_steps_with_old_derivatives_end_at_the_same_motion(d):
    """From every distance: near, where they suffice, and far, where they are given up."""
    n, distances = 40, np.geomspace(1e-9, 0.3, 25)
    boundary, p = discretised(d, n)
    exact = solve_periodic(boundary, p, rest(boundary, n)).x
    exact = solve_periodic(boundary, p, exact).x
    many = np.repeat(p, distances.size, axis=0)
    found = solve_periodic(boundary, many, exact * (1.0 + distances[:, None, None]))
    assert (found.status == Status.CONVERGED).all()
    assert abs(found.x - exact).max() < 1e-12 * abs(exact).max()
    general = periodic._Newton(boundary, many, exact * (1.0 + distances[:, None, None]), 40, True)
    np.testing.assert_allclose(found.x, general.run().x, rtol=0, atol=1e-11)


@pytest.mark.parametrize("ties", ["next", "all", "first"])
def test_nothing_is_left_of_the_solve_before(ties):
    """Blocks that are zero are not written, and so must not be read."""
    boundary, p = discretised(5, 16, ties)
    start = rest(boundary, 16)
    first = solve_periodic(boundary, p, start)
    for arrays, _ in arrangement._kept.rooms.values():
        arrays.transfer[:] = np.nan
    again = solve_periodic(boundary, p, start)
    assert again.status[0] == Status.CONVERGED
    np.testing.assert_array_equal(again.x, first.x)


@pytest.mark.slow
@pytest.mark.parametrize("d", [2, 3, 4])
def test_near_a_solution_derivatives_are_made_once(d, monkeypatch):
    """A first step of a thousandth of the motion is what a prediction leaves; three more with the
    same derivatives suffice. Steps with new ones cost several times as much."""
    n = 40
    boundary, p = discretised(d, n)
    start = 1.001 * solve_periodic(boundary, p, rest(boundary, n)).x
    blocks = boundary.arranged.inputs.shape[0]
    calls, original = [], _Callback(boundary.equations.jacobian.address)

    @_Callback
    def watched(*arguments):
        calls.append(1)
        original(*arguments)

    address = ctypes.cast(watched, ctypes.c_void_p).value
    monkeypatch.setitem(vars(boundary.equations.jacobian), "address", address)
    found = solve_periodic(boundary, p, start)
    assert found.status[0] == Status.CONVERGED
    assert len(calls) == blocks
    assert found.iterations[0] <= 4


def test_what_does_not_fit_into_memory_takes_the_general_iteration(monkeypatch):
    monkeypatch.setattr(arrangement, "MOST_BYTES", 1e4)
    boundary, p = problem(chain(3), FORCE, FREQUENCY, "radau3", 13, "numba")
    assert boundary.arranged is None
    solution = solve_periodic(boundary, p, rest(boundary, 13))
    values, _ = Dense(3, 13).solved(NOMINAL)
    np.testing.assert_allclose(solution.x[0, :, :6][:, in_order(3)], values, rtol=0, atol=1e-12)


def test_more_dofs_than_loops_are_for_take_the_general_iteration():
    most = program.LARGEST_BLOCKED
    assert program.collocation(tableau("radau3"), (2,) * (most + 1)) is None
