"""Columns that are swept with a scheme's pieces, against the factorisation of a whole period."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.solvers import _collocation as collocation, _elimination as elimination
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._mesh import Mesh, tableau

LANES, STEP = 2, 0.02
#: Straight-line code, loops over blocks of dofs, a last row that is not full, chunks of one step.
CASES = [((2,), 100), ((2,), 13), ((1,), 8), ((2, 1), 41), ((1, 1, 2), 64), ((2,) * 5, 40)]


def equations(orders, n, columns, seed=1):
    """Random equations whose highest derivatives dominate."""
    rng = np.random.default_rng(seed)
    scheme = Collocation(tableau("radau3"), orders)
    d, points = len(orders), n * scheme.method.stages
    gz = 0.3 * rng.standard_normal((LANES, d, scheme.state_size + d, points))
    row = 0
    for j, order in enumerate(orders):
        gz[:, j, row + order] += 3.0
        row += order + 1
    right = rng.standard_normal((LANES, d, columns, points))
    x = rng.standard_normal((LANES, n, scheme.width))
    jumps = rng.standard_normal((LANES, scheme.state_size, columns, n))
    return scheme, gz, right, x, jumps


def factorised(scheme, gz, right, ends, n):
    """Of one lane, by a sparse factorisation that exchanges rows."""
    h = scheme.lengths(n, STEP)
    found = elimination.collocation_step(gz, right, ends, scheme.method, scheme.orders, h)
    assert found is not None
    return found


@pytest.mark.parametrize("equal", [True, False])
@pytest.mark.parametrize(("orders", "n"), CASES)
def test_columns_with_jumps_solve_the_period(orders, n, equal, monkeypatch):
    scheme, gz, right, x, jumps = equations(orders, n, 3)
    if not equal:
        edges = np.cumsum(1.0 + 0.5 * np.sin(np.arange(n)))
        mesh = Mesh(np.concatenate(([0.0], edges / edges[-1])))
        scheme = Collocation(scheme.method, orders, mesh)
    monkeypatch.delattr(elimination, "eliminate_steps")  # all of it is swept
    lanes, h = np.arange(LANES), scheme.lengths(n, STEP)
    none, _, _ = scheme.linear(gz, right, None, lanes, STEP)
    added, _, ok = scheme.linear(gz, right, x, lanes, STEP, jumps=jumps)
    assert ok.all()
    for lane in lanes:
        ends = np.zeros_like(jumps[lane])
        wanted = factorised(scheme, gz[lane], right[lane], ends, n)
        scale = np.abs(wanted).max()
        # The recursion through all steps loses a few digits of sixteen.
        np.testing.assert_allclose(none[lane], wanted, rtol=0, atol=1e-11 * scale)
        ends = jumps[lane].copy()
        ends[:, 0] += scheme._jumps(x[lane], h)
        wanted = factorised(scheme, gz[lane], right[lane], ends, n)
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(added[lane], wanted, rtol=0, atol=1e-11 * scale)


@pytest.mark.parametrize(("orders", "n"), CASES)
@pytest.mark.parametrize("given", [True, False])
def test_a_held_start_is_as_by_the_elimination_that_exchanges_rows(orders, n, given, monkeypatch):
    scheme, gz, right, x, jumps = equations(orders, n, 2, seed=2)
    arguments = gz, right, x if given else None, np.arange(LANES), STEP
    swept = scheme.linear(*arguments, initial=True, jumps=jumps)
    monkeypatch.setattr(collocation, "can_sweep", lambda *_: False)
    wanted = scheme.linear(*arguments, initial=True, jumps=jumps)
    for mine, other in zip(swept, wanted, strict=True):
        scale = np.abs(other).max()
        np.testing.assert_allclose(mine, other, rtol=0, atol=1e-12 * scale)


@pytest.mark.parametrize("n", [1, 4, 20])
def test_no_column_leaves_the_monodromy(n):
    """Four steps, and one, are too few to be swept."""
    scheme, gz, right, _, _ = equations((2,), n, 1)
    _, wanted, _ = scheme.linear(gz, right, None, np.arange(LANES), STEP)
    dx, monodromy, ok = scheme.linear(gz, right[:, :, :0], None, np.arange(LANES), STEP)
    assert dx.shape[-1] == 0
    assert ok.all()
    np.testing.assert_array_equal(monodromy, wanted)


def test_other_lanes_are_not_touched():
    scheme, gz, right, _, _ = equations((2,), 20, 2)
    dx, monodromy, _ = scheme.linear(gz, right, None, np.array([1]), STEP)
    both, _, _ = scheme.linear(gz, right, None, np.arange(LANES), STEP)
    assert not dx[0].any()
    assert np.isnan(monodromy[0]).all()
    np.testing.assert_array_equal(dx[1], both[1])


def test_rows_that_have_to_be_exchanged_are():
    """A dof whose own equation does not name its highest derivative."""
    scheme, gz, right, _, _ = equations((1, 1), 24, 2)
    gz[1] = gz[1, ::-1]
    dx, _, ok = scheme.linear(gz, right, None, np.arange(LANES), STEP)
    assert ok.all()
    ends = np.zeros((scheme.state_size, 2, 24))
    for lane in range(LANES):
        wanted = factorised(scheme, gz[lane], right[lane], ends, 24)
        np.testing.assert_allclose(dx[lane], wanted, rtol=0, atol=1e-11 * np.abs(wanted).max())


@pytest.mark.parametrize("d", [1, 6])
@pytest.mark.parametrize("rate", [10.0, 16.0])
def test_derivatives_of_an_unstable_motion_keep_their_digits(d, rate):
    """One that grows by 2e4 and by 8e6 in a period: rounding may grow as much, not by its square.

    Straight-line code, and loops over dofs that are not tied to each other."""
    n, scheme = 100, Collocation(tableau("radau3"), (2,) * d)
    phase = 2 * np.pi * scheme.phases(n)
    gz = np.zeros((1, d, 3 * d, phase.size))
    for j in range(d):
        gz[0, j, 3 * j] = -(rate**2) * (1 + 0.2 * np.sin(phase))
        gz[0, j, 3 * j + 1], gz[0, j, 3 * j + 2] = 0.1, 1.0
    right = np.repeat(np.stack([np.cos(phase), np.sin(2 * phase) + 1])[None, None], d, axis=1)
    dx, monodromy, ok = scheme.linear(gz, right, None, np.arange(1), 1.0 / n)
    growth = np.abs(np.linalg.eigvals(monodromy[0])).max()
    assert growth > 1e4
    assert ok[0]
    ends, h = np.zeros((2 * d, 2, n)), scheme.lengths(n, 1.0 / n)
    wanted = elimination.collocation_step(gz[0], right[0], ends, scheme.method, scheme.orders, h)
    error = np.abs(dx[0] - wanted).max() / np.abs(wanted).max()
    assert error < 1e-15 * growth
