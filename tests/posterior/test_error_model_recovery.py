"""Error models find the quantities that made the data, and ArviZ compares them."""

import arviz as az
import numpy as np
import pytest
import xarray as xr
from linear_runs import linear_runs

from bayesoleo.error_models._discrepancy import basis, spectrum
from bayesoleo.error_models._registry import ERROR_MODELS
from bayesoleo.errors import InputError
from bayesoleo.posterior import LogDensity, laplace_mixture, prior_sensitivity, sample, to_datasets

RUNS, PERIODS, COUNT = 4, 4, 200


def drawn(word, seed=0):
    """Errors (s, n) of each run, and the quantities that made them."""
    rng = np.random.default_rng(seed)
    white = [rng.standard_normal((1, COUNT)) for _ in range(RUNS)]
    time = np.arange(COUNT) / 50
    if word == "independent":
        return [0.3 * e for e in white], {"log_variance_force": 2 * np.log(0.3)}
    if word == "per-run":
        sd = [0.1, 0.2, 0.4, 0.2]
        truth = {f"log_variance_force[r{k}]": 2 * np.log(s) for k, s in enumerate(sd)}
        return [s * e for s, e in zip(sd, white, strict=True)], truth
    if word == "full":
        errors = [0.3 * rng.standard_normal((2, COUNT)) for _ in range(RUNS)]
        for e in errors:
            e[1] = 0.8 * e[0] + 0.6 * e[1]
        truth = {"correlation_force_pressure": 0.8, "log_variance_pressure": 2 * np.log(0.3)}
        return errors, truth
    if word == "correlated":
        share, tau, v = 0.8, 0.1, 0.09
        memory = np.exp(-np.abs(np.subtract.outer(time, time)) / tau)
        factor = np.linalg.cholesky(v * ((1 - share) * np.eye(COUNT) + share * memory))
        truth = {"correlated_share_force": share, "correlation_time_force": tau}
        return [(factor @ e[0])[None] for e in white], truth | {"log_variance_force": np.log(v)}
    share, length, v = 0.7, 0.1, 0.09
    weight = np.sqrt(spectrum(np.array([length]))[0])
    wave = [basis(time) @ (weight * rng.standard_normal(weight.size)) for _ in range(RUNS)]
    errors = [
        np.sqrt(v) * (np.sqrt(share) * d + np.sqrt(1 - share) * e)
        for d, e in zip(wave, white, strict=True)
    ]
    return errors, {"discrepancy_share_force": share, "discrepancy_length_force": length}


def fitted(word, problem, **options):
    density = LogDensity(problem, errors=word)
    mixture = laplace_mixture(density, problem.start[None])
    options = {"seed": 1, "quick": True, "progress": False} | options
    return density, sample(density, mixture, **options)


def problem_of(word, seed=0):
    errors, truth = drawn(word, seed)
    problem = linear_runs(errors, levels=[0.5] * RUNS, by_run=False)
    return problem, truth | {"level": 0.5, "slope": 1.5}


@pytest.mark.parametrize(
    "word",
    [
        "correlated",
        *(
            pytest.param(word, marks=pytest.mark.slow)
            for word in ERROR_MODELS
            if word[0] not in "cp" and word != "spectral"
        ),
    ],
)
def test_what_made_the_data_is_found(word):
    problem, truth = problem_of(word)
    density, samples = fitted(word, problem)
    assert samples.reached, samples.warning
    assert samples.names == density.names
    for name, value in truth.items():
        draws = samples.draws[:, :, samples.names.index(name)]
        # One draw of the truth in 30 000 lies further off.
        assert abs(draws.mean() - value) < 4 * draws.std(), name


@pytest.mark.slow
def test_intervals_are_as_wide_as_the_errors_make_them():
    # The mean of n values that remember is as good as that of fewer: ours against generalised
    # least squares with the covariance that made the data.
    problem, truth = problem_of("correlated")
    _, samples = fitted("correlated", problem, effective_size=1000, quick=False)
    _, white = fitted("independent", problem)
    time = problem.times[0]
    v = np.exp(truth["log_variance_force"])
    memory = np.exp(-np.abs(np.subtract.outer(time, time)) / truth["correlation_time_force"])
    share = truth["correlated_share_force"]
    matrix = v * ((1 - share) * np.eye(time.size) + share * memory)
    table = problem.columns(0)
    exact = np.sqrt(np.diag(np.linalg.inv(RUNS * table.T @ np.linalg.solve(matrix, table))))
    found = samples.theta.reshape(-1, 2).std(axis=0)
    # The time and the share are themselves known to a tenth, and with them the widths.
    np.testing.assert_allclose(found, exact, rtol=0.15)
    narrow = white.theta.reshape(-1, 2).std(axis=0)
    assert narrow[0] < 0.5 * found[0]


def tree_of(word, problem):
    density, samples = fitted(word, problem)
    units = {"force": "N", "level": "N", "slope": "N"}
    groups = to_datasets(samples, problem.priors, units=units, density=density)
    return xr.DataTree.from_dict(groups)


@pytest.fixture(scope="module")
def trees():
    problem, _ = problem_of("correlated")
    return {word: tree_of(word, problem) for word in ("independent", "correlated")}


# Four runs are few for a smoothed tail; what is compared here differs by hundreds.
@pytest.mark.filterwarnings("ignore:Estimated shape parameter of Pareto")
def test_leaving_runs_out_prefers_what_made_the_data(trees):
    for tree in trees.values():
        found = az.loo(tree, var_name="runs")
        assert found.n_data_points == RUNS
    table = az.compare(trees, var_name="runs")
    assert table.index[0] == "correlated"
    better = az.loo(trees["correlated"], var_name="runs").elpd
    assert better - az.loo(trees["independent"], var_name="runs").elpd > 100


def test_what_is_stored_says_what_it_is(trees, tmp_path):
    tree = trees["correlated"]
    posterior = tree["posterior"]
    assert posterior.attrs["error_model"] == "correlated"
    assert posterior["log_variance_force"].attrs["units"] == "ln((N)^2)"
    assert posterior["correlation_time_force"].attrs["units"] == "s"
    assert set(tree["prior"].data_vars) == set(posterior.data_vars) - {"log_variance_force"}
    for group in tree.children.values():
        for variable in group.data_vars.values():
            assert {"units", "long_name"} <= set(variable.attrs)
    tree.to_netcdf(tmp_path / "tree.nc", engine="h5netcdf")
    tree.to_zarr(tmp_path / "tree.zarr", consolidated=False)
    with xr.open_datatree(tmp_path / "tree.nc", engine="h5netcdf") as back:
        np.testing.assert_array_equal(back["log_prior"]["slope"], tree["log_prior"]["slope"])
    with xr.open_datatree(tmp_path / "tree.zarr", engine="zarr", consolidated=False) as back:
        assert az.summary(back).shape[0] == len(posterior.data_vars)


def test_prior_sensitivity_tells_data_from_prior(trees):
    found = prior_sensitivity(trees["independent"])
    assert found["likelihood"].sel(quantity="slope") > 0.05
    assert found["prior"].sel(quantity="slope") < 0.01
    assert set(found["diagnosis"].values) == {""}
    with pytest.raises(InputError, match="log_prior"):
        prior_sensitivity(xr.DataTree.from_dict({"posterior": trees["independent"]["posterior"]}))


def test_a_parameter_with_an_error_models_name_is_refused():
    problem, _ = problem_of("independent")
    named = type(problem)(problem.y, problem.times, by_run=False)
    with pytest.raises(InputError, match="name of an error model's quantity"):
        LogDensity(_Renamed(named))


class _Renamed:
    def __init__(self, problem):
        self.problem, self.names = problem, ("log_variance_force", "slope")

    def __getattr__(self, name):
        return getattr(self.problem, name)
