"""Figures of branches and of motions found by multiple shooting."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo import plots
from bayesoleo.estimation._multiple_shooting import EstimatedTrajectory
from bayesoleo.plots import _style as style
from bayesoleo.prediction._branches import follow_branch
from bayesoleo.prediction._simulate import RunPlan, motion
from bayesoleo.systems import system


@pytest.fixture(scope="module")
def branch():
    plan = RunPlan("sweep", 1.0, {"force": motion(0.0, [6.0])})
    return follow_branch(system("duffing"), plan, "frequency", (1.5, 6.0), steps=32)


def test_stable_and_unstable_parts_meet_at_the_folds(branch):
    above, below = plots.branch(branch, "displacement").axes
    marks = [line for line in above.lines if line.get_marker() == "o"]
    folds = branch.branch.of_kind("fold")
    assert [line.get_xdata()[0] for line in marks] == [fold.value for fold in folds]
    parts = [line for line in above.lines if line.get_marker() == "None"]
    assert [line.get_color() for line in parts] == [style.AFTER, style.BEFORE, style.AFTER]
    assert [line.get_linestyle() for line in parts] == ["-", "--", "-"]
    assert [line.get_xdata()[-1] for line in parts[:2]] == [fold.value for fold in folds]
    assert above.get_ylabel() == "swing of displacement in mm"
    assert below.get_xlabel() == "frequency in Hz"
    # Two multipliers for each part, and the circle that limits stability.
    assert len(below.lines) == 2 * len(parts) + 1


def test_branches_along_one_value_share_a_figure(branch):
    one, two = (plots.branch(b, "displacement") for b in (branch, [branch, branch]))
    assert len(two.axes[0].lines) == 2 * len(one.axes[0].lines)
    assert len(two.legends[0].get_texts()) == len(one.legends[0].get_texts()) == 3


def test_a_panel_for_each_state_and_samples_where_it_was_measured():
    time = np.linspace(2.0, 4.0, 21)
    states = np.stack([np.sin(time), np.cos(time)], axis=1)
    measured = np.linspace(0.0, 1.0, 11)[None]
    found = EstimatedTrajectory(
        "a", time, states, np.zeros(2), ("q",), 0.4 * measured, 0.6 * measured, 0.0, ("q", "dot(q)")
    )
    figure = plots.trajectory(found, units={"q": "m"}, truth={"q": (time, states[:, 0])})
    first, second = figure.axes
    samples = next(line for line in first.lines if line.get_marker() == ".")
    np.testing.assert_allclose(samples.get_ydata(), 1000 * measured[0])
    np.testing.assert_allclose(samples.get_xdata(), np.linspace(2.0, 4.0, 11))
    assert first.get_ylabel() == "q in mm"
    assert second.get_ylabel() == "dot(q), not measured"
    assert len(second.lines) == 1
