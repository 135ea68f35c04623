"""The page holds what was found, needs no other file, and shows a user's text as text."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from importlib.resources import files

import matplotlib
import numpy as np
import pytest
import xarray as xr

import bayesoleo._kept_processes as kept_processes
import bayesoleo._process_messages as messages
import bayesoleo._worker_processes as processes
from bayesoleo import _schema as schema
from bayesoleo._report import sections
from bayesoleo._report.page import render_report, write_report
from bayesoleo._report.page_figures import (
    LARGEST,
    _drawn_ahead,
    draw_ahead,
    parts_of_draws,
    shared_by,
)
from bayesoleo._report.sections import Image, encode_formula
from bayesoleo._report.sentences import headline, reason, runs_used
from bayesoleo._report.tables import (
    diagnostics,
    diagnostics_by_parameter,
    expected_text,
    format_short,
    records,
)
from bayesoleo._storage.result_files import read_tree, write_tree
from bayesoleo.errors import ResultsError
from bayesoleo.plots._style import contrast


@pytest.fixture(scope="module")
def page(oleo):
    return render_report(oleo)


@pytest.fixture
def unpainted(monkeypatch):
    """Figures are made, but not painted: that takes most of a page's time and is none of its
    text."""
    monkeypatch.setattr(sections, "encode_figure", lambda figure: Image("data:,", 1.0, 1.0))


#: Only the script's own test needs one.
BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
DATA = '<script type="application/json" id="runs-data">'


def viewer_data(page):
    """What the script of a page draws."""
    return json.loads(page.split(DATA)[1].split("</script>")[0])


def without(tree, *names):
    groups = {name: node.to_dataset() for name, node in tree.children.items() if name not in names}
    cut = xr.DataTree.from_dict(groups)
    cut.attrs = dict(tree.attrs)
    return cut


@pytest.mark.slow
def test_the_page_makes_its_case(page):
    for text in (
        "Probable: Stribeck friction was missing.</h1>",
        "9.04 → 1.06",
        "Figure 17.",
        "Residual of pressure against stroke",
        "40.200",
        "cm²",
        "effective sample size",
        "12 inadmissible",
        "What remains unexplained",
        "bayesoleo close made-up --model f16n2d2 --seed 7",
        "3f5a3f5a",
        "inertia + gas_spring",
    ):
        assert text in page, text


@pytest.mark.slow
def test_the_page_begins_with_the_case(page):
    assert page.index("Was anything wrong?") < page.index("Data and noise</h2>")


def test_the_page_needs_no_other_file_and_is_not_too_large(page):
    assert len(page) < 6_000_000
    assert not re.search(r'(?:src|href)="(?!data:|#)', page)
    # What is called for by address: a clip path of the page itself, and the name of a language.
    assert set(re.findall(r"url\([^)]*\)", page)) == {"url(#panel)"}
    assert set(re.findall(r"https?://[^\"\s]+", page)) <= {"http://www.w3.org/2000/svg"}
    assert not re.search(r"@import|XMLHttpRequest|fetch\(|WebSocket", page)
    assert "default-src 'none'" in page


def test_every_figure_has_a_caption_and_a_text_for_those_who_cannot_see_it(page):
    pictures = re.findall(r"<figure>\s*<div [^>]*><img [^>]*alt=\"([^\"]+)\"", page)
    assert len(pictures) == page.count("<figure>") == page.count("<figcaption>") == 18


def test_no_value_is_left_out_by_accident(page):
    hidden = r'src="[^"]*"|<style>.*?</style>|<script.*?</script>|<[^>]+>'
    visible = re.sub(hidden, " ", page, flags=re.DOTALL)
    assert not re.search(r"\b(nan|None|inf|undefined)\b", visible)


@pytest.mark.slow
@pytest.mark.usefixtures("unpainted")
def test_what_a_user_wrote_is_text(synthetic):
    evil = "<script>alert(1)</script>"
    tree = synthetic.oleo_tree(label=f"{evil}&\"'", description=f"rig {evil}\nsecond line")
    page = render_report(tree)
    assert re.findall(r"<script[^>]*>", page) == [DATA, "<script>"]
    assert "<script>alert" not in page
    assert page.count("&lt;script&gt;alert(1)&lt;/script&gt;") > 14 * 3
    assert viewer_data(page)["runs"][0]["label"].startswith(evil)


@pytest.mark.slow
@pytest.mark.parametrize(
    "names",
    [
        ("posterior", "sample_stats", "period_predictive"),
        ("residual",),
        ("noise", "constant_data"),
        tuple(name for name in schema.GROUPS),
    ],
)
def test_absent_groups_are_left_out(oleo, names):
    page = render_report(without(oleo, *names))
    assert "Stribeck_friction" in page
    assert ("The posterior was not sampled" in page) == ("posterior" in names)


@pytest.mark.usefixtures("unpainted")
def test_two_runs_nothing_added(two_runs):
    page = render_report(two_runs)
    assert "Nothing is missing: the model explains" in page
    assert "→" not in page
    assert "No candidate was scored." in page
    assert "The posterior was not sampled" in page


def test_the_page_of_a_stored_result_is_the_same(two_runs, tmp_path):
    write_tree(two_runs, tmp_path / "results.nc")
    write_report(read_tree(tmp_path / "results.nc"), tmp_path / "report.html")
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == render_report(two_runs)


@pytest.mark.usefixtures("unpainted")
@pytest.mark.parametrize(
    ("effects", "text"),
    [
        ([], "missing: the error of voltage on the fit runs is 2.50 times its standard error."),
        (["wall"], "A likeness only: wall was added.</h1>"),
        (["wall", "lag"], "A likeness only: wall and lag were added.</h1>"),
    ],
)
def test_an_unexplained_remainder_is_said(two_runs, effects, text):
    tree = two_runs.copy()
    summary = json.loads(tree.attrs["summary"])
    summary.update(verdict=schema.UNEXPLAINED, effects=effects)
    summary["error_after"]["fit"]["voltage"]["ratio_to_noise"] = 2.5
    tree.attrs["summary"] = json.dumps(summary)
    assert text in render_report(tree)


@pytest.mark.parametrize(
    ("estimated", "p_value", "gain", "text"),
    [
        (False, 1e-6, 0.89, "; cubic (strut) would explain 89 % of the excess, and was not tried."),
        (True, 1e-6, 0.89, "; no further effect was confirmed, the nearest is cubic (strut)."),
        (False, 0.2, 0.89, "; no effect in the catalogue explains it."),
        (False, 1e-6, 0.01, "; no effect in the catalogue explains it."),
    ],
)
def test_a_candidate_that_stands_open_is_not_denied(two_runs, estimated, p_value, gain, text):
    summary = json.loads(two_runs.attrs["summary"])
    summary.update(verdict=schema.UNEXPLAINED, effects=[])
    candidate = {"effect": "cubic", "target": "strut", "gain": gain, "p_value": p_value}
    summary["rounds"][-1]["candidates"] = [{**candidate, "estimated": estimated}]
    assert text in headline(summary).replace("\N{NO-BREAK SPACE}", " ")


def test_a_candidate_of_an_earlier_round_was_tried(two_runs):
    summary = json.loads(two_runs.attrs["summary"])
    summary.update(verdict=schema.UNEXPLAINED, effects=[])
    one = {"effect": "cubic", "target": "strut", "gain": 0.3, "p_value": 1e-6, "estimated": False}
    last = summary["rounds"][-1]
    earlier = {**last, "candidates": [{**one, "estimated": True}]}
    summary["rounds"] = [earlier, {**last, "candidates": [one]}]
    text = headline(summary).replace("\N{NO-BREAK SPACE}", " ")
    assert (
        "cubic (strut) would explain 30 % of the excess, and was tried in an earlier round" in text
    )
    assert "was not tried" not in text


def test_many_candidates_are_folded_and_a_range_stands_for_the_runs(page):
    assert "<details><summary>" in page
    text = expected_text({"gain": 1060.0, "offset[a]": 2.0, "offset[b]": -1.0})
    assert text.replace("\N{NO-BREAK SPACE}", " ") == "gain = 1060, offset = −1.00 … 2.00 (2 runs)"
    assert [format_short(value) for value in (1064.0, 41989.0, 999.7)] == ["1060", "42000", "1000"]


def test_diagnostics_by_parameter_are_rounded_and_empty_rows_left_out(synthetic):
    tree = synthetic.oleo_tree()
    stats = tree[schema.SAMPLE_STATS]
    stats.attrs["rhat_nested"] = '{"m": 1.0025610773362879}'
    stats.attrs |= {"reached": 1, "warning": ""}
    assert diagnostics_by_parameter(tree).rows == [["m", "1.003"]]
    rows = dict(diagnostics(tree).rows)
    assert "warning" not in rows
    assert rows["effective size asked for reached"] == "yes"


def test_a_reason_begins_with_a_title_and_not_with_an_id():
    entry = {"accepted": None, "candidates": [{"effect": "play", "target": None}]}
    assert reason(entry | {"reason": "play explains 4 %"}) == "Play explains 4 %."
    assert reason(entry | {"reason": "no effect is significant"}) == "No effect is significant."
    mine = {"accepted": None, "candidates": [{"effect": "my_law", "target": "stroke"}]}
    told = reason(mine | {"reason": "my_law explains 4 %"}, {"my_law": "Law of mine (new)"})
    assert told == "Law of mine explains 4 %."


def test_a_tree_without_summary():
    with pytest.raises(ResultsError, match=r"key summary: the result holds no summary"):
        render_report(xr.DataTree())


def test_formulas_are_drawn_or_left_as_text(page):
    assert encode_formula(r"m \ddot{q} + \frac{a}{\left|{b}\right|} = F") is not None
    assert encode_formula(r"\begin{cases} 1 \end{cases}") is None
    assert r"<pre>\begin{cases}" in page


def test_a_frequency_shows_no_digits_that_nobody_reads(two_runs):
    """A record without noise knows its frequency to twelve digits."""
    tree = two_runs.copy(deep=True)
    constant = tree[schema.CONSTANT_DATA].to_dataset()
    exact = xr.full_like(constant[schema.FREQUENCY], 1e-14)
    tree[schema.CONSTANT_DATA] = xr.DataTree(constant.assign({schema.FREQUENCY_SD: exact}))
    table = records(tree)
    column = table.head.index("frequency [Hz]")
    assert all(len(row[column]) <= 9 for row in table.rows)


def test_sizes_that_are_expected_have_units():
    units = {"k": "N/m**3", "offset[a]": "m", "offset[b]": "m", "ratio": ""}
    values = {"k": -3e7, "offset[a]": 2e-3, "offset[b]": -1e-3, "ratio": 0.5}
    assert expected_text(values, units).replace("\N{NO-BREAK SPACE}", " ") == (
        "k = −30.0 MN/m³, offset = −1.00 … 2.00 mm (2 runs), ratio = 0.500"
    )


def test_the_viewer_holds_what_the_figures_show(page, oleo):
    shown = viewer_data(page)
    assert [output["name"] for output in shown["outputs"]] == ["force", "pressure"]
    run = shown["outputs"][0]["runs"][0]
    assert shown["outputs"][0]["labels"] == ["force in kN", "residual in N"]
    assert run["ends"] == [0.0, 1.0]
    measured = oleo["records/force"].values[0] / 1e3
    assert min(run["measured"]) >= 0.999 * np.nanmin(measured)
    stored = oleo["residual/force_before_mean"].values[0]
    np.testing.assert_allclose(run["residual"]["before"], stored, rtol=1e-4)
    assert run["residual"]["band"] == pytest.approx(
        oleo["residual/force_noise"].values[0], rel=1e-4
    )


@pytest.mark.usefixtures("unpainted")
def test_a_transient_is_not_averaged_over_periods(two_runs):
    tree = two_runs.isel(run=[1])
    summary = json.loads(tree.attrs["summary"])
    transient = summary["rounds"][0]["error"]["voltage"]
    summary["rounds"][0]["error"]["voltage"] = {"transient": transient["transient"]}
    tree.attrs["summary"] = json.dumps(summary)
    page = render_report(tree)
    visible = re.sub(r"<script.*?</script>|<style>.*?</style>", "", page, flags=re.DOTALL)
    assert "the periods" not in visible
    assert "over periods" not in visible
    assert "repeating" not in visible
    assert viewer_data(page)["outputs"][0]["runs"][0]["x_label"] == "time in s"


@pytest.mark.slow
@pytest.mark.usefixtures("unpainted")
def test_noise_has_one_meaning(oleo):
    """That of a sample; errors are compared with a standard error, or with what is expected."""
    page = render_report(oleo)
    assert "The noise of a channel is the standard deviation of a single sample" in page
    for text in ("times its noise", "/ noise", "noise floor", "<b>noise</b>"):
        assert text not in page


def test_the_first_screen_says_on_which_runs(page, two_runs):
    first = page[: page.index("<nav")]
    assert "Fitted on 11 runs; tested on 3 runs (run e, run j, run m) that were not used." in first
    assert first.count("<figure>") == 1
    summary = json.loads(two_runs.attrs["summary"])
    assert runs_used(summary).endswith("tested on 1 run (transient) that was not used.")
    for error in summary["rounds"][0]["error"]["voltage"].values():
        error["role"] = "fit"
    assert runs_used(summary).endswith("no run was held out to test it.")


@pytest.mark.slow
@pytest.mark.usefixtures("unpainted")
def test_the_reason_of_the_error_model_is_on_the_page(synthetic):
    tree = synthetic.oleo_tree()
    tree["posterior"].attrs |= {
        "error_model": "catalogue",
        schema.ERROR_MODEL_REASON: "catalogue errors, chosen because effects that the data do not"
        " tell apart are left: sensor_lag @ force",
    }
    text = "Catalogue errors, chosen because effects that the data do not tell apart are left: lag"
    assert text in render_report(tree)
    del tree["posterior"].attrs[schema.ERROR_MODEL_REASON]
    assert "The intervals assume catalogue errors." in render_report(tree)


def colours_of(css):
    """Variables of the style sheet."""
    return dict(re.findall(r"--([a-z]+): (#[0-9a-f]{3,6})", css))


def test_text_on_the_page_has_enough_contrast():
    """4.5 at least (WCAG 2.1, AA) of every text colour on every ground that it stands on."""
    css = files("bayesoleo._report").joinpath("report.css").read_text()
    root = colours_of(css.split("}")[0])
    grounds = ["#ffffff", root["ground"], root["pale"]]
    texts = [root[name] for name in ("ink", "faint", "before", "after")]
    texts += ["#b3261e"]  # a stage that did not finish
    assert set(re.findall(r"(?<![-\w])color: (?!#fff)([^;]+);", css)) == {
        "var(--ink)", "var(--faint)", "var(--before)", "var(--after)", "#b3261e"
    }  # fmt: skip
    assert min(contrast(text, ground) for text in texts for ground in grounds) >= 4.5
    verdicts = re.findall(r"--verdict: (#[0-9a-f]{6})", css)
    assert len(verdicts) == 4
    assert min(contrast("#ffffff", ground) for ground in verdicts) >= 4.5


def test_transients_have_no_columns_of_frequencies_and_periods(two_runs):
    table = records(two_runs)
    assert {"frequency [Hz]", "periods"} <= set(table.head)
    tree = two_runs.isel(run=[1])
    tree["constant_data/periods"] = 0 * tree["constant_data/periods"]
    head = records(tree).head
    assert "frequency [Hz]" not in head
    assert "periods" not in head


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_a_browser_draws_one_run(two_runs, tmp_path):
    """The script runs without an error under the page's own content security policy."""
    path = tmp_path / "report.html"
    write_report(two_runs, path)
    command = [BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom", path.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True).stdout
    viewer = shown[shown.index('id="viewer"') : shown.index(DATA)]
    assert 'hidden=""' not in viewer[: viewer.index(">")]
    assert viewer.count('class="line ') == 3  # measured, predicted and the residual
    assert viewer.count("<option") == 2 + 1
    assert "NaN" not in viewer


def test_shortened_paths_are_the_same_but_for_a_hundredth_of_a_point():
    svg = b'<path d="M 1.23456 2 \nL 3 4.98765 \nL 5 6 \nz\nM 7 8 \nL 9 1 \n" style="a: 1.2345"/>'
    short = '<path d="M 1.23 2 3 4.98 5 6 \nz\nM 7 8 9 1 \n" style="a: 1.2345"/>'
    assert sections._short(svg).decode() == short
    # After a curve, pairs would be further curves.
    curve = b'<path d="M 1 2 \nQ 3 4 5 6 \nL 7 8 \n"/>'
    assert sections._short(curve) == curve


def test_one_figure_of_a_kind_that_fails_leaves_the_others(oleo, unpainted, monkeypatch, tmp_path):
    rightly = sections.plots.residual

    def failing(tree, output, against="phase"):
        if against == "velocity":
            raise ValueError("no velocity")
        return rightly(tree, output, against)

    assert write_report(oleo, tmp_path / "whole.html") == []
    monkeypatch.setattr(sections.plots, "residual", failing)
    said = write_report(oleo, tmp_path / "without.html")
    assert len(said) == 1  # once for all outputs
    assert "figure of the residual" in said[0]
    assert "no velocity" in said[0]
    whole, left = (
        (tmp_path / f"{name}.html").read_text(encoding="utf-8").count("</b> Residual of ")
        for name in ("whole", "without")
    )
    outputs = len(sections.reading.outputs(oleo))
    assert left == whole - outputs > 0


def test_curves_that_fail_leave_a_page_without_them_that_says_so(
    oleo, unpainted, monkeypatch, tmp_path
):
    def failing(tree):
        raise ValueError("no curves")

    monkeypatch.setattr(sections, "viewer", failing)
    (said,) = write_report(oleo, tmp_path / "without.html")
    assert "curves of each run" in said
    assert "no curves" in said
    text = (tmp_path / "without.html").read_text(encoding="utf-8")
    assert "no curves" in text
    assert 'id="viewer"' not in text


@pytest.mark.slow
def test_figures_of_another_process_are_the_same(oleo, page, monkeypatch):
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    monkeypatch.setattr(processes, "WORTH_ASKING", 0.0)
    kept_processes.process_of(0).ask(messages.dumps((None, None, None)))
    try:
        with matplotlib.rc_context({"axes.titleweight": "bold"}):
            mixed = render_report(oleo)
        assert render_report(oleo) == page
    finally:
        kept_processes.end_processes()
    monkeypatch.setenv("BAYESOLEO_PROCESSES", "0")
    with matplotlib.rc_context({"axes.titleweight": "bold"}):
        assert render_report(oleo) == mixed != page


class Drawing:
    """Another process that has drawn some figures, and ends with those that it is asked for."""

    def __init__(self, tree, there, here=()):
        shared = shared_by(tree)
        self._there = dict(draw_ahead(shared, part) for part in there)
        self.drawn = {part: ["drawn here before"] for part in here}
        self.asked, self.looks, self.goes_on = [], [], True

    def end_with(self, tree, part):
        self.asked.append(part)
        self._there |= dict([draw_ahead(shared_by(tree), part)])

    def pictures(self):
        self.goes_on = False
        return {**self._there, **self.drawn}


def test_the_largest_figure_is_asked_for_before_results_are_written(oleo, unpainted):
    order, ahead = [], Drawing(oleo, [("data", 0)])
    ends = ahead.end_with
    ahead.end_with = lambda *given: (order.append("largest"), ends(*given))
    found = _drawn_ahead(oleo, lambda: order.append("written"), ahead)
    assert order == ["largest", "written"]
    assert ahead.asked == [LARGEST]
    assert set(found) == {("data", 0), *parts_of_draws(oleo)}
    shared = shared_by(oleo)
    assert all(draw_ahead(shared, part) == (part, figures) for part, figures in found.items())


def test_figures_are_drawn_here_only_while_another_process_draws(oleo, unpainted):
    ahead = Drawing(oleo, [])

    def written():
        ahead.goes_on = False

    assert set(_drawn_ahead(oleo, written, ahead)) == {LARGEST}


def test_what_was_drawn_before_is_not_drawn_again(oleo, unpainted):
    before = [LARGEST, ("trace", 0)]
    ahead = Drawing(oleo, [], here=before)
    found = _drawn_ahead(oleo, lambda: None, ahead)
    assert ahead.asked == []
    assert [found[part] for part in before] == [["drawn here before"]] * 2
    assert set(found) == set(parts_of_draws(oleo))


@pytest.mark.parametrize("goes_on", [True, False])
def test_results_are_written_once_before_a_page(oleo, unpainted, tmp_path, goes_on):
    calls, ahead = [], Drawing(oleo, [("data", 0)])
    ahead.goes_on = goes_on
    write_report(oleo, tmp_path / "report.html", lambda: calls.append("written"), ahead)
    assert calls == ["written"]
    assert ahead.asked == [LARGEST] * goes_on
    alone = tmp_path / "alone.html"
    write_report(oleo, alone)
    assert (tmp_path / "report.html").read_text("utf-8") == alone.read_text("utf-8")
