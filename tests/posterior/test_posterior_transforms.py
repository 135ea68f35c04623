"""Maps to coordinates without bounds: round trips and Jacobians."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from bayesoleo.model._priors import (
    LogNormal,
    Normal,
    Transform,
    Transforms,
    TruncatedNormal,
    Uniform,
)

SUPPORTS = [(-np.inf, np.inf), (2.0, np.inf), (-np.inf, -3.0), (1e3, 5e3)]


@pytest.mark.parametrize("support", SUPPORTS)
@given(u=st.floats(-8, 8))
def test_the_way_back_ends_at_the_start(support, u):
    transform = Transform(*support)
    back = transform.unbounded(transform.natural(np.array([u])))
    # Near a bound the parameter keeps only the digits above it: exp(8) eps * 5e3 / 4e3 at worst.
    np.testing.assert_allclose(back, u, atol=1e-10)


@pytest.mark.parametrize("support", SUPPORTS)
def test_the_jacobian_is_the_derivative(support):
    transform, u, h = Transform(*support), np.linspace(-3, 3, 7), 1e-5
    slope = (transform.natural(u + h) - transform.natural(u - h)) / (2 * h)
    # Central differences: h^2 relative, and rounding eps * 5e3 / h.
    np.testing.assert_allclose(transform.derivative(u), slope, rtol=1e-6)
    np.testing.assert_allclose(transform.log_jacobian(u), np.log(np.abs(slope)), atol=1e-6)


def test_supports_choose_the_maps_and_columns_stay_apart():
    priors = (Normal(0, 1), LogNormal(2, 1), TruncatedNormal(0, 1, high=1.0), Uniform(-1, 1))
    transforms = Transforms.of(priors)
    theta = np.array([[0.3, 2.0, -0.5, 0.2], [-1.0, 0.1, 0.9, -0.9]])
    u = transforms.unbounded(theta)
    np.testing.assert_allclose(transforms.natural(u), theta, rtol=1e-13)
    each = [t.log_jacobian(u[:, a]) for a, t in enumerate(transforms.each)]
    np.testing.assert_allclose(transforms.log_jacobian(u), np.sum(each, axis=0))
