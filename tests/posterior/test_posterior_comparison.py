"""A posterior against its point, by a normal one for which all ratios are known."""

import numpy as np
import pytest
import xarray as xr

from bayesoleo import plots
from bayesoleo.errors import ResultsError
from bayesoleo.estimation import FunctionProblem, estimate, indifference, sampling_distribution
from bayesoleo.model import Normal
from bayesoleo.plots._posterior import inside
from bayesoleo.posterior import (
    LogDensity,
    compare,
    comparison_text,
    laplace_mixture,
    sample,
    to_datasets,
)


@pytest.fixture(scope="module")
def tree():
    x = np.linspace(-1, 1, 400)
    y = 1.0 + 2.0 * x + 0.3 * np.random.default_rng(0).standard_normal(x.size)
    problem = FunctionProblem(
        lambda x, p: p[0] + p[1] * x, x, y, [Normal(0, 9), Normal(0, 9)], ["level", "slope"]
    )
    point = estimate(problem, "be")
    density = LogDensity(problem)
    start = laplace_mixture(density, point.theta[None])
    samples = sample(density, start, effective_size=4000, seed=1, progress=False)
    groups = to_datasets(samples, problem.priors, density=density)
    groups["point"] = point.to_dataset(units=["1", "1"])
    groups["indifference"] = indifference(problem, point).data
    groups["sampling_distribution"] = sampling_distribution(
        problem, point, replications=2000, seed=2
    ).data
    return xr.DataTree.from_dict(groups)


def test_a_linear_normal_problem_has_ratios_of_one(tree):
    found = compare(tree)
    # Standard errors: 1 / sqrt(2 * 4000) of the draws, 1 / sqrt(2 * 2000) of the simulations.
    np.testing.assert_allclose(found["sd_ratio"], 1.0, atol=0.08)
    np.testing.assert_allclose(found["variance_ratio"][:2], 1.0, atol=0.2)
    assert np.isnan(found["variance_ratio"].sel(reference="indifference")).all()
    np.testing.assert_allclose(found["shift"], 0.0, atol=4 / np.sqrt(4000))
    np.testing.assert_allclose(found["skewness"], 0.0, atol=0.2)


def test_the_table_shows_what_there_is_to_compare_with(tree):
    found = compare(tree)
    head, level, slope, *rest = comparison_text(found).splitlines()
    assert head.split("  ")[0] == "parameter"
    assert "sd / indifference" in head
    assert level.split()[1:] == [
        f"{float(found[name].sel(parameter='level', **which)):.2f}"
        for name, which in (
            ("shift", {}),
            ("sd_ratio", {"reference": "linearised"}),
            ("sd_ratio", {"reference": "monte carlo"}),
            ("sd_ratio", {"reference": "indifference"}),
            ("skewness", {}),
        )
    ]
    assert slope.startswith("slope")
    assert [line.split(" one")[0] for line in rest] == [
        "variance over the linearised",
        "variance over the monte carlo",
    ]
    few = xr.DataTree.from_dict({name: tree[name].to_dataset() for name in ("point", "posterior")})
    assert "monte carlo" not in comparison_text(compare(few))


def test_what_is_not_there_is_not_compared_with(tree):
    few = xr.DataTree.from_dict({name: tree[name].to_dataset() for name in ("point", "posterior")})
    found = compare(few)
    assert np.isnan(found["sd_ratio"].sel(reference=["monte carlo", "indifference"])).all()
    with pytest.raises(ResultsError, match="needs the group 'point'"):
        compare({"posterior": tree["posterior"].to_dataset()})


def test_the_region_holds_what_a_normal_posterior_would(tree, tmp_path):
    data = tree["indifference"].to_dataset().isel(section=-1, pair=0)
    names = [str(name) for name in data["name"].values]
    draws = np.column_stack([tree["posterior"][name].values.ravel() for name in names])
    assert inside(data["contour"].values, draws) == pytest.approx(0.95, abs=0.02)
    assert np.isnan(inside(np.full((4, 2), np.inf), draws))
    figure = plots.pairs(tree)
    figure.savefig(tmp_path / "pairs.png", dpi=50)
    (panel,) = figure.axes
    assert panel.get_title(loc="left").endswith("(95 %)")


def test_pairs_need_both_groups(tree):
    with pytest.raises(ResultsError, match="indifference"):
        plots.pairs(xr.DataTree.from_dict({"posterior": tree["posterior"].to_dataset()}))
