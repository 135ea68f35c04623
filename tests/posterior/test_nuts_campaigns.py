"""Gradients and the no-U-turn sampler on simulated campaigns whose runs are solved for."""

import numpy as np
import pytest
from test_gradient import differences, whitening

from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.estimation._problem import anchored_evaluation
from bayesoleo.posterior import LogDensity, laplace_mixture, sample
from bayesoleo.posterior._gradient import Gradient
from bayesoleo.systems import system
from tests.small_campaigns import oscillator_campaign


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    """A Duffing oscillator that measured forces drive, in three runs."""
    reduced = oscillator_campaign(
        tmp_path_factory.mktemp("duffing"),
        restoring=lambda x, v: 0.8 * v + 100.0 * x + 3e4 * x**3,
        runs=(("a", 1.0, 2.0, "fit"), ("b", 2.1, 3.0, "fit"), ("c", 1.3, 1.5, "fit")),
        noise=1e-4,
    )
    return fit_model(system("duffing"), reduced.records, Numerics(jobs=1))


@pytest.mark.parametrize("word", ["independent", "per-run", "correlated", "discrepancy"])
def test_the_gradient_is_that_of_the_density(fit, word):
    density = LogDensity(fit.problem, errors=word)
    phi, factor = whitening(density, fit.point.theta)
    value, gradient = Gradient(density, np.sqrt(np.sum(factor**2, axis=1)))(phi)
    assert value == pytest.approx(density(phi[None])[0][0], rel=1e-9)
    # Newton's method ends 1e-9 of the motion from the solution, which a step of a hundredth of a
    # standard deviation enlarges: the differences are less exact than the gradient.
    exact = differences(density, phi, factor, 0.03)
    assert np.abs(exact).max() > 0.1
    np.testing.assert_allclose(factor.T @ gradient, exact, rtol=1e-4, atol=1e-4)


def test_an_anchored_evaluation_depends_on_its_vector_alone(fit):
    theta = fit.point.theta
    near, far = theta * 1.001, theta * 1.05
    first = anchored_evaluation(fit.problem, near)
    anchored_evaluation(fit.problem, far)
    again = anchored_evaluation(fit.problem, near)
    np.testing.assert_array_equal(first.residual[0], again.residual[0])
    np.testing.assert_array_equal(first.sensitivity[0], again.sensitivity[0])
    other = fit.problem.for_thread()
    np.testing.assert_array_equal(anchored_evaluation(other, near).residual[0], first.residual[0])
    assert other.predictor.runs[0] is not fit.problem.predictor.runs[0]
    exact = fit.problem.misfit(near[None]).sum_of_squares.sum()
    assert first.residual[0] @ first.residual[0] == pytest.approx(exact, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("word", ["independent", "correlated"])
def test_both_samplers_draw_the_same_posterior(fit, word):
    density = LogDensity(fit.problem, errors=word)
    start = laplace_mixture(density, fit.point.theta[None])
    found = [
        sample(density, start, seed=1, progress=False, effective_size=400, sampler=name)
        for name in ("nuts", "ensemble")
    ]
    assert all(samples.reached for samples in found), [samples.warning for samples in found]
    one, other = (density.coordinates(s.draws.reshape(-1, s.draws.shape[2])) for s in found)
    sd = other.std(axis=0)
    # Four standard errors of a difference of two means; a spread's is half that times the root of
    # two of a normal's, and more with heavier tails.
    error = 4 * np.sqrt(sum(1 / samples.effective_size for samples in found))
    np.testing.assert_array_less(np.abs(one.mean(axis=0) - other.mean(axis=0)) / sd, error)
    np.testing.assert_array_less(np.abs(one.std(axis=0) / sd - 1), error)
