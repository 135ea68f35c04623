"""The no-U-turn sampler against closed forms and the ensembles, its failures, and what it says."""

import sys
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from linear_runs import hierarchical_quadrature
from posterior_gas_spring import GasSpring, gas_spring, measured, quadrature
from posterior_targets import Gaussian
from test_hierarchical_runs import RUNS, density_of, problem_of, told
from test_posterior_sample import normal_mixture, within_error

from bayesoleo.errors import InputError, MissingExtraError, ResultsError
from bayesoleo.estimation import FunctionProblem
from bayesoleo.model._priors import Normal
from bayesoleo.posterior import LogDensity, MoveWeights, _nuts, laplace_mixture, sample, to_datasets
from bayesoleo.solvers._orbit import Status

pytest.importorskip("nutpie")


class Steep(Gaussian):
    """A normal density with its gradient; ``wall`` is where it ends, and nothing says so before."""

    def __init__(self, sd, wall=np.inf):
        super().__init__(sd)
        self.wall = wall

    def with_gradient(self, phi):
        if phi[0] > self.wall:
            return -np.inf, np.zeros_like(phi)
        return float(-0.5 * np.sum((phi / self.sd) ** 2)), -phi / self.sd**2


def by_nuts(density, start, **given):
    options = {"seed": 1, "progress": False, "sampler": "nuts", "climbs": 0} | given
    return sample(density, start, **options)


def test_a_gaussian_from_a_start_that_is_off():
    sd = 10.0 ** np.linspace(-3, 3, 4)
    samples = by_nuts(Steep(sd), normal_mixture(sd, off=0.5, stretch=1.5))
    assert samples.reached
    assert samples.warning == ""
    assert samples.effective_size.min() >= 1000
    assert samples.draws.shape[0] == samples.start.shape[0] == 4
    within_error(samples, np.zeros(4), sd)


@pytest.mark.slow
def test_the_same_draws_whatever_the_threads():
    problem = gas_spring(relative_sd=0.1, seed=1)
    start = laplace_mixture(LogDensity(problem), np.array([[1.2]]))
    found = [
        by_nuts(LogDensity(problem, jobs), start, effective_size=100, quick=True) for jobs in (1, 4)
    ]
    np.testing.assert_array_equal(found[0].draws, found[1].draws)
    np.testing.assert_array_equal(found[0].log_density, found[1].log_density)
    assert found[0].evaluations == found[1].evaluations
    other = by_nuts(LogDensity(problem), start, effective_size=100, quick=True, seed=2)
    assert not np.array_equal(found[0].draws[:, 0], other.draws[:, 0])


def test_the_gas_spring_against_quadrature():
    problem = gas_spring(relative_sd=0.1, seed=1)
    density = LogDensity(problem)
    samples = by_nuts(density, laplace_mixture(density, np.array([[1.2]])))
    assert samples.reached, samples.warning
    within_error(samples, *moments(problem))
    phi = density.coordinates(samples.draws[0])
    np.testing.assert_allclose(samples.log_density[0], density(phi)[0], rtol=1e-9)
    np.testing.assert_allclose(samples.log_likelihood[0], density(phi)[1], rtol=1e-9)


def moments(problem):
    """Mean and standard deviation of exponent and log variance, by quadrature."""
    theta, log_v = np.linspace(1.0, 1.4, 801), np.linspace(-6.0, -1.0, 801)
    density = quadrature(problem, theta, log_v)
    sums = [
        (density.sum(axis=1), theta),
        (density.sum(axis=0), log_v),
    ]
    mean = np.array([weight @ x / weight.sum() for weight, x in sums])
    square = np.array([weight @ x**2 / weight.sum() for weight, x in sums])
    return mean, np.sqrt(square - mean**2)


@pytest.mark.slow
@pytest.mark.parametrize("spread", [0.0, 1.0])
def test_a_hierarchy_is_the_exact_one(spread):
    # Where the runs are alike the spread is a funnel's neck.
    problem = problem_of(spread)
    density = density_of(problem)
    samples = by_nuts(density, laplace_mixture(density, told(problem)[None]), effective_size=400)
    assert samples.reached, samples.warning
    mean, sd = hierarchical_quadrature(problem)
    flat = samples.draws.reshape(-1, samples.draws.shape[2])[:, : RUNS + 3]
    error = 4 / np.sqrt(samples.effective_size[: RUNS + 3])
    np.testing.assert_array_less(np.abs(flat.mean(axis=0) - mean) / sd, error)
    # A spread's own tail is heavy: its standard deviation is known less well.
    np.testing.assert_array_less(np.abs(flat.std(axis=0) / sd - 1), 2 * error)


def test_divergences_are_counted_and_told():
    sd = np.ones(2)
    target = Steep(sd, wall=0.5)
    samples = by_nuts(target, normal_mixture(sd), effective_size=200)
    assert samples.divergences > 0
    assert samples.divergences == samples.diverging.sum()  # none is left out here
    assert f"{samples.divergences} of {samples.diverging.size} trajectories diverged" in (
        samples.warning
    )
    assert "target_accept" in samples.warning
    groups = to_datasets(samples, [Normal(0.0, 1.0)] * 2)
    stats = groups["sample_stats"]
    assert stats.attrs["sampler"] == "nuts"
    assert stats.attrs["divergences"] == samples.divergences
    np.testing.assert_array_equal(stats["diverging"].values, samples.diverging)
    assert samples.thinned(50).diverging.shape == samples.thinned(50).log_density.shape


class Failing(GasSpring):
    """Has no solution above an exponent that the posterior reaches."""

    most = 1.2275

    def evaluate(self, theta):
        found = super().evaluate(theta)
        return found if theta[0] < self.most else replace(found, status=Status.NO_CONVERGENCE)

    def misfit(self, theta):
        found = super().misfit(theta)
        found.status[theta[:, 0] >= self.most] = Status.NO_CONVERGENCE
        return found


@pytest.mark.slow
def test_failed_solves_are_counted_by_reason_whatever_the_threads():
    problem = Failing(measured(1), Normal(1.0, 0.1))
    start = laplace_mixture(LogDensity(problem), np.array([[1.22]]))
    found = [
        by_nuts(LogDensity(problem, jobs), start, effective_size=100, quick=True) for jobs in (1, 4)
    ]
    assert found[0].failures["no_convergence"] > 0
    assert found[0].failures == found[1].failures
    assert found[0].divergences == found[1].divergences > 0
    assert (found[0].draws[:, :, 0] < problem.most).all()
    assert np.isfinite(found[0].log_density).all()


def test_modes_apart_are_told():
    class Two(Steep):
        """Two normal densities, a hundred standard deviations apart."""

        def with_gradient(self, phi):
            away = phi - 100.0 * np.round(np.clip(phi / 100.0, 0.0, 1.0))
            return float(-0.5 * np.sum(away**2)), -away

        def __call__(self, phi):
            heights = np.array([self.with_gradient(row)[0] for row in phi])
            return heights, np.stack([heights, 0 * heights], axis=1)

    one = normal_mixture(np.ones(1))
    both = type(one)(np.array([[0.0], [100.0]]), np.ones((2, 1, 1)), np.log([0.5, 0.5]))
    samples = by_nuts(Two(np.ones(1)), both, max_evaluations=20_000)
    assert not samples.reached
    assert "a chain has been to 1 of 2 known modes" in samples.warning


@pytest.mark.slow
def test_only_a_complete_run_is_kept(tmp_path):
    sd = np.ones(2)
    calls = Counter()

    class Noted(Steep):
        def with_gradient(self, phi):
            calls["all"] += 1
            if calls["all"] > self.most:
                raise KeyboardInterrupt
            return super().with_gradient(phi)

    target, start = Noted(sd), normal_mixture(sd)
    target.most = 500
    with pytest.raises(KeyboardInterrupt):
        by_nuts(target, start, out=tmp_path)
    assert not list(tmp_path.glob("*.npz"))
    target.most = np.inf
    first = by_nuts(target, start, out=tmp_path)
    spent = calls["all"]
    again = by_nuts(target, start, out=tmp_path)
    assert calls["all"] == spent
    np.testing.assert_array_equal(first.draws, again.draws)
    assert first.evaluations == again.evaluations
    np.testing.assert_array_equal(first.draws, by_nuts(Steep(sd), start).draws)
    # More is not there: it is drawn anew, and begins with the same draws.
    more = by_nuts(target, start, out=tmp_path, effective_size=2000)
    assert calls["all"] > spent
    np.testing.assert_array_equal(first.draws, more.draws[:, : first.draws.shape[1]])
    with pytest.raises(ResultsError, match="another problem, seed or setting"):
        by_nuts(target, start, out=tmp_path, seed=2)


def test_an_error_of_the_users_own_code_is_its_own():
    class Broken(Steep):
        def with_gradient(self, phi):
            raise ZeroDivisionError("of the user")

    with pytest.raises(ZeroDivisionError, match="of the user"):
        by_nuts(Broken(np.ones(2)), normal_mixture(np.ones(2)))


def test_no_start_is_an_error():
    with pytest.raises(InputError, match="no start among"):
        by_nuts(Steep(np.ones(2), wall=-np.inf), normal_mixture(np.ones(2)))


def test_a_budget_that_the_warm_up_takes_is_an_error():
    with pytest.raises(InputError, match="no draw could be kept"):
        by_nuts(Steep(np.ones(2)), normal_mixture(np.ones(2)), max_evaluations=100)


def test_a_budget_ends_it_and_is_told():
    samples = by_nuts(Steep(np.ones(2)), normal_mixture(np.ones(2)), max_evaluations=8_000,
                      effective_size=1e5)  # fmt: skip
    assert not samples.reached
    assert "stopped before 8000 evaluations; the effective size is" in samples.warning


def test_so_many_draws_end_it_and_are_told(monkeypatch):
    monkeypatch.setattr(_nuts, "MOST_DRAWS", 70)
    samples = by_nuts(Steep(np.ones(2)), normal_mixture(np.ones(2)), effective_size=1e5)
    assert samples.draws.shape[1] == 70
    assert samples.warning.startswith("stopped after 70 draws; the effective size is")


@pytest.mark.parametrize(
    ("key", "value"), [("walkers", 20), ("weights", MoveWeights()), ("scheduler", "local:2")]
)
def test_what_belongs_to_ensembles_is_refused(key, value):
    with pytest.raises(InputError, match=f"{key}.*no-U-turn|no-U-turn.*{key}"):
        by_nuts(Steep(np.ones(2)), normal_mixture(np.ones(2)), **{key: value})


def test_an_unknown_sampler_is_named():
    with pytest.raises(InputError, match=r"unknown sampler.*nuts"):
        by_nuts(Steep(np.ones(2)), normal_mixture(np.ones(2)), sampler="nut")


def test_a_density_without_gradient_is_refused():
    with pytest.raises(InputError, match="needs the gradient"):
        by_nuts(Gaussian(np.ones(2)), normal_mixture(np.ones(2)))


def test_a_function_without_derivatives_is_refused():
    x = np.linspace(0.0, 1.0, 20)
    problem = FunctionProblem(lambda x, t: t[0] * x, x, 1.2 * x, [Normal(1.0, 1.0)])
    density = LogDensity(problem)
    with pytest.raises(InputError, match=r"needs derivatives.*ensemble"):
        by_nuts(density, normal_mixture(np.ones(2)))


def test_without_nutpie_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "nutpie", None)
    with pytest.raises(MissingExtraError, match=r"bayesoleo\[nuts\]"):
        by_nuts(Steep(np.ones(2)), normal_mixture(np.ones(2)))


def test_a_quick_run_adapts_before_its_budget_ends():
    """However few evaluations a quick run has, its chains keep draws."""
    samples = by_nuts(Steep(np.ones(3)), normal_mixture(np.ones(3)), quick=True, max_evaluations=10)
    assert samples.draws.shape[1] >= 25
    assert samples.evaluations <= _nuts.QUICK_GRADIENTS * 4 + samples.log_density.size
