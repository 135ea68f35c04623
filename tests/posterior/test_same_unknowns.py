"""Rows of a log density that share their unknowns are solved once, and none after a failed run."""

from __future__ import annotations

import numpy as np
import pytest
from linear_runs import linear_runs

from bayesoleo.error_models._base import Frame
from bayesoleo.error_models._independent import IndependentErrors, log_likelihood_by_run
from bayesoleo.posterior import LogDensity
from bayesoleo.posterior._same_unknowns import SameUnknowns
from bayesoleo.solvers._orbit import Status, first_failure

RUNS = 4


class Watched:
    """Linear runs of which some have no solution for some vectors; it notes what it is asked."""

    def __init__(self, problem, failing):
        self.problem, self.failing, self.asked = problem, failing, []

    def __getattr__(self, name):
        return getattr(self.problem, name)

    def residuals(self, theta, run):
        self.asked += [(run, float(row[0])) for row in theta]
        residual, status = self.problem.residuals(theta, run)
        status = np.array(status)
        for vector, (first, reason) in self.failing.items():
            status[(theta[:, 0] == vector) & (run >= first)] = reason
        return residual, status


@pytest.fixture
def problem():
    errors = np.random.default_rng(0).standard_normal((RUNS, 1, 12))
    return linear_runs(0.1 * errors, levels=np.zeros(RUNS), by_run=False)


class ByResiduals(IndependentErrors):
    """The same errors, which do not know that sums of squares are enough."""

    by_sums = False

    def of_run(self, run, residual, eta):
        sums = np.sum(residual**2, axis=2)[:, None]
        return log_likelihood_by_run(sums, self.frame.counts[run : run + 1], eta)[:, 0]


class OverRuns(ByResiduals):
    """The same, asked for all runs at once."""

    over_runs = True


@pytest.fixture(params=[ByResiduals, OverRuns])
def density(problem, request):
    def of(failing=(), jobs=1):
        watched = Watched(problem, dict(failing))
        return LogDensity(watched, jobs, errors=request.param(Frame.of(problem))), watched

    return of


def rows_of(density, vectors, repeats):
    rng = np.random.default_rng(1)
    phi = np.zeros((len(vectors) * repeats, len(density.names)))  # level, slope, variance
    phi[:, 0] = np.tile(vectors, repeats)
    phi[:, 2:] = rng.normal(-4.0, 1.0, size=phi[:, 2:].shape)
    return phi


def test_equal_vectors_are_found_in_any_order():
    theta = np.array([[2.0, 1.0], [0.0, 1.0], [2.0, 1.0], [0.0, 0.5], [0.0, 1.0]])
    same = SameUnknowns.of(theta)
    assert len(same.theta) == 3
    np.testing.assert_array_equal(same.theta[same.of_row], theta)
    blocks = same.blocks(2)
    assert sorted(np.concatenate([block.rows for block in blocks])) == list(range(5))
    for block in blocks:
        np.testing.assert_array_equal(same.theta[block.lanes][block.of_row], theta[block.rows])
        left = block.only(np.arange(len(block.lanes)) > 0)
        np.testing.assert_array_equal(same.theta[left.lanes][left.of_row], theta[left.rows])
        assert set(left.rows) < set(block.rows)


def test_no_rows_have_no_blocks():
    assert SameUnknowns.of(np.zeros((0, 3))).blocks(8) == []


def test_each_vector_is_solved_once_and_each_row_has_its_own_value(density):
    vectors = np.linspace(0.5, 2.0, 11)
    log_density, watched = density()
    phi = rows_of(log_density, vectors, 5)
    value, by_run = log_density(phi)
    assert len(watched.asked) == len(set(watched.asked)) == RUNS * vectors.size
    for k in (0, 13, 54):
        alone, _ = density()
        one, one_by_run = alone(phi[k : k + 1])
        np.testing.assert_array_equal(one, value[k : k + 1])
        np.testing.assert_array_equal(one_by_run, by_run[k : k + 1])
    assert len(np.unique(value)) == len(phi)


@pytest.mark.parametrize("jobs", [1, 3, 64])
def test_a_vector_without_a_solution_costs_one_run(density, jobs):
    failing = {1.0: (1, Status.SINGULAR), 2.0: (0, Status.INADMISSIBLE)}
    log_density, watched = density(failing, jobs=jobs)
    phi = rows_of(log_density, np.array([0.5, 1.0, 1.5, 2.0]), 3)
    value, by_run = log_density(phi)
    lost = np.isin(phi[:, 0], (1.0, 2.0))
    assert np.all(np.isfinite(value) == ~lost)
    assert np.all(by_run[lost] == -np.inf)
    assert log_density.failures == {"singular": 3, "inadmissible": 3}
    clean, _ = density()
    np.testing.assert_array_equal(value[~lost], clean(phi[~lost])[0])
    assert {run for run, vector in watched.asked if vector == 1.0} == {0, 1}
    assert {run for run, vector in watched.asked if vector == 2.0} == {0}


def test_the_first_failure_of_several_is_told():
    status = np.array([[0, 0, 0], [0, 3, 2], [4, 0, 1]])
    assert first_failure(status).tolist() == [0, 3, 4]
    assert first_failure(np.zeros((2, 0), dtype=np.int64)).tolist() == [0, 0]
