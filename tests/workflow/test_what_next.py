"""What to measure next, from a campaign to the result and its page."""

from __future__ import annotations

import json

import numpy as np
import pytest
from small_campaigns import damper, damper_campaign

from bayesoleo import _schema as schema, _workflow as workflow, plots
from bayesoleo._report.page import render_report
from bayesoleo._workflow.settings import Settings
from bayesoleo.effects import find_effect
from bayesoleo.errors import InputError

RUNS = (("a", 1.0, 0.010, "fit"), ("b", 2.0, 0.010, "fit"), ("c", 1.5, 0.010, "hold-out"))
SPRINGS = tuple(map(find_effect, ("linear_stiffness", "cubic_stiffness")))
SETTINGS = Settings(jobs=1, effects=SPRINGS)
WIDE = {"amplitude": (0.005, 0.05), "force": (-np.inf, np.inf)}


@pytest.fixture(scope="module")
def reduced(tmp_path_factory):
    """A linear spring is missing, in motions of one amplitude."""
    folder = tmp_path_factory.mktemp("springs")
    return damper_campaign(
        folder, lambda x, v, t: 200 * v + 1000 * x, runs=RUNS, noise=40.0, periods=16
    )


@pytest.fixture(scope="module")
def proposed(reduced):
    model = damper(cubic=False, linear=False)
    return workflow.propose(reduced, model, SETTINGS, limits=WIDE)


@pytest.mark.slow
def test_the_group_holds_every_run_with_its_place(proposed):
    group = proposed[schema.PROPOSAL].to_dataset()
    assert group.sizes == {"round": 1, "mean": 1, "amplitude": 6, "frequency": 6}
    assert group["amplitude"].attrs["units"] == "m"
    ranks = group["rank"].values[np.isfinite(group["rank"].values)]
    assert sorted(ranks) == list(range(1, ranks.size + 1))
    best = group["information"].values[group["rank"].values == 1]
    assert best == np.nanmax(group["information"].values)


@pytest.mark.slow
def test_summary_and_group_agree(proposed):
    (entry,) = json.loads(proposed.attrs[schema.SUMMARY])["proposals"]
    group = proposed[schema.PROPOSAL].to_dataset().isel(round=0)
    first = entry["runs"][0]
    at = group.sel({key: first[key] for key in ("mean", "amplitude", "frequency")})
    assert float(at["rank"]) == 1
    assert float(at["sigma"]) == pytest.approx(first["sigma"])
    assert entry["question"] == "structures"
    assert {"linear_stiffness", "cubic_stiffness"} <= set(entry["rivals"])
    assert sum(entry["probabilities"]) == pytest.approx(1.0)
    assert first["information"] >= entry["repeat"]["information"]
    assert first["information"] <= entry["entropy"] + 1e-9


def test_page_and_figure_show_it(proposed):
    page = render_report(proposed)
    assert "What to measure next" in page
    assert "amplitude 50.0 mm is expected to tell" in page
    figure = plots.proposal(proposed)
    assert figure.axes[0].get_ylabel() == "amplitude of displacement in mm"


def test_trace_asks_the_question_by_itself(reduced):
    found = workflow.trace(reduced, damper(cubic=False, linear=False), SETTINGS)
    (entry,) = json.loads(found.attrs[schema.SUMMARY])["proposals"]
    assert entry["runs"][0]["amplitude"] == pytest.approx(0.01, rel=1e-3)


def test_nothing_is_asked_where_nothing_is_missing(reduced):
    found = workflow.trace(reduced, damper(cubic=False), SETTINGS)
    assert json.loads(found.attrs[schema.SUMMARY])["proposals"] == []
    assert schema.PROPOSAL not in found.children
    assert "What to measure next" not in render_report(found)


def test_a_limit_of_no_channel_is_refused(reduced):
    with pytest.raises(InputError, match=r"no such limit.*force"):
        workflow.propose(
            reduced, damper(cubic=False, linear=False), SETTINGS,
            rivals=["linear_stiffness", "cubic_stiffness"], limits={"stroke": (0.0, 1.0)},
        )  # fmt: skip


def test_parameters_are_asked_for_by_a_setting(reduced):
    found = workflow.propose(
        reduced, damper(cubic=False), Settings(jobs=1, effects=SPRINGS, next_run="parameters")
    )
    (entry,) = json.loads(found.attrs[schema.SUMMARY])["proposals"]
    assert entry["question"] == "parameters"
    ratio = entry["runs"][0]["sd_ratio"]
    assert set(ratio) == {"damping", "stiffness"}
    # A third run beside the two that were fitted has a third of the information or more.
    assert all(0.3 < value < 1.0 for value in ratio.values())
    assert min(ratio.values()) < np.sqrt(2 / 3) + 0.05
    page = render_report(found)
    assert "To know the parameters more precisely" in page


def test_one_parameter_is_asked_for_by_its_name(reduced):
    settings = Settings(jobs=1, effects=SPRINGS, next_run="stiffness")
    found = workflow.trace(reduced, damper(cubic=False), settings)
    (entry,) = json.loads(found.attrs[schema.SUMMARY])["proposals"]
    best = entry["runs"][0]
    assert list(best["sd_ratio"]) == ["stiffness"]
    assert best["information"] == pytest.approx(-np.log2(best["sd_ratio"]["stiffness"]))
    with pytest.raises(InputError, match=r"next_run: unknown aim.*mean stiffness"):
        workflow.trace(reduced, damper(cubic=False), Settings(jobs=1, next_run="stifness"))
