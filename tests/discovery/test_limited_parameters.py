"""Intervals of parameters given a structure respect their supports, and are those of the integral
over likelihood and prior."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from discovery.fitted_states import NUMERICS, fitted
from scipy import stats
from small_campaigns import damper_campaign

from bayesoleo.discovery import StructurePrior
from bayesoleo.discovery._limited_parameters import Coordinates, powers
from bayesoleo.discovery._parameter_mixture import Mixture, part_of
from bayesoleo.discovery._ranking import score_candidates
from bayesoleo.discovery._spectral_data import EstimatedModel, SpectralData, linearised
from bayesoleo.discovery._structure_columns import Likelihood
from bayesoleo.discovery._structure_parameters import GivenStructure
from bayesoleo.discovery._structure_search import structure_posterior
from bayesoleo.effects import find_effect
from bayesoleo.estimation import FunctionProblem, estimate
from bayesoleo.model import LogNormal, Model, Normal, Output, Parameter, TruncatedNormal, Uniform
from bayesoleo.model._correlated_priors import JointNormal
from bayesoleo.model._priors import LogUniform

CHANCES = np.array([0.05, 0.5, 0.95])


class Peak:
    """A prior of one's own: two-sided exponential about one."""

    mean, sd, support = 1.0, np.sqrt(2.0), (-np.inf, np.inf)

    def log_density(self, value):
        return -np.abs(np.asarray(value) - 1.0) - np.log(2.0)

    def sample(self, rng, size):
        return rng.laplace(1.0, 1.0, size)


def normal_part(prior, theta: float) -> tuple[float, float]:
    """Standard deviation and centre, from ``theta``, of the normal part of a prior, the centre in
    units of the deviation."""
    if isinstance(prior, LogNormal):
        return theta * prior.log_spread, np.log(prior.median / theta) / prior.log_spread
    return prior.sd, (prior.mean - theta) / prior.sd


def structure(priors, theta, gram, slope, power=None) -> GivenStructure:
    """One of no effects, whose likelihood is normal in the parameters about an estimate."""
    theta, gram, slope = (np.asarray(x, dtype=float) for x in (theta, gram, slope))
    unit, offset = np.array([normal_part(p, t) for p, t in zip(priors, theta, strict=True)]).T
    made = Coordinates.of(priors, theta, unit, offset)
    if power is not None:
        made = Coordinates(*(*vars(made).values(),)[:-1], np.array(power))
    products = np.zeros((1, 1 + theta.size, 1 + theta.size))
    products[0, 1:, 1:] = gram * np.outer(unit, unit)
    products[0, 0, 1:] = products[0, 1:, 0] = slope * unit
    products[0, 0, 0] = 1e4
    names = tuple("abcd"[: theta.size])
    return GivenStructure(
        names, made, made.place, np.diag(unit / made.slope), products, np.zeros(1), (), 0,
        offset, [(0, None, 1.0)], np.array([0.2]), Likelihood(100, 1e12),
    )  # fmt: skip


def quantiles_of(found: GivenStructure) -> np.ndarray:
    return np.array([[one.quantile(c) for c in CHANCES] for one in found.mixtures()])


def exact(priors, theta, gram, slope, axes) -> np.ndarray:
    """Quantiles by a grid over one or two parameters."""
    places = np.meshgrid(*axes, indexing="ij")
    away = [p - t for p, t in zip(places, theta, strict=True)]
    log = sum(s * d for s, d in zip(slope, away, strict=True))
    for i, one in enumerate(away):
        for j, other in enumerate(away):
            log = log - 0.5 * gram[i][j] * one * other
    for prior, place in zip(priors, places, strict=True):
        log = log + prior.log_density(place)
    for k, axis in enumerate(axes):  # grids need not be even
        step = np.gradient(axis)
        log = log + np.log(step).reshape([-1 if j == k else 1 for j in range(len(axes))])
    density = np.exp(log - log.max())
    found = []
    for k, axis in enumerate(axes):
        own = density.sum(axis=tuple(j for j in range(len(axes)) if j != k))
        below = (np.cumsum(own) - 0.5 * own) / own.sum()
        found.append(np.interp(CHANCES, below, axis))
    return np.array(found)


#: A prior, the estimate, deviation of the likelihood and its peak from the estimate, places.
ONE = {
    "positive, hardly known": (LogNormal(1.0, 1.5), 0.5, 3.0, 0.4, np.geomspace(1e-4, 50, 20001)),
    "positive, beyond zero": (LogNormal(1.0, 0.7), 0.5, 1.0, -3.0, np.geomspace(1e-4, 50, 20001)),
    "at a limit": (Uniform(0.0, 1.0), 0.01, 0.3, 0.0, np.linspace(0.0, 1.0, 20001)),
    "beyond a limit": (Uniform(-2.0, 1.0), 1.0, 0.3, 1.5, np.linspace(-2.0, 1.0, 20001)),
    "nothing known": (Uniform(-2.0, 1.0), 0.5, 1e3, 0.0, np.linspace(-2.0, 1.0, 20001)),
    "cut off": (TruncatedNormal(0.5, 1.0, 0.0), 0.1, 0.8, 0.0, np.linspace(0.0, 6.0, 20001)),
    "flat in the logarithm": (LogUniform(1e-3, 1e2), 0.5, 1.0, 0.5, np.geomspace(1e-3, 1e2, 20001)),
    "of one's own": (Peak(), 0.5, 1.0, 0.0, np.linspace(-8.0, 9.0, 20001)),
}  # fmt: skip


@pytest.mark.parametrize("case", ONE)
def test_a_parameter_known_poorly_has_the_quantiles_of_likelihood_and_prior(case):
    """Of a force's size, in which outputs are linear."""
    prior, theta, sd, peak, axis = ONE[case]
    gram, slope = [[sd**-2]], [peak / sd**2]
    power = [1.0] if prior.support[0] >= 0.0 else None
    found = quantiles_of(structure([prior], [theta], gram, slope, power))[0]
    wanted = exact([prior], [theta], gram, slope, [axis])[0]
    # Of a deviation: the density at some places, and 4096 draws.
    width = (wanted[2] - wanted[0]) / 3.3
    np.testing.assert_allclose(found, wanted, atol=0.02 * width)
    assert prior.support[0] <= found[0] < found[2] <= prior.support[1]


def test_what_is_linear_in_a_logarithm_stays_so():
    prior, theta = LogNormal(2.0, 1.0), 3.0
    # In the logarithm: peak at -0.4 from that of the estimate, deviation 0.5.
    made = structure([prior], [theta], [[4.0 / theta**2]], [-1.6 / theta])
    precision = 4.0 + 1.0
    mean = (4.0 * (np.log(theta) - 0.4) + np.log(2.0)) / precision
    wanted = np.exp(mean + np.array([-1.64485, 0.0, 1.64485]) / np.sqrt(precision))
    np.testing.assert_allclose(quantiles_of(made)[0], wanted, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    "priors",
    [
        (Uniform(0.0, 1.0), Uniform(0.0, 1.0)),
        (LogNormal(0.5, 1.0), LogNormal(0.5, 1.0)),
        (LogNormal(0.5, 1.0), Normal(0.5, 1.0)),
    ],
)
def test_two_parameters_of_which_the_sum_is_known(priors):
    """The limits of each are limits of the other."""
    gram = np.full((2, 2), 100.0) + np.diag([0.1, 0.1])
    slope = np.full(2, 100.0 * -0.35)  # the sum is 0.65 about 0.5 each
    top = 1.0 if isinstance(priors[0], Uniform) else 4.0
    axes = [np.linspace(1e-4, top, 1500), np.linspace(1e-4, top, 1500)]
    power = [1.0, 1.0]
    if isinstance(priors[1], Normal):
        axes[1], power = np.linspace(-4.0, 4.0, 3000), [1.0, 0.0]
    found = quantiles_of(structure(priors, [0.5, 0.5], gram, slope, power))
    wanted = exact(priors, [0.5, 0.5], gram, slope, axes)
    np.testing.assert_allclose(found, wanted, atol=0.012)


def test_limits_of_a_joint_prior_are_kept():
    joint = JointNormal.of(["a", "b"], [0.2, 0.0], [[1.0, 0.6], [0.6, 1.0]], [(0.0, 9.0), (-9, 9)])
    priors = [joint.prior("a"), joint.prior("b")]
    covariance = np.array(joint.covariance)
    made = Coordinates.of(priors, np.array([0.2, 0.0]), np.ones(2), np.zeros(2))
    found, log = made.draws(np.array([0.2, 0.0]), covariance, 4096)
    assert found[:, 0].min() >= 0.0
    draws = np.random.default_rng(0).multivariate_normal([0.2, 0.0], covariance, 400_000)
    kept = draws[draws[:, 0] > 0.0]
    assert np.exp(log).mean() == pytest.approx(len(kept) / len(draws), rel=0.01)
    weight = np.exp(log) / np.exp(log).sum()
    np.testing.assert_allclose(weight @ found, kept.mean(axis=0), atol=0.02)


def test_weights_of_draws_are_evidences():
    """The same likelihood under a prior of two thirds its width has the evidence of that prior."""
    sd, peak = 0.5, 0.9
    made = structure([Uniform(-2.0, 1.0)], [0.0], [[sd**-2]], [peak / sd**2])
    (part,) = made.normals()
    _, log = made.coordinates.draws(part.mean, part.covariance, 4096)
    axis = np.linspace(-30, 30, 200_001)
    likelihood = np.exp(peak / sd**2 * axis - 0.5 * (axis / sd) ** 2)
    unit, offset = normal_part(Uniform(-2.0, 1.0), 0.0)
    flat = np.where((axis > -2.0) & (axis < 1.0), 1.0 / 3.0, 0.0)
    normal = np.exp(-0.5 * ((axis - unit * offset) / unit) ** 2) / unit / np.sqrt(2 * np.pi)
    wanted = (likelihood @ flat) / (likelihood @ normal)
    assert np.exp(log).mean() == pytest.approx(wanted, rel=1e-3)


def test_quantiles_have_the_digits_of_the_smallest_parameters():
    """An absolute tolerance of a root would have been a tenth of the deviation."""
    mixture = Mixture.of(
        [part_of(0.5, -1.3e-8, 1e-11, False), part_of(0.5, -1.301e-8, 1e-11, False)]
    )
    scaled = Mixture.of([part_of(0.5, -1300.0, 1.0, False), part_of(0.5, -1301.0, 1.0, False)])
    for chance in CHANCES:
        assert mixture.quantile(chance) == pytest.approx(1e-11 * scaled.quantile(chance), rel=1e-9)


def test_quantiles_have_all_digits_over_many_decades():
    """Draws beside a log-normal density, over fourteen decades: a straight scale had lost all
    digits of the lowest."""
    places = np.geomspace(1e-9, 1e-8, 1000)
    mixture = Mixture.of(
        [part_of(0.5 / 1000, places, 0.0, False), part_of(0.5, np.log(1e5), 0.1, True)]
    )
    for chance in (0.05, 0.2, 0.45):
        assert mixture.quantile(chance) == pytest.approx(np.quantile(places, 2 * chance), rel=0.005)
    assert mixture.quantile(0.75) == pytest.approx(1e5, rel=1e-6)


def test_what_has_no_weight_does_not_stretch_the_scale():
    """A density without weight at zero left a straight scale from there."""
    low = part_of(np.array([0.5, 0.0]), np.array([1e-9, 0.0]), 0.0, False)
    mixture = Mixture.of([low, part_of(0.5, np.log(1e6), 0.1, True)])
    assert mixture.quantile(0.05) == pytest.approx(1e-9, rel=1e-9)


def test_a_density_changes_as_another_did():
    """A shifted density follows the same change of scale."""
    plain = part_of(1.0, 0.0, 1.0, True)
    values = np.exp(2.0 * np.linspace(-1, 1, 401)) ** 1.5
    level = (np.arange(401) + 0.5) / 401
    same = plain.changed(plain, values)
    for chance in CHANCES:
        assert same.quantile(chance) == pytest.approx(np.quantile(values, chance), rel=0.05)
    other = part_of(1.0, 0.5, 0.8, True)
    found = other.changed(plain, values)
    wanted = np.interp(stats.norm.cdf(0.5 + 0.8 * stats.norm.ppf(0.5)), level, values)
    assert found.quantile(0.5) == pytest.approx(wanted, rel=0.05)


def test_a_prior_is_not_widened_where_noise_is_larger_than_measured():
    made = structure([Normal(0.0, 1.0)], [0.0], [[1e-9]], [0.0])
    loud = GivenStructure(*(*vars(made).values(),)[:-1], Likelihood(100, 10.0))
    assert loud._posterior(0, np.ones(1), np.arange(1))[3] > 50.0  # the noise
    low, _, high = quantiles_of(loud)[0]
    assert high - low == pytest.approx(2 * 1.64485, rel=1e-3)


def function_fit(f, x, theta, priors) -> SimpleNamespace:
    y = f(x, theta) + 1e-3 * np.random.default_rng(0).standard_normal(x.size)
    problem = FunctionProblem(f, x, y, names=["a"], priors=priors, start=theta)
    return SimpleNamespace(problem=problem, point=estimate(problem, "be"))


@pytest.mark.parametrize(
    ("f", "power"),
    [
        (lambda x, theta: theta[0] * x, 1.0),
        (lambda x, theta: np.log(theta[0]) * x, 0.0),
        (lambda x, theta: x / theta[0], -1.0),
        (lambda x, theta: theta[0] ** 4 * x, 1.0),  # beyond the powers that are used
    ],
)
def test_a_power_is_that_in_which_outputs_are_linear(f, power):
    x = np.linspace(0.5, 2.0, 50)
    fit = function_fit(f, x, np.array([2.0]), [LogNormal(2.0, 1.0)])
    for shift in (-0.7, 0.5):
        assert powers(fit, ("a",), np.array([shift]))[0] == pytest.approx(power, abs=0.02)
    assert powers(fit, ("a",), np.zeros(1))[0] == 0.0


def rubbing(x, v, _):
    return 200.0 * v + 1000.0 * x + 3.0 * np.arctan(60.0 * v) + 300.0 * v * np.abs(v)


@pytest.fixture(scope="module")
def slope_state(tmp_path_factory):
    """Friction whose steepness hardly shows, and drag that is missing."""
    model = Model(
        "damper",
        inputs={"displacement": "m"},
        parameters={
            "damping": Parameter(150.0, "N*s/m", sd=500.0),
            "stiffness": Parameter(800.0, "N/m", bounds=(0.0, 5000.0)),
            "friction": Parameter(2.0, "N", sd=5.0),
            "steepness": Parameter(50.0, "s/m", prior=LogNormal(50.0, 1.0)),
        },
        outputs={
            "force": Output(
                "damping*dot(displacement) + stiffness*displacement"
                " + friction*atan(steepness*dot(displacement))",
                "N",
            )
        },
    )
    return fitted(damper_campaign(tmp_path_factory.mktemp("rub"), rubbing, noise=2.0), model)


@pytest.mark.slow
@pytest.mark.parametrize("prior", [StructurePrior(), StructurePrior(nothing=0.1, outside=0.8)])
def test_intervals_of_all_structures_lie_in_the_supports(slope_state, prior):
    base = slope_state.base()
    effects = [find_effect(name) for name in ("quadratic_damping", "coulomb_friction", "preload")]
    scores, _ = score_candidates(base, slope_state.assembly, effects, 1)
    errors = {(entry.run, entry.output): entry for entry in slope_state.fit_errors.entries}
    found = structure_posterior(base, slope_state.assembly, scores, errors, NUMERICS, prior=prior)
    for name, one in zip(base.fit.problem.names, base.fit.problem.priors, strict=True):
        shown = found.parameters[name]
        if shown.reason:
            assert shown.low is shown.median is shown.high is shown.mean is shown.sd is None
        else:
            assert one.support[0] <= shown.low < shown.median < shown.high <= one.support[1]
    # Its prior is all that is known at worst.
    shown, logs = found.parameters["steepness"], 2 * 1.64485
    assert shown.reason or 0.0 < np.log(shown.high / shown.low) < 1.02 * logs
    assert not found.parameters["damping"].reason


def test_a_logarithm_is_integrated_over_itself(slope_state):
    """Without data a parameter has its prior, not the density of which an estimator takes the
    mode."""
    fit = slope_state.base().fit
    found = linearised(EstimatedModel(fit, {}), SpectralData.of(fit))
    k = found.names.index("steepness")
    centre = np.log(found.theta[k]) + found.change[k, k] / found.theta[k] * found.offset[k]
    assert np.exp(centre) == pytest.approx(50.0)
