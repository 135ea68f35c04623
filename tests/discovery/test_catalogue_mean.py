"""The mean under the catalogue's errors: exact where outputs are linear, and no leap where not."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.discovery import _catalogue_mean as catalogue_mean
from bayesoleo.discovery._catalogue_mean import shifted
from bayesoleo.error_models._catalogue_evidence import Linearised
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.estimation._problem import Evaluation
from bayesoleo.model import LogNormal, Normal, Uniform
from bayesoleo.solvers._orbit import Status

NODES = np.linspace(0.0, 1.0, 40)


class Stand:
    """Errors of unit variance in place of the catalogue's, in which everything is known exactly."""

    def __init__(self, problem):
        self.problem = problem
        self.scale = PriorScale.of(problem.priors, problem.names)

    def linearised(self, theta, found):
        rows = found.sensitivity[0] * self.scale.sd
        pull, precision = self.scale.quadratic(theta)
        covariance = np.linalg.inv(rows.T @ rows + precision)
        return Linearised(0.0, covariance @ (rows.T @ found.residual[0] + pull), covariance)

    def height(self, theta, residual):
        prior = float(self.scale.log_density(theta[None])[0])
        return prior - 0.5 * float(residual[0] @ residual[0])


class Problem:
    """Outputs of one curve, fitted to data without noise."""

    names = ("a", "b")

    def __init__(self, curve, slope, truth, priors):
        self.curve, self.slope, self.priors = curve, slope, priors
        self.data, self.tried = curve(np.array(truth)), []

    def evaluate(self, theta):
        self.tried.append(theta)
        residual, slope = self.data - self.curve(theta), self.slope(theta)
        ok = bool(np.isfinite(residual).all())
        status = Status.CONVERGED if ok else Status.NO_CONVERGENCE
        return Evaluation((residual,), (slope,), status)

    def height(self, theta):
        return Stand(self).height(theta, self.evaluate(theta).residual)


@pytest.fixture(autouse=True)
def stand(monkeypatch):
    monkeypatch.setattr(catalogue_mean, "_About", Stand)


def test_one_step_is_enough_where_outputs_are_linear():
    rows = np.stack([NODES, np.cos(7 * NODES)], axis=1)
    priors = (Normal(0.5, 2.0), Normal(-1.0, 1.0))
    problem = Problem(lambda t: rows @ t, lambda _: rows, (2.0, -0.3), priors)
    mean = shifted(problem, np.array([-1.0, 1.0]))
    theta, found, place = mean.theta, mean.found, mean.place
    assert mean.settled
    precision = rows.T @ rows + np.diag([0.25, 1.0])
    right = rows.T @ problem.data + np.array([0.5 / 4.0, -1.0])
    np.testing.assert_allclose(theta, np.linalg.solve(precision, right), rtol=1e-9)
    np.testing.assert_allclose(place, theta, rtol=1e-9)
    np.testing.assert_allclose(found.shift, 0.0, atol=1e-9)
    # Where it began; the step, and once more to stay there; and the small one that ended it.
    assert len(problem.tried) == 5


def saturating(gain):
    """Outputs that turn flat: the slope at the start promises far too much."""

    def curve(theta):
        return gain * np.tanh(theta[0] * NODES) + theta[1]

    def slope(theta):
        inner = 1.0 / np.cosh(theta[0] * NODES) ** 2
        return np.stack([gain * inner * NODES, np.ones_like(NODES)], axis=1)

    return curve, slope


@pytest.mark.parametrize("start", [(4.0, 0.0), (8.0, 3.0), (0.2, -2.0)])
def test_no_step_ends_far_below_what_slopes_foresee(start):
    """The density never falls much, and ends at its top."""
    curve, slope = saturating(10.0)
    priors = (Normal(0.0, 5.0), Normal(0.0, 5.0))
    problem = Problem(curve, slope, (1.0, 0.0), priors)
    theta = shifted(problem, np.array(start)).theta
    begun, heights = problem.height(np.array(start)), problem.height(theta)
    assert heights > begun
    # What is left of the way within the passes is small beside the prior.
    assert np.abs(theta - np.array([1.0, 0.0])).max() < 0.5


def test_a_step_into_what_cannot_be_solved_is_halved():
    rows = np.stack([NODES, np.ones_like(NODES)], axis=1)

    def curve(theta):
        return rows @ theta if theta[0] < 1.2 else np.full(NODES.size, np.nan)

    problem = Problem(curve, lambda _: rows, (1.0, 0.0), (Normal(6.0, 0.3), Normal(0.0, 1.0)))
    theta = shifted(problem, np.array([0.0, 0.0])).theta
    assert 0.0 < theta[0] < 1.2


def test_supports_are_not_left():
    rows = np.stack([NODES, np.ones_like(NODES)], axis=1)
    priors = (LogNormal(1.0, 0.5), Uniform(-1.0, 1.0))
    problem = Problem(lambda t: rows @ t, lambda _: rows, (0.05, 0.99), priors)
    theta = shifted(problem, np.array([1.0, 0.0])).theta
    assert all(tried[0] > 0.0 and abs(tried[1]) < 1.0 for tried in problem.tried)
    assert problem.height(theta) > problem.height(np.array([1.0, 0.0]))


def test_others_go_where_they_are_most_likely_beside_one_at_its_limit():
    """The density of a linear model is highest at a limit: known in closed form."""
    rows = np.stack([NODES, np.ones_like(NODES)], axis=1)
    priors = (Uniform(0.5, 3.0), Normal(0.0, 3.0))
    problem = Problem(lambda t: rows @ t, lambda _: rows, (-2.0, 1.0), priors)
    mean = shifted(problem, np.array([1.0, -0.5]))
    assert mean.settled
    # The first unknown nears its limit by halves, up to a tenth of its standard deviation of 0.5. A
    # uniform prior has no slope.
    assert 0.5 < mean.theta[0] < 0.55
    left = problem.data - rows[:, 0] * mean.theta[0]
    best = left @ rows[:, 1] / (rows[:, 1] @ rows[:, 1] + 1 / 9.0)
    assert mean.theta[1] == pytest.approx(best, abs=0.02)


def test_a_mean_that_is_still_far_off_is_not_settled():
    """A bent valley, along which eight steps do not lead to the end."""

    def curve(theta):
        return np.array([300.0 * (theta[0] ** 2 - theta[1]), theta[0]])

    def slope(theta):
        return np.array([[600.0 * theta[0], -300.0], [1.0, 0.0]])

    priors = (Normal(0.0, 300.0), Normal(0.0, 300.0))
    problem = Problem(curve, slope, (9.0, 81.0), priors)
    first = shifted(problem, np.array([-9.0, 81.0]))
    assert not first.settled
    assert shifted(problem, np.array([9.0, 81.0])).settled


def test_nothing_moves_where_no_part_of_a_step_is_believed():
    def curve(theta):
        return np.full(NODES.size, np.nan) if theta[0] else np.ones(NODES.size)

    def slope(_):
        return np.stack([NODES, np.ones_like(NODES)], axis=1)

    problem = Problem(curve, slope, (0.0, 0.0), (Normal(1.0, 1.0), Normal(1.0, 1.0)))
    start = np.array([0.0, 0.0])
    mean = shifted(problem, start)
    theta, found, place = mean.theta, mean.found, mean.place
    assert not mean.settled
    np.testing.assert_array_equal(theta, start)
    np.testing.assert_array_equal(place, start)
    assert np.isfinite(found.shift).all()
    assert len(problem.tried) == 2 + catalogue_mean._HALVINGS - 1


def test_steps_do_not_go_downhill_where_a_rise_is_foreseen():
    """A bent valley, along which each slope promises a rise."""

    def curve(theta):
        return np.array([10.0 * (theta[0] ** 2 - theta[1]), theta[0]])

    def slope(theta):
        return np.array([[20.0 * theta[0], -10.0], [1.0, 0.0]])

    problem = Problem(curve, slope, (1.0, 1.0), (Normal(0.0, 30.0), Normal(0.0, 30.0)))
    start = np.array([-1.5, 2.25])
    height, theta = problem.height(start), start
    for _ in range(3):
        theta = shifted(problem, theta).theta
        assert problem.height(theta) > height - 0.1 * catalogue_mean._PASSES
        height = problem.height(theta)
    np.testing.assert_allclose(theta, 1.0, atol=0.05)


def test_an_effect_alone_is_believed_where_its_density_is_not_far_below():
    rows = np.stack([NODES, np.ones_like(NODES)], axis=1)

    def curve(theta):
        return rows @ theta if theta[0] < 2.0 else np.full(NODES.size, np.nan)

    problem = Problem(curve, lambda _: rows, (1.0, 0.0), (Normal(0.0, 9.0),) * 2)
    mean = shifted(problem, np.array([0.5, 0.1]))
    # Near it, far below it, and where nothing can be solved.
    places = [mean.theta + 0.1, mean.theta - 10.0, np.array([2.5, 0.0])]
    assert mean.near(places) == [True, False, False]
    assert mean.near([]) == []
