"""Estimates and modes are labelled arrays, tables in a terminal and a notebook, and one figure."""

from __future__ import annotations

import json

import numpy as np
import pytest

from bayesoleo import plots
from bayesoleo.estimation import FunctionProblem, estimate, multistart, polish, to_dataset
from bayesoleo.model._priors import Normal


@pytest.fixture
def line():
    x = np.linspace(0, 1, 30)
    y = 2 * x + 1 + 0.1 * np.sin(40 * x)
    priors = [Normal(1.5, 1.0), Normal(0.5, 1.0)]
    return FunctionProblem(lambda x, t: t[0] * x + t[1], x, y, priors, ["slope <a>", "offset"])


def test_an_estimate_is_a_table_in_a_terminal_and_a_notebook(line):
    point = estimate(line)
    assert repr(point) == str(point)
    assert "offset" in str(point)
    page = point._repr_html_()
    assert "slope &lt;a&gt;" in page  # names are text, not markup
    assert "xarray" in page


def test_modes_are_labelled_and_shown(gas_spring):
    modes = multistart(gas_spring(0, 0.01), 0)
    data = modes.to_dataset()
    assert data["estimate"].dims == ("mode", "parameter")
    np.testing.assert_array_equal(
        data["estimate"].sel(parameter="exponent"), [m["exponent"] for m in modes]
    )
    assert data["hits"].values.sum() == sum(modes.hits)
    assert json.loads(data.attrs["status"]) == modes.status
    assert str(modes).count("\n") == len(modes) == 2
    assert str(modes).splitlines()[0].split() == ["mode", "exponent", "log", "posterior", "hits"]
    assert "<pre>" in modes._repr_html_()


def test_no_mode_is_said_with_its_reasons():
    def failing(x, theta):
        return np.full(x.size, np.nan)

    problem = FunctionProblem(failing, np.arange(4.0), np.arange(4.0), [Normal(1, 1)])
    modes = multistart(problem, 0)
    assert str(modes) == "no mode was found: 1 not finite"
    assert modes.to_dataset()["estimate"].shape == (0, 0)


def test_the_way_is_one_figure_with_a_colour_for_each_estimator(gas_spring):
    problem = gas_spring(0, 0.01)
    robust = estimate(problem, "mbe")
    mode = polish(problem, robust)
    figure = plots.history(to_dataset(mode, mbe=robust))
    exponent, objective = figure.axes
    drawn = [line.get_ydata() for line in exponent.lines]
    np.testing.assert_array_equal(
        np.concatenate(drawn), np.r_[robust.history[:, 0], mode.history[:, 0]]
    )
    assert len({line.get_color() for line in exponent.lines}) == 2
    assert objective.get_title(loc="left") == "objective"
