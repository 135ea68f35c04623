"""Each error model's density against a dense multivariate normal, and its priors against laws."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy import integrate, special, stats

from bayesoleo.error_models import ERROR_MODELS, error_model
from bayesoleo.error_models._base import RunSamples
from bayesoleo.error_models._correlated import covariance
from bayesoleo.error_models._discrepancy import basis, spectrum
from bayesoleo.error_models._stretch import Stretch
from bayesoleo.errors import InputError
from bayesoleo.model._priors import Transforms
from bayesoleo.posterior._datatree import sd_of_averages


@dataclass
class Campaign:
    """As much of a problem as an error model sees."""

    outputs: tuple = ("force", "pressure")
    runs: tuple = ("a", "b")
    names: tuple = ("stiffness",)
    lengths: tuple = (41, 60)
    frequency: float | None = 0.5
    counts: np.ndarray = field(init=False)
    effective: np.ndarray = field(init=False)
    stretch: Stretch = field(init=False)

    def __post_init__(self):
        self.counts = np.array([[n] * len(self.outputs) for n in self.lengths])
        # Of the power likelihood.
        self.effective = 0.4 * self.counts
        # Of the spectral one.
        self.stretch = Stretch(Transforms(()), np.zeros(0), np.eye(0))

    @property
    def samples(self):
        rng = np.random.default_rng(3)
        # Two periods and more, unequal steps, and a gap in each run.
        times = []
        for n in self.lengths:
            steps = rng.choice([0.05, 0.07, rng.uniform(0.04, 0.2)], n)
            steps[n // 2] = 2.0
            times.append(np.cumsum(steps))
        return tuple(RunSamples(time, self.frequency) for time in times)


def drawn(model, rows, seed=0):
    """Coordinates that are anywhere, and residuals of run 1."""
    rng = np.random.default_rng(seed)
    eta = rng.normal(0, 0.8, (rows, len(model.names)))
    residual = rng.normal(0, 1.5, (rows, len(model.frame.outputs), model.frame.counts[1, 0]))
    return eta, residual


def dense(word, model, eta, time, frequency):
    """Covariance over outputs and samples of a run, (s n, s n), by its definition."""
    value = dict(zip(model.names, model.natural(eta[None])[0], strict=True))
    outputs, n = model.frame.outputs, time.size
    v = [np.exp(value[f"log_variance_{o}"]) for o in outputs]
    if word == "full":
        r = value["correlation_force_pressure"]
        cross = r * np.sqrt(v[0] * v[1])
        return np.kron([[v[0], cross], [cross, v[1]]], np.eye(n))
    blocks = []
    for o, variance in zip(outputs, v, strict=True):
        if word == "correlated":
            share, tau = value[f"correlated_share_{o}"], value[f"correlation_time_{o}"]
            away = np.abs(np.subtract.outer(time, time))
            kernel = np.exp(-away / tau)
        else:
            share, length = value[f"discrepancy_share_{o}"], value[f"discrepancy_length_{o}"]
            table = basis(RunSamples(time, frequency).phase)
            kernel = (table * spectrum(np.array([length]))) @ table.T
        blocks.append(variance * ((1 - share) * np.eye(n) + share * kernel))
    zero = np.zeros((n, n))
    return np.block([[blocks[0], zero], [zero, blocks[1]]])


@pytest.mark.parametrize("frequency", [0.5, None])
@pytest.mark.parametrize("word", ["full", "correlated", "discrepancy"])
def test_a_run_is_a_multivariate_normal(word, frequency):
    campaign = Campaign(frequency=frequency)
    model = error_model(word, campaign)
    eta, residual = drawn(model, 5)
    found = model.of_run(1, residual, eta)
    time = campaign.samples[1].time
    for lane in range(5):
        matrix = dense(word, model, eta[lane], time, frequency)
        exact = stats.multivariate_normal(cov=matrix).logpdf(residual[lane].ravel())
        assert found[lane] == pytest.approx(exact, rel=1e-11)
    rows = np.random.default_rng(1).normal(size=(3, 2, time.size))
    matrix = dense(word, model, eta[0], time, frequency)
    flat = rows.reshape(3, -1)
    exact = flat @ np.linalg.solve(matrix, flat.T)
    columns = [rows[:, 0], rows[:, 1]]
    np.testing.assert_allclose(model.products(1, columns, eta[0]), exact, rtol=1e-9)


@pytest.mark.parametrize("word", ["independent", "per-run"])
def test_sums_give_products_of_normals(word):
    campaign = Campaign()
    model = error_model(word, campaign)
    rng = np.random.default_rng(0)
    eta = rng.normal(0, 0.5, (3, len(model.names)))
    e = [rng.normal(size=(2, n)) for n in campaign.lengths]
    sums = np.stack([[np.sum(run**2, axis=1) for run in e]] * 3)
    found = model.of_sums(sums, eta)
    natural = model.natural(eta)
    for lane in range(3):
        for r, run in enumerate(campaign.runs):
            v = model.variance(natural[lane : lane + 1], run)[0]
            exact = stats.norm(0, np.sqrt(v)[:, None]).logpdf(e[r]).sum()
            assert found[lane, r] == pytest.approx(exact, rel=1e-12)


def test_a_settled_filter_is_the_filter_itself():
    # Equal steps, so that the gain is frozen on the way; long enough to matter.
    time = np.arange(200) * 0.01
    campaign = Campaign(outputs=("force",), runs=("a",), lengths=(200,))
    campaign.__class__ = type("Equal", (Campaign,), {"samples": (RunSamples(time, 1.0),)})
    model = error_model("correlated", campaign)
    eta = np.array([[0.3, 1.0, np.log(0.05)], [0.3, 7.0, np.log(0.5)], [0.3, -7.0, 0.0]])
    residual = np.random.default_rng(0).normal(size=(3, 1, 200))
    found = model.of_run(0, residual, eta)
    for lane in range(3):
        log_v, share, tau = model.natural(eta[lane : lane + 1])[0]
        v = np.exp(log_v)
        exact = stats.multivariate_normal(cov=covariance(time, v, share, tau))
        assert found[lane] == pytest.approx(exact.logpdf(residual[lane, 0]), rel=1e-10)


@pytest.mark.parametrize("length", [0.05, 0.2])
def test_the_series_is_materns_correlation_around_the_circle(length):
    phase = np.linspace(0, 1, 41)
    series = (basis(np.zeros(1)) * spectrum(np.array([length]))) @ basis(phase).T
    # Around the circle a correlation is the sum of the one on the line over all turns.
    away = np.sqrt(3) * np.abs(phase[:, None] + np.arange(-30, 31)) / length
    wrapped = ((1 + away) * np.exp(-away)).sum(axis=1)
    # Cut off is 9 / (2 pi k l)^4 beyond harmonic 24, on both sides, of a sum of sqrt(3) / (4 l);
    # the rest is scaled up by as much.
    cut = 2 * 9 / (2 * np.pi * length) ** 4 / (3 * 24.5**3) / (np.sqrt(3) / (4 * length))
    np.testing.assert_allclose(series[0], wrapped / wrapped[0], atol=2 * cut)
    assert cut < 1e-2
    assert spectrum(np.array([length]))[0].sum() == pytest.approx(
        1 + spectrum(np.array([length]))[0, 1::2].sum()
    )


def test_a_discrepancy_repeats_from_period_to_period():
    phase = np.array([0.1, 1.1, 7.1])
    np.testing.assert_allclose(basis(phase)[0], basis(phase)[2], atol=1e-12)
    line = RunSamples(np.linspace(5.0, 9.0, 5), None)
    np.testing.assert_allclose(line.phase, [0, 0.125, 0.25, 0.375, 0.5])


@pytest.mark.parametrize("word", ERROR_MODELS)
def test_a_row_depends_on_itself_alone(word):
    model = error_model(word, Campaign())
    eta, residual = drawn(model, 11)
    if model.by_sums:
        sums = np.random.default_rng(2).chisquare(40, (11, 2, 2))
        whole = model.of_sums(sums, eta)
        np.testing.assert_array_equal(model.of_sums(sums[4:5], eta[4:5])[0], whole[4])
    else:
        whole = model.of_run(1, residual, eta)
        np.testing.assert_array_equal(model.of_run(1, residual[4:5], eta[4:5])[0], whole[4])
    np.testing.assert_array_equal(model.log_prior(eta[4:5])[0], model.log_prior(eta)[4])


@pytest.mark.parametrize("word", ERROR_MODELS)
def test_coordinates_are_the_inverse_of_units(word):
    model = error_model(word, Campaign(outputs=("force", "pressure", "stroke")))
    eta = np.random.default_rng(0).normal(0, 0.7, (6, len(model.names)))
    np.testing.assert_allclose(model.coordinates(model.natural(eta)), eta, atol=1e-10)
    assert len(set(model.names)) == len(model.names) == len(model.scales())


@pytest.mark.parametrize("word", ["full", "correlated", "discrepancy"])
def test_the_prior_of_one_coordinate_is_normalised(word):
    model = error_model(word, Campaign())
    for k in range(2, len(model.names)):

        def density(u, k=k):
            eta = np.zeros((1, len(model.names)))
            eta[0, k] = u
            return float(np.exp(model.log_prior(eta)[0]))

        rest = np.zeros((1, len(model.names)))
        alone = integrate.quad(density, -40, 40, limit=200)[0]
        others = np.exp(model.log_prior(rest)[0]) / density(0.0)
        assert others == pytest.approx(1.0)
        # The other coordinates stay at zero: their densities there are a factor.
        factor = 1.0
        for j in range(2, len(model.names)):
            if j != k and word != "full":
                factor *= float(np.exp(model.quantities[j].log_prior(np.zeros(1))[0]))
        assert alone == pytest.approx(factor, rel=1e-6)


def test_correlations_are_uniform_over_all_matrices():
    # Of three outputs each correlation alone is Beta(3/2, 3/2) on (-1, 1): variance 1/4.
    model = error_model("full", Campaign(outputs=("a", "b", "c")))
    draws = model.sample_prior(np.random.default_rng(0), 40_000)
    for name in ("correlation_a_b", "correlation_a_c", "correlation_b_c"):
        p = stats.kstest((draws[name] + 1) / 2, stats.beta(1.5, 1.5).cdf).pvalue
        assert p > 1e-3
    # And the density agrees with the draws: importance weights of a normal proposal average one.
    rng = np.random.default_rng(1)
    z = rng.normal(0, 1.2, (40_000, 3))
    eta = np.concatenate([np.zeros((40_000, 3)), z], axis=1)
    weight = np.exp(model.log_prior(eta) - stats.norm(0, 1.2).logpdf(z).sum(axis=1))
    assert weight.mean() == pytest.approx(1.0, abs=5 * weight.std() / 200)


def test_the_density_of_correlations_is_the_same_everywhere():
    """Uniform over matrices: less the stretch of the coordinates, all points are alike."""
    model, step = error_model("full", Campaign(outputs=("a", "b", "c"))), 1e-5
    densities = []
    for z in np.random.default_rng(2).normal(0, 1.0, (6, 3)):
        eta = np.concatenate([np.zeros(3), z])
        ends = [model.natural(eta + sign * step * np.eye(6)[3:])[:, 3:] for sign in (1, -1)]
        stretch = np.linalg.slogdet((ends[0] - ends[1]) / (2 * step))[1]
        densities.append(model.log_prior(eta[None])[0] - stretch)
    # The volume of all correlation matrices of three outputs is pi^2 / 2.
    np.testing.assert_allclose(densities, -np.log(np.pi**2 / 2), atol=1e-6)


def test_what_does_not_suit_is_refused():
    with pytest.raises(InputError, match="did you mean correlated"):
        error_model("corelated", Campaign())
    with pytest.raises(InputError, match="needs two of them"):
        error_model("full", Campaign(outputs=("force",)))
    ragged = Campaign()
    ragged.counts = np.array([[41, 40], [60, 60]])
    with pytest.raises(InputError, match="at the same samples"):
        error_model("full", ragged)

    class SumsOnly:
        outputs, runs, counts = ("force",), ("a",), np.array([[10]])

    with pytest.raises(InputError, match="sums of squares only"):
        error_model("correlated", SumsOnly())


@pytest.mark.parametrize("word", ["full", "correlated", "discrepancy"])
def test_drawn_errors_have_the_covariance_of_the_density(word):
    campaign = Campaign(lengths=(5, 9))
    model = error_model(word, campaign)
    eta = drawn(model, 1)[0]
    samples = campaign.samples[1]
    exact = dense(word, model, eta[0], samples.time, samples.frequency)
    size = 40_000
    natural = np.repeat(model.natural(eta), size, axis=0)
    rows = model.draw(natural, "b", samples, np.random.default_rng(5)).reshape(size, -1)
    sd = np.sqrt(np.diag(exact))
    found = rows.T @ rows / size / np.outer(sd, sd)
    # The largest of 171 entries, each with a standard error of at most sqrt(2 / size).
    np.testing.assert_allclose(found, exact / np.outer(sd, sd), atol=4.5 * np.sqrt(2 / size))


@pytest.mark.parametrize("run", ["a", "new"])
def test_a_new_run_has_another_variance(run):
    model = error_model("per-run", Campaign())
    natural = np.zeros((20_000, len(model.names)))
    natural[:, [2, 3]] = [0.5, 1.0]  # scatter of the logarithms of force and pressure
    natural[:, 4:] = np.log(4.0)
    e = model.draw(natural, run, RunSamples(np.arange(20.0), None), np.random.default_rng(2))
    log_v = np.log(np.mean(e**2, axis=2))
    # Of the logarithm of a mean of 20 squares.
    noise = np.sqrt(special.polygamma(1, 10))
    mean = (np.log(4.0) if run == "a" else 0.0) + special.digamma(10) - np.log(10)
    expected = np.array([0.5, 1.0]) if run == "new" else np.zeros(2)
    np.testing.assert_allclose(log_v.std(axis=0), np.hypot(expected, noise), rtol=0.03)
    np.testing.assert_allclose(log_v.mean(axis=0), mean, atol=0.03)


def test_averages_of_errors_keep_what_repeats():
    """Noise of a sample falls by the root of the periods, a discrepancy not at all."""
    time = np.arange(16 * 100) / 100.37
    samples, rng = RunSamples(time, 1.0), np.random.default_rng(4)
    campaign = Campaign(outputs=("force",), runs=("a",), lengths=(time.size,))
    campaign.__class__ = type("Long", (Campaign,), {"samples": (samples,)})
    in_bin = np.mean(1 / np.histogram(samples.phase % 1, 50, (0, 1))[0])
    white = error_model("independent", campaign)
    e = white.draw(np.zeros((300, 1)), "a", samples, rng)
    found = sd_of_averages(e, samples.phase, 50)
    assert np.sqrt(np.mean(found**2)) == pytest.approx(np.sqrt(in_bin), rel=0.02)
    repeating = error_model("discrepancy", campaign)
    e = repeating.draw(np.tile([0.0, 0.64, 0.1], (3000, 1)), "a", samples, rng)
    found = sd_of_averages(e, samples.phase, 50)
    assert np.sqrt(np.mean(found**2)) == pytest.approx(np.sqrt(0.64 + 0.36 * in_bin), rel=0.02)
