"""Runs that scatter about a common mean: against closed forms, recovery, and shrinkage."""

import numpy as np
import pytest
from linear_runs import hierarchical_quadrature, linear_runs
from scipy import stats

from bayesoleo.errors import InputError
from bayesoleo.model._priors import LogNormal
from bayesoleo.posterior import LogDensity, hierarchical, laplace_mixture, sample

RUNS, COUNT, NOISE = 6, 20, 0.5


def levels_of(spread, seed, runs=RUNS):
    return 0.5 + spread * np.random.default_rng(seed).standard_normal(runs)


def problem_of(spread, seed=3, runs=RUNS, **options):
    rng = np.random.default_rng(seed + 100)
    errors = [NOISE * rng.standard_normal((1, COUNT)) for _ in range(runs)]
    return linear_runs(errors, levels=levels_of(spread, seed, runs), **options)


def told(problem):
    """Least squares of levels and slope."""
    table = np.concatenate([problem.columns(k) for k in range(len(problem.y))])
    return np.linalg.lstsq(table, np.concatenate([y[0] for y in problem.y]), rcond=None)[0]


def density_of(problem, anchored=True):
    theta = told(problem) if anchored else None
    return LogDensity(problem, unknowns=hierarchical(problem, ["level"], theta=theta))


def test_the_density_is_likelihood_times_hierarchical_prior():
    problem = problem_of(0.4)
    density = density_of(problem)
    rng = np.random.default_rng(0)
    natural = np.concatenate([rng.normal(0.5, 0.5, RUNS), [1.4, 0.6, 0.3, -1.2]])
    value, _ = density(density.coordinates(natural[None]))
    levels, slope, mean, spread, log_v = np.split(natural, np.cumsum([RUNS, 1, 1, 1]))
    misfit = problem.misfit(natural[None, : RUNS + 1]).sum_of_squares.sum()
    n = RUNS * COUNT
    exact = -0.5 * n * np.log(2 * np.pi * np.exp(log_v[0])) - 0.5 * misfit / np.exp(log_v[0])
    exact += stats.norm(mean, spread).logpdf(levels).sum() + stats.norm(0, 10).logpdf(slope[0])
    exact += stats.norm(0, 2).logpdf(mean[0]) + stats.halfnorm(0, 2).logpdf(spread[0])
    # What the coordinates stretch: each level, the mean given the spread, and the spread.
    population = density.unknowns.populations[0]
    stretch = population.spread_of(population.coordinate_of(spread))[1]
    centres = population.conditional_centres(slope[None])
    stretch = stretch + np.log(population.mean_given(spread, centres)[1])
    for k in range(RUNS):
        stretch = stretch + np.log(population.run_given(k, mean, spread, centres)[1])
    assert value[0] == pytest.approx(exact + stretch[0], rel=1e-12)
    np.testing.assert_allclose(density.natural(density.coordinates(natural[None])), natural[None])


def test_the_stretch_is_the_determinant_of_the_map():
    density = density_of(problem_of(0.4))
    unknowns = density.unknowns
    block = np.random.default_rng(1).normal(0, 0.5, len(unknowns.names))
    h = 1e-5
    ends = [unknowns.natural(block + s * h * np.eye(block.size)) for s in (1, -1)]
    jacobian = (ends[0] - ends[1]) / (2 * h)
    numeric = np.log(abs(np.linalg.det(jacobian)))
    log_jacobian = unknowns._values(block[None], 0)[3]
    assert numeric == pytest.approx(log_jacobian[0], rel=1e-6)
    np.testing.assert_allclose(
        unknowns.jacobian(block), jacobian.T[: RUNS + 1], rtol=1e-5, atol=1e-7
    )


def test_a_spread_of_any_size_is_kept():
    population = density_of(problem_of(0.4)).unknowns.populations[0]
    spread = population.typical * 10.0 ** np.arange(-12, 13)
    back, _ = population.spread_of(population.coordinate_of(spread))
    np.testing.assert_allclose(back, spread, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_the_posterior_is_the_exact_one(spread):
    # Where the runs are alike the spread is a funnel's neck; where they differ each is its own.
    problem = problem_of(spread)
    density = density_of(problem)
    mixture = laplace_mixture(density, told(problem)[None])
    samples = sample(density, mixture, seed=2, effective_size=1500, progress=False)
    assert samples.reached, samples.warning
    mean, sd = hierarchical_quadrature(problem)
    flat = samples.draws.reshape(-1, samples.draws.shape[2])[:, : RUNS + 3]
    error = 4 / np.sqrt(samples.effective_size[: RUNS + 3])
    np.testing.assert_array_less(np.abs(flat.mean(axis=0) - mean) / sd, error)
    # A spread's own tail is heavy: its standard deviation is known less well.
    np.testing.assert_array_less(np.abs(flat.std(axis=0) / sd - 1), 2 * error)


def test_what_the_runs_say_first_changes_the_work_only():
    problem = problem_of(0.4)
    natural = np.concatenate([levels_of(0.4, 3), [1.4, 0.6, 0.3, -1.2]])
    found = []
    for anchored in (True, False):
        density = density_of(problem, anchored)
        phi = density.coordinates(natural[None])
        unknowns = density.unknowns
        log_jacobian = unknowns._values(density.split(phi)[0], 0)[3]
        found.append(density(phi)[0][0] - log_jacobian[0])
    assert found[0] == pytest.approx(found[1], rel=1e-12)


@pytest.mark.slow
def test_runs_are_drawn_together_and_their_spread_is_found():
    spread, runs = 0.4, 12
    problem = problem_of(spread, runs=runs)
    density = density_of(problem)
    mixture = laplace_mixture(density, told(problem)[None])
    samples = sample(density, mixture, seed=2, quick=True, progress=False)
    draws = dict(zip(samples.names, np.moveaxis(samples.draws, 2, 0), strict=True))
    for name, truth in (("mean_level", 0.5), ("spread_level", spread), ("slope", 1.5)):
        assert abs(draws[name].mean() - truth) < 4 * draws[name].std()
    alone = told(problem)[:runs]
    together = np.array([draws[f"level[r{k}]"].mean() for k in range(runs)])
    # Nearer to each other, and to their mean.
    assert together.std() < alone.std()
    mean = draws["mean_level"].mean()
    outer = np.abs(alone - mean) > 0.2  # next to the mean there is hardly a pull
    assert (np.abs(together - mean) < np.abs(alone - mean))[outer].all()


def test_a_bounded_parameter_scatters_in_its_logarithm():
    problem = problem_of(0.05, level_prior=LogNormal(0.5, 0.5))
    unknowns = density_of(problem).unknowns
    draws = unknowns.sample_prior(np.random.default_rng(0), 4000)
    assert (draws[:, :RUNS] > 0).all()
    mean, spread = draws[:, RUNS + 1], draws[:, RUNS + 2]
    away = np.log(draws[:, 0] / mean) / spread
    assert stats.kstest(away, "norm").pvalue > 1e-3
    found = unknowns.natural_log_prior(draws)
    assert set(found) == {"slope", "mean_level", "spread_level"}


@pytest.mark.parametrize(
    ("name", "runs", "match"), [("slope", 6, "each run's own"), ("level", 2, "three of them")]
)
def test_what_cannot_scatter_is_refused(name, runs, match):
    with pytest.raises(InputError, match=match):
        hierarchical(problem_of(0.4, runs=runs), [name])


def test_coordinates_are_conditional_means_and_deviations():
    """Gelman et al. (2013), section 5.4: normal measurements of a run's value, and of the mean."""
    population = density_of(problem_of(0.4)).unknowns.populations[0]
    centres, spread = population.conditional_centres(np.array([[1.4]])), np.array([0.7])
    for k, sd in enumerate(population.sds):
        middle, width = population.run_given(k, np.array([0.2]), spread, centres)
        precision = sd**-2 + 0.7**-2
        assert width[0] == pytest.approx(precision**-0.5)
        assert middle[0] == pytest.approx((centres[0, k] / sd**2 + 0.2 / 0.7**2) / precision)
    weight = 1 / (population.sds**2 + 0.7**2)
    precision = weight.sum() + population.scale**-2
    middle, width = population.mean_given(spread, centres)
    assert width[0] == pytest.approx(precision**-0.5)
    pulled = weight @ centres[0] + population.middle / population.scale**2
    assert middle[0] == pytest.approx(pulled / precision)
