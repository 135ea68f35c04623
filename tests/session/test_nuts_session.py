"""The no-U-turn sampler asked for in a session."""

from __future__ import annotations

import numpy as np
import pytest

import bayesoleo as bo
from bayesoleo import _schema as schema
from bayesoleo.errors import InputError
from tests.session.shown import check_shown
from tests.small_campaigns import damper

pytest.importorskip("nutpie")


@pytest.fixture(scope="module")
def plain(campaign: bo.Campaign) -> bo.Fit:
    settings = {"quick": True, "jobs": 1, "error_model": "independent"}
    return bo.Problem(campaign, damper(cubic=False), **settings).fit()


@pytest.mark.slow
def test_a_campaign_is_sampled_by_either(plain: bo.Fit) -> None:
    by_nuts, by_walkers = (plain.sample(seed=3, sampler=s) for s in ("nuts", "ensemble"))
    check_shown(by_nuts, "4 chains of")
    stats = by_nuts.tree[schema.SAMPLE_STATS]
    assert stats.attrs["sampler"] == "nuts"
    assert stats.attrs["divergences"] == 0  # the model is linear
    assert stats["diverging"].dims == ("chain", "draw")
    one, other = (item.summary().data for item in (by_nuts, by_walkers))
    # Both have 200 effective draws: four standard errors of the difference of two means.
    away = np.abs(one["mean"] - other["mean"]) / other["sd"]
    assert (away < 4 * np.sqrt(2 / 200)).all()


def test_a_function_has_no_gradient(line_fit: bo.Fit) -> None:
    with pytest.raises(InputError, match=r"needs derivatives.*ensemble"):
        line_fit.sample(seed=1, sampler="nuts")


def test_another_word_is_refused(plain: bo.Fit) -> None:
    with pytest.raises(InputError, match="unknown sampler"):
        plain.sample(sampler="hmc")
