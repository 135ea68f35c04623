"""Marginal likelihoods of structures against dense densities, and against their own prior."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import integrate, stats
from scipy.special import erfcx, logsumexp

from bayesoleo.discovery._spectral_data import RunLines
from bayesoleo.discovery._structure_columns import (
    Covariances,
    Group,
    Likelihood,
    Reduced,
    Remainders,
    mean_of,
    root_of,
)
from bayesoleo.discovery._structure_evidence import Largest, effect_evidence, pair_evidence
from bayesoleo.discovery._structure_moments import _scaled_tail, log_moments
from bayesoleo.discovery._structures import StructurePrior

SAMPLES, UNKNOWNS, COLUMNS = 40, 3, 4
SIZES = np.array([0.2, 1.0, 5.0])


@pytest.fixture
def problem():
    """Residual, unknowns, columns, noise variance and prior centres of a small problem."""
    rng = np.random.default_rng(7)
    variance = rng.uniform(0.5, 2.0, SAMPLES)
    unknowns = 2.0 * rng.standard_normal((UNKNOWNS, SAMPLES))
    columns = rng.standard_normal((COLUMNS, SAMPLES))
    residual = rng.standard_normal(SAMPLES) + 0.7 * columns[1]
    return residual, unknowns, columns, variance, rng.standard_normal(UNKNOWNS)


def reduced(problem) -> Reduced:
    residual, unknowns, columns, variance, offset = problem
    rows = np.concatenate([residual[None], unknowns, columns])
    product = (rows / variance) @ rows.T
    log_det = np.array([np.log(variance).sum()])
    return Reduced.of(product[None], log_det, UNKNOWNS, offset)


def dense(problem, power: dict[int, float]) -> tuple[float, float]:
    """Square and log determinant by the whole covariance."""
    residual, unknowns, columns, variance, offset = problem
    covariance = np.diag(variance) + unknowns.T @ unknowns
    for k, size in power.items():
        covariance = covariance + size * np.outer(columns[k], columns[k])
    left = residual - offset @ unknowns
    return float(left @ np.linalg.solve(covariance, left)), float(np.linalg.slogdet(covariance)[1])


def test_unknowns_are_integrated_out(problem):
    part = reduced(problem)
    np.testing.assert_allclose([part.square[0], part.log_det[0]], dense(problem, {}), rtol=1e-10)


def test_columns_in_the_covariance_are_those_of_the_dense_one(problem):
    part = reduced(problem).with_columns([0, 2], np.array([0.5, 3.0]))
    expected = dense(problem, {0: 0.5, 2: 3.0})
    np.testing.assert_allclose([part.square[0], part.log_det[0]], expected, rtol=1e-10)


def amplitudes(problem, power: dict[int, float]) -> tuple[np.ndarray, np.ndarray]:
    """Means of effects' amplitudes and their covariance, by the whole covariance of the data."""
    residual, unknowns, columns, variance, offset = problem
    rows, prior = columns[list(power)], np.diag(list(power.values()))
    rest = np.diag(variance) + unknowns.T @ unknowns
    gain = prior @ rows @ np.linalg.inv(rest + rows.T @ prior @ rows)
    return gain @ (residual - offset @ unknowns), prior - gain @ rows.T @ prior


@pytest.mark.parametrize("freedom", [4.0, 30.0, 1e5])
def test_evidence_of_an_effect_is_students_density_by_the_moment_of_its_amplitudes(
    problem, freedom
):
    likelihood = Likelihood(SAMPLES, freedom)
    found = effect_evidence(reduced(problem), likelihood, [Group((1,)), Group((0, 3))], SIZES)
    for t, size in enumerate(SIZES):
        for g, columns in enumerate([(1,), (0, 3)]):
            # The mean square of n amplitudes under b' b N(b; 0, v I) is (n + 2) v.
            normal = size**2 / (len(columns) + 2)
            power = dict.fromkeys(columns, normal)
            square, log_det = dense(problem, power)
            mean, covariance = amplitudes(problem, power)
            noise = likelihood.noise(np.array(square))
            moment = (mean @ mean / noise + np.trace(covariance)) / (normal * len(columns))
            expected = likelihood(np.array(square), np.array(log_det)) + np.log(moment)
            np.testing.assert_allclose(found[0, g, t], expected, rtol=1e-10)


@pytest.mark.parametrize(("freedom", "count", "square"), [(20, 100, 900.0), (100, 40, 200.0)])
def test_noise_and_amplitude_are_integrated_together(freedom, count, square):
    """The noise of the first case is three times as large as was measured."""
    gram, slope, size = 60.0, 90.0, 0.7
    part = Reduced(
        np.full((1, 1, 1), gram), np.full((1, 1), slope), np.array([square]), np.zeros(1)
    )
    likelihood = Likelihood(count, float(freedom))
    found = effect_evidence(part, likelihood, [Group((0,))], np.array([size]))[0, 0, 0]
    found -= likelihood(part.square, part.log_det)[0]
    # Sizes are in units of the noise as it is: the amplitude is noise times a moment variate.
    log_variance, b = np.linspace(-4.0, 6.0, 2001)[:, None], np.linspace(-6.0, 6.0, 2001)
    noise = np.exp(0.5 * log_variance)
    log = -0.5 * (freedom + count) * log_variance - 0.5 * (freedom + square) / noise**2
    with_effect = log + slope * b / noise - 0.5 * gram * b**2
    evidence = logsumexp(with_effect, b=moment_density(b, size) * (b[1] - b[0]))
    assert found == pytest.approx(evidence - logsumexp(log), abs=1e-3)


def test_effects_in_the_covariance_have_their_moments(problem):
    """The evidence of an anchor's effects is that of the same effects as candidates."""
    likelihood, part = Likelihood(SAMPLES, 1e6), reduced(problem)
    groups = [Group((1,)), Group((0, 3))]
    found = effect_evidence(part, likelihood, groups, SIZES)
    for t, size in enumerate(SIZES):
        for g, group in enumerate(groups):
            own = part.with_effects([group], [size])
            assert own.size == COLUMNS - len(group.columns)
            evidence = likelihood(own.square, own.log_det) + own.log_moment(likelihood)
            np.testing.assert_allclose(evidence[0], found[0, g, t], rtol=1e-10)


def test_nothing_missing_is_favoured_faster_than_under_a_normal_density():
    """Of an amplitude that is estimated as nothing, the ratio to the evidence of nothing falls with
    the third power of its size, and with the first one under a normal density."""
    gram, likelihood = 100.0, Likelihood(1000, 1e9)
    part = Reduced(np.full((1, 1, 1), gram), np.zeros((1, 1)), np.array([1000.0]), np.zeros(1))
    nothing = likelihood(part.square, part.log_det)[0]
    sizes = np.array([1.0, 10.0, 100.0])
    found = effect_evidence(part, likelihood, [Group((0,))], sizes)[0, 0] - nothing
    np.testing.assert_allclose(found, -1.5 * np.log1p(gram * sizes**2 / 3.0), rtol=1e-6)


def test_students_density_is_that_of_scipy_up_to_a_constant():
    rng, freedom = np.random.default_rng(0), 6.0
    covariance = np.diag([1.0, 2.0, 0.5])
    likelihood = Likelihood(3, freedom)
    points = rng.standard_normal((5, 3))
    square = np.einsum("ni,ij,nj->n", points, np.linalg.inv(covariance), points)
    ours = likelihood(square, np.full(5, np.linalg.slogdet(covariance)[1]))
    theirs = stats.multivariate_t(shape=covariance, df=freedom).logpdf(points)
    np.testing.assert_allclose(ours - theirs, (ours - theirs)[0], atol=1e-12)


def moment_density(b, size: float):
    """Of an amplitude with a root mean square."""
    normal = size / np.sqrt(3.0)
    return (b / normal) ** 2 * stats.norm.pdf(b, scale=normal)


def two_columns(correlation: float, truth: tuple[float, float]) -> Reduced:
    """Two columns of this correlation in data without noise that have both with these sizes."""
    gram = np.array([[100.0, 100.0 * correlation], [100.0 * correlation, 100.0]])
    slope, size = gram @ truth, np.array(truth) @ gram @ truth
    return Reduced(gram[None], slope[None], np.array([size + 500.0]), np.zeros(1))


def pair_integral(part: Reduced, side: float, size: float, its: float) -> float:
    """Log evidence over that of nothing, the first amplitude with a likely side."""
    grid = np.linspace(-3.0, 3.0, 1201)
    first, second = grid[:, None], grid
    (slope,), (gram,) = part.slope, part.gram
    log = slope[0] * first + slope[1] * second - gram[0, 1] * first * second
    log = log - 0.5 * (gram[0, 0] * first**2 + gram[1, 1] * second**2)
    sides = 2.0 * np.where(first > 0, side, 1.0 - side)
    prior = sides * moment_density(first, size) * moment_density(second, its)
    top = log.max()
    return top + float(np.log(np.sum(np.exp(log - top) * prior) * (grid[1] - grid[0]) ** 2))


@pytest.mark.parametrize("side", [0.5, 0.9, 1.0])
@pytest.mark.parametrize("correlation", [0.0, 0.5, -0.8, 0.95])
@pytest.mark.parametrize(
    "truth",
    [(0.0, 1.0), (1.0, 0.0), (0.5, -0.5), (0.1, 0.1), (-0.3, -0.3), (-0.2, 0.1), (-0.1, 0.3)],
)
def test_a_pair_has_the_same_evidence_by_every_way(truth, correlation, side):
    """As two candidates, as one beside the other, and with both in the model: the integral over
    both amplitudes, also where one of them only stood in for the other."""
    part, size, its = two_columns(correlation, truth), 0.8, 0.5
    likelihood = Likelihood(500, 1e10)
    one, other = Group((0,), side), Group((1,), 0.5)
    both = part.with_effects([one, other], [size, its])
    about_one = part.with_effects([one], [size])
    about_other = part.with_effects([other], [its])
    next_one, next_other = Group((0,), side), Group((0,), 0.5)
    found = [
        pair_evidence(part, likelihood, one, [other], np.array([size, its]))[0, 0, 0, 1],
        effect_evidence(about_one, likelihood, [next_other], np.array([its]))[0, 0, 0],
        effect_evidence(about_other, likelihood, [next_one], np.array([size]))[0, 0, 0],
        (likelihood(both.square, both.log_det) + both.log_moment(likelihood))[0],
    ]
    np.testing.assert_allclose(found, found[0], rtol=1e-6)
    exact = pair_integral(part, side, size, its)
    nothing = likelihood(part.square, part.log_det)[0]
    # The grid of the integral has an edge at zero where only one side is possible.
    assert found[0] - nothing == pytest.approx(exact, abs=1e-4 if side == 0.5 else 0.01)


def test_a_third_effect_has_the_same_evidence_by_every_way():
    """Also where it changes what two effects of the model have to do with each other."""
    gram = 100.0 * np.array([[1.0, 0.6, -0.5], [0.6, 1.0, 0.4], [-0.5, 0.4, 1.0]])
    truth, sizes = np.array([0.4, -0.2, 0.3]), [0.5, 0.4, 0.6]
    square = np.array([truth @ gram @ truth + 500.0])
    part = Reduced(gram[None], (gram @ truth)[None], square, np.zeros(1))
    likelihood, every = Likelihood(500, 1e10), [Group((k,)) for k in range(3)]
    whole = part.with_effects(every, sizes)
    expected = (likelihood(whole.square, whole.log_det) + whole.log_moment(likelihood))[0]
    for last in range(3):
        rest = [k for k in range(3) if k != last]
        about = part.with_effects([every[k] for k in rest], [sizes[k] for k in rest])
        found = effect_evidence(about, likelihood, [Group((0,))], np.array([sizes[last]]))[0, 0, 0]
        assert found == pytest.approx(expected, rel=1e-9)


def test_an_effect_of_two_amplitudes_has_the_same_evidence_beside_another(problem):
    likelihood, part = Likelihood(SAMPLES, 1e6), reduced(problem)
    one, two = Group((1,)), Group((0, 3))
    both = part.with_effects([one, two], [0.7, 1.3])
    expected = (likelihood(both.square, both.log_det) + both.log_moment(likelihood))[0]
    beside = part.with_effects([one], [0.7])  # columns 0, 2, 3 are left
    found = effect_evidence(beside, likelihood, [Group((0, 2))], np.array([1.3]))[0, 0, 0]
    assert found == pytest.approx(expected, rel=1e-10)
    beside = part.with_effects([two], [1.3]).of_some([0], [0])
    found = effect_evidence(beside, likelihood, [Group((0,))], np.array([0.7]))[0, 0, 0]
    assert found == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize(
    ("counts", "sides", "tolerance"),
    [
        # The relative standard error of the mean of so many draws is about 0.004.
        ([1, 3], [0.5, 0.5], 0.02),
        ([1, 3], [0.9, 0.5], 0.02),
        # Correlations count by pairs: those of all three together are left out.
        ([1, 1, 2], [0.5, 0.5, 0.5], 0.4),
        # Of two likely sides each is conditioned on the other's by halves.
        ([1, 1, 2], [0.9, 0.1, 0.5], 0.4),
    ],
)
def test_moments_of_amplitudes_are_those_of_draws(counts, sides, tolerance):
    rng = np.random.default_rng(4)
    mean, root = np.array([0.5, -1.0, 0.3, 1.5]), rng.standard_normal((4, 4)) * 0.6
    draws = mean + rng.standard_normal((1_000_000, 4)) @ root.T
    product = np.ones(len(draws))
    for part, side in zip(np.split(draws, np.cumsum(counts)[:-1], axis=1), sides, strict=True):
        product *= (part**2).mean(axis=1)
        if part.shape[1] == 1:
            product *= 2.0 * np.where(part[:, 0] > 0, side, 1.0 - side)
    found = log_moments(counts, sides, mean, root @ root.T)
    assert float(found) == pytest.approx(np.log(product.mean()), abs=tolerance)


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_sign_halves_the_prior(problem, sign):
    part, likelihood, size = reduced(problem), Likelihood(SAMPLES, 1e9), 0.8
    found = effect_evidence(part, likelihood, [Group((1,), float(sign > 0))], np.array([size]))[
        0, 0, 0
    ]
    slope, gram = part.slope[0, 1], part.gram[0, 1, 1]

    def density(b: float) -> float:
        return 2 * moment_density(b, size) * np.exp(slope * b - 0.5 * gram * b**2)

    side = (0.0, 20.0) if sign > 0 else (-20.0, 0.0)
    at_null = likelihood(part.square, part.log_det)[0]
    # Student's density with so many degrees of freedom is normal to some 1e-7.
    expected = at_null + np.log(integrate.quad(density, *side, points=[0.0])[0])
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_remainders_are_more_variance_on_their_outputs():
    rng = np.random.default_rng(3)
    variance, smooth = rng.uniform(1, 2, 12), rng.uniform(0, 1, 12)
    output = np.repeat([0, 1], 6)
    covariances = Covariances.of(variance, smooth, output, np.array([5.0, 50.0]), 100)
    rows = rng.standard_normal((3, 12))
    products, logs = covariances.products(rows)
    unit = np.array([variance[output == b].mean() for b in (0, 1)])[output]
    for q, pattern in enumerate(covariances.patterns):
        level = np.array(
            [covariances.levels[b, k - 1] if k else 0.0 for b, k in enumerate(pattern)]
        )
        total = variance + level[output] * smooth * unit
        np.testing.assert_allclose(products[q], (rows / total) @ rows.T, rtol=1e-12)
        np.testing.assert_allclose(logs[q], np.log(total).sum(), rtol=1e-12)
    first, log = covariances.products(rows, 1)
    np.testing.assert_array_equal(first, products[:1])
    np.testing.assert_array_equal(log, logs[:1])


def test_prior_of_single_effects_adds_up_and_near_copies_share():
    families = {("a", "x"): "friction", ("b", "x"): "friction", ("c", "x"): "stiffness"}
    prior = StructurePrior()
    weights = prior.weights(families)
    assert weights["a", "x"] == weights["b", "x"] == pytest.approx(weights["c", "x"] / 2)
    assert sum(weights.values()) == pytest.approx(1.0)
    single = [
        prior.log_probability((key,), outside, weights)
        for key in families
        for outside in (False, True)
    ]
    assert np.exp(logsumexp(single)) == pytest.approx(prior.catalogue * prior.share_of(1))


@pytest.mark.parametrize("numbers", [(0.75, 0.2, 0.04, 0.01), (1.0,), (2.0, 1.0)])
def test_numbers_of_effects_have_probabilities_that_add_up(numbers):
    prior = StructurePrior(numbers=numbers)
    shares = [prior.share_of(count) for count in range(1, 40)]
    assert sum(shares) == pytest.approx(1.0)
    assert shares[0] / shares[1] == pytest.approx(
        4.0 if len(numbers) == 1 else numbers[0] / numbers[1]
    )
    # With members of equal weight five effects come about in five times as many orders as four.
    five, four = (prior.log_of_set([0.1] * count) for count in (5, 4))
    assert np.exp(five - four) == pytest.approx(0.25 * 0.1 * 5)


def test_common_laws_weigh_more_within_their_family_and_a_user_can_say_otherwise():
    names = {"coulomb_friction": "friction", "lugre_friction": "friction", "a": "stiffness"}
    families = {(name, "x"): family for name, family in names.items()}
    weights = StructurePrior().weights(families)
    assert weights["coulomb_friction", "x"] == pytest.approx(3 * weights["lugre_friction", "x"])
    assert weights["a", "x"] == pytest.approx(0.5)  # its family as a whole weighs the same
    told = StructurePrior(effects={"coulomb_friction": 1.0, "lugre_friction": 4.0})
    weights = told.weights(families)
    assert weights["lugre_friction", "x"] == pytest.approx(4 * weights["coulomb_friction", "x"])


def log_moment(positive: float, distance) -> np.ndarray:
    """Of one amplitude of unit variance."""
    mean = np.atleast_1d(np.asarray(distance, dtype=float))[None]
    return log_moments([1], [positive], mean, np.ones((1, 1, 1)))


@pytest.mark.parametrize("positive", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_a_moment_by_sides_is_that_of_a_normal_density(positive):
    for distance in (-8.0, -3.0, -0.5, 0.0, 2.0, 30.0):

        def square(x: float, d: float = distance) -> float:
            return x * x * stats.norm.pdf(x, loc=d)

        above = integrate.quad(square, 0.0, max(distance, 0.0) + 12.0, epsabs=0.0, limit=200)[0]
        below = integrate.quad(square, min(distance, 0.0) - 12.0, 0.0, epsabs=0.0, limit=200)[0]
        expected = 2 * positive * above + 2 * (1 - positive) * below
        assert np.exp(log_moment(positive, distance))[0] == pytest.approx(expected, rel=1e-7)


def test_moments_far_on_the_wrong_side_are_smooth():
    """Where the closed form ends its asymptotic series takes over."""
    distances = -np.array([99.0, 99.9, 100.1, 101.0, 1e4])
    found = log_moment(1.0, distances)
    tail = np.log(2) + np.log(2 / np.sqrt(2 * np.pi)) - 0.5 * distances**2
    np.testing.assert_allclose(found, tail - 3 * np.log(-distances), atol=1e-3)
    assert log_moment(1.0, np.array([0.0]))[0] == pytest.approx(0.0)


def test_posterior_probabilities_are_right_as_often_as_they_say():
    """Data drawn from the prior: the mean probability of what is true is that of being right."""
    rng, draws = np.random.default_rng(12), 1000
    columns = rng.standard_normal((3, 25))
    columns[1] = 0.9 * columns[0] + 0.4 * columns[1]  # two effects are alike
    likelihood, said, true = Likelihood(25, 1e6), [], []
    groups = [Group((k,)) for k in range(3)]
    for _ in range(draws):
        truth, residual = int(rng.integers(4)), rng.standard_normal(25)
        if truth < 3:
            # A moment density: the square has three degrees of freedom.
            size = rng.choice([-1, 1]) * np.sqrt(rng.chisquare(3) / 3)
            residual = residual + rng.choice(SIZES) * size * columns[truth]
        rows = np.concatenate([residual[None], columns])
        part = Reduced.of((rows @ rows.T)[None], np.zeros(1), 0, np.zeros(0))
        logs = [mean_of(row) for row in effect_evidence(part, likelihood, groups, SIZES)[0]]
        logs.append(float(likelihood(part.square, part.log_det)[0]))
        probability = np.exp(np.array(logs) - logsumexp(logs))
        said += list(probability)
        true += [k == truth for k in range(4)]
    said, true = np.array(said), np.array(true)
    for low, high in ((0.0, 0.2), (0.2, 0.5), (0.5, 0.8), (0.8, 0.95), (0.95, 1.01)):
        band = (said >= low) & (said < high)
        expected = said[band].mean()
        # Four standard errors of a proportion: once in sixteen thousand.
        error = 4 * np.sqrt(expected * (1 - expected) / band.sum()) + 1e-3
        assert abs(true[band].mean() - expected) < error


def test_a_law_like_an_effect_has_a_prior_over_its_difference_that_adds_up():
    """Where the data say nothing, its evidence is that of the effect, at each of its sizes."""
    output_of = np.zeros(8, dtype=int)
    covariances = Covariances.of(
        np.ones(8), np.linspace(1, 0.1, 8), output_of, np.array([9.0]), 100
    )
    remainders = Remainders.of(covariances, np.array([0.5, 2.0]))
    logs = np.full((len(remainders.weights), 2, SIZES.size), 1.7)
    np.testing.assert_allclose(remainders.similar(logs, SIZES), 1.7, atol=1e-12)


def test_a_set_of_two_effects_comes_about_in_either_order():
    """Two draws from all effects: pairs, and those that are drawn twice, add up to all."""
    weights, prior = np.array([0.5, 0.3, 0.2]), StructurePrior()
    pairs = [(0, 1), (0, 2), (1, 2)]
    two = prior.share_of(2)
    total = sum(np.exp(prior.log_of_set(weights[list(pair)])) for pair in pairs)
    assert total + two * np.sum(weights**2) == pytest.approx(two)


@pytest.mark.parametrize("size", [24, 25])
def test_coefficients_on_all_lines_have_the_signal_s_square(size):
    """Orthonormal, as white noise of one variance on every line supposes."""
    record = SimpleNamespace(periodic=True, periods=1, kept=None, time=np.arange(size))
    lines = RunLines(record, np.arange(size // 2 + 1))
    signal = np.random.default_rng(0).standard_normal(size) + (-1.0) ** np.arange(size)
    assert np.sum(lines.transformed(signal) ** 2) == pytest.approx(signal @ signal)


def test_scaled_tail_of_a_normal_density_is_scipy_s():
    x = np.concatenate([np.linspace(-20.0, 30.0, 501), [4.999999, 5.0, 100.0, 1e6]])
    found = np.array([_scaled_tail(one) for one in x])
    # exp(x^2) alone has a relative error of x^2 times that of a number.
    np.testing.assert_allclose(found, erfcx(x), rtol=2e-13)


def test_likely_sides_of_one_effect_say_nothing_of_another():
    """Effects that are compared in one call have the evidence that they have alone."""
    part, likelihood = two_columns(0.6, (0.4, -0.3)), Likelihood(500, 1e10)
    wide = part.gram[0][np.ix_([0, 1, 1], [0, 1, 1])], part.slope[0][[0, 1, 1]]
    every = Reduced(wide[0][None], wide[1][None], part.square, part.log_det)
    beside = every.with_effects([Group((0,), 0.9)], [0.8])
    groups = [Group((0,), 0.5), Group((1,), 0.9)]
    found = effect_evidence(beside, likelihood, groups, SIZES)
    for k, group in enumerate(groups):
        alone = effect_evidence(beside, likelihood, [group], SIZES)
        np.testing.assert_array_equal(found[:, [k]], alone)


@pytest.mark.parametrize("side", [0.5, 0.9, 0.0])
def test_evidence_is_exact_wherever_it_counts(side):
    """One largest evidence for all calls, also where the most probable side is impossible; against
    calls for each group by itself, which take nothing for small but what is so beside itself."""
    rng, likelihood = np.random.default_rng(8), Likelihood(400, 1e4)
    columns = rng.standard_normal((6, 400)) * np.geomspace(0.2, 2.0, 6)[:, None]
    rows = np.concatenate(
        [(rng.standard_normal(400) + 0.4 * columns[1:4].sum(axis=0))[None], columns]
    )
    levels = [rows @ rows.T / level for level in (1.0, 1.5, 3.0)]
    logs = np.array([0.0, 400 * np.log(1.5), 400 * np.log(3.0)])
    part = Reduced.of(np.array(levels), logs, 0, np.zeros(0))
    beside = [part.with_effects([Group((1,), side)], [size]) for size in SIZES]
    groups = [Group((0,)), Group((1,), side), Group((2,), 0.9), Group((3, 4))]
    labels, largest = [0, 1, 1, 2], Largest.of(3)
    found = np.stack(
        [effect_evidence(b, likelihood, groups, SIZES, labels, largest) for b in beside], axis=1
    )
    each = [
        effect_evidence(b.of_some([p], range(b.size)), likelihood, [group], SIZES[[t]])
        for b in beside
        for p in range(3)
        for group in groups
        for t in range(SIZES.size)
    ]
    exact = np.reshape(each, (SIZES.size, 3, len(groups), SIZES.size)).swapaxes(0, 1)
    for label in range(3):
        for some in (slice(0, 1), slice(1, None)):
            chosen = np.array(labels) == label
            ours, theirs = (logs[some][:, :, chosen] for logs in (found, exact))
            assert mean_of(ours) == pytest.approx(mean_of(theirs), abs=1e-9)


def test_columns_that_are_nearly_the_same_far_above_the_noise():
    """Round-off of their gram matrix is larger than one, which the noise adds to its diagonal."""
    size = 1e19
    gram = size * np.array([[1.0, 1.0 + 1e-15], [1.0 + 1e-15, 1.0]])
    assert np.linalg.eigvalsh(np.eye(2) + gram)[0] < -1e3
    part = Reduced(gram[None], np.zeros((1, 2)), np.array([100.0]), np.zeros(1))
    found = part.with_columns([0, 1], np.ones(2))
    # Of rank one: the determinant of I + size (1, 1)'(1, 1) is 1 + 2 size.
    # Beside a root of 4e9 round-off is 1e-6 of the other one.
    np.testing.assert_allclose(found.log_det, np.log(1.0 + 2.0 * size), atol=1e-5)
    assert np.isfinite(found.gram).all()
    groups = [Group((0,), 0.5), Group((1,), 0.5)]
    acting = part.with_effects(groups, [1.0, 1.0]).own
    assert acting is not None
    covariance = acting.covariance[:, :, 0]
    assert np.linalg.eigvalsh(covariance)[0] >= -1e-6
    # What the two do together is known, what they do apart is not.
    np.testing.assert_allclose(covariance, [[0.5, -0.5], [-0.5, 0.5]], atol=1e-5)


@pytest.mark.parametrize("least", [1.0, 1e-3])
def test_roots_of_matrices_that_round_off_made_indefinite(least):
    rng = np.random.default_rng(3)
    turn = np.linalg.qr(rng.standard_normal((4, 4)))[0]
    exact = turn @ np.diag([9.0, 4.0, least, least]) @ turn.T
    broken = exact - turn @ np.diag([0.0, 0.0, 0.0, 2.0 * least]) @ turn.T
    root = root_of(np.stack([exact, broken]), least)
    np.testing.assert_allclose(root @ np.swapaxes(root, 1, 2), [exact, exact], atol=1e-13)
    np.testing.assert_allclose(np.triu(root, 1), 0.0, atol=1e-14)
    assert (np.diagonal(root, axis1=1, axis2=2) > 0).all()
    np.testing.assert_array_equal(root_of(exact, least), np.linalg.cholesky(exact))
