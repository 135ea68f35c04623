"""Distributions and spectra that need neither scipy.stats nor scipy.signal agree with these."""

from __future__ import annotations

import os
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from bayesoleo import _distributions as distributions
from bayesoleo.discovery._nonparametric_quantities import _rank_correlation
from bayesoleo.model._priors import TruncatedNormal

INF, NAN = np.inf, np.nan
X = np.array(
    [-INF, -1e300, -40.0, -1.0, 0.0, 1e-300, 1e-8, 0.3, 1.0, 7.0, 40.0, 1e4, 1e300, INF, NAN]
)
P = np.array(
    [-0.1, 0.0, 1e-300, 1e-100, 1e-12, 1e-6, 1e-3, 0.05, 0.4, 0.5, 0.9, 1 - 1e-9, 1.0, 1.5, NAN]
)
DF = np.array([-1.0, 0.0, 0.5, 1.0, 2.0, 7.0, 30.0, 1e4, NAN])


def agree(name, function, arguments, rtol=1e-15):
    """The same as of scipy.stats, for arrays and for numbers."""
    ours, theirs = (getattr(getattr(m, name), function) for m in (distributions, stats))
    with np.errstate(all="ignore"):
        expected = theirs(*arguments)
        found = ours(*arguments)
        np.testing.assert_allclose(found, expected, rtol=rtol, err_msg=f"{name}.{function}")
        flat = [np.ravel(a) for a in np.broadcast_arrays(*arguments)]
        for row in list(zip(*flat, strict=True))[:: max(1, flat[0].size // 50)]:
            one = ours(*(float(value) for value in row))
            assert type(one) is np.float64
            np.testing.assert_allclose(one, theirs(*row), rtol=rtol, err_msg=f"{function} {row}")


@pytest.mark.parametrize("function", ["pdf", "logpdf", "cdf", "sf"])
def test_normal(function):
    agree("norm", function, [X])


@pytest.mark.parametrize("function", ["ppf", "isf"])
def test_normal_quantiles(function):
    agree("norm", function, [P])


@pytest.mark.parametrize("function", ["cdf", "sf", "logsf"])
def test_chi_square(function):
    agree("chi2", function, [X[:, None], DF])


@pytest.mark.parametrize("function", ["ppf", "isf"])
def test_chi_square_quantiles(function):
    agree("chi2", function, [P[:, None], DF])


@pytest.mark.parametrize("function", ["cdf", "sf"])
def test_f(function):
    agree("f", function, [X[:, None, None], DF[:, None], DF])


def test_f_quantiles():
    agree("f", "ppf", [P[:, None, None], DF[:, None], DF])
    # scipy.stats takes one minus the probability, which leaves few of a small one's digits.
    large = P[~(P < 1e-3)]
    agree("f", "isf", [large[:, None, None], DF[:, None], DF], 1e-11)


@pytest.mark.parametrize(("above", "below"), [(1.0, 7.0), (2.0, 30.0), (40.0, 3.0), (5.0, 1e6)])
def test_f_exceeds_its_quantile_with_the_probability_however_small(above, below):
    p = np.array([1e-300, 1e-100, 1e-20, 1e-9, 1e-4, 0.1])
    x = distributions.f.isf(p, above, below)
    assert np.isfinite(x).all()
    np.testing.assert_allclose(distributions.f.sf(x, above, below), p, rtol=1e-10)
    # It is the inverse of the one with exchanged degrees of freedom.
    np.testing.assert_allclose(1 / distributions.f.ppf(p[3:], below, above), x[3:], rtol=1e-12)


@pytest.mark.parametrize("function", ["cdf", "sf"])
def test_student(function):
    agree("t", function, [X[:, None], DF])


@pytest.mark.parametrize("function", ["ppf", "isf"])
def test_student_quantiles(function):
    agree("t", function, [P[:, None], DF])


def test_student_density():
    for degrees in (1.0, 3.0, 30.0):
        agree("t", "logpdf", [X, degrees])


@pytest.mark.parametrize("size", [3, 40, 5000])
def test_shapes_of_samples(size):
    rng = np.random.default_rng(size)
    rows = np.stack([rng.standard_normal(size), 1e6 + rng.exponential(size=size), np.full(size, 2)])
    rows[2, 0] += 1.0
    for axis, values in ((-1, rows), (0, rows.T), (0, rows[1])):
        skewness = distributions.skewness(values, axis)
        kurtosis = distributions.kurtosis(values, axis)
        np.testing.assert_allclose(skewness, stats.skew(values, axis), rtol=1e-12)
        np.testing.assert_allclose(kurtosis, stats.kurtosis(values, axis, fisher=False), rtol=1e-12)
    assert np.isnan(distributions.skewness(np.full(size, 0.1)))
    assert np.isnan(distributions.kurtosis(np.full(size, 0.1)))


@pytest.mark.parametrize("levels", [3, 20, 10**9])
def test_rank_correlation_with_equal_values(levels):
    one, other = np.random.default_rng(1).integers(0, levels, (2, 300)).astype(float)
    other += one
    expected = abs(stats.spearmanr(one, other).statistic)
    assert _rank_correlation(one, -other) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("low", "high"), [(-INF, INF), (0.0, INF), (-INF, 1.0), (2.0, 3.5), (9.0, INF), (-20.0, -8.0)]
)
def test_quantiles_of_a_truncated_normal(low, high):
    centre, spread = 1.0, 0.5
    part = np.array([[0.0, 1e-12, 1e-3, 0.3], [0.5, 0.9, 1 - 1e-9, 1.0]])
    ends = [(end - centre) / spread for end in (low, high)]
    expected = stats.truncnorm.ppf(part, *ends, loc=centre, scale=spread)
    found = TruncatedNormal(centre, spread, low, high).quantile(part)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    assert all((a < b).all() for a, b in pairwise(found.ravel()[:, None]))


@pytest.mark.parametrize(
    "modules",
    ["['arviz_base', 'bayesoleo._workflow.closing']", "bayesoleo._worker_processes.OF_A_SEARCH"],
)
def test_a_search_begins_without_the_library(modules):
    code = (
        "import sys; from importlib import import_module; import bayesoleo._worker_processes;"
        f"[import_module(one) for one in {modules}];"
        "print(*{'scipy.stats', 'scipy.signal'} & set(sys.modules))"
    )
    said = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ
    )
    assert said.stdout.strip() == ""
