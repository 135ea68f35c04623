"""Every figure is drawn from 14 runs and from 2, and shows what is stored."""

from __future__ import annotations

import io
import json
import sys
from itertools import pairwise

import numpy as np
import pytest
import xarray as xr
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.markers import TICKDOWN, TICKLEFT
from matplotlib.text import Text
from scipy.special import ndtr

from bayesoleo import _schema as schema, plots
from bayesoleo.errors import InputError
from bayesoleo.plots import _reading as reading, _style as style
from bayesoleo.plots._discovery import chosen, format_share, similar
from bayesoleo.plots._estimates import _SHADES
from bayesoleo.plots._predictions import _quantile


def texts(figure):
    """All texts of a figure that has been drawn."""
    figure.savefig(io.BytesIO(), format="png", dpi=40)
    found = [item.get_text() for item in figure.findobj(Text)]
    return [text for text in found if text]


def lines(axes, colour):
    return [line for line in axes.lines if line.get_color() == colour]


@pytest.mark.parametrize(
    "draw",
    [
        plots.records,
        plots.error,
        plots.ranking,
        plots.point_against_posterior,
        plots.trace,
    ],
)
def test_figures_of_a_tree(oleo, draw):
    assert len(texts(draw(oleo))) > 10


@pytest.mark.slow
@pytest.mark.parametrize(
    ("draw", "output"),
    [
        (plots.fit, "force"),
        (plots.fit, "pressure"),
        (plots.predictive, "pressure"),
        (plots.residual, "force"),
        (lambda tree, output: plots.residual(tree, output, "velocity"), "pressure"),
        (lambda tree, output: plots.residual(tree, output, "stroke"), "force"),
    ],
)
def test_figures_of_an_output_have_a_panel_for_each_run(oleo, draw, output):
    figure = draw(oleo, output)
    shown = texts(figure)
    assert len(figure.axes) == 14
    assert all(run.label in shown for run in reading.runs(oleo))
    assert sum(text.startswith("hold-out") for text in shown) == 3


@pytest.mark.parametrize(
    "draw",
    [
        plots.records,
        plots.error,
        plots.ranking,
        lambda tree: plots.fit(tree, "voltage"),
        lambda tree: plots.residual(tree, "voltage"),
    ],
)
def test_two_runs_one_transient_nothing_added(two_runs, draw):
    shown = texts(draw(two_runs))
    assert "after" not in shown
    assert "before" not in shown


def test_a_residual_is_drawn_at_its_size_and_in_its_unit(oleo):
    figure = plots.residual(oleo, "pressure")
    assert any("pressure residual in kPa" in text for text in texts(figure))
    drawn = lines(figure.axes[0], style.BEFORE)[0].get_ydata()
    stored = oleo["residual/pressure_before_mean"].values[0]
    np.testing.assert_allclose(drawn, stored / 1e3)


def test_no_noise_band_under_a_transient(two_runs):
    figure = plots.residual(two_runs, "voltage")
    assert [len(axes.patches) for axes in figure.axes] == [1, 0]


def test_error_without_any_noise_floor_is_the_rms(two_runs):
    tree = two_runs.copy()
    summary = json.loads(tree.attrs["summary"])
    for run in summary["rounds"][0]["error"]["voltage"].values():
        run["ratio_to_noise"] = None
    tree.attrs["summary"] = json.dumps(summary)
    assert "rms in µV" in texts(plots.error(tree))


def candidate(effect, target, *same):
    return {"effect": effect, "target": target, "indistinguishable_from": list(same)}


def test_only_what_the_accepted_candidate_lists_is_marked(oleo):
    first, last = json.loads(oleo.attrs["summary"])["rounds"]
    assert [c["effect"] for c in similar(first)] == ["Dahl_friction"]
    assert chosen(last) is None
    assert similar(last) == []
    assert texts(plots.ranking(oleo, 0)).count("≈") == 1


def test_an_id_with_several_targets_marks_the_one_that_is_meant():
    entry = {
        "accepted": "lag",
        "candidates": [
            candidate("lag", "force", "lag @ stroke", "offset", "wall"),
            candidate("lag", "stroke", "lag @ force"),
            candidate("offset", "force", "lag"),
            candidate("offset", "stroke", "wall"),
            candidate("wall", None),
            candidate("play", None, "wall", "lag"),
        ],
    }
    found = [(c["effect"], c["target"]) for c in similar(entry)]
    assert found == [("lag", "stroke"), ("offset", "force"), ("wall", None)]


def test_of_two_places_the_one_that_was_added_is_marked():
    candidates = [
        {"effect": "lag", "target": target, "gain": gain, "indistinguishable_from": []}
        for target, gain in (("force", 0.5), ("stroke", 0.4))
    ]
    entry = {"accepted": "lag", "accepted_target": "stroke", "candidates": candidates}
    assert chosen(entry) is candidates[1]
    assert chosen(entry | {"accepted_target": None}) is candidates[0]


def test_corner_shows_at_most_ten_parameters_new_ones_and_shared_ones_first(oleo):
    figure = plots.corner(oleo)
    assert len(figure.axes) == 100
    assert len(texts(figure)) > 10
    labels = " ".join(texts(figure))
    assert "breakaway" in labels
    assert "offset" not in labels
    assert len(plots.corner(oleo, ["breakaway"]).axes) == 1


def test_long_names_in_a_corner_stay_inside_it_and_apart(oleo):
    names = ["breakaway", "correlation_time_force", "discrepancy_share_pressure"]
    draws = oleo["posterior"].to_dataset()["breakaway"]
    tree = xr.DataTree.from_dict({"posterior": xr.Dataset(dict.fromkeys(names, draws))})
    figure = plots.corner(tree)
    FigureCanvasAgg(figure).draw()
    below = [axes.xaxis.label.get_window_extent() for axes in figure.axes[-3:]]
    for box in (*below, *(axes.yaxis.label.get_window_extent() for axes in figure.axes[3::3])):
        assert box.x0 > 0
        assert box.y0 > 0
    assert all(left.x1 < right.x0 for left, right in pairwise(below))


def test_panels_without_numbers_have_ticks_where_those_with_numbers_have_them(oleo):
    figure = plots.residual(oleo, "force")
    FigureCanvasAgg(figure).draw()
    first, inner, last = figure.axes[0], figure.axes[1], figure.axes[-1]
    assert (first.yaxis.get_visible(), inner.yaxis.get_visible()) == (True, False)
    assert (last.xaxis.get_visible(), inner.xaxis.get_visible()) == (True, False)
    marks = {line.get_marker(): line.get_data() for line in inner.lines}
    low, high = first.get_ylim()
    numbered = [tick for tick in first.get_yticks() if low <= tick <= high]
    assert len(numbered) > 1
    np.testing.assert_allclose(marks[TICKLEFT][1], numbered)
    np.testing.assert_allclose(marks[TICKDOWN][0], last.get_xticks())


def test_the_band_of_averages_is_that_of_the_mixture():
    rng = np.random.default_rng(7)
    centres, sd = rng.normal(size=(60, 5)), rng.uniform(0.5, 2.0, 60)
    for probability in (0.025, 0.5, 0.975):
        limit = _quantile(centres, sd, probability)
        reached = ndtr((limit - centres) / sd[:, None]).mean(axis=0)
        np.testing.assert_allclose(reached, probability, atol=5e-4)
    # A single draw is a normal distribution, and nothing is left to be found.
    np.testing.assert_allclose(_quantile(centres[:1], sd[:1], 0.5), centres[0], rtol=1e-12)


def test_a_posterior_of_zero_width_is_no_error(oleo):
    tree = xr.DataTree.from_dict(
        {"posterior": oleo["posterior"].to_dataset()[["breakaway", "conduction"]].copy(deep=True)}
    )
    tree["posterior/breakaway"][:] = 3.0
    for draw in (plots.corner, plots.trace):
        texts(draw(tree))


def broadband(harmonics=300, count=4096):
    """A multisine that 120 bins of phase cannot show."""
    rng = np.random.default_rng(3)
    phase = np.tile(np.arange(count) / count, 2)[None]
    angle = 2 * np.pi * np.arange(1, harmonics + 1)[:, None] * phase
    signal = np.cos(angle + 2 * np.pi * rng.random((harmonics, 1))).sum(axis=0)[None]
    velocity = np.gradient(signal[0])[None]
    dims = (schema.RUN, schema.SAMPLE)
    data = {
        "voltage": (dims, signal, {"units": "V"}),
        "time": (dims, phase),
        "phase": (dims, phase),
    }
    e = {
        "voltage_before": (dims, signal**3),
        "stroke": (dims, signal),
        "velocity": (dims, velocity),
    }
    constant = {"frequency": ("run", [1.0]), "role": ("run", ["fit"])}
    return xr.DataTree.from_dict(
        {
            "records": xr.Dataset(data, coords={"run": ["a"]}),
            "constant_data": xr.Dataset(constant),
            "prediction": xr.Dataset({"voltage_before": (dims, 0.9 * signal)}),
            "residual": xr.Dataset(e),
        }
    )


def test_a_signal_of_many_harmonics_is_shown_raw_and_its_residual_by_value():
    tree = broadband()
    signal = tree["records/voltage"].values[0]
    fit = plots.fit(tree, "voltage").axes[0]
    shown = lines(fit, style.MEASURED)[0].get_ydata()
    assert np.isin(np.round(shown, 9), np.round(signal, 9)).all()
    x, y = lines(plots.residual(tree, "voltage", "stroke").axes[0], style.BEFORE)[0].get_data()
    assert np.corrcoef(np.asarray(x) ** 3, y)[0, 1] > 0.999
    texts(plots.records(tree))


def test_thinning_keeps_the_extremes():
    y = np.random.default_rng(0).normal(size=10_000)
    x, thinned = reading.thin(np.arange(y.size), y)
    assert thinned.size <= 2 * reading.BINS
    assert (thinned.min(), thinned.max()) == (y.min(), y.max())
    assert (np.diff(x) > 0).all()


def test_folding_averages_and_breaks_off_in_a_gap():
    phase = np.concatenate((np.arange(0.005, 0.3, 0.01), np.arange(0.605, 1.0, 0.01), [np.nan]))
    x, means = reading.fold(phase, 3.0 * phase, 50)
    gap = np.flatnonzero(~np.isfinite(x))
    assert gap.size == 1
    np.testing.assert_allclose(x[:2], [0.01, 0.03])
    np.testing.assert_allclose(means, 3.0 * x)
    assert (x[gap - 1] < 0.3).all()
    assert (x[gap + 1] > 0.6).all()


@pytest.mark.parametrize("per_period", [7, 40, 60, 100, 130])
def test_few_samples_of_a_period_are_all_drawn(per_period):
    jitter = 1e-12 * np.random.default_rng(0).normal(size=30 * per_period)
    phase = (np.arange(30 * per_period) / per_period + jitter) % 1.0
    x, means = reading.fold(phase, np.sin(2 * np.pi * phase))
    assert np.isfinite(x).all()
    # The sample at the end of the period may be drawn at both of its ends.
    assert 0 <= x.size - min(per_period, reading.BINS) <= 1
    np.testing.assert_allclose(means, np.sin(2 * np.pi * x), atol=2e-3)
    assert reading.is_few(x) == (x.size <= reading.BINS // 2)


def sparse(tree, step):
    """A result whose records have fewer samples."""
    groups = ("records", "prediction", "residual")
    thin = {name: tree[name].to_dataset().isel(sample=slice(None, None, step)) for name in groups}
    found = xr.DataTree.from_dict({**thin, "constant_data": tree["constant_data"].to_dataset()})
    found.attrs = dict(tree.attrs)
    return found


@pytest.mark.parametrize(
    "draw",
    [
        plots.records,
        lambda tree: plots.fit(tree, "force"),
        lambda tree: plots.residual(tree, "force"),
        lambda tree: plots.residual(tree, "force", "velocity"),
    ],
)
def test_no_panel_is_empty_at_26_samples_a_period(oleo, draw):
    for axes in draw(sparse(oleo, 10)).axes:
        drawn = [np.count_nonzero(np.isfinite(one.get_ydata())) for one in axes.lines]
        assert max(drawn) >= 20
        marked = [one for one in axes.lines if one.get_marker() == "o"]
        assert marked or all(np.diff(np.flatnonzero(np.isfinite(one.get_xdata()))).min() == 1
                             for one in axes.lines if np.size(one.get_ydata()) > 2)  # fmt: skip


def test_shares_of_no_excess_are_not_drawn(oleo):
    """An output at its noise has no shares; what is left of another has none below zero."""
    residual = oleo["residual"].to_dataset()
    noise = residual["pressure_noise"].values[:, None]
    quiet = np.random.default_rng(2).normal(size=residual["pressure_before_mean"].shape) * noise
    quiet = residual.assign(pressure_before_mean=(("run", "phase"), quiet))
    groups = {name: oleo[name].to_dataset() for name in ("records", "constant_data")}
    figure = plots.residual_breakdown(xr.DataTree.from_dict({**groups, "residual": quiet}))
    assert len(figure.axes) == 2
    assert "no excess: pressure" in texts(figure)
    heights = [bar.get_height() for bar in figure.axes[0].patches]
    assert min(heights) >= 0.0
    quiet["force_before_mean"] = quiet["force_noise"] * np.sign(quiet["pressure_before_mean"])
    nothing = plots.residual_breakdown(xr.DataTree.from_dict({**groups, "residual": quiet}))
    assert texts(nothing) == ["no error beyond the noise: force, pressure"]


def test_a_share_below_nothing_is_none_and_a_small_one_is_not():
    assert [format_share(gain) for gain in (-1.0, 0.0, 4e-4, 5e-4, 0.0126, 1.0)] == [
        "none", "none", "< 0.1 %", "0.1 %", "1.3 %", "100.0 %"
    ]  # fmt: skip


def test_colours_can_be_read_and_told_from_white():
    """Contrast of 4.5 of text and of 3 of lines and marks (WCAG 2.1, AA)."""
    assert style.contrast("#ffffff", "#000000") == pytest.approx(21.0)
    assert style.contrast("#777777", "white") == pytest.approx(4.48, abs=0.01)
    for text in (style.INK, style.FAINT, style.BEFORE, style.AFTER):
        assert style.contrast(text, "white") >= 4.5
    for ground in (style.NOISE, style.SIMILAR, "#eef4f9"):
        assert style.contrast(style.INK, ground) >= 4.5
    for mark in (style.MEASURED, style.BEFORE, style.AFTER, *style.ENSEMBLES):
        assert style.contrast(mark, "white") >= 3.0
    shades = [to_hex(_SHADES(value)) for value in np.linspace(0, 1, 21)]
    assert min(style.contrast(style.text_on(shade), shade) for shade in shades) >= 4.5


def test_many_runs_are_cut_and_that_is_said(oleo):
    wide = xr.DataTree.from_dict(
        {
            name: xr.concat([oleo[name].to_dataset()] * 2, schema.RUN)
            for name in ("records", "prediction", "constant_data")
        }
    )
    figure = plots.fit(wide, "force")
    assert len(figure.axes) == style.MOST_PANELS
    assert "first 24 of 28 runs" in texts(figure)


def test_labels_of_users_are_no_mathematics(oleo):
    runs = list(oleo["records"]["run"].values)
    runs[0] = r"a$\frac{$ <b>" + "\n" + "x" * 80
    tree = oleo.copy()
    tree["records"] = xr.DataTree(oleo["records"].to_dataset().assign_coords(run=runs))
    shown = texts(plots.records(tree))
    assert any(text.startswith(r"a\$") and len(text) < 30 for text in shown)


def test_figures_need_no_pyplot(oleo):
    known = "matplotlib.pyplot" in sys.modules
    before = sys.modules["matplotlib.pyplot"].get_fignums() if known else []
    plots.fit(oleo, "force")
    after = sys.modules["matplotlib.pyplot"].get_fignums() if known else []
    assert after == before


def test_probabilities_of_structures_are_drawn_as_stored(oleo):
    tree = oleo.copy()
    summary = json.loads(tree.attrs["summary"])
    effects = [
        {"effect": "Stribeck_friction", "target": "stroke", "title": "", "probability": 0.9},
        {"effect": "play", "target": "stroke", "title": "", "probability": 0.002},
    ]
    listed = [
        {"effects": ["Stribeck_friction @ stroke"], "outside": outside, "probability": p,
         "estimated": True}
        for outside, p in ((False, 0.86), (True, 0.04))
    ]  # fmt: skip
    known = {"nothing": 0.06, "outside": 0.08, "effects": effects, "list": listed}
    tree.attrs["summary"] = json.dumps(summary | {"targets": ["stroke"], "structures": known})
    figure = plots.structures(tree)
    shown = texts(figure)
    assert {"0.06", "0.08", "0.90", "0.86", "0.04", "nothing missing"} <= set(shown)
    assert not any("play" in text for text in shown)
    widths = [bar.get_width() for bar in figure.axes[0].patches]
    assert widths[1::2] == [0.06, 0.9, 0.08]


def test_results_without_probabilities_have_no_such_figure(oleo):
    with pytest.raises(InputError, match="holds no probabilities of structures"):
        plots.structures(oleo)
