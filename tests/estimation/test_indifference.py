"""Regions of equal fit: ellipses where the model is linear, shadows and open ends where not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from bayesoleo.errors import InputError
from bayesoleo.estimation import FunctionProblem, estimate
from bayesoleo.estimation._identifiability import as_product, in_words, principal_axes
from bayesoleo.estimation._indifference_regions import indifference
from bayesoleo.estimation._profile_likelihood import LogLikelihoodRatio, profile
from bayesoleo.model._priors import Normal, Uniform

SIZE = 30


@pytest.fixture(scope="module")
def line():
    rng = np.random.default_rng(3)
    design = rng.normal(size=(SIZE, 3)) @ [[1, 0.5, 0], [0, 1, 0.8], [0, 0, 1]]
    y = design @ [1.0, -2.0, 3.0] + rng.normal(size=SIZE)
    problem = FunctionProblem(lambda x, t: x @ t, design, y, [Normal(0.0, 10.0)] * 3, list("abc"))
    return problem, design, estimate(problem, tolerance=1e-10)


@pytest.fixture(scope="module")
def product():
    """Only the product of two parameters is seen (Verbeek 1993, eq. 2.45)."""
    x = np.linspace(0.0, 1.0, 40)
    y = 6.0 * x + 0.01 * np.random.default_rng(1).normal(size=40)
    priors = [Normal(2.0, 1.0), Normal(3.0, 1.0)]
    problem = FunctionProblem(lambda x, t: t[0] * t[1] * x, x, y, priors, ["area", "pressure"])
    return problem, estimate(problem, "be", tolerance=1e-10)


def test_contours_of_a_linear_model_are_known(line):
    problem, design, point = line
    found = indifference(problem, point, [("a", "c")], level=0.9, points=24)
    epsilon = stats.chi2.isf(0.1, 2) / 2
    assert found.data.attrs["epsilon"] == pytest.approx(epsilon)
    normal = design.T @ design
    shadow = np.linalg.inv(np.linalg.inv(normal)[np.ix_([0, 2], [0, 2])])
    blocks = {"conditional": normal[np.ix_([0, 2], [0, 2])], "profiled": shadow}
    for section, block in blocks.items():
        away = found["contour"].sel(section=section)[0].values - point.theta[[0, 2]]
        square = np.einsum("ai,ij,aj->a", away, block, away)
        fall = 0.5 * SIZE * np.log1p(square / (SIZE * point.variance[0]))
        np.testing.assert_allclose(fall, epsilon, rtol=2e-3)
        away = found["ellipse"].sel(section=section)[0].values - point.theta[[0, 2]]
        square = np.einsum("ai,ij,aj->a", away, block, away)
        np.testing.assert_allclose(0.5 * square / point.variance[0], epsilon, rtol=1e-9)


def test_small_regions_are_ellipses():
    """Taylor's order of error: halving the region halves its relative departure."""
    x = np.linspace(0.0, 3.0, 25)
    y = 2.0 * np.exp(-1.5 * x) + 0.1 * np.random.default_rng(4).normal(size=25)
    priors = [Normal(2.0, 1.0), Normal(1.5, 0.5)]
    problem = FunctionProblem(lambda x, t: t[0] * np.exp(-t[1] * x), x, y, priors)
    point = estimate(problem, tolerance=1e-12)
    departures = []
    for epsilon in (0.25, 0.0625):
        found = indifference(problem, point, epsilon=epsilon, exact=True)
        fall = LogLikelihoodRatio(problem, point)
        departures.append(np.abs(fall(found["ellipse"].values[0, 0]) / epsilon - 1).max())
        # a thousandth of the radius is two of the fall
        np.testing.assert_allclose(fall(found["contour"].values[0, 0]), epsilon, rtol=3e-3)
    # the next term of the series is odd, so the departure follows the radius
    assert departures[0] / departures[1] == pytest.approx(2.0, abs=0.2)


def test_shadow_of_the_region_is_the_profile(line):
    problem, _, point = line
    epsilon = stats.chi2.isf(0.05, 1) / 2
    found = indifference(problem, point, [("a", "b")], epsilon=epsilon, points=40)
    contour = found["contour"].sel(section="profiled").values[0]
    limits = profile(problem, point, ["a", "b"])
    # 20 nodes dense at the ends miss the extremes by less than a hundredth of the half width
    np.testing.assert_allclose(contour.min(axis=0), limits["low"], rtol=3e-3)
    np.testing.assert_allclose(contour.max(axis=0), limits["high"], rtol=3e-3)


def test_degenerate_product_is_named(product):
    problem, point = product
    axes = principal_axes(problem, point)
    assert float(axes["information"][0]) < 1e-6 < 1e3 < float(axes["information"][1])
    assert "not determined by the data" in str(axes).splitlines()[1]
    relative = principal_axes(problem, point, scale="value")
    assert relative["words"].values[1] in {
        "area^0.71 · pressure^0.71",
        "pressure^0.71 · area^0.71",
    }
    # the product is known as well as the slope of the line
    sd = np.sqrt(point.variance[0] / np.sum(problem._x**2)) / np.prod(point.theta)
    assert float(relative["sd"][1]) == pytest.approx(sd / np.sqrt(2), rel=1e-6)


def test_region_of_a_product_is_a_bent_valley(product):
    problem, point = product
    found = indifference(problem, point, points=24)
    contour = found["contour"].values[0, 0]
    assert np.isfinite(contour).all()  # the prior closes it
    area, pressure = contour.T
    drop = LogLikelihoodRatio(problem, point)
    np.testing.assert_allclose(drop(contour), found.data.attrs["epsilon"], rtol=5e-3)
    assert np.ptp(area * pressure) < 0.1 * min(np.ptp(area), np.ptp(pressure))
    open_ended = indifference(problem, point, kind="likelihood", points=24)
    assert np.isinf(open_ended["contour"].values).any()
    assert "open" in str(open_ended)


def test_limits_of_the_support_end_a_region():
    x = np.linspace(0.0, 1.0, 20)
    y = 0.02 * x + 1.0 + 0.1 * np.random.default_rng(1).normal(size=20)
    priors = [Uniform(0.0, 5.0), Normal(1.0, 1.0)]
    problem = FunctionProblem(lambda x, t: t[0] * x + t[1], x, y, priors, ["slope", "level"])
    point = estimate(problem, start=[0.05, 1.0])
    contour = indifference(problem, point)["contour"].values[0, 0]
    assert np.isfinite(contour).all()
    assert contour[:, 0].min() == pytest.approx(0.0, abs=2e-3)


def test_words_leave_small_parts_out():
    vector = np.array([-0.39, 0.92, 0.02])
    assert in_words(vector, ["volume", "area", "mass"]) == "0.92 area − 0.39 volume"
    assert in_words(-vector, ["volume", "area", "mass"]) == "−0.92 area + 0.39 volume".replace(
        "−0.92", "− 0.92"
    )
    assert as_product(vector, ["volume", "area", "mass"]) == "area^0.92 · volume^−0.39"


def test_text_names_axes_and_reach(line):
    problem, _, point = line
    text = str(indifference(problem, point, [("a", "b")], epsilon=1e-3, points=12))
    assert "a and b, profiled: reaches a -1.00 to +1.00" in text
    assert len(text.splitlines()) == 4 + 1 + 1 + 2


def test_bad_requests_are_named(line, product):
    problem, _, point = line
    with pytest.raises(InputError, match=r"no such unknown .*one of: a, b, c"):
        indifference(problem, point, [("a", "z")])
    with pytest.raises(InputError, match="use 'conditional' or 'profiled'"):
        indifference(problem, point, sections=["slice"])
    with pytest.raises(InputError, match="of another problem"):
        indifference(problem, product[1])
    level = FunctionProblem(lambda x, t: t[0] + 0 * x, np.ones(3), np.zeros(3), [Normal(0, 1)])
    zero = estimate(level)
    with pytest.raises(InputError, match="use scale='prior'"):
        principal_axes(level, zero, scale="value")
