"""Sampling against closed forms and quadrature, and when it stops."""

from itertools import groupby
from types import SimpleNamespace

import numpy as np
import pytest
from posterior_gas_spring import gas_spring, quadrature
from posterior_targets import Banana, BentRidge, Gaussian
from scipy.stats import norm

from bayesoleo.errors import InputError
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.posterior import LogDensity, Mixture, _sampler, _stopping, laplace_mixture, sample
from bayesoleo.posterior._checkpoints import REASONS
from bayesoleo.posterior._datatree import choose_all
from bayesoleo.posterior._diagnostics import effective_size
from bayesoleo.posterior._ensemble_moves import Ensembles, MoveWeights


def normal_mixture(sd, *, off: float | np.ndarray = 0.0, stretch: float = 1.0) -> Mixture:
    sd = np.asarray(sd, dtype=float)
    return Mixture((off * sd)[None], np.diag((stretch * sd) ** 2)[None], np.zeros(1))


def within_error(samples, mean, sd):
    """Mean and standard deviation within four Monte Carlo errors, from the effective size."""
    flat = samples.draws.reshape(-1, samples.draws.shape[-1])
    error = 4 / np.sqrt(samples.effective_size)
    np.testing.assert_array_less(np.abs(flat.mean(axis=0) - mean) / sd, error)
    # The error of a normal's standard deviation is sd / sqrt(2 n); doubled for heavier tails.
    np.testing.assert_array_less(np.abs(flat.std(axis=0) / sd - 1), error)


class Interrupted(Gaussian):
    """A user's Ctrl-C while the ensembles move."""

    def __call__(self, phi):
        if self.evaluations > 500:
            raise KeyboardInterrupt
        return super().__call__(phi)


def test_interrupt_passes_without_a_word(capfd):
    mixture = Mixture(np.zeros((1, 2)), np.eye(2)[None], np.zeros(1))
    with pytest.raises(KeyboardInterrupt):
        sample(Interrupted(np.ones(2)), mixture, seed=1, progress=False)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("steps", "evaluations"), [((128,) * 11, 40_000), ((4436, 4600, 4460, 4688), 3849)]
)
def test_a_quick_run_evaluates_less_where_runs_are_long(steps, evaluations):
    problem = object.__new__(CampaignProblem)
    problem.predictor = SimpleNamespace(runs=[SimpleNamespace(steps=n) for n in steps])
    assert _sampler._quick_evaluations(SimpleNamespace(problem=problem)) == evaluations


def test_what_is_no_campaign_has_no_long_runs():
    assert _sampler._quick_evaluations(Gaussian(np.ones(2))) == _sampler.QUICK_EVALUATIONS


def test_a_quick_run_of_long_runs_still_keeps_draws(monkeypatch):
    """However long runs are, each walker moves often enough for draws to be kept."""
    monkeypatch.setattr(_sampler, "_quick_evaluations", lambda _: 1)
    target = Banana(np.ones(4))
    samples = sample(target, normal_mixture(np.ones(4)), seed=1, quick=True, progress=False)
    chains, draws = samples.draws.shape[:2]
    assert draws >= 4
    assert samples.evaluations <= _sampler.QUICK_STEPS * chains
    assert samples.reached or "evaluations" in samples.warning


@pytest.mark.parametrize("dimension", [1, 2, 9])
def test_a_gaussian_from_a_start_that_is_off(dimension):
    sd = 10.0 ** np.linspace(-3, 3, dimension)
    samples = sample(Gaussian(sd), normal_mixture(sd, off=0.5, stretch=1.5), seed=1, progress=False)
    assert samples.reached
    assert samples.warning == ""
    assert samples.effective_size.min() >= 1000
    within_error(samples, np.zeros(dimension), sd)


@pytest.mark.statistical
@pytest.mark.parametrize("far", [0.3, 1.0])
def test_quantiles_of_quick_runs_err_by_what_their_effective_size_says(far):
    """Of 40 runs of six coordinates, from a start that is off by some standard deviations."""
    sd, levels, errors = np.ones(6), np.array([0.05, 0.5, 0.95]), []
    for seed in range(40):
        off = far * np.random.default_rng(seed).standard_normal(6)
        found = sample(
            Gaussian(sd), normal_mixture(sd, off=off), seed=seed, quick=True, progress=False,
            climbs=0,
        )  # fmt: skip
        quantiles = np.quantile(found.draws.reshape(-1, 6), levels, axis=0)
        sizes = found.effective_size
        errors.append((norm.cdf(quantiles.T) - levels) * np.sqrt(sizes)[:, None])
    scaled = np.array(errors) / np.sqrt(levels * (1 - levels))
    # 240 errors of each level, those of one run nearly independent: their root mean square is known
    # to 5 %. Sizes are the smallest of some estimates, so that it is 0.95 on average.
    assert np.sqrt(np.mean(scaled**2, axis=(0, 1))) == pytest.approx(0.95, abs=0.2)
    assert abs(scaled.mean(axis=(0, 1))).max() < 4 / np.sqrt(240)


class Skirted(Gaussian):
    """A fifth of the weight lies in a skirt that is six times as wide, in the first coordinate: the
    normal density about the mode says nothing of it."""

    def __init__(self):
        super().__init__(np.ones(2))

    def __call__(self, phi):
        self.evaluations += len(phi)
        core, skirt = -0.5 * phi[:, 0] ** 2, -0.5 * (phi[:, 0] / 6) ** 2
        height = np.logaddexp(np.log(0.8) + core, np.log(0.2 / 6) + skirt) - 0.5 * phi[:, 1] ** 2
        return height, np.column_stack([0.25 * height, 0.75 * height])

    def below(self, x):
        return 0.8 * norm.cdf(x) + 0.2 * norm.cdf(x / 6)


@pytest.mark.statistical
def test_a_tail_that_the_mode_says_nothing_of_is_found_by_a_quick_run():
    errors = []
    for seed in range(60):
        target = Skirted()
        start = normal_mixture([1.02, 1.0])  # by the curvature at the mode
        found = sample(target, start, seed=seed, quick=True, progress=False, climbs=0)
        below = target.below(found.draws[..., 0])
        both = np.array([np.mean(below <= 0.05) - 0.05, np.mean(below > 0.95) - 0.05])
        errors.append(both * np.sqrt(found.effective_size[0] / (0.05 * 0.95)))
    # Of a density so far from any mixture the error is up to half more than stated. Where warm-up
    # began with rounds of five draws it was 2.4 times as much, and more than half on one side.
    assert np.sqrt(np.mean(np.square(errors), axis=0)).max() < 1.9
    assert np.mean(errors, axis=0).min() > -1.1


@pytest.mark.slow
def test_a_curved_density_that_no_mixture_fits():
    target = Banana(np.ones(4))
    samples = sample(target, normal_mixture(np.ones(4)), seed=1, progress=False)
    assert samples.reached
    # Variance of x^2 / 2 is 1/2, so the curved coordinates have variance 3/2.
    within_error(samples, np.zeros(4), np.sqrt([1, 1.5, 1.5, 1.5]))


def test_a_first_look_ends_after_so_many_evaluations_and_says_so(monkeypatch):
    monkeypatch.setattr("bayesoleo.posterior._sampler.QUICK_EVALUATIONS", 4_000)
    monkeypatch.setattr("bayesoleo.posterior._sampler.QUICK_STEPS", 1)
    target = BentRidge()
    samples = sample(target, normal_mixture(target.sd), seed=1, quick=True, progress=False)
    assert not samples.reached
    assert samples.evaluations <= 4_000
    assert "stopped before 4000 evaluations; " in samples.warning


def test_a_first_look_warms_up_once_where_the_mixture_is_the_posterior(monkeypatch):
    """Walkers that start in the posterior have nothing to forget."""
    sd, phases, advance = np.ones(3), list[str](), Ensembles.advance

    def noted(group, last, steps, phase):
        phases.append(phase)
        return advance(group, last, steps, phase)

    monkeypatch.setattr(Ensembles, "advance", noted)
    rounds = {}
    for name, stretch, quick in (("near", 1.0, True), ("far", 3.0, True), ("full", 1.0, False)):
        phases.clear()
        mixture = normal_mixture(sd, stretch=stretch)
        samples = sample(Gaussian(sd), mixture, seed=1, quick=quick, progress=False)
        assert samples.reached
        within_error(samples, np.zeros(3), sd)
        rounds[name] = phases.count("warm-up")
    assert rounds == {"near": 1, "far": 2, "full": 2}


def test_proposals_of_a_mixture_that_misses_are_fewer_already_in_the_warm_up(monkeypatch):
    shares, advance = list[float](), Ensembles.advance

    def noted(group, last, steps, phase):
        shares.append(group.weights.independence)
        return advance(group, last, steps, phase)

    monkeypatch.setattr(Ensembles, "advance", noted)
    sd = np.ones(6)
    mixture = normal_mixture(sd, stretch=30.0)
    found = sample(Gaussian(sd), mixture, seed=1, quick=True, progress=False, climbs=0)
    first, second = shares[:2]
    assert first == 0.8
    assert second == 0.3
    # With 80 % of them it took 38 320, of which 9 in 100 were accepted in the end.
    assert found.reached
    assert found.evaluations < 25_000
    # A user's own weights stay.
    shares.clear()
    own = MoveWeights(0.5, 0.4, 0.1)
    sample(Gaussian(sd), mixture, seed=1, quick=True, progress=False, climbs=0, weights=own)
    assert set(shares) == {0.5}


def test_a_quick_run_hands_on_draws_that_tell_something_new():
    """Walkers that move slowly: one draw of each autocorrelation time, with what failed between."""
    sd, slow = np.ones(8), MoveWeights(0.02, 0.9, 0.08)
    options = {"seed": 1, "progress": False, "climbs": 0, "weights": slow}
    mixture = normal_mixture(sd)
    few = sample(Gaussian(sd), mixture, quick=True, **options)
    chains, draws, _ = few.draws.shape
    assert chains * draws >= 1000
    tau = few.autocorrelation_time
    assert tau.min() > 10
    kept = few.evaluations // chains
    assert draws < kept / (tau.min() - 1)
    assert len(few.failed) == len(few.log_density[0]) == draws
    # What is handed on tells as much as is said of all, but for a quarter and scatter.
    own = effective_size(few.draws)
    assert own.min() > 0.6 * few.effective_size.min()
    within_error(few, np.zeros(8), sd)


@pytest.mark.parametrize("correlation", [-0.4, 0.0, 0.3, 0.9])
@pytest.mark.parametrize("every", [1, 3, 10])
def test_the_effective_size_of_every_few_draws_is_that_of_their_correlation(correlation, every):
    """An autoregression of first order, whose thinned chain is one too."""
    time = (1 + correlation) / (1 - correlation)
    quality = _stopping.Quality(np.array([time]), np.array([6000 / time]), np.ones(1), 100)
    thinned = (1 + correlation**every) / (1 - correlation**every)
    exact = min(6000 / every / thinned, 6000 / time)
    assert _stopping.sizes_of_every(quality, every) == pytest.approx(exact, rel=1e-12)


def test_a_quick_run_hands_on_enough_of_draws_that_are_nearly_independent():
    sd = np.ones(3)
    few = sample(Gaussian(sd), normal_mixture(sd), seed=1, quick=True, progress=False, climbs=0)
    chains, draws, _ = few.draws.shape
    assert few.autocorrelation_time.max() < 3
    assert 1000 <= chains * draws < 2000 <= few.evaluations
    own = effective_size(few.draws)
    # Scatter of an estimate from chains of about ten draws.
    assert own.min() > 0.6 * few.effective_size.min()
    assert few.effective_size.max() <= 1.05 * chains * draws
    within_error(few, np.zeros(3), sd)


@pytest.mark.slow
@pytest.mark.parametrize("quick", [True, False])
def test_no_walker_is_left_at_the_tip_of_a_bent_ridge(quick):
    target = BentRidge()
    samples = sample(target, normal_mixture(target.sd), seed=1, quick=quick, progress=False)
    assert samples.reached
    stays = np.diff(samples.log_density, axis=1) == 0
    longest = max(
        max((len(list(g)) for same, g in groupby(row) if same), default=0) for row in stays
    )
    # Where the mixture proposes nothing the other moves are taken every seventh draw; among 60 000
    # draws of which a twentieth lies there one stays for about 60. It was 900.
    assert longest < 150
    first = samples.draws[:, :, 0].ravel()
    tail, exact = np.mean(np.abs(first) > 2), 0.0455
    assert abs(tail - exact) < 3 * np.sqrt(exact / samples.effective_size[0])


def grid(problem):
    """Means and standard deviations of theta and ln v, and the probability of the upper mode."""
    theta, log_v = np.linspace(0.98, 1.28, 1501), np.linspace(-6.5, 2.5, 451)
    density = quadrature(problem, theta, log_v)
    moments = []
    for axis, marginal in (
        (theta, np.trapezoid(density, log_v, axis=1)),
        (log_v, np.trapezoid(density, theta, axis=0)),
    ):
        mean = np.trapezoid(axis * marginal, axis)
        moments.append((mean, np.sqrt(np.trapezoid((axis - mean) ** 2 * marginal, axis))))
    upper = np.trapezoid(np.trapezoid(density, log_v, axis=1)[theta > 1.13], theta[theta > 1.13])
    return np.array(moments), upper


def test_the_gas_spring_agrees_with_quadrature():
    problem = gas_spring(relative_sd=0.1, seed=1)
    log_density = LogDensity(problem)
    mixture = laplace_mixture(log_density, np.array([[1.2]]))
    samples = sample(log_density, mixture, seed=2, effective_size=4000, progress=False)
    moments, _ = grid(problem)
    within_error(samples, moments[:, 0], moments[:, 1])
    assert samples.failures == {}
    np.testing.assert_allclose(
        log_density.evaluations, samples.evaluations, atol=200
    )  # the rest went into the mode


# Of 60 noise seeds these have the upper mode at 0.22, 0.36, 0.64 and 0.86: both modes matter.
@pytest.mark.parametrize("noise", [0, 19, 13, 28])
def test_the_weights_of_both_modes_agree_with_quadrature(noise):
    problem = gas_spring(relative_sd=0.01, seed=noise)
    log_density = LogDensity(problem)
    mixture = laplace_mixture(log_density, np.array([[1.227], [1.04]]))
    samples = sample(log_density, mixture, seed=3, effective_size=2000, progress=False)
    _, upper = grid(problem)
    share = np.mean(samples.theta > 1.13)
    # theta is hardly more than which mode it is in, so its effective size is that of the share.
    error = np.sqrt(upper * (1 - upper) / samples.effective_size[0])
    assert samples.reached
    assert share == pytest.approx(upper, abs=4 * error)


def test_a_seed_gives_the_same_draws_whatever_the_threads():
    problem = gas_spring(relative_sd=0.1, seed=1)
    mixture = laplace_mixture(LogDensity(problem), np.array([[1.2]]))
    runs = [
        sample(LogDensity(problem, jobs), mixture, seed=5, quick=True, progress=False)
        for jobs in (None, 3)
    ]
    np.testing.assert_array_equal(runs[0].draws, runs[1].draws)
    other = sample(LogDensity(problem), mixture, seed=6, quick=True, progress=False)
    assert not np.array_equal(other.draws, runs[0].draws)


def test_stopping_early_is_said():
    samples = sample(
        Gaussian(np.ones(2)),
        normal_mixture(np.ones(2)),
        seed=1,
        effective_size=1e6,
        max_evaluations=20_000,
        progress=False,
    )
    assert not samples.reached
    assert "stopped before 20000 evaluations" in samples.warning
    assert "of 1000000 asked for" in samples.warning
    assert samples.evaluations <= 20_000


def test_a_limit_that_allows_nothing_is_refused():
    with pytest.raises(InputError, match="no draw could be kept"):
        sample(
            Gaussian(np.ones(2)),
            normal_mixture(np.ones(2)),
            seed=1,
            max_evaluations=100,
            progress=False,
        )


class Nowhere(Gaussian):
    def __call__(self, phi):
        height, by_run = super().__call__(phi)
        self.failures["inadmissible"] += len(phi)
        return np.full_like(height, -np.inf), by_run


class Fenced(Gaussian):
    """Nothing is allowed beyond one standard deviation of the first coordinate."""

    def __call__(self, phi):
        height, by_run = super().__call__(phi)
        beyond = phi[:, 0] > 1.0
        self.failures["inadmissible"] += int(beyond.sum())
        height[beyond] = -np.inf
        return height, by_run


def test_failures_are_kept_draw_by_draw():
    target = Fenced(np.ones(2))
    samples = sample(
        target, normal_mixture(np.ones(2)), seed=1, quick=True, climbs=0, progress=False
    )
    assert samples.draws[:, :, 0].max() <= 1.0
    assert samples.failures["inadmissible"] == target.failures["inadmissible"]
    by_reason = dict(zip(REASONS, samples.failed.T, strict=True))
    assert samples.failed.shape[0] == samples.draws.shape[1]
    assert 0 < by_reason["inadmissible"].sum() < samples.failures["inadmissible"]
    assert samples.failed.sum() == by_reason["inadmissible"].sum()


def test_a_start_without_a_finite_walker_is_refused():
    with pytest.raises(InputError, match=r"found no point of finite log density.*inadmissible"):
        sample(Nowhere(np.ones(2)), normal_mixture(np.ones(2)), seed=1, progress=False)


@pytest.mark.parametrize(
    ("settings", "match"),
    [
        ({"walkers": 4}, "even number of walkers"),
        ({"ensembles": 1}, "at least two"),
        ({"effective_size": 0}, "must be positive"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings, match):
    with pytest.raises(InputError, match=match):
        sample(Gaussian(np.ones(2)), normal_mixture(np.ones(2)), seed=1, progress=False, **settings)
    with pytest.raises(InputError, match="another dimension"):
        sample(Gaussian(np.ones(3)), normal_mixture(np.ones(2)), seed=1, progress=False)


def test_one_unknown_takes_six_walkers_and_one_climb():
    settings = {"seed": 1, "quick": True, "progress": False, "ensembles": 2}
    start = normal_mixture([1.0])
    with pytest.raises(InputError, match="even number from 6"):
        sample(Gaussian(np.ones(1)), start, walkers=4, **settings)
    assert sample(Gaussian(np.ones(1)), start, walkers=6, climbs=1, **settings).reached


def test_a_bar_is_shown(capsys):
    sample(Gaussian(np.ones(2)), normal_mixture(np.ones(2)), seed=1, quick=True)
    assert "200/200" in capsys.readouterr().err


def test_draws_are_chosen_once_each():
    samples = sample(
        Gaussian(np.ones(2)), normal_mixture(np.ones(2)), seed=1, quick=True, progress=False
    )
    theta, errors = choose_all(samples, 50, seed=0)
    assert theta.shape == (50, 2)
    assert errors.shape == (50, 0)
    again, _ = choose_all(samples, 50, seed=0)
    np.testing.assert_array_equal(theta, again)


@pytest.mark.slow
def test_other_processes_draw_the_same():
    target = LogDensity(gas_spring(relative_sd=0.1, seed=1))
    start = laplace_mixture(target, np.array([[1.2]]))
    options = {"effective_size": 200, "seed": 3, "progress": False, "quick": True}
    here = sample(target, start, **options)
    there = sample(LogDensity(target.problem), start, scheduler="local:2", **options)
    np.testing.assert_array_equal(there.draws, here.draws)
    np.testing.assert_array_equal(there.log_likelihood, here.log_likelihood)
    assert there.acceptance == here.acceptance
    assert there.failures == here.failures
