"""Figures of the report with their captions, a call for each; those without data are left out.

Figures and formulas are embedded as ``<img>`` with their data: SVG inside the page would share its
ids between figures.
"""

from __future__ import annotations

import base64
import io
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import matplotlib
import numpy as np
import xarray as xr
from matplotlib import mathtext
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from numpy.typing import NDArray

from bayesoleo import _schema as schema, plots
from bayesoleo._report.sentences import begin, response_entries, response_sentence
from bayesoleo._report.structures import proposal_table
from bayesoleo._report.tables import words
from bayesoleo._types import Array
from bayesoleo.assessment._residual_breakdown import residual_breakdown
from bayesoleo.effects._catalogue import called, listed
from bayesoleo.errors import InputError
from bayesoleo.plots import _reading as reading, _style as style
from bayesoleo.plots._residuals import Against, has_excess
from bayesoleo.plots._style import Scale, engineering

LARGEST_SVG = 300_000
"""Bytes above which a figure is stored as pixels instead; a page stays below some megabytes."""
MOST_PANELS = 64
"""Panels beyond which it is too large in any case, such as those of a posterior's many pairs."""
DPI = 130
FORMULA_SIZE = 12.0

# Matplotlib's settings are global; two reports may be written at once.
_settings = threading.Lock()


@dataclass(frozen=True)
class Image:
    """A picture: its data URI, and its size in points."""

    source: str
    width: float
    height: float


def encode_figure(figure: Figure) -> Image:
    """A figure as SVG, or as PNG where that would be too large.

    Parameters
    ----------
    figure : Figure

    Returns
    -------
    Image
        The same bytes for the same figure: no date, no random ids.
    """
    width, height = (72.0 * side for side in figure.get_size_inches())
    if len(figure.axes) <= MOST_PANELS:
        svg = _short(_save(figure, "svg", metadata={"Date": None, "Creator": None}))
        if len(svg) <= LARGEST_SVG:
            return Image(_uri("image/svg+xml", svg), width, height)
    return Image(_uri("image/png", _save(figure, "png", dpi=DPI)), width, height)


def encode_formula(latex: str) -> Image | None:
    """A formula as SVG, None where Matplotlib's small TeX does not know what is in it.

    Parameters
    ----------
    latex : str
        Without dollar signs.

    Returns
    -------
    Image or None
    """
    buffer = io.BytesIO()
    properties = FontProperties(size=FORMULA_SIZE, math_fontfamily="cm")
    text = f"${' '.join(latex.split())}$"
    try:
        with _settings, matplotlib.rc_context({"svg.hashsalt": "bayesoleo"}):
            mathtext.math_to_image(text, buffer, prop=properties, dpi=72, format="svg")
    # Whatever it stumbles on, the text is shown instead.
    except (ValueError, RuntimeError, KeyError, IndexError):
        return None
    svg = re.sub(rb"<metadata>.*?</metadata>", b"", buffer.getvalue(), flags=re.DOTALL)
    size = re.search(rb'<svg[^>]*?width="([\d.]+)pt"[^>]*?height="([\d.]+)pt"', svg)
    size = size or re.search(rb'viewBox="0 0 ([\d.]+) ([\d.]+)"', svg)
    if size is None:
        return None
    return Image(_uri("image/svg+xml", svg), float(size[1]), float(size[2]))


def _save(figure: Figure, kind: str, **options: Any) -> bytes:
    buffer = io.BytesIO()
    with _settings, matplotlib.rc_context({"svg.hashsalt": "bayesoleo"}), warnings.catch_warnings():
        # A label may be in a script that the font lacks; a box in its place is no reason to stop.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure.savefig(buffer, format=kind, **options)
    return buffer.getvalue()


def _short(svg: bytes) -> bytes:
    """Coordinates of paths to a hundredth of a point, and no letter at the end of each line: takes
    less than half the room.
    """
    return re.sub(r' d="[^"]*"', _short_path, svg.decode()).encode()


def _short_path(path: re.Match[str]) -> str:
    text = re.sub(r"(\.\d\d)\d+", r"\1", path[0])
    # Pairs that follow a line's end are lines, as those that follow the beginning of a path.
    return text if "C" in text or "Q" in text else re.sub(r"(?<=\d) \nL ", " ", text)


def _uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


@dataclass(frozen=True)
class CaptionedFigure:
    """A figure on the page."""

    image: Image
    caption: str


@dataclass
class Drawing:
    """Draws figures; one that fails is left out and named.

    Parameters
    ----------
    failed : list of str
        Sentences about those that failed.
    """

    failed: list[str] = field(default_factory=list)

    def of[Found](self, what: str, draw: Callable[[], list[Found]]) -> list[Found]:
        """What a function gives; nothing where it fails."""
        try:
            return draw()
        except Exception as error:
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            said = f"A figure of {what} could not be drawn. {reason}"
            self.failed += [said] if said not in self.failed else []
            return []


Draw = Callable[[], Figure]
#: Draws one figure of a kind; gives None where there is nothing to show.
Drawer = Callable[[], CaptionedFigure | None]

LOOPS: tuple[Against, ...] = ("velocity", "stroke")


def data_figures(tree: xr.DataTree) -> list[Drawer]:
    """The records."""
    caption = (
        f"The records as measured{averaged_over(tree)}. All runs of a channel share its scale."
    )
    return _each([(lambda: plots.records(tree), caption)] if reading.channels(tree) else [])


def response_figures(tree: xr.DataTree) -> list[Drawer]:
    """What multisine runs show before any model; nothing without such runs."""
    group = reading.group(tree, schema.FREQUENCY_RESPONSE)
    if group is None:
        return []
    lead = (
        "Left: the best linear approximation, its standard deviation by noise (between periods) "
        "and in total (between realisations). Right: the output at excited lines and at detection "
        "lines, which the input does not excite and where a linear system has noise only; squares "
        "are the stochastic distortion of one realisation."
    )
    entries: list[tuple[Draw, str]] = []
    for output in map(str, group[schema.OUTPUT].values):
        said = [
            response_sentence(entry) + "."
            for entry in response_entries(group)
            if entry["output"] == output
        ]
        draw = partial(plots.frequency_response, group, output)
        entries.append((draw, f"{lead} {' '.join(map(begin, said))}"))
    return _each(entries)


def averaged_over(tree: xr.DataTree, lead: str = ", averaged over the periods of each run") -> str:
    """That runs are averaged over their periods, where they have periods."""
    periodic = [run.periodic for run in reading.runs(tree)]
    if not any(periodic):
        return ""
    return lead if all(periodic) else f"{lead} that has periods"


def fit_figures(tree: xr.DataTree) -> list[Drawer]:
    """Measurement and prediction of each output."""
    entries: list[tuple[Draw, str]] = []
    for output in reading.outputs(tree):
        caption = f"Measured {output} and what the model predicts."

        entries.append((partial(plots.fit, tree, output), caption))
    return _each(entries)


def breakdown_figure(tree: xr.DataTree) -> list[Drawer]:
    """The breakdown of the repeating residual."""
    return [partial(_breakdown, tree)]


def _breakdown(tree: xr.DataTree) -> CaptionedFigure | None:
    """Nothing without a periodic run that has one."""
    try:
        excess = residual_breakdown(tree)["excess"].values
    except (InputError, KeyError):
        return None
    if not any(map(has_excess, excess)):
        return None
    caption = (
        "How the repeating error divides over harmonics and coordinates, all runs together. Each "
        "bar is the share that one function of that coordinate, the same in all runs, explains; "
        "for run and group it is a constant for each. Constants point to conditions and sensors, "
        "a function of velocity to friction and damping, of position to stiffness and gas."
    )
    return _captioned(lambda: plots.residual_breakdown(tree), caption)


def residual_figures(tree: xr.DataTree) -> list[Drawer]:
    """The residual of each output against phase, velocity and stroke."""
    if schema.RESIDUAL not in tree.children:
        return []
    return _each(list(_residuals(tree)))


def residual_title(tree: xr.DataTree) -> str:
    """Title of the section: what the residuals are shown against."""
    if schema.RESIDUAL not in tree.children:
        return "Residual"
    *most, last = [
        _place(tree),
        *(against for against in LOOPS if against in tree[schema.RESIDUAL]),
    ]
    return f"Residual against {', '.join(most)} and {last}" if most else f"Residual against {last}"


def _place(tree: xr.DataTree) -> str:
    """What runs are drawn over."""
    return "phase" if any(run.periodic for run in reading.runs(tree)) else "time"


def _residuals(tree: xr.DataTree) -> Iterator[tuple[Draw, str]]:
    loops = (
        "A cycle is a loop; where it closes to a line the residual is a function of {}, and "
        "the line is the shape of what is missing."
    )
    for output in reading.outputs(tree):
        yield (
            partial(plots.residual, tree, output),
            f"Residual of {output} against {_place(tree)}{averaged_over(tree)}.",
        )
        for against in LOOPS:
            if against in tree[schema.RESIDUAL]:
                what = reading.coordinate_name(tree[schema.RESIDUAL].to_dataset(), against)
                yield (
                    partial(plots.residual, tree, output, against),
                    f"Residual of {output} against {what}. {loops.format(what)}",
                )


def structures_figure(tree: xr.DataTree) -> list[Drawer]:
    """The probabilities of what is missing; nothing where they are not known."""
    if not reading.summary(tree).get("structures"):
        return []
    caption = (
        "Left: probability that nothing is missing, that each effect acts, alone or with others, "
        "and that something outside the catalogue does; what was added is blue. Right: the most "
        "probable structures, a column each with its probability on top and a dot for each member; "
        "hollow dots: from scores, not estimated together."
    )
    return _each([(lambda: plots.structures(tree), caption)])


def ranking_figure(tree: xr.DataTree, number: int) -> list[Drawer]:
    """The candidates of one round."""
    caption = (
        f"Candidates of round {number + 1}: the share of the excess error that each would "
        "explain, and the probability of such a share if it were not there."
    )
    entry = reading.summary(tree)["rounds"][number]
    if entry["accepted"]:
        caption += " These data cannot tell the effects marked ≈ from the accepted one."
    return _each([(lambda: plots.ranking(tree, number), caption)] if entry["candidates"] else [])


def proposal_figure(tree: xr.DataTree, entry: Mapping[str, Any]) -> list[Drawer]:
    """Where on the rig's range the rivals of one round would be told apart."""
    group = reading.group(tree, schema.PROPOSAL)
    if group is None or proposal_table(entry) is None:
        return []
    rounds = [int(number) for number in group[schema.ROUND].values]
    if entry["round"] not in rounds:
        return []
    titles = reading.summary(tree).get("titles", {})
    names = dict.fromkeys(e for one in entry["rivals"] for e in one.split(" + "))
    rivals = listed([called(one, titles) for one in names])
    if entry["question"] == "parameters":
        caption = "Information of a run on the parameters. Where it is blank the rig cannot go."
        return _each([(lambda: plots.proposal(tree, rounds.index(entry["round"])), caption)])
    caption = (
        "Standard deviations by which a run would separate the least separated pair of "
        f"{rivals}, at the mean position that is best for it. Where it is blank the rig cannot go."
    )
    return _each([(lambda: plots.proposal(tree, rounds.index(entry["round"])), caption)])


def nonparametric_figure(tree: xr.DataTree, entry: Mapping[str, Any]) -> list[Drawer]:
    """The shape of an effect without a name, in the round that added it."""
    if schema.NONPARAMETRIC not in tree.children:
        return []
    if entry["accepted"] != tree[schema.NONPARAMETRIC].attrs["effect"]:
        return []
    caption = (
        "The effect that has no name: what it adds to the balance, beside all that the model's own "
        "terms do, with its 95 % band. Beyond the range shown nothing is known of it."
    )
    return _each([(lambda: plots.nonparametric_shape(tree), caption)])


def error_figure(tree: xr.DataTree) -> list[Drawer]:
    """The error of each run."""
    of, what = words(reading.summary(tree)), reading.averaged_word(tree).capitalize()
    caption = f"{what} error of each run over {of}, on a logarithmic axis. At 1 nothing is missing."
    return _each([(lambda: plots.error(tree), caption)])


def posterior_figures(tree: xr.DataTree) -> list[Drawer]:
    """Pairs, and the point against the posterior."""
    if schema.POSTERIOR not in tree.children:
        return []
    pairs = (
        "Posterior of the parameters, pair by pair; contours hold 39 and 86 % of the draws, as one "
        "and two standard deviations of a normal density do. Lines: the point estimate."
    )
    forest = (
        "Point estimate and its linearised standard deviation against the posterior. Where both "
        "agree, the problem is as good as linear within its uncertainty."
    )
    entries: list[tuple[Draw, str]] = [(lambda: plots.corner(tree), pairs)]
    if schema.POINT in tree.children:
        entries.append((lambda: plots.point_against_posterior(tree), forest))
    return _each(entries)


def predictive_figures(tree: xr.DataTree) -> list[Drawer]:
    """The posterior prediction of each output."""
    if schema.PERIOD_PREDICTIVE not in tree.children:
        return []
    entries: list[tuple[Draw, str]] = []
    for output in reading.outputs(tree):
        if schema.average_sd(output) in tree[schema.PERIOD_PREDICTIVE]:
            caption = (
                f"Measured {output}{averaged_over(tree)}, about the prediction. "
                "Dark: what the parameters leave open; light: where 95 % of such averages would "
                "lie if the run were repeated, with errors as the error model has them."
            )

            entries.append((partial(plots.predictive, tree, output), caption))
    return _each(entries)


def trace_figures(tree: xr.DataTree) -> list[Drawer]:
    """The chains."""
    if schema.POSTERIOR not in tree.children:
        return []
    caption = "Some walkers of each ensemble, one colour an ensemble: colours must not keep apart."
    return _each([(lambda: plots.trace(tree), caption)])


#: Numbers of one curve of the viewer at least and at most, and of all curves together.
FEWEST_POINTS, MOST_POINTS, ALL_POINTS = 240, 1200, 100_000


def viewer(tree: xr.DataTree) -> dict[str, Any] | None:
    """What the page's script draws: measurement, prediction and residual of one run at a time.

    Parameters
    ----------
    tree : DataTree

    Returns
    -------
    dict or None
        Numbers in the units of the axes, for JSON; None without a prediction.
    """
    runs, names = reading.runs(tree), reading.outputs(tree)
    if not runs or not names or schema.RESIDUAL not in tree.children:
        return None
    stages = [s for s in _STAGES if f"{names[0]}_{s}" in tree[schema.PREDICTION].to_dataset()]
    share = ALL_POINTS // (2 * len(runs) * len(names) * (1 + len(stages)))
    points = min(max(share, FEWEST_POINTS), MOST_POINTS)
    shown = []
    for name in names:
        measured = reading.variable(tree, schema.RECORDS, name)
        left = reading.variable(tree, schema.RESIDUAL, schema.before(name))
        unit = reading.unit(measured)
        scales = [engineering(unit, style.magnitude(part.values)) for part in (measured, left)]
        shown.append(
            {
                "name": name,
                "unit": scales[0].unit,
                "labels": [scales[0].label(name), scales[1].label("residual")],
                "runs": [_one_run(tree, name, run, scales, stages, points) for run in runs],
            }
        )
    two = len(stages) > 1
    words = {"measured": "measured", "before": "before" if two else "model", "after": "after"}
    about = [{"label": r.label, "role": r.role, "remark": r.remark} for r in runs]
    return {"runs": about, "outputs": shown, "words": words, "stages": stages}


_STAGES = ("before", "after")


def _one_run(
    tree: xr.DataTree,
    name: str,
    run: reading.RunView,
    scales: list[Scale],
    stages: list[str],
    points: int,
) -> dict[str, Any]:
    """Curves of one output in one run: signals, and below them residuals in their own unit."""
    measured = reading.variable(tree, schema.RECORDS, name).values[run.index]
    predicted, left = (tree[group].to_dataset() for group in (schema.PREDICTION, schema.RESIDUAL))
    curves = {"measured": measured}
    curves |= {s: predicted[f"{name}_{s}"].values[run.index] for s in stages}
    errors = {s: left[f"{name}_{s}"].values[run.index] for s in stages}
    position = reading.abscissa(tree, run)
    if run.periodic and reading.is_resolved(position, measured):
        folded = {key: reading.fold(position, y, points) for key, y in curves.items()}
        means = {s: reading.averaged_residual(tree, f"{name}_{s}", run) for s in stages}
        x, below = folded["measured"][0], means[stages[0]][0]
        label, ends = "phase in cycles", [0.0, 1.0]
        curves = {key: y for key, (_, y) in folded.items()}
        errors = {s: y for s, (_, y) in means.items()}
        band = (
            float(left[schema.noise(name)].values[run.index])
            if schema.noise(name) in left
            else np.nan
        )
    else:
        time = reading.variable(tree, schema.RECORDS, schema.TIME).values[run.index]
        chosen = _telling([measured, *errors.values()], np.isfinite(time), points, run.periodic)
        curves = {key: y[chosen] for key, y in curves.items()}
        errors = {s: y[chosen] for s, y in errors.items()}
        x = below = time[chosen]
        label, band, ends = "time in s", np.nan, [float(x[0]), float(x[-1])]
    return {
        "x": _numbers(x), "x_label": label, "ends": ends,
        **{key: _numbers(scales[0].factor * y) for key, y in curves.items()},
        "residual": {
            "x": _numbers(below), "band": _number(scales[1].factor * band),
            **{s: _numbers(scales[1].factor * y) for s, y in errors.items()},
        },
    }  # fmt: skip


def _telling(
    curves: list[Array], known: NDArray[np.bool_], points: int, periodic: bool
) -> NDArray[np.intp]:
    """Indices of samples to draw: extremes of stretches of a transient, else a stretch."""
    every = np.flatnonzero(known)
    if every.size <= points:
        return every
    if periodic:
        middle = every.size // 2
        return every[middle - points // 2 : middle + points // 2]
    chosen: set[int] = set()
    for part in np.array_split(every, points // (2 * len(curves))):
        for curve in curves:
            values = np.where(np.isfinite(curve[part]), curve[part], 0.0)
            chosen |= {int(part[values.argmin()]), int(part[values.argmax()])}
    return np.array(sorted(chosen), dtype=np.intp)


def _numbers(values: Array) -> list[float | None]:
    return [_number(value) for value in np.asarray(values, dtype=float)]


def _number(value: float) -> float | None:
    """Five digits: more than a screen can show."""
    return float(f"{value:.5g}") if np.isfinite(value) else None


def _each(entries: list[tuple[Draw, str]]) -> list[Drawer]:
    """One call for each figure, so that several processes can share those of a kind."""
    return [partial(_captioned, draw, caption) for draw, caption in entries]


def _captioned(draw: Draw, caption: str) -> CaptionedFigure:
    return CaptionedFigure(encode_figure(draw()), caption)
