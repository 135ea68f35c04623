"""Every function of ArviZ that applies works on a sampled result as it is."""

from __future__ import annotations

import arviz as az
import numpy as np
import pytest
from small_campaigns import damper, damper_campaign

from bayesoleo import _schema as schema, _workflow as workflow
from bayesoleo._storage.result_files import read_tree
from bayesoleo._workflow.settings import Settings

plt = pytest.importorskip("matplotlib.pyplot")

#: Plots that do not apply, and why.
NOT_APPLICABLE = {
    "plot_collection": "a module",
    "plot_matrix": "a module",
    "plot_ecdf_pit": "of simulation-based calibration, a study of its own",
    "plot_energy": "of Hamiltonian Monte Carlo; emcee has no energy",
    "plot_ppc_censored": "of survival times",
    "plot_ppc_pava": "of binary and categorical outputs",
    "plot_ppc_pava_residuals": "of binary and categorical outputs",
    "plot_loo_pava": "of binary and categorical outputs",
    "plot_ppc_rootogram": "of counts",
}
#: What else a plot needs to be told.
ARGUMENTS = {
    "plot_bf": {"var_names": "stiffness", "ref_val": 1000.0},
    "plot_lm": {"x": "displacement", "y": "force"},
    "plot_pair_focus": {"focus_var": "stiffness"},
}
PLOTS = [n for n in dir(az) if n.startswith("plot_") and n not in NOT_APPLICABLE]
SHARED = (schema.OBSERVED_DATA, schema.POSTERIOR_PREDICTIVE, schema.LOG_LIKELIHOOD)


def sampled(folder, **settings):
    return workflow.sample(
        folder, damper(), Settings(quick=True, jobs=1, effects=(), seed=5, **settings)
    )


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign")
    damper_campaign(folder)
    return folder


@pytest.fixture(scope="module")
def tree(campaign, tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    settings = Settings(quick=True, jobs=1, effects=(), seed=5, error_model="independent")
    workflow.sample(campaign, damper(), settings, out=out)
    return read_tree(out / "results.nc")


@pytest.fixture(scope="module")
def correlated(campaign):
    return sampled(campaign, error_model="correlated")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", PLOTS)
def test_a_plot_of_arviz_works_on_the_result(name, tree, correlated):
    about = ARGUMENTS.get(name, {})
    first: object = tree
    if name == "plot_khat":
        first = az.loo(tree, pointwise=True)
    elif name == "plot_compare":
        first = az.compare({"independent": tree, "correlated": correlated})
    try:
        assert getattr(az, name)(first, **about) is not None
    finally:
        plt.close("all")


def test_plots_that_do_not_apply_are_still_there():
    assert set(NOT_APPLICABLE) <= set(dir(az))


def test_observations_predictions_and_densities_have_the_same_blocks(tree):
    observed, drawn, logs = (tree[group].to_dataset() for group in SHARED)
    assert set(observed.data_vars) == set(drawn.data_vars) == set(logs.data_vars) == {"force"}
    for name in (schema.BLOCK, schema.RUN, schema.PERIOD):
        for other in (drawn, logs):
            np.testing.assert_array_equal(observed[name], other[name])
    assert observed["force"].dims == (schema.BLOCK,)
    assert drawn["force"].dims == logs["force"].dims == (schema.CHAIN, schema.DRAW, schema.BLOCK)
    for data in (observed, drawn, logs):
        assert np.isfinite(data["force"]).all()
    # Each block shows a sample that was measured, at the time that is said.
    records = tree[schema.RECORDS].to_dataset()
    constant = tree[schema.CONSTANT_DATA].to_dataset()
    for k, run in enumerate(observed[schema.RUN].values):
        one = records.sel(run=str(run))
        there = int(np.nanargmin(np.abs(one[schema.TIME] - constant[schema.TIME][k]).values))
        assert float(one["force"][there]) == float(observed["force"][k])
        assert float(one["displacement"][there]) == float(constant["displacement"][k])
        assert int(np.floor(one[schema.PHASE][there] + 1e-6)) + 1 == int(observed["period"][k])


@pytest.mark.filterwarnings("ignore")
def test_leaving_blocks_out_prefers_the_model_that_made_the_data(tree, correlated):
    assert az.loo(tree).n_data_points == tree[schema.OBSERVED_DATA].sizes[schema.BLOCK] == 24
    table = az.compare({"independent": tree, "correlated": correlated})
    assert table.index[0] == "correlated"  # friction is missing: its error is alike over a while
    assert "period" in tree[schema.LOG_LIKELIHOOD].attrs["data_points"]


def test_predictions_cover_the_measured_samples(tree):
    drawn = tree[schema.POSTERIOR_PREDICTIVE]["force"]
    low, high = drawn.quantile([0.005, 0.995], (schema.CHAIN, schema.DRAW)).values
    measured = tree[schema.OBSERVED_DATA]["force"].values
    assert np.mean((low <= measured) & (measured <= high)) > 0.8
