"""The same verbs for a user's function."""

from __future__ import annotations

import pickle
from pathlib import Path

import arviz
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import bayesoleo as bo
from bayesoleo import _schema as schema
from bayesoleo._session.display import html
from bayesoleo.errors import ResultsError
from bayesoleo.plots._style import blank
from tests.session.conftest import line
from tests.session.shown import check_shown

SLOPE = {"slope": bo.Parameter(1.0, sd=5.0), "offset": bo.Parameter(0.0, sd=1.0)}
TERMS = {"quadratic": lambda x, c: c * x**2, "cubic": lambda x, c: c * x**3}


def vector(x, theta):
    return theta[0] * x + theta[1]


def test_fit_agrees_with_least_squares(table, line_problem, line_fit) -> None:
    check_shown(line_problem, "y = line(x, …)", "60 samples", picture=False)
    check_shown(line_problem.check(), "unknowns: slope, offset", picture=False)
    check_shown(line_fit, "fit of line", "converged")
    expected = np.polyfit(table["x"], table["y"], 1)
    moved = (line_fit.parameters["estimate"] - expected) / line_fit.parameters["sd"]
    assert (abs(moved) < 0.1).all()  # the priors are wide
    assert line_fit.residuals["y"].sizes == {"run": 1, "sample": 60}
    assert "x" in line_fit.residuals.coords


@pytest.mark.parametrize("kind", [pd.DataFrame, xr.Dataset, dict])
@pytest.mark.parametrize("function", [line, vector, lambda t, slope, offset: slope * t + offset])
def test_every_table_and_signature(table, kind, function, line_fit) -> None:
    data = {name: ("i", column) for name, column in table.items()}
    given = xr.Dataset(data) if kind is xr.Dataset else kind(table)
    fit = bo.Problem(given, function, parameters=SLOPE).fit()
    np.testing.assert_array_equal(fit.parameters["estimate"], line_fit.parameters["estimate"])


def test_fixed_parameters_and_columns_by_name(table) -> None:
    parameters = {**SLOPE, "offset": bo.Parameter(0.5, fixed=True)}
    data = {"x": table["x"], "unused": table["x"], "force": table["y"]}
    fit = bo.Problem(data, line, parameters=parameters, output="force").fit()
    assert list(fit.parameters.index) == ["slope"]


def test_each_question_is_one_line(line_fit: bo.Fit) -> None:
    check_shown(line_fit.profile(), "linear low")
    check_shown(line_fit.indifference(), "fall of the posterior")
    check_shown(line_fit.sampling_distribution(20), "20 of 20 replications")
    check_shown(line_fit.assess(), "runs z")
    check_shown(line_fit.predict(), "of 60 samples")
    assert line_fit.profile() is line_fit.profile()


def test_prediction_is_wider_with_noise_and_outside(line_fit: bo.Fit) -> None:
    inside, outside = line_fit.predict([1.0], noise=False), line_fit.predict({"x": [9.0]})
    assert float(inside["sd"][0]) < float(line_fit.predict([1.0])["sd"][0])
    assert float(line_fit.predict([1.0])["sd"][0]) < float(outside["sd"][0])


def test_posterior(line_fit: bo.Fit) -> None:
    posterior = line_fit.sample(seed=1)
    check_shown(posterior, "posterior of line")
    check_shown(posterior.compare(line_fit.sampling_distribution(20)), "sd / monte carlo")
    assert "slope" in arviz.summary(posterior.tree, var_names=["slope"]).index
    assert posterior.tree.attrs[schema.SEED] == 1


def test_each_sample_of_a_function_is_a_data_point(table) -> None:
    # The cubic term that is missing would ask for correlated errors, of which loo warns.
    parameters = {"slope": bo.Parameter(1.0, sd=5.0), "offset": bo.model.Normal(0.0, 1.0)}
    settings = {"quick": True, "jobs": 1, "error_model": "independent"}
    problem = bo.Problem(table, line, parameters=parameters, **settings)
    tree = problem.fit().sample(seed=1).tree
    observed, drawn = tree[schema.OBSERVED_DATA], tree[schema.POSTERIOR_PREDICTIVE]
    assert list(observed.data_vars) == list(drawn.data_vars) == ["y"]
    np.testing.assert_array_equal(observed["y"], np.asarray(table["y"]))
    assert arviz.loo(tree).n_data_points == observed["y"].size
    for plot in (
        arviz.plot_ppc_dist,
        arviz.plot_ppc_pit,
        arviz.plot_ppc_interval,
        arviz.plot_loo_pit,
    ):
        plot(tree, backend="none")


def test_missing_term_is_found(line_fit: bo.Fit, tmp_path: Path) -> None:
    found = line_fit.explain(candidates=TERMS)
    assert found.effects == ("cubic",)
    assert found.verdict == "effect added"
    assert found.certainty is None
    with pytest.raises(ResultsError, match="terms of a function are tested one by one"):
        _ = found.structures
    check_shown(found, "cubic", "added")
    value, sd = found.parameters.loc["cubic_c", ["estimate", "sd"]]
    assert abs(value - 0.4) < 3 * sd
    check_shown(found.sample(), "cubic_c")
    assert "cubic" in found.report(tmp_path / "report.html").read_text(encoding="utf-8")
    loaded = bo.load_result(found.save(tmp_path / "results.nc"))
    assert repr(loaded) == repr(found)
    assert line_fit.explain(candidates=TERMS) is found


def test_nothing_is_added_to_a_complete_function(table) -> None:
    def cubic(x, slope, c3):
        return slope * x + c3 * x**3

    parameters = {"slope": bo.Parameter(1.0, sd=5.0), "c3": bo.Parameter(0.0, sd=5.0)}
    fit = bo.Problem(table, cubic, parameters=parameters).fit()
    found = fit.explain(candidates={**TERMS, "more": lambda x, k: k * np.sin(5 * x)})
    assert found.effects == ()
    assert found.verdict == "no candidate is significant"


@pytest.mark.parametrize(
    ("data", "function", "options", "message"),
    [
        (None, line, {}, r"key parameters: no parameter to estimate .*bo\.Parameter"),
        (None, line, {"parameters": {"slope": 1.0}}, r"parameters\['slope'\].*got 1\.0.*Parameter"),
        (
            None, line, {"parameters": {"slope": bo.Parameter(1.0, sd=1.0)}},
            r"argument offset: of line is neither a column of the data \(x\) .*offset",
        ),
        (
            None, line, {"parameters": {**SLOPE, "c": bo.Parameter(1.0, sd=1.0)}},
            r"key parameters: function line .*got 'c'.*x, slope, offset",
        ),
        (
            None, line, {"parameters": {"slope": bo.Parameter(2.0)}},
            r"parameters\['slope'\]: has no prior \(got 2\.0\); write bo\.Parameter\(2, sd",
        ),
        (None, line, {"parameters": SLOPE, "output": "z"}, r"key output: .*got 'z'.*x, y"),
        (None, line, {"parameters": SLOPE, "drive": "x"}, r"key drive: a function has no such"),
        ({"x": ["a"], "y": [1.0]}, line, {"parameters": SLOPE}, r"data\['x'\].*numbers"),
        (3, line, {"parameters": SLOPE}, r"key data: .*'int'.*\{\"x\": x, \"y\": y\}"),
        ({"x": ["1"], "y": [1.0]}, line, {"parameters": SLOPE}, r"data\['x'\].*text.*got '1'"),
        (
            {"x": [1.0, 2.0, 3.0], "y": [1.0, 2.0]}, line, {"parameters": SLOPE},
            r"data\['x'\]: has 3 rows, the measured column has 2; give columns of one length",
        ),
        (
            {"t": [1.0], "u": [1.0], "y": [1.0]}, line, {"parameters": SLOPE},
            r"key model: .*TypeError.*got 'line'.*all columns as a dictionary.*columns: t, u",
        ),
        (
            None, lambda x, theta: theta[2] * x, {"parameters": SLOPE},
            r"key model: function fails at the start values: IndexError",
        ),
        (None, line, {"parameters": ["slope"]}, r"key parameters: is not a dictionary .*write par"),
    ],
)  # fmt: skip
def test_what_a_function_does_not_take(table, data, function, options, message) -> None:
    with pytest.raises(bo.errors.InputError, match=message):
        bo.Problem(table if data is None else data, function, **options)


@pytest.mark.parametrize(
    ("candidates", "message"),
    [
        (None, r"key candidates: a function needs named terms .*lambda x, c"),
        ({"one": lambda x, c: 1 + c * x}, r"candidates\['one'\]: does not vanish .*got 1\.0"),
        ({"none": lambda x: x}, r"candidates\['none'\]: has no coefficient"),
    ],
)
def test_what_is_no_term(line_fit: bo.Fit, candidates, message) -> None:
    with pytest.raises(bo.errors.InputError, match=message):
        line_fit.explain(candidates=candidates)


def test_remainder_beside_its_neighbours_is_told(table, line_fit: bo.Fit) -> None:
    """The line lacks a cubic term; of a complete function nothing is said (one in 1 000 chance)."""
    assert "neighbouring residuals are alike (correlation 0." in repr(line_fit)
    x, rng = table["x"], np.random.default_rng(2)
    for _ in range(20):
        data = {"x": rng.permutation(x)}
        data["y"] = 1.5 * data["x"] + 0.05 * rng.standard_normal(x.size)
        assert "alike" not in repr(bo.Problem(data, line, parameters=SLOPE).fit())


def test_wrong_questions(line_fit: bo.Fit) -> None:
    for pairs in (["slope", "offset"], "slope"):
        with pytest.raises(bo.errors.InputError, match=r'key pairs: .*\[\("slope", "offset"\)\]'):
            line_fit.indifference(pairs)
    with pytest.raises(bo.errors.InputError, match=r"key pairs: .*got 'slop'.*did you mean slope"):
        line_fit.indifference([("slop", "offset")])
    with pytest.raises(
        bo.errors.InputError, match=r'key names: .*got \'slope\'.*write \["slope"\]'
    ):
        line_fit.profile("slope")
    with pytest.raises(bo.errors.InputError, match=r"key level: is not a number .*level=0\.95"):
        line_fit.profile(level="high")
    with pytest.raises(bo.errors.InputError, match=r"key output: .*got 'z'.*one of: y"):
        line_fit.plot("z")
    with pytest.raises(bo.errors.InputError, match=r"key seed: .*got 'one'"):
        line_fit.sample(seed="one")
    with pytest.raises(bo.errors.InputError, match=r"key path: is not a path \(got 3\)"):
        line_fit.save(3)


@pytest.mark.parametrize("read", [bo.load_campaign, bo.load_result, bo.load_model])
def test_what_is_no_path(read) -> None:
    with pytest.raises(
        bo.errors.InputError, match=rf"is not a path \(got 3\); .*{read.__name__}\("
    ):
        read(3)


def test_sampling_goes_on_in_its_folder(line_problem: bo.Problem, tmp_path: Path) -> None:
    first = line_problem.fit().sample(seed=2, out=tmp_path)
    assert list(tmp_path.rglob("segment-*.npz"))
    again = pickle.loads(pickle.dumps(line_problem)).fit()
    second = again.sample(seed=2, out=str(tmp_path))
    assert second is not first
    assert repr(second) == repr(first)
    assert len(list(tmp_path.iterdir())) == 1


def test_a_column_of_any_name(table) -> None:
    frame = pd.DataFrame({"variables": table["x"], "y": table["y"]})
    fit = bo.Problem(frame, lambda variables, a: a * variables, parameters={"a": SLOPE["slope"]})
    assert "samples of variables, y" in repr(fit)


def test_correlated_errors_are_no_missing_term() -> None:
    """Errors with the autocorrelation 0.9 made a polynomial term significant in three of four."""

    def line(x, slope, offset):
        return slope * x + offset

    x, named = np.linspace(0.0, 2.0, 120), 0
    parameters = {"slope": bo.Parameter(1.0, sd=5.0), "offset": bo.Parameter(0.0, sd=1.0)}
    terms = {"quadratic": lambda x, c: c * x**2, "cubic": lambda x, c: c * x**3}
    for seed in range(12):
        errors = np.random.default_rng(seed).standard_normal(x.size)
        for i in range(1, x.size):
            errors[i] = 0.9 * errors[i - 1] + np.sqrt(1 - 0.81) * errors[i]
        data = {"x": x, "y": 1.5 * x + 0.05 * errors}
        found = bo.Problem(data, line, parameters=parameters).fit().explain(candidates=terms)
        named += bool(found.effects)
    assert named <= 2  # of twelve with the probability 0.01 each, more come once in 5 000 times


def test_a_result_in_a_notebook_keeps_its_columns_and_names_its_figure():
    text = html("a  b\n1 < 2", lambda: blank(2.0, 1.0))
    assert text.startswith('<pre style="white-space:pre;overflow-x:auto">a  b\n1 &lt; 2</pre><img ')
    assert 'alt="figure: a  b"' in text
    assert "<img" not in html("a", lambda: None)
    sentence = 20 * "words "
    assert f'<span style="white-space:pre-wrap">{sentence}</span></pre>' in html(
        sentence, lambda: None
    )
    assert html("a", lambda: 1 / 0) == html("a", lambda: None)
