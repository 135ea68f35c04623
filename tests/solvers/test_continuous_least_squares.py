"""Banded elimination of states under continuity, against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.solvers._multiple_shooting import ContinuousLeastSquares

#: Measurements at each node: enough for one node alone.
K = 7


def random_problem(n: int, D: int, count: int, growth: float = 1.0):
    rng = np.random.default_rng(n + 10 * D)
    rows = rng.standard_normal((n, K, D))
    own = rng.standard_normal((n, K, count))
    transition = growth * rng.standard_normal((n - 1, D, D))
    by_parameter = rng.standard_normal((n - 1, D, count))
    target, gap = rng.standard_normal((n, K)), rng.standard_normal((n - 1, D))
    return rows, own, transition, by_parameter, target, gap


def dense(rows, own, transition, by_parameter, target, gap, slack):
    """Parameters, states and the parameters' information by the whole optimality conditions."""
    n, _, D = rows.shape
    count, states, multipliers = own.shape[2], n * D, (n - 1) * D
    jacobian = np.zeros((n * K, states + count))
    constraint = np.zeros((multipliers, states + count))
    for m in range(n):
        jacobian[K * m : K * m + K, m * D : (m + 1) * D] = rows[m]
        jacobian[K * m : K * m + K, states:] = own[m]
    for m in range(n - 1):
        here = slice(m * D, (m + 1) * D)
        constraint[here, m * D : (m + 1) * D] = -transition[m]
        constraint[here, (m + 1) * D : (m + 2) * D] = np.eye(D)
        constraint[here, states:] = -by_parameter[m]
    matrix = np.block(
        [[jacobian.T @ jacobian, constraint.T], [constraint, -np.diag(slack.ravel())]]
    )
    answer = np.linalg.solve(matrix, np.concatenate([jacobian.T @ target.ravel(), gap.ravel()]))
    covariance = np.linalg.inv(matrix)[states : states + count, states : states + count]
    return answer[states : states + count], answer[:states].reshape(n, D), covariance


@pytest.mark.parametrize("n", [1, 2, 9])
@pytest.mark.parametrize("D", [1, 3])
@pytest.mark.parametrize("slack", [0.0, 0.3])
def test_elimination_agrees_with_the_whole_system(n, D, slack):
    parts = random_problem(n, D, 2)
    rows, own, transition, by_parameter, target, gap = parts
    allowed = np.full((n - 1, D), slack)
    system = ContinuousLeastSquares.of(
        np.einsum("nka,nkb->nab", rows, rows),
        np.einsum("nka,nkb->nab", rows, own),
        transition,
        by_parameter,
        allowed,
    )
    assert system.regular
    states, multipliers = system.solve(np.einsum("nka,nk->na", rows, target), gap)
    information = system.information(np.einsum("nka,nkb->ab", own, own))
    descent = system.descent(np.einsum("nka,nk->a", own, target), states, multipliers)
    theta = np.linalg.solve(information, descent)
    expected, expected_states, covariance = dense(*parts, allowed)
    np.testing.assert_allclose(theta, expected, rtol=1e-9)
    np.testing.assert_allclose(states + system.states @ theta, expected_states, atol=1e-9)
    np.testing.assert_allclose(np.linalg.inv(information), covariance, rtol=1e-8)


def test_growth_beyond_all_digits_along_the_record_does_no_harm():
    """300 nodes that each triple a disturbance: a product of transitions would reach 1e143."""
    n = 300
    rows, own = np.ones((n, 1, 1)), np.zeros((n, 1, 1))
    transition, by_parameter = np.full((n - 1, 1, 1), 3.0), np.ones((n - 1, 1, 1))
    system = ContinuousLeastSquares.of(rows, own, transition, by_parameter, np.zeros((n - 1, 1)))
    # The fixed point -1/2 of s -> 3 s + theta at theta = 1, seen without noise.
    states, multipliers = system.solve(np.full((n, 1), -0.5), np.zeros((n - 1, 1)))
    information = system.information(np.zeros((1, 1)))
    theta = system.descent(np.zeros(1), states, multipliers) / information[0]
    np.testing.assert_allclose(theta, 1.0, rtol=1e-12)
    np.testing.assert_allclose(states + system.states @ theta, -0.5, rtol=1e-12)


def test_states_that_no_data_determine_are_singular():
    nothing = np.zeros((4, 2, 2))
    system = ContinuousLeastSquares.of(
        nothing, np.zeros((4, 2, 1)), np.zeros((3, 2, 2)), np.ones((3, 2, 1)), np.zeros((3, 2))
    )
    assert not system.regular
