"""The gradient of the log density against differences of the density, wherever it can be asked."""

import numpy as np
import pytest
from linear_runs import linear_runs
from posterior_gas_spring import GasSpring, measured
from posterior_targets import Gaussian
from test_catalogue_errors import campaign_of

from bayesoleo.error_models import ERROR_MODELS
from bayesoleo.error_models._stretch import Stretch
from bayesoleo.errors import InputError
from bayesoleo.estimation import FunctionProblem
from bayesoleo.estimation._problem import Held
from bayesoleo.model import JointNormal
from bayesoleo.model._correlated_priors import Correlated
from bayesoleo.model._priors import LogNormal, Normal, Transforms, Uniform
from bayesoleo.posterior import LogDensity, hierarchical
from bayesoleo.posterior._gradient import Gradient, gradient_of
from bayesoleo.posterior._laplace import gauss_newton_covariance, start_coordinates

SIZES = (40, 60, 50)


def runs_of(word, by_run=True, prior=None):
    """Straight lines in three runs with slow errors, one output where a model has to have it."""
    rng = np.random.default_rng(5)
    outputs = 2 if word == "full" or word == "catalogue" else 1
    errors = [0.3 * rng.standard_normal((outputs, n)) for n in SIZES]
    errors = [e + 0.2 * np.cumsum(rng.standard_normal(e.shape), axis=1) / 5 for e in errors]
    more = {} if prior is None else {"level_prior": prior}
    problem = linear_runs(errors, levels=(0.5, 1.0, 0.8), by_run=by_run, **more)
    if word == "power":
        problem.__dict__["effective"] = problem.counts * np.array([[0.3], [0.5], [0.2]])
    if word == "spectral":
        problem.__dict__["stretch"] = stretch_of(problem)
    if word == "catalogue":
        given = campaign_of(problem.outputs, SIZES, 1.0, ((0.3, 0.2), (0.0, 1.0)), 5)
        problem.__dict__["signatures"] = given.signatures
    return problem


def stretch_of(problem):
    """To three times the width, and no longer along the axes."""
    size = len(problem.names)
    stated = np.diag(np.linspace(1.0, 2.0, size)) * 1e-2
    turn = np.eye(size) + 0.3
    estimate = 0.5 + np.linspace(0.0, 1.0, size)
    transforms = Transforms.of(problem.priors)
    return Stretch.of(transforms, estimate, stated, 3 * turn @ stated @ turn.T)


def whitening(density, theta):
    """A point beside the start, and a factor of the covariance there."""
    phi = start_coordinates(density, theta)
    factor = np.linalg.cholesky(gauss_newton_covariance(density, phi))
    z = np.random.default_rng(2).normal(0, 0.7, phi.size)
    return phi + factor @ z, factor


def differences(density, phi, factor, step=1e-3):
    """Of sixth order, by the standard deviations of the Gauss-Newton covariance.

    The truncation is the step to the sixth, and so is rounding: 1e-16 times a height of 100 over
    the step is 1e-11, which a solver's tolerance exceeds.
    """
    offsets, weights = np.array([1.0, 2.0, 3.0]), np.array([45.0, -9.0, 1.0]) / 60.0
    shifts = step * np.concatenate([o * factor.T for o in offsets])
    heights, _ = density(np.concatenate([phi + shifts, phi - shifts]))
    ahead, behind = heights.reshape(2, 3, phi.size)
    return weights @ (ahead - behind) / step


def assert_gradient(density, theta, atol=2e-6):
    """In standard deviations of the posterior. An error of the gradient by ``atol`` tilts the
    density over one of them by as much, far below what thousands of draws can show."""
    phi, factor = whitening(density, theta)
    scale = np.sqrt(np.sum(factor**2, axis=1))
    value, gradient = Gradient(density, scale)(phi)
    assert value == pytest.approx(density(phi[None])[0][0], rel=1e-9)
    exact = differences(density, phi, factor)
    assert np.abs(exact).max() > 0.1  # not a maximum, where anything small would pass
    np.testing.assert_allclose(factor.T @ gradient, exact, rtol=atol, atol=atol)


@pytest.mark.parametrize("by_run", [True, False])
@pytest.mark.parametrize("word", ERROR_MODELS)
def test_every_error_model_has_its_gradient(word, by_run):
    problem = runs_of(word, by_run)
    theta = np.array([0.5, 1.0, 0.8, 1.5] if by_run else [0.8, 1.5])
    assert_gradient(LogDensity(problem, errors=word), theta)


@pytest.mark.parametrize("word", ["independent", "correlated", "catalogue", "shared-discrepancy"])
def test_a_hierarchy_has_its_gradient(word):
    problem, theta = runs_of(word), np.array([0.5, 1.0, 0.8, 1.5])
    unknowns = hierarchical(problem, ["level"], theta=theta, errors=word)
    assert_gradient(LogDensity(problem, errors=word, unknowns=unknowns), theta)


PRIORS = [Normal(1.0, 0.1), LogNormal(1.2, 0.1), Uniform(1.0, 1.6)]


@pytest.mark.parametrize("prior", PRIORS, ids=lambda prior: type(prior).__name__)
def test_bounds_and_a_model_that_is_not_linear(prior):
    density = LogDensity(GasSpring(measured(1), prior))
    assert_gradient(density, np.array([1.22]))


def test_bounded_populations_of_runs():
    problem = runs_of("independent", prior=LogNormal(0.7, 1.0))
    theta = np.array([0.5, 1.0, 0.8, 1.5])
    unknowns = hierarchical(problem, ["level"], theta=theta)
    assert_gradient(LogDensity(problem, unknowns=unknowns), theta)


def joint_line(jacobian=lambda x, theta: np.column_stack([np.ones(x.size), x])):
    joint = JointNormal.of(["a", "b"], [0.3, 1.0], [[0.04, 0.03], [0.03, 0.09]])
    x = np.linspace(0.0, 1.0, 30)
    y = 0.4 + 1.2 * x + 0.1 * np.random.default_rng(3).standard_normal(x.size)
    priors = [Correlated("a", joint), Correlated("b", joint)]
    return FunctionProblem(
        lambda x, t: t[0] + t[1] * x, x, y, priors, ["a", "b"], jacobian=jacobian
    )


def test_parameters_that_are_known_together():
    assert_gradient(LogDensity(joint_line()), np.array([0.4, 1.2]))


def test_a_problem_with_unknowns_held():
    held = Held(joint_line(), np.array([0.4, 1.2]), [0])
    assert_gradient(LogDensity(held), np.array([1.2]))


def test_a_function_without_derivatives_is_refused():
    with pytest.raises(InputError, match=r"needs derivatives.*ensemble"):
        gradient_of(LogDensity(joint_line(jacobian=None)), np.ones(3))


def test_a_density_without_gradient_is_refused():
    with pytest.raises(InputError, match=r"needs the gradient.*with_gradient"):
        gradient_of(Gaussian(np.ones(2)), np.ones(2))


def test_failures_are_minus_infinity_and_counted():
    gradient = Gradient(LogDensity(GasSpring(measured(1), LogNormal(1.2, 0.1))), np.ones(2))
    value, slope = gradient(np.array([-800.0, -4.0]))  # exp(-800) is the bound itself
    assert value == -np.inf
    assert not slope.any()
    assert gradient(np.array([0.2, -2e3]))[0] == -np.inf
    assert gradient.failures == {"out_of_bounds": 1, "not_finite": 1}
