"""Estimates of single runs, and what they say of the scatter between runs."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.stats
import xarray as xr

from bayesoleo.errors import InputError
from bayesoleo.estimation import FunctionProblem, between_runs, estimate, estimate_each
from bayesoleo.estimation._between_runs import pooled
from bayesoleo.model._priors import Normal

#: Trials of a vaccine: cases and others, vaccinated and not (Colditz and others 1994, *JAMA* 271).
VACCINE = """
4 119 11 128 / 6 300 29 274 / 3 228 11 209 / 62 13536 248 12619 / 33 5036 47 5761
180 1361 372 1079 / 8 2537 10 619 / 505 87886 499 87892 / 29 7470 45 7232 / 17 1699 65 1600
186 50448 141 27197 / 5 2493 3 2338 / 27 16886 29 17825
"""


@pytest.mark.reference
def test_log_risk_ratios_as_published():
    """Viechtbauer (2010), *Journal of Statistical Software* 36(3), and the metafor manual.

    Restricted maximum likelihood, interval by Q-profile, mean by Knapp and Hartung.
    """
    table = np.array(VACCINE.replace("/", " ").split(), dtype=float).reshape(-1, 4)
    a, b, c, d = table.T
    ratio = np.log(a / (a + b)) - np.log(c / (c + d))
    variance = 1 / a - 1 / (a + b) + 1 / c - 1 / (c + d)
    runs = [str(k) for k in range(len(a))]
    found = pooled(ratio[:, None], variance[:, None, None], names=["ratio"], runs=runs)
    # the digits that are published
    assert found.spread[0] ** 2 == pytest.approx(0.3132, abs=5e-5)
    np.testing.assert_allclose(found.spread_interval[0] ** 2, [0.1197, 1.1115], atol=5e-5)
    assert found.mean[0] == pytest.approx(-0.7145, abs=5e-5)
    assert found.mean_sd[0] == pytest.approx(0.1808, abs=5e-5)
    assert found.p_value[0] == pytest.approx(scipy.stats.chi2.sf(152.2330, 12), rel=1e-3)


def drawn(rng, runs, error, spread):
    """Estimates of runs about a mean of (1, -2e4), and their common covariance."""
    true = np.array([1.0, -2e4]) + rng.standard_normal((runs, 2)) @ np.linalg.cholesky(spread).T
    return true, true + rng.standard_normal((runs, 2)) @ np.linalg.cholesky(error).T


SPREAD = np.array([[0.04, 600.0], [600.0, 2.5e7]])
ERROR = np.array([[0.02, -300.0], [-300.0, 9e6]])


def test_equal_errors_have_a_closed_form():
    """Then restricted maximum likelihood is the sample covariance less that of the errors."""
    _, y = drawn(np.random.default_rng(2), 40, ERROR, SPREAD)
    S = np.repeat(ERROR[None], 40, axis=0)
    found = pooled(y, S, names=["a", "b"], runs=[str(k) for k in range(40)])
    excess = np.cov(y.T) - ERROR
    assert np.linalg.eigvalsh(excess)[0] > 0
    unit = np.sqrt(np.diag(excess))
    # relative to the optimiser's gradient tolerance of 1e-5
    np.testing.assert_allclose(
        found.spread_covariance / np.outer(unit, unit), excess / np.outer(unit, unit), atol=1e-4
    )
    np.testing.assert_allclose(found.mean, y.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(found.mean_covariance, np.cov(y.T) / 40, rtol=1e-4)
    shrunken = found.mean + (y - found.mean) @ np.linalg.solve(excess + ERROR, excess)
    np.testing.assert_allclose(found.shrunken / unit, shrunken / unit, atol=1e-3)


@pytest.mark.statistical
def test_intervals_cover_and_shrinking_helps():
    """400 sets of 8 runs; 95 % intervals, so 380 +- 4.4 expected."""
    rng = np.random.default_rng(4)
    names, runs = ["a", "b"], list("abcdefgh")
    held = np.zeros((2, 2))
    before = after = 0.0
    scale = np.sqrt(np.diag(SPREAD))
    for _ in range(400):
        sizes = rng.uniform(0.2, 2.0, 8)
        true = np.array([1.0, -2e4]) + rng.standard_normal((8, 2)) @ np.linalg.cholesky(SPREAD).T
        S = sizes[:, None, None] * ERROR
        y = true + np.einsum("nij,nj->ni", np.linalg.cholesky(S), rng.standard_normal((8, 2)))
        found = pooled(y, S, names=names, runs=runs)
        truth = np.array([[1.0, scale[0]], [-2e4, scale[1]]])
        ends = np.stack((found.mean_interval, found.spread_interval), axis=1)
        held += (ends[..., 0] <= truth) & (truth <= ends[..., 1])
        before += np.sum(((y - true) / scale) ** 2)
        after += np.sum(((found.shrunken - true) / scale) ** 2)
    # three standard errors of a binomial; Student's t is a little cautious with few, unequal runs
    assert (held[:, 1] >= 380 - 13).all()
    assert (held[:, 1] <= 380 + 13).all()
    assert (held[:, 0] >= 380 - 13).all()
    assert after < 0.8 * before


def test_no_scatter_between_runs_is_none():
    rng = np.random.default_rng(6)
    y = np.array([1.0, -2e4]) + 0.3 * rng.standard_normal((9, 2)) @ np.linalg.cholesky(ERROR).T
    S = np.repeat(ERROR[None], 9, axis=0)
    found = pooled(y, S, names=["a", "b"], runs=[str(k) for k in range(9)])
    assert (found.spread < 1e-3 * np.sqrt(np.diag(ERROR))).all()
    np.testing.assert_allclose(found.shrunken, np.repeat(found.mean[None], 9, axis=0), rtol=1e-5)
    assert (found.spread_interval[:, 0] == 0).all()
    assert (found.p_value > 0.5).all()


@pytest.fixture(scope="module")
def lines():
    """Straight lines through noise, one a run, of slopes that differ."""
    rng = np.random.default_rng(1)
    x, problems = np.linspace(0, 1, 50), {}
    for label, slope in {"a": 1.0, "b": 1.4, "c": 0.7}.items():
        y = 2.0 + slope * x + 0.1 * rng.standard_normal(x.size)
        priors = [Normal(2.0, 1.0), Normal(1.0, 1.0)]
        problems[label] = FunctionProblem(
            lambda x, t: t[0] + t[1] * x, x, y, priors, ["level", "slope"]
        )
    return problems


def test_each_run_is_estimated_as_if_it_were_alone(lines):
    options = {"tolerance": 1e-6, "max_iterations": 50}
    each = estimate_each(lines, units=["N", "N/m"], jobs=2, **options)
    assert dict(each.sizes) == {"run": 3, "parameter": 2, "parameter_column": 2, "output": 1}
    for label, problem in lines.items():
        alone = estimate(problem, "mbe", **options)
        run = each.sel(run=label)
        np.testing.assert_array_equal(run["estimate"], alone.theta)
        np.testing.assert_array_equal(run["covariance_likelihood"], alone.covariance_likelihood)
        residual = problem.evaluate(alone.theta).residual[0]
        assert float(run["rms"].item()) == pytest.approx(residual.std())
        assert float(run["largest"].item()) == np.abs(residual).max()
        assert str(run["status"].values) == "converged"
    view = between_runs(each)
    assert view.runs == ("a", "b", "c")
    assert view.p_value[1] < 1e-6 < view.p_value[0]
    assert "slope" in str(view)
    assert view.to_dataset()["shrunken"].sel(run="b", parameter="slope") == view.shrunken[1, 1]


def test_failed_runs_are_left_out_of_the_view(lines):
    each = estimate_each(lines)
    each["status"].loc[{"run": "b"}] = "not_finite"
    assert between_runs(each).runs == ("a", "c")
    each["status"].loc[{"run": "c"}] = "not_finite"
    with pytest.raises(InputError, match="needs two runs that were estimated"):
        between_runs(each)


def test_what_cannot_be_compared_is_refused(lines):
    other = FunctionProblem(
        lambda x, t: t[0] * x, np.arange(3.0), [1.0, 2.0, 4.0], [Normal(1.0, 1.0)]
    )
    with pytest.raises(InputError, match=r"run d: this run has other unknowns.*level, slope, y"):
        estimate_each({**lines, "d": other})
    with pytest.raises(InputError, match="no run to estimate from"):
        estimate_each({})
    with pytest.raises(
        InputError, match=r'would count it once a run.*estimate each run with "mbe"'
    ):
        between_runs(estimate_each(lines, "be"))
    with pytest.raises(InputError, match=r"run x, key a: .*not positive definite"):
        pooled(np.zeros((2, 1)), np.zeros((2, 1, 1)), names=["a"], runs=["x", "y"])


def vague(each, run, parameter):
    """The estimates as if the data of one run said next to nothing of one parameter."""
    each = each.copy(deep=True)
    factor = xr.ones_like(each["estimate"])
    factor.loc[{"run": run, "parameter": parameter}] = 1e9
    each["covariance_likelihood"] *= factor * factor.rename(parameter="parameter_column")
    return each


def test_a_run_that_does_not_determine_a_parameter_is_left_out_and_named(lines):
    each = estimate_each(lines)
    view, known = between_runs(vague(each, "b", "slope")), between_runs(each.sel(run=["a", "c"]))
    assert view.left_out == ("run b, does not determine slope",)
    assert "left out: run b" in str(view)
    assert view.to_dataset().attrs["left_out"] == view.left_out[0]
    np.testing.assert_array_equal(view.mean, known.mean)


def test_a_parameter_that_most_runs_leave_open_is_left_out_and_named(lines):
    each = estimate_each(lines)
    view = between_runs(vague(vague(each, "b", "slope"), "c", "slope"))
    assert view.names == ("level",)
    assert view.runs == ("a", "b", "c")
    assert view.left_out == ("parameter slope, not determined by run b, c",)
    # Each slope that is open is marginal: the levels are what they were.
    level = each["estimate"].sel(parameter="level").values
    assert level.min() < view.mean[0] < level.max()


def test_what_a_run_does_not_show_at_all_costs_it_nothing_else():
    """One run at rest has no slope; its level counts as it would without the slope."""
    rng = np.random.default_rng(5)
    problems = {}
    for run, level, reach in (("a", 1.0, 1.0), ("b", 1.2, 0.0), ("c", 0.9, 0.0)):
        x = np.linspace(-reach, reach, 60)
        y = level + 2.0 * x + 0.05 * rng.standard_normal(x.size)
        priors = [Normal(1.0, 1.0), Normal(2.0, 1.0)]
        problems[run] = FunctionProblem(
            lambda x, t: t[0] + t[1] * x, x, y, priors, ["level", "slope"]
        )
    view = between_runs(estimate_each(problems))
    assert view.names == ("level",)
    assert view.runs == ("a", "b", "c")
    assert view.left_out == ("parameter slope, not determined by run b, c",)


def test_what_is_lacking_is_said_where_nothing_can_be_compared(lines):
    each = estimate_each(lines)
    for run in "abc":
        for parameter in ("level", "slope"):
            each = vague(each, run, parameter)
    with pytest.raises(InputError, match="parameter level, not determined by run a, b, c; param"):
        between_runs(each)
    each["covariance_likelihood"].loc[{"run": ["a", "b"]}] = np.nan
    with pytest.raises(InputError, match="run a, does not tell level, slope apart"):
        between_runs(each)


def test_units_of_any_size_are_compared_alike():
    """Covariances are judged in their own units: newtons beside nanometres, and one vague run."""
    y = np.array([[1.0, 2e-9], [1.1, 2.2e-9], [0.9, 1.9e-9], [500.0, 3e-9]])
    R = np.array([[1.0, 0.4], [0.4, 1.0]])
    S = np.array([np.outer(u, u) * R for u in ([0.1, 1e-10],) * 3 + ([1e9, 1e-10],)])
    runs = list("abcd")
    view = pooled(y, S, names=["force", "gap"], runs=runs)
    # the vague run moves the mean of the force by nothing
    three = pooled(y[:3], S[:3], names=["force", "gap"], runs=runs[:3])
    assert view.mean[0] == pytest.approx(three.mean[0], abs=0.05)


def test_a_run_given_all_is_known_as_its_normal_posterior_says():
    """With the spread held, runs and their mean are normal together; the mean's prior is flat."""
    _, y = drawn(np.random.default_rng(5), 5, ERROR, SPREAD)
    S = np.repeat(ERROR[None], 5, axis=0) * np.array([0.3, 1.0, 1.0, 2.0, 4.0])[:, None, None]
    found = pooled(y, S, names=["a", "b"], runs=list("vwxyz"))
    unit = np.sqrt(np.diag(ERROR))
    T = np.linalg.inv(found.spread_covariance / np.outer(unit, unit))
    precision, right = np.zeros((12, 12)), np.zeros(12)
    for k in range(5):
        own, rows = np.linalg.inv(S[k] / np.outer(unit, unit)), slice(2 * k, 2 * k + 2)
        precision[rows, rows] += own + T
        precision[rows, 10:] -= T
        precision[10:, rows] -= T
        precision[10:, 10:] += T
        right[rows] = own @ (y[k] / unit)
    covariance = np.linalg.inv(precision)
    np.testing.assert_allclose(found.shrunken / unit, (covariance @ right)[:10].reshape(5, 2))
    sd = np.sqrt(np.diag(covariance))[:10].reshape(5, 2)
    np.testing.assert_allclose(found.shrunken_sd / unit, sd, rtol=1e-6)


def test_a_new_run_scatters_by_its_spread_and_by_the_error_of_the_mean():
    """Without errors of the runs: as a further value of a normal sample."""
    y = np.array([[1.0], [1.4], [0.7], [1.3]])
    found = pooled(y, np.full((4, 1, 1), 1e-14), names=["a"], runs=list("wxyz"))
    expected = np.std(y, ddof=1) * np.sqrt(1 + 1 / 4)
    assert found.new_run_sd[0] == pytest.approx(expected, rel=1e-5)
