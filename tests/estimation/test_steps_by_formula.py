"""Every estimator's iterations against its formula, written out with inverses and plain sums.

Verbeek (1993), eqs. 3.17-3.23, and Appendix A for Newton's method, whose Hessian here is that of
the objective in the parameters and the variances together, from closed second derivatives.
"""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.estimation import Evaluation, FunctionProblem, estimate
from bayesoleo.estimation._least_squares import WhitenedEquations
from bayesoleo.model._priors import Normal
from bayesoleo.solvers._orbit import Status

TIME = np.linspace(0.0, 2.0, 40)
CENTRE, SD = np.array([1.9, 0.9]), np.array([0.3, 0.2])
W = np.diag(SD**2)


def predicted(x, theta):
    """A decay and its rate, of very different size: two outputs."""
    decay = theta[0] * np.exp(-theta[1] * x)
    return decay, -10 * theta[1] * decay


def first(theta):
    """Derivatives of each output, (n, l)."""
    a, b = theta
    e = np.exp(-b * TIME)
    rate = -10 * np.column_stack((b * e, a * e * (1 - b * TIME)))
    return np.column_stack((e, -a * TIME * e)), rate


def second(theta):
    """Second derivatives of each output, (n, l, l)."""
    a, b = theta
    e = np.exp(-b * TIME)
    cross, rate = -TIME * e, -10 * e * (1 - b * TIME)
    twice = a * TIME**2 * e, -10 * a * e * (b * TIME**2 - 2 * TIME)
    zero = np.zeros_like(e)
    return [
        np.stack([np.stack([zero, c], -1), np.stack([c, t], -1)], -1)
        for c, t in ((cross, twice[0]), (rate, twice[1]))
    ]


class TwoOutputs:
    """Both outputs, measured at the same times."""

    names, outputs, runs = ("height", "rate"), ("decay", "slope"), ("1",)
    priors = tuple(Normal(c, s) for c, s in zip(CENTRE, SD, strict=True))
    start, counts = CENTRE, np.array([[TIME.size, TIME.size]])

    def __init__(self):
        rng = np.random.default_rng(5)
        exact = zip(predicted(TIME, [2.0, 0.8]), (0.05, 0.8), strict=True)
        self.data = [part + rng.normal(0, sd, TIME.size) for part, sd in exact]

    def evaluate(self, theta):
        residual = [y - p for y, p in zip(self.data, predicted(TIME, theta), strict=True)]
        return Evaluation(tuple(residual), first(theta), Status.CONVERGED)


@pytest.fixture(scope="module")
def problem():
    return TwoOutputs()


def parts(problem, theta, unknowns=0):
    """``v`` by (3.17) or (3.18), ``A`` and the descent ``-b``."""
    e = [y - p for y, p in zip(problem.data, predicted(TIME, theta), strict=True)]
    v = [part @ part / (part.size - unknowns / 2) for part in e]
    j = first(theta)
    matrix = sum(p.T @ p / var for p, var in zip(j, v, strict=True))
    return e, v, matrix, sum(p.T @ r / var for p, r, var in zip(j, e, v, strict=True))


def by_formula(problem, method, count, unknowns=0):
    """The first iterates, from the formulas of the thesis."""
    theta, states = CENTRE.copy(), [CENTRE.copy()]
    inverse = np.linalg.inv
    memory = W.copy() if method == "mve" else np.zeros((2, 2))
    for _ in range(count):
        _, _, a, pull = parts(problem, theta, unknowns)
        if method == "be":
            step = inverse(a + inverse(W)) @ (pull - inverse(W) @ (theta - CENTRE))
        elif method == "mbe":
            step = inverse(a + inverse(W)) @ pull
        elif method == "mve":
            memory = inverse(a + inverse(memory))
            step = memory @ pull
        elif method == "mmve":
            memory = inverse(a + inverse(memory + W))
            step = memory @ pull
        else:
            step = inverse(a) @ pull
        theta = theta + step
        states.append(theta)
    return np.array(states)


@pytest.mark.parametrize("bias_corrected", [False, True])
@pytest.mark.parametrize("method", ["be", "mve", "mmve", "mbe", "gauss-newton"])
def test_the_first_iterations_are_those_of_the_formulas(problem, method, bias_corrected):
    point = estimate(problem, method, max_iterations=3, bias_corrected=bias_corrected)
    assert point.halvings == 0
    expected = by_formula(problem, method, 3, unknowns=2 if bias_corrected else 0)
    np.testing.assert_allclose(point.history, expected, rtol=1e-10)
    variances = [parts(problem, t, 2 if bias_corrected else 0)[1] for t in expected]
    np.testing.assert_allclose(point.history_variance, variances, rtol=1e-9)


def joint_hessian(problem, theta):
    """Of ``-Phi_B`` in parameters and variances, Appendix A, with its gradient."""
    e, v, a, pull = parts(problem, theta)
    curved = sum(
        np.einsum("nij,n->ij", s, r / var) for s, r, var in zip(second(theta), e, v, strict=True)
    )
    cross = [p.T @ r / var**2 for p, r, var in zip(first(theta), e, v, strict=True)]
    n = TIME.size
    corner = [-n / (2 * var**2) + r @ r / var**3 for r, var in zip(e, v, strict=True)]
    hessian = np.block(
        [[a - curved + np.linalg.inv(W), np.array(cross).T], [np.array(cross), np.diag(corner)]]
    )
    # the staged variances have no slope left
    return hessian, np.concatenate((-pull + np.linalg.inv(W) @ (theta - CENTRE), np.zeros(2)))


def test_newton_steps_are_those_of_the_joint_hessian(problem):
    """In parameters and variances together; the variances are then staged, not stepped."""
    near = estimate(problem, "be").theta + 0.03 * SD
    point = estimate(problem, "newton", start=near, max_iterations=1)
    hessian, gradient = joint_hessian(problem, near)
    assert np.linalg.eigvalsh(hessian)[0] > 0
    step = -np.linalg.solve(hessian, gradient)[:2]
    # second derivatives come from central differences over 0.02 sd: their error is the square
    np.testing.assert_allclose(point.history[1] - near, step, rtol=1e-3)
    # that of Gauss and Newton is another
    plain = -np.linalg.solve(parts(problem, near)[2] + np.linalg.inv(W), gradient[:2])
    assert np.max(np.abs(plain / step - 1)) > 0.02


def test_newton_converges_quadratically(problem):
    point = estimate(problem, "newton", tolerance=1e-12)
    error = np.linalg.norm((point.history - point.theta) / SD, axis=1)
    error = error[(error < 0.02) & (error > 1e-7)]
    assert error.size >= 2
    assert (error[1:] < 10 * error[:-1] ** 2 + 1e-7).all()


@pytest.mark.parametrize("method", ["gauss-newton", "levenberg-marquardt"])
def test_the_shortest_of_many_steps_is_taken(method):
    """Only the sum of two unknowns is known: the pseudo-inverse changes both alike."""
    x = np.linspace(0, 1, 20)
    y = 3.0 * x + 0.01 * np.sin(9 * x)
    priors = [Normal(1.0, 1.0), Normal(0.5, 1.0)]
    point = estimate(FunctionProblem(lambda x, t: (t[0] + t[1]) * x, x, y, priors), method)
    total = (x @ y) / (x @ x)
    np.testing.assert_allclose(
        point.theta, [1.0 + (total - 1.5) / 2, 0.5 + (total - 1.5) / 2], rtol=1e-6
    )


def test_the_gain_of_a_step_is_that_of_the_quadratic_that_it_solves():
    """Half the squares before less those after, and what the prior's slope adds."""
    rng = np.random.default_rng(0)
    jacobian, residual, slope = rng.normal(size=(9, 3)), rng.normal(size=9), rng.normal(size=3)
    nowhere = (np.full(3, np.inf), np.full(3, np.inf))
    equations = WhitenedEquations(jacobian, residual, slope, nowhere, np.eye(3), np.zeros(3))
    for step in rng.normal(size=(4, 3)):
        after = residual - jacobian @ step
        gain = 0.5 * (residual @ residual - after @ after) + slope @ step
        assert equations.expected_gain(step) == pytest.approx(gain, rel=1e-12)
