"""A result whose posterior was drawn by the no-U-turn sampler, on disk and in the report."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo import _schema as schema, _workflow as workflow
from bayesoleo._report.tables import diagnostics
from bayesoleo._storage.result_files import read_tree
from bayesoleo._workflow.output import search_key
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from tests.small_campaigns import damper, damper_campaign, spring_damper_force

pytest.importorskip("nutpie")
SETTINGS = Settings(quick=True, jobs=1, error_model="independent", sampler="nuts", seed=4)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    return damper_campaign(tmp_path_factory.mktemp("nuts") / "damper", spring_damper_force)


@pytest.mark.slow
def test_the_result_says_which_sampler_drew(campaign, tmp_path):
    tree = workflow.sample(campaign, damper(), SETTINGS, out=tmp_path)
    back = read_tree(tmp_path / "results.nc")
    stats = back[schema.SAMPLE_STATS]
    assert stats.attrs["sampler"] == "nuts"
    assert int(stats.attrs["divergences"]) == 0  # the model is linear
    assert not stats["diverging"].values.any()
    assert "failed" not in stats
    name = next(iter(back[schema.POSTERIOR].data_vars))
    drawn = back[schema.POSTERIOR][name].values
    np.testing.assert_array_equal(drawn, tree[schema.POSTERIOR][name].values)
    rows = dict(row[:2] for row in diagnostics(back).rows)
    assert rows["trajectories that diverged"] == "0"
    assert rows["chains × draws"].startswith("4 × ")


def test_a_search_goes_on_whatever_draws_afterwards(campaign):
    keys = [
        search_key(prepare(campaign, damper(), Settings(jobs=1, sampler=sampler)))
        for sampler in ("ensemble", "nuts")
    ]
    assert keys[0] == keys[1]
