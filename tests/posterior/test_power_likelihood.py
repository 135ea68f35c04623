"""The power likelihood: effective numbers of samples, and intervals that follow from them."""

from __future__ import annotations

import numpy as np
import pytest
from linear_runs import linear_runs
from scipy import signal

from bayesoleo.error_models import error_model
from bayesoleo.error_models._base import RunSamples
from bayesoleo.error_models._correlated import autocorrelation_time, effective_samples
from bayesoleo.errors import InputError
from bayesoleo.estimation import FunctionProblem
from bayesoleo.model import Normal
from bayesoleo.posterior import LogDensity
from bayesoleo.posterior._laplace import find_mode, start_coordinates


def ar1(rng, shape, coefficient):
    white = rng.standard_normal((*shape[:-1], shape[-1] + 200))
    scale = np.sqrt(1 - coefficient**2)
    return signal.lfilter([scale], [1.0, -coefficient], white, axis=-1)[..., 200:]


def samples_of(count, frequency=None):
    return RunSamples(np.arange(count) * 0.02, frequency)


@pytest.mark.parametrize("coefficient", [0.0, 0.5, 0.9])
def test_the_exponent_of_ar1_noise_is_its_closed_form(coefficient):
    rng = np.random.default_rng(0)
    residuals = [ar1(rng, (2, 4000), coefficient) for _ in range(3)]
    found = effective_samples(residuals, [samples_of(4000)] * 3) / 4000
    # The sum of an autocorrelation of 12 000 samples is known to about a seventh at 0.9.
    np.testing.assert_allclose(found, (1 - coefficient) / (1 + coefficient), rtol=0.25)


def test_white_noise_counts_in_full_and_the_posterior_is_that_of_independent_errors():
    rng = np.random.default_rng(1)
    errors = [rng.standard_normal((1, 1500)) for _ in range(3)]
    problem = linear_runs(errors, levels=[0.5] * 3, by_run=False)
    residuals = [e - e.mean() for e in errors]
    problem.__dict__["effective"] = effective_samples(residuals, problem.samples)
    share = problem.effective / problem.counts
    assert (share > 0.85).all()
    modes = {
        word: find_mode(density, start_coordinates(density, np.array([0.5, 1.5])))
        for word in ("independent", "power")
        for density in [LogDensity(problem, errors=word)]
    }
    one, other = modes["independent"], modes["power"]
    np.testing.assert_allclose(one.centre, other.centre, atol=2e-3)
    sd = np.sqrt(np.diag(other.covariance) / np.diag(one.covariance))
    # Wider by the root of the exponent, a few parts in a hundred.
    np.testing.assert_allclose(sd, 1 / np.sqrt(share.mean()), rtol=5e-3)


def test_a_power_of_the_likelihood_is_the_likelihood_of_so_many_samples():
    """With a fraction of the samples, the density is that fraction of the log-likelihood."""
    rng = np.random.default_rng(2)
    problem = linear_runs([rng.standard_normal((2, 80))] * 2, levels=[0.0] * 2, by_run=False)
    problem.__dict__["effective"] = 0.3 * problem.counts
    power, plain = (error_model(word, problem) for word in ("power", "independent"))
    sums, eta = rng.chisquare(80, (5, 2, 2)), rng.normal(0, 0.5, (5, 2))
    np.testing.assert_allclose(power.of_sums(sums, eta), 0.3 * plain.of_sums(sums, eta), rtol=1e-12)


def test_the_mean_of_ar1_noise_is_covered():
    """Nominal 90 %; independent errors cover half of it."""
    rng, inside, narrow = np.random.default_rng(3), [], []
    x = np.arange(600) * 0.02
    for _ in range(150):
        y = ar1(rng, (600,), 0.8)
        problem = FunctionProblem(lambda t, p: p[0] + 0 * t, x, y, [Normal(0.0, 100.0)], ["level"])
        left = [(y - y.mean())[None]]
        problem.effective = effective_samples(left, [RunSamples(x, None)])
        for word, found in (("power", inside), ("independent", narrow)):
            density = LogDensity(problem, errors=word)
            mode = find_mode(density, start_coordinates(density, np.array([y.mean()])))
            found.append(abs(mode.centre[0]) <= 1.645 * np.sqrt(mode.covariance[0, 0]))
    # Binomial scatter of 150 is 2.4 %; a short record underestimates the autocorrelation a little.
    assert 0.80 <= np.mean(inside) <= 0.96
    assert np.mean(narrow) < 0.6


def test_what_repeats_counts_once_however_many_periods_there_are():
    rng, found = np.random.default_rng(4), []
    for periods in (4, 16):
        time = np.arange(periods * 100) * 0.01
        wave = np.cos(2 * np.pi * 3 * time) + np.sin(2 * np.pi * 7 * time)
        residual = wave + 0.3 * rng.standard_normal(time.size)
        found.append(float(effective_samples([residual[None]], [RunSamples(time, 1.0)])[0, 0]))
    # Four times the periods hold about the same information.
    assert found[1] == pytest.approx(found[0], rel=0.35)
    assert found[1] < 200


def test_effective_numbers_stay_between_one_and_the_number():
    slow = np.linspace(-1.0, 1.0, 50)[None]
    found = effective_samples([slow, 0 * slow], [samples_of(50), samples_of(50)])
    assert (found >= 1).all()
    assert (found <= 50).all()
    assert autocorrelation_time([np.zeros(40)]) == 1.0


def test_without_effective_numbers_it_says_what_to_write():
    problem = linear_runs([np.zeros((1, 30))] * 2, levels=[0.0] * 2, by_run=False)
    with pytest.raises(InputError, match=r"problem\.effective = effective_samples"):
        LogDensity(problem, errors="power")


@pytest.mark.parametrize("periods", [3, 8])
@pytest.mark.parametrize("per_period", [400, 97])
def test_a_curve_that_repeats_exactly_is_worth_one_period(periods, per_period):
    """All of it repeats: each further period tells nothing, whatever its samples resemble."""
    curve = np.random.default_rng(6).standard_normal(per_period)
    when = RunSamples(np.arange(per_period * periods) / per_period, 1.0)
    whole = np.tile(curve, periods)
    found = effective_samples([whole[None]], [when])[0, 0]
    own, again = autocorrelation_time([whole]), autocorrelation_time([curve])
    assert found == pytest.approx(whole.size / (own + (periods - 1) * again), rel=1e-6)
    assert found <= 1.1 * per_period
