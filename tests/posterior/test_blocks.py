"""Blocks cover each run, and their densities add up to the joint log-likelihood."""

import numpy as np
import pytest
from linear_runs import linear_runs
from test_error_model_densities import Campaign

from bayesoleo.error_models import ERROR_MODELS, error_model
from bayesoleo.error_models._base import RunSamples
from bayesoleo.posterior import LogDensity, laplace_mixture, sample
from bayesoleo.posterior._datatree import MOST_BLOCKS, STRETCHES, Blocks, block_groups, cut


@pytest.mark.parametrize("word", ERROR_MODELS)
def test_densities_of_blocks_add_up(word):
    campaign = Campaign()
    model = error_model(word, campaign)
    rng = np.random.default_rng(0)
    eta = rng.normal(0, 0.5, (5, len(model.names)))
    residuals = [rng.normal(0, 1.2, (5, 2, n)) for n in campaign.lengths]
    starts = [np.array([0] if model.over_runs else [0, 7, 20]) for _ in residuals]
    found = model.of_blocks(residuals, eta, starts)
    if model.by_sums:
        sums = np.stack([np.sum(e * e, axis=2) for e in residuals], axis=1)
        joint = model.of_sums(sums, eta)
    else:
        joint = model.of_runs(residuals, eta)
    for run, blocks in enumerate(found):
        assert blocks.shape == (5, 2, len(starts[run]))
        if word != "catalogue":  # which counts what runs share with the last run
            np.testing.assert_allclose(blocks.sum(axis=(1, 2)), joint[:, run], rtol=1e-11)
    total = sum(blocks.sum(axis=(1, 2)) for blocks in found)
    np.testing.assert_allclose(total, joint.sum(axis=1), rtol=1e-11)


def test_a_block_is_a_period_or_a_stretch():
    time = np.arange(350) / 50
    periods = Blocks.of(RunSamples(time, 1.0), 100)
    np.testing.assert_array_equal(periods.starts, 50 * np.arange(7))
    np.testing.assert_array_equal(periods.period, 1 + np.arange(7))
    assert ((periods.shown >= periods.starts) & (periods.shown < periods.starts + 50)).all()
    assert len(set((periods.shown % 50).tolist())) == 7
    pairs = Blocks.of(RunSamples(time[:300], 1.0), 3)
    np.testing.assert_array_equal(pairs.starts, [0, 100, 200])
    np.testing.assert_array_equal(pairs.period, [1, 3, 5])
    stretches = Blocks.of(RunSamples(time, None), 100)
    assert len(stretches.starts) == STRETCHES
    assert len(Blocks.of(RunSamples(time, 1.0), 1).starts) == 1


@pytest.mark.slow
@pytest.mark.parametrize("word", ["full", "shared-discrepancy"])
def test_two_outputs_and_many_runs(word):
    rng = np.random.default_rng(1)
    problem = linear_runs(
        [0.1 * rng.standard_normal((2, 150)) for _ in range(3)], levels=(1.0, 2.0, 3.0)
    )
    density = LogDensity(problem, errors=word)
    start = laplace_mixture(density, np.array([[1.0, 2.0, 3.0, 1.5]]))
    draws = sample(density, start, seed=1, quick=True, progress=False)
    groups = block_groups(draws, density)
    logs = groups["log_likelihood"]
    assert list(logs.data_vars) == ["force", "pressure"]
    assert sum(len(part.starts) for part in cut(density)) == logs.sizes["block"] <= MOST_BLOCKS
    assert logs.sizes["block"] == (9 if word == "full" else 3)
    joint = sum(logs[name].sum("block") for name in logs.data_vars).values
    np.testing.assert_allclose(joint, draws.log_likelihood.sum(axis=2), rtol=1e-6)
    about = groups["posterior_predictive"]["force"] - groups["observed_data"]["force"]
    assert float(np.abs(about.mean(("chain", "draw"))).max()) < 0.5


def test_what_a_refused_proposal_repeats_is_evaluated_once(monkeypatch):
    rng = np.random.default_rng(1)
    problem = linear_runs(
        [0.1 * rng.standard_normal((2, 150)) for _ in range(2)], levels=(1.0, 2.0)
    )
    density = LogDensity(problem)
    start = laplace_mixture(density, np.array([[1.0, 2.0, 1.5]]))
    draws = sample(density, start, seed=1, quick=True, progress=False)
    blocks, rows = cut(density), list[int]()
    inner = type(problem).residuals

    def counted(self, theta, run):
        rows.append(len(theta))
        return inner(self, theta, run)

    monkeypatch.setattr(type(problem), "residuals", counted)
    groups = block_groups(draws, density, seed=3)
    flat = draws.draws.reshape(-1, draws.draws.shape[2])
    different = len(np.unique(flat, axis=0))
    assert sum(rows) == 2 * different < 2 * len(flat)
    # Each draw has what it has alone.
    of_blocks, eta = density.errors.of_blocks, density.split(density.coordinates(flat))[1]
    for draw in (0, 1, len(flat) - 1):
        left = [inner(problem, flat[draw : draw + 1, :3], run)[0] for run in range(2)]
        alone = of_blocks(left, eta[draw : draw + 1], [part.starts for part in blocks])
        for b, output in enumerate(problem.outputs):
            stored = groups["log_likelihood"][output].values.reshape(len(flat), -1)[draw]
            np.testing.assert_array_equal(stored, np.concatenate([one[0, b] for one in alone]))


def test_thinning_leaves_diagnostics_and_counts():
    problem = linear_runs([0.1 * np.random.default_rng(1).standard_normal((1, 100))], levels=(1.0,))
    density = LogDensity(problem)
    start = laplace_mixture(density, np.array([[1.0, 1.5]]))
    draws = sample(density, start, seed=1, quick=True, progress=False)
    assert draws.thinned(draws.log_density.size) is draws
    few = draws.thinned(draws.log_density.size // 3)
    np.testing.assert_array_equal(few.draws, draws.draws[:, ::3])
    assert few.failed.sum() == draws.failed.sum()
    assert len(few.failed) == few.draws.shape[1]
    np.testing.assert_array_equal(few.effective_size, draws.effective_size)
