"""Marginal likelihoods of structures against dense densities, and against their own prior."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import integrate, stats
from scipy.special import logsumexp

from bayesoleo.discovery._structure_evidence import (
    Covariances,
    Group,
    Likelihood,
    Reduced,
    by_side,
    effect_evidence,
    mean_of,
    pair_evidence,
)
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


@pytest.mark.parametrize("freedom", [4.0, 30.0, 1e5])
def test_evidence_of_an_effect_is_students_density(problem, freedom):
    likelihood = Likelihood(SAMPLES, freedom)
    found = effect_evidence(reduced(problem), likelihood, [Group((1,)), Group((0, 3))], SIZES)
    for t, size in enumerate(SIZES):
        for g, columns in enumerate([(1,), (0, 3)]):
            square, log_det = dense(problem, {k: size**2 / len(columns) for k in columns})
            expected = likelihood(np.array(square), np.array(log_det))
            np.testing.assert_allclose(found[0, g, t], expected, rtol=1e-10)


def test_students_density_is_that_of_scipy_up_to_a_constant():
    rng, freedom = np.random.default_rng(0), 6.0
    covariance = np.diag([1.0, 2.0, 0.5])
    likelihood = Likelihood(3, freedom)
    points = rng.standard_normal((5, 3))
    square = np.einsum("ni,ij,nj->n", points, np.linalg.inv(covariance), points)
    ours = likelihood(square, np.full(5, np.linalg.slogdet(covariance)[1]))
    theirs = stats.multivariate_t(shape=covariance, df=freedom).logpdf(points)
    np.testing.assert_allclose(ours - theirs, (ours - theirs)[0], atol=1e-12)


def test_a_pair_is_one_effect_after_the_other(problem):
    likelihood, part = Likelihood(SAMPLES, 50.0), reduced(problem)
    found = pair_evidence(part, likelihood, Group((1,)), Group((3,)), SIZES)
    for t, size in enumerate(SIZES):
        grown = part.with_columns([1], np.array([size**2]))
        np.testing.assert_allclose(
            found[0, t], effect_evidence(grown, likelihood, [Group((3,))], SIZES)[0, 0], rtol=1e-9
        )


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_sign_halves_the_prior(problem, sign):
    part, likelihood, size = reduced(problem), Likelihood(SAMPLES, 1e9), 0.8
    found = effect_evidence(part, likelihood, [Group((1,), float(sign > 0))], np.array([size]))[
        0, 0, 0
    ]
    slope, gram = part.slope[0, 1], part.gram[0, 1, 1]

    def density(b: float) -> float:
        return 2 * stats.norm.pdf(b, scale=size) * np.exp(slope * b - 0.5 * gram * b**2)

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
    share = prior.numbers[0] / sum(prior.numbers)
    assert np.exp(logsumexp(single)) == pytest.approx(prior.catalogue * share)


def test_common_laws_weigh_more_within_their_family_and_a_user_can_say_otherwise():
    names = {"coulomb_friction": "friction", "lugre_friction": "friction", "a": "stiffness"}
    families = {(name, "x"): family for name, family in names.items()}
    weights = StructurePrior().weights(families)
    assert weights["coulomb_friction", "x"] == pytest.approx(3 * weights["lugre_friction", "x"])
    assert weights["a", "x"] == pytest.approx(0.5)  # its family as a whole weighs the same
    told = StructurePrior(effects={"coulomb_friction": 1.0, "lugre_friction": 4.0})
    weights = told.weights(families)
    assert weights["lugre_friction", "x"] == pytest.approx(4 * weights["coulomb_friction", "x"])


@pytest.mark.parametrize("positive", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_a_likely_side_of_zero_has_its_share_of_a_normal_prior(positive):
    """A normal posterior under the prior that is flat by sides: the integral by hand."""
    for distance in (-3.0, -0.5, 0.0, 2.0, 8.0):
        weight = 2 * positive * stats.norm.cdf(distance)
        weight += 2 * (1 - positive) * stats.norm.cdf(-distance)
        assert np.exp(by_side(positive, distance)) == pytest.approx(weight, rel=1e-12)


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
            residual = residual + rng.choice(SIZES) * rng.standard_normal() * columns[truth]
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
