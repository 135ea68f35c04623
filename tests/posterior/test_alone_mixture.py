"""Moments of the mixture over effects that act alone, against each component written out."""

import numpy as np
import pytest

from bayesoleo.error_models._alone_mixture import Components, moments_of


def components(rng: np.random.Generator, unknowns: int, effects: int, sizes: int) -> Components:
    root = rng.standard_normal((unknowns, unknowns))
    return Components(
        rng.standard_normal(1 + effects * sizes),
        rng.standard_normal(unknowns),
        root @ root.T,
        rng.uniform(0.5, 2.0),
        rng.standard_normal((unknowns, effects)),
        rng.standard_normal((effects, sizes)),
        rng.uniform(0.0, 3.0, (effects, sizes)),
        rng.uniform(0.1, 2.0, (effects, sizes)),
    )


def written_out(one: Components) -> tuple[np.ndarray, np.ndarray]:
    """Mean (c, l) and covariance (c, l, l) of every component."""
    means, spreads = [one.mean], [one.covariance * one.variance]
    for k, direction in enumerate(one.directions.T):
        outer = np.outer(direction, direction)
        for moved, widened, variance in zip(
            one.moved[k], one.widened[k], one.variances[k], strict=True
        ):
            means.append(one.mean - moved * direction)
            spreads.append((one.covariance + widened * outer) * variance)
    return np.array(means), np.array(spreads)


@pytest.mark.parametrize("effects", [0, 1, 5])
def test_moments_are_those_of_all_components(effects):
    rng = np.random.default_rng(effects)
    found = [components(rng, 3, effects, 4) for _ in range(6)]
    weights = rng.uniform(size=(6, 1 + 4 * effects)) ** 4
    weights[2] = 0.0
    total, mean, covariance = moments_of(found, weights)
    both = [written_out(one) for one in found]
    part = weights.ravel() / weights.sum()
    means, spreads = (np.concatenate(each) for each in zip(*both, strict=True))
    centre = part @ means
    expected = np.einsum("c,clm->lm", part, spreads)
    expected += np.einsum("c,cl,cm->lm", part, means - centre, means - centre)
    assert total == pytest.approx(weights.sum(), rel=1e-12)
    # Sums of a hundred terms of order one.
    np.testing.assert_allclose(mean, centre, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(covariance, expected, rtol=1e-11, atol=1e-12)
    np.testing.assert_array_equal(covariance, covariance.T)


def test_weightless_groups_have_no_weight():
    total, mean, covariance = moments_of(
        [components(np.random.default_rng(0), 2, 3, 2)], np.zeros((1, 7))
    )
    assert total == 0.0
    assert np.all(mean == 0.0)
    assert np.all(np.isfinite(covariance))
