"""Parameters given a structure, against the integral over its effects' amplitudes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

from bayesoleo.discovery._limited_parameters import Coordinates
from bayesoleo.discovery._parameter_section import _heaviest
from bayesoleo.discovery._structure_columns import Group, Likelihood
from bayesoleo.discovery._structure_parameters import LIGHTEST, GivenStructure
from bayesoleo.model import Normal

SAMPLES, SIZE = 400, 0.2
STANDARD = Coordinates.of([Normal(0.0, 1.0)], np.zeros(1), np.ones(1), np.zeros(1))


def columns(own: float, effects: int, seed: int) -> np.ndarray:
    """One unknown and effects of which the unknown cannot make this part; unit mean square."""
    basis = np.linalg.qr(np.random.default_rng(seed).standard_normal((SAMPLES, 1 + effects)))[0].T
    like, rest = np.sqrt(1.0 - own), np.sqrt(own)
    rows = [basis[0], *(like * basis[0] + rest * other for other in basis[1:])]
    return np.sqrt(SAMPLES) * np.array(rows)


def of_residual(residual: np.ndarray, rows: np.ndarray, sides: tuple[float, ...]) -> GivenStructure:
    """About an estimate of zero, with a prior of unit deviation, under known noise."""
    every = np.concatenate([residual[None], rows])
    effects = tuple(Group((1 + k,), side) for k, side in enumerate(sides))
    gram = (every @ every.T)[None]
    return GivenStructure(
        ("theta",), STANDARD, np.zeros(1), np.eye(1), gram, np.zeros(1), effects, 0,
        np.zeros(1), [(0, None, 1.0)], np.array([SIZE]), Likelihood(SAMPLES, 1e12),
    )  # fmt: skip


def moment_density(b: np.ndarray) -> np.ndarray:
    normal = SIZE / np.sqrt(3.0)
    return (b / normal) ** 2 * stats.norm.pdf(b, scale=normal)


def exact(residual: np.ndarray, rows: np.ndarray, sides: tuple[float, ...]) -> tuple[float, ...]:
    """Mean, deviation, and limits of the interval by a grid over all unknowns."""
    theta = np.linspace(-1.5, 2.5, 401)
    b = np.linspace(-1.2, 1.2, 401 if len(sides) == 1 else 81)
    axes = np.meshgrid(theta, *[b] * len(sides), indexing="ij")
    gram, slope = rows @ rows.T, rows @ residual
    log = stats.norm.logpdf(axes[0]) + sum(s * a for s, a in zip(slope, axes, strict=True))
    log = log - 0.5 * sum(
        gram[i, j] * axes[i] * axes[j] for i in range(len(axes)) for j in range(len(axes))
    )
    density = np.exp(log - log.max())
    for amplitude, side in zip(axes[1:], sides, strict=True):
        density *= moment_density(amplitude) * np.where(amplitude > 0, side, 1.0 - side)
    density = density.reshape(theta.size, -1).sum(axis=1)
    density /= density.sum()
    mean = float(density @ theta)
    below = np.cumsum(density) - 0.5 * density
    sd = float(np.sqrt(density @ (theta - mean) ** 2))
    return mean, sd, *(float(np.interp(chance, below, theta)) for chance in (0.05, 0.95))


@pytest.mark.slow
@pytest.mark.parametrize("sides", [(0.5,), (0.9,), (1.0,), (0.5, 0.5), (0.9, 0.5)])
@pytest.mark.parametrize("own", [0.05, 0.5])
@pytest.mark.parametrize("size", [0.0, 1.5, 4.0])
def test_a_parameter_given_a_structure_is_that_of_the_integral(size, own, sides):
    """Effects of some standard deviations of the part that the parameter cannot make."""
    rows = columns(own, len(sides), 7)
    amplitudes = np.full(len(sides), size / np.sqrt(SAMPLES * own))
    noise = np.random.default_rng(3).standard_normal(SAMPLES)
    residual = 0.05 * rows[0] + amplitudes @ rows[1:] + noise
    (mixture,) = of_residual(residual, rows, sides).mixtures()
    found = mixture.summary()
    mean, sd, low, high = exact(residual, rows, sides)
    # A normal density on each side of zero instead of one with the moment: a tenth of a deviation.
    assert found.mean == pytest.approx(mean, abs=0.02 * sd)
    assert found.sd == pytest.approx(sd, rel=0.02)
    assert (found.low, found.high) == pytest.approx((low, high), abs=0.1 * sd)


def test_intervals_cover_where_data_say_little_of_the_structure():
    """Draws from the prior: one effect acts, of which the parameter makes nine tenths."""
    rng, inside, draws = np.random.default_rng(11), 0, 200
    rows = columns(0.1, 1, 7)
    for _ in range(draws):
        theta = rng.standard_normal()
        amplitude = SIZE / np.sqrt(3.0) * stats.chi.rvs(3, random_state=rng) * rng.choice([-1, 1])
        residual = theta * rows[0] + amplitude * rows[1] + rng.standard_normal(SAMPLES)
        (mixture,) = of_residual(residual, rows, (0.5,)).mixtures()
        found = mixture.summary()
        inside += found.low < theta < found.high
    # Three standard errors of a proportion of 0.9.
    assert inside / draws == pytest.approx(0.9, abs=3 * np.sqrt(0.09 / draws))


@pytest.mark.parametrize("size", [3.0, 3e3, 1e9])
def test_a_sign_that_physics_forbids_has_no_evidence(size):
    """The more the data want it, the less there is; in the end none, which is no error."""
    rows = columns(0.3, 1, 3)
    noise = np.random.default_rng(4).standard_normal(SAMPLES)
    wanted, forbidden = (
        of_residual(sign * size * rows[1] + noise, rows, (1.0,)) for sign in (1.0, -1.0)
    )
    power, cells = np.ones(1), _heaviest(wanted)
    assert np.isfinite(wanted.log_evidence(cells, power)[0])
    cells = _heaviest(forbidden)
    assert len(cells) >= 1
    log, mean, sd = forbidden.log_evidence(cells, power)
    assert log < wanted.log_evidence(cells, power)[0] - 10.0
    assert mean.shape == sd.shape == (1,)
    if size > 1e3:
        assert log == -np.inf
        assert np.isnan(mean).all()


@pytest.mark.parametrize("size", [0.0, 1.0, 30.0, 3000.0])
@pytest.mark.parametrize("sides", [(0.5,), (0.5, 1.0), (0.5, 0.5, 0.0)])
def test_parts_that_are_left_out_by_bounds_weigh_nothing(size, sides):
    """No part weighs more than its bound says, and those that count are those of all cells."""
    rows = columns(0.3, len(sides), 3)
    residual = size * rows[1:].sum(axis=0) + np.random.default_rng(4).standard_normal(rows.shape[1])
    found = of_residual(residual, rows, sides)
    for bound, cell in found._bounds():
        assert max((log for log, _, _ in found.each([cell])), default=-np.inf) < bound
    every = list(found.each(found.cells()))
    if not every:  # three effects with one that is never below zero, and is
        assert sides == (0.5, 0.5, 0.0)
        assert found.normals() == []
        return
    logs, means, _ = zip(*every, strict=True)
    weights = np.exp(logs - logsumexp(logs))
    order = np.argsort(-weights)
    counted = order[weights[order] > LIGHTEST]
    normals = sorted(found.normals(), key=lambda part: -part.weight)
    assert len(normals) == len(counted)
    # What was left out altogether is less than one in a million.
    np.testing.assert_allclose([part.weight for part in normals], weights[counted], rtol=1e-5)
    mean = sum(part.weight * part.mean for part in normals)
    np.testing.assert_allclose(
        mean, sum(weights[k] * means[k] for k in counted), rtol=1e-5, atol=1e-9
    )


def test_moments_of_some_coefficients_are_those_of_all():
    """Only the last rows of a root are solved for: against the inverse of the whole matrix."""
    rows = columns(0.3, 2, 5)
    found = of_residual(np.random.default_rng(6).standard_normal(rows.shape[1]), rows, (0.5, 0.5))
    precision = np.linspace(0.5, 2.0, 3)
    log, mean, covariance, noise = found._posterior(0, precision, np.array([2, 0]))
    everything = found._posterior(0, precision, np.arange(3))
    assert (log, noise) == pytest.approx((everything[0], everything[3]), rel=1e-12)
    np.testing.assert_allclose(mean, everything[1][[2, 0]], rtol=1e-9)
    np.testing.assert_allclose(covariance, everything[2][np.ix_([2, 0], [2, 0])], rtol=1e-9)
    gram = found.products[0]
    stated = precision * np.where(np.arange(3) < found.offset.size, noise, 1.0)
    inverse = np.linalg.inv(gram[1:, 1:] + np.diag(stated))
    np.testing.assert_allclose(everything[2], inverse, rtol=1e-9)
