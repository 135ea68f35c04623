"""Independent errors, stretched about an estimate to a covariance that is given."""

from __future__ import annotations

import numpy as np
import pytest
from linear_runs import LinearRuns, linear_runs

from bayesoleo.error_models._stretch import Stretch
from bayesoleo.errors import InputError
from bayesoleo.model._priors import LogNormal, Transforms
from bayesoleo.posterior import LogDensity, laplace_mixture, sample
from bayesoleo.posterior._datatree import _at_draws, _measured, block_groups, cut
from bayesoleo.posterior._laplace import find_mode, start_coordinates

ESTIMATE = np.array([0.5, 1.5])


def line(level_prior=None) -> LinearRuns:
    """A level and a slope in two runs of white noise."""
    rng = np.random.default_rng(0)
    errors = [0.2 * rng.standard_normal((1, 200)) for _ in range(2)]
    more = {} if level_prior is None else {"level_prior": level_prior}
    return linear_runs(errors, levels=[0.5, 0.5], by_run=False, **more)


def mode_of(problem: LinearRuns, word: str):
    density = LogDensity(problem, errors=word)
    return density, find_mode(density, start_coordinates(density, ESTIMATE))


def stretched(problem: LinearRuns, factors) -> tuple[LinearRuns, np.ndarray, np.ndarray]:
    """The problem with deviations that are so many times as large, its estimate, and these."""
    density, mode = mode_of(problem, "independent")
    u = mode.centre[None, :2]
    theta, slope = density.unknowns.theta(u)[0], density.unknowns.jacobian(u[0])
    stated = slope @ mode.covariance[:2, :2] @ slope.T
    covariance = stated * np.outer(factors, factors)
    transforms = Transforms.of(problem.priors)
    problem.__dict__["stretch"] = Stretch.of(transforms, theta, stated, covariance)
    return problem, theta, covariance


@pytest.mark.parametrize("factors", [(1.0, 1.0), (3.0, 1.0), (0.5, 4.0)])
def test_the_posterior_has_the_covariance_that_is_asked_for(factors):
    problem, theta, covariance = stretched(line(), factors)
    density, mode = mode_of(problem, "spectral")
    np.testing.assert_allclose(density.unknowns.theta(mode.centre[None, :2])[0], theta, atol=1e-3)
    # The priors, a hundredth of the width, are stretched with the likelihood there.
    np.testing.assert_allclose(mode.covariance[:2, :2], covariance, rtol=0.02, atol=1e-6)


def test_it_stays_inside_the_bounds_of_an_unknown():
    problem, _, covariance = stretched(line(LogNormal(0.5, 1.0)), (20.0, 1.0))
    density, mode = mode_of(problem, "spectral")
    far = density.unknowns.theta(np.array([[-40.0, 1.5], [40.0, 1.5]]))
    assert np.isfinite(density.errors.moved(far)).all()
    assert (density.errors.moved(far)[:, 0] > 0.0).all()
    slope = density.unknowns.jacobian(mode.centre[:2])
    found = slope @ mode.covariance[:2, :2] @ slope.T
    assert found[1, 1] == pytest.approx(covariance[1, 1], rel=0.05)


def test_derivatives_of_the_place_are_those_by_differences():
    problem, theta, _ = stretched(line(LogNormal(0.5, 1.0)), (3.0, 0.7))
    errors, at = LogDensity(problem, errors="spectral").errors, theta + np.array([0.03, -0.05])
    steps = 1e-6 * np.eye(2)
    by_differences = (errors.moved(at + steps) - errors.moved(at - steps)) / 2e-6
    np.testing.assert_allclose(errors.slope(at), by_differences.T, rtol=1e-6, atol=1e-8)


def test_a_row_depends_on_itself_alone():
    problem, theta, _ = stretched(line(LogNormal(0.5, 1.0)), (3.0, 0.7))
    density = LogDensity(problem, errors="spectral")
    rows = np.append(theta, -3.2) + 0.05 * np.random.default_rng(1).standard_normal((9, 3))
    whole = density(rows)[0]
    assert all(density(rows[k : k + 1])[0][0] == whole[k] for k in range(9))


def test_blocks_have_the_density_that_was_sampled():
    problem, theta, _ = stretched(line(), (3.0, 1.0))
    density = LogDensity(problem, errors="spectral")
    start = laplace_mixture(density, theta[None])
    draws = sample(density, start, seed=1, quick=True, progress=False)
    groups = block_groups(draws, density)
    joint = groups["log_likelihood"]["force"].sum("block").values
    np.testing.assert_allclose(joint, draws.log_likelihood.sum(axis=2), rtol=1e-6)
    # What is predicted is that of the unknowns themselves, as wide as they are known.
    level = draws.draws[:, :, 0].std()
    shown = groups["posterior_predictive"]["force"].values
    assert level == pytest.approx(3.0 * 0.2 / np.sqrt(400), rel=0.2)
    assert abs(shown.mean() - theta[0]) < 3.0


def test_what_is_predicted_is_that_of_the_draw_and_not_of_the_place_of_its_density():
    problem, theta, _ = stretched(line(), (3.0, 1.0))
    density = LogDensity(problem, errors="spectral")
    natural = np.column_stack([np.tile(theta, (4, 1)), np.full(4, 0.04)])
    natural[:, 0] += [0.1, -0.1, 0.2, 0.0]
    blocks, measured = cut(density), _measured(problem)
    _, expected = _at_draws(natural, density, blocks, measured)
    first = blocks[0].shown
    own = measured[0][:, first] - problem.residuals(natural[:, :2], 0)[0][:, :, first]
    np.testing.assert_allclose(expected[:, :, : len(first)], own, rtol=1e-12)
    moved = density.errors.moved(natural[:, :2])
    assert np.abs(moved - natural[:, :2])[:3].max(axis=1).min() > 0.05


def test_without_a_covariance_it_says_what_to_take_instead():
    with pytest.raises(InputError, match='error_model="power"'):
        LogDensity(line(), errors="spectral")
