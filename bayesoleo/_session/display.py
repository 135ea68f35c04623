"""How the objects of a session show themselves.

All of them are shown as a table and, in a notebook, with a small figure; they can be pickled and
keep their results. The figures here have no equivalent in :mod:`bayesoleo.plots`.
"""

from __future__ import annotations

import base64
import inspect
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import wraps
from html import escape
from typing import Any

import cloudpickle
import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayesoleo import _schema as schema, plots
from bayesoleo._parallel import session_blas_threads
from bayesoleo._report import structures
from bayesoleo._schema import LabelledResult, columns
from bayesoleo._storage.resume import digest
from bayesoleo._types import Array
from bayesoleo.errors import InputError, choose
from bayesoleo.plots import _reading as reading, _style as style
from bayesoleo.plots._discovery import SHOWN, format_probability
from bayesoleo.plots._style import engineering

_MEASURED, _PREDICTED = "_measured", "_predicted"


def measured_name(output: str) -> str:
    """Name of the variable with an output's measurements."""
    return output + _MEASURED


def predicted_name(output: str) -> str:
    """Name of the variable with an output's predictions."""
    return output + _PREDICTED


def outputs(data: xr.Dataset) -> list[str]:
    """Output channels of residuals."""
    names = [str(name) for name in data.data_vars]
    return [name for name in names if measured_name(name) in names]


def abscissa_of(one: xr.Dataset) -> str:
    """The coordinate over which a run is drawn: phase, time, or a function's input."""
    names = [str(name) for name in one.coords if schema.SAMPLE in one[name].dims]
    if schema.PHASE in names and not one[schema.PHASE].notnull().any():
        names.remove(schema.PHASE)  # of a transient
    return next(name for name in (schema.PHASE, schema.TIME, *names) if name in names)


def residuals(tree: xr.DataTree) -> xr.Dataset:
    """Residual, measurement and prediction of each output of each predicted run.

    Parameters
    ----------
    tree : DataTree
        With ``records``, ``prediction`` and ``residual``. Of a result with added effects,
        those of the extended model.

    Returns
    -------
    Dataset
        ``<output>``, ``<output>_measured``, ``<output>_predicted`` ``(run, sample)`` with the
        coordinates ``time`` and ``phase``, or the inputs of a function.
    """
    predictions = tree[schema.PREDICTION].to_dataset()
    left = tree[schema.RESIDUAL].to_dataset()
    observed = tree[schema.RECORDS].to_dataset().sel({schema.RUN: predictions[schema.RUN]})
    width = predictions.sizes[schema.SAMPLE]
    observed = observed.isel({schema.SAMPLE: slice(width)})
    end, data = schema.before(""), {}
    names = [str(n)[: -len(end)] for n in predictions.data_vars if str(n).endswith(end)]
    for name in names:
        stage = schema.after if schema.after(name) in predictions else schema.before
        about = dict(observed[name].attrs)
        data[name] = left[stage(name)].drop_attrs().assign_attrs(about)
        data[name].attrs[schema.LONG_NAME] = f"residual of {name}"
        data[measured_name(name)] = observed[name]
        data[predicted_name(name)] = predictions[stage(name)]
    places = {name: item for name, item in observed.data_vars.items() if name not in names}
    kept = {n: v for n, v in places.items() if n in (schema.TIME, schema.PHASE)} or places
    return xr.Dataset(data).assign_coords(kept)


#: Correlation of neighbouring residuals, in standard deviations of white ones, that is told.
ALIKE = 3.0


def misfit(tree: xr.DataTree, output: str, sd: float) -> str:
    """How a residual compares with the noise of its output; of a function, with its neighbours.

    Parameters
    ----------
    tree : DataTree
        Of a fit.
    output : str
    sd : float
        Standard deviation of the residual, SI.
    """
    left = tree[schema.RESIDUAL].to_dataset()[schema.before(output)]
    if schema.NOISE in tree.children:
        noise = tree[schema.NOISE].to_dataset()[output].sel({schema.RUN: left[schema.RUN]})
        size = float(np.sqrt((noise**2).weighted(left.count(schema.SAMPLE)).mean()))
        return f", {sd / size:.3g} times the noise of a sample ({size:.4g})" if size > 0 else ""
    data = residuals(tree)
    values, place = np.asarray(data[output].values[0]), abscissa_of(data)
    inputs = [name for name in data.coords if schema.SAMPLE in data[name].dims]
    if len(inputs) == 1:
        values = values[np.argsort(data[place].values[0], kind="stable")]
    alike = float(values[1:] @ values[:-1] / (values @ values)) if values.any() else 0.0
    if values.size < 20 or alike * np.sqrt(values.size) < ALIKE:
        return ""
    return (
        f"; neighbouring residuals are alike (correlation {alike:.2f}): a term is missing, or "
        "errors are correlated"
    )


#: Runs shown at most, and columns of the figure.
RUNS, COLUMNS = 12, 4


def fit_and_residual(data: xr.Dataset, output: str | None = None) -> Figure:
    """Measurement and prediction of each run, and the residual below them.

    Parameters
    ----------
    data : xarray.Dataset
        Of :func:`bayesoleo._session.display.residuals`.
    output : str, optional
        By default all, one below the other.

    Raises
    ------
    InputError
        If there is no such output.
    """
    known = outputs(data)
    if output is not None and output not in known:
        hint = choose(output, known)
        raise InputError("there is no such output", key="output", value=output, hint=hint)
    names = known if output is None else [output]
    runs = [str(run) for run in data[schema.RUN].values[:RUNS]]
    columns = min(len(runs), COLUMNS)
    rows = -(-len(runs) // columns)
    height = 2.9 * rows * len(names) + 0.6
    figure = style.blank(2.6 * columns + 1.0, height)
    parts = figure.subfigures(len(names), 1, squeeze=False)[:, 0]
    for name, part in zip(names, parts, strict=True):
        axes = part.subplots(
            2 * rows, columns, squeeze=False, gridspec_kw={"height_ratios": [2, 1] * rows}
        )
        _runs(axes, data, name, runs)
        part.subplots_adjust(0.09, 0.2 / rows, 0.98, 1 - 0.09 / rows, 0.25, 0.35)
    return figure


def _runs(axes: NDArray[Any], data: xr.Dataset, name: str, runs: list[str]) -> None:
    """One output of all runs."""
    measured = data[measured_name(name)]
    scale = engineering(reading.unit(measured), style.magnitude(measured.values))
    columns = axes.shape[1]
    for place in axes.flat:
        place.set_visible(False)
    for number, run in enumerate(runs):
        row, column = 2 * (number // columns), number % columns
        upper, lower = axes[row, column], axes[row + 1, column]
        for place in (upper, lower):
            place.set_visible(True)
            style.dress(place)
        one = data.sel({schema.RUN: run})
        _curves(upper, lower, one, name, scale.factor)
        upper.set_title(style.plain(run, 24), fontsize=style.TEXT, loc="left")
        upper.tick_params(labelbottom=False)
        lower.set_xlabel(abscissa_of(one), fontsize=style.SMALL)
        if column == 0:
            upper.set_ylabel(scale.label(name), fontsize=style.SMALL)
            lower.set_ylabel("residual", fontsize=style.SMALL)
    axes[0, 0].legend(frameon=False, fontsize=style.SMALL)


def _curves(upper: Axes, lower: Axes, one: xr.Dataset, name: str, factor: float) -> None:
    """Measured broad and pale, so that a prediction that lies on it can be seen on it."""
    place = abscissa_of(one)
    x = np.asarray(one[place].values, dtype=float)
    x = x % 1.0 if place == schema.PHASE else x
    curves = [
        factor * np.asarray(one[key].values, dtype=float)
        for key in (measured_name(name), predicted_name(name), name)
    ]
    if place == schema.PHASE and reading.is_resolved(x, curves[0]):
        lines = [reading.fold(x, curve) for curve in curves]
    else:
        lines = [_in_order(x, curve) for curve in curves]
    many = not reading.is_few(lines[0][0])
    shape = {"lw": 4.0, "alpha": 0.55} if many else {"lw": 0.0, "marker": "o", "ms": 3.5}
    upper.plot(*lines[0], color=style.MEASURED, label="measured", **shape)
    upper.plot(*lines[1], color=style.BEFORE, lw=1.3, label="predicted")
    lower.axhline(0.0, color=style.NEUTRAL, lw=0.8)
    line = {"lw": 0.9} if many else {"lw": 0.0, "marker": "o", "ms": 2.5}
    lower.plot(*lines[2], color=style.BEFORE, **line)


def _in_order(x: Array, y: Array) -> tuple[Array, Array]:
    keep = np.isfinite(x) & np.isfinite(y)
    order = np.argsort(x[keep], kind="stable")
    return reading.thin(x[keep][order], y[keep][order])


def prediction(data: xr.Dataset) -> Figure:
    """Prediction of a function with its interval, over its input or the number of the sample.

    Parameters
    ----------
    data : xarray.Dataset
        Of :meth:`bayesoleo._session.results.Fit.predict` for a function.
    """
    place = str(data.attrs["place"])
    x, mean = np.asarray(data[place].values, dtype=float), data["mean"].values
    order = np.argsort(x, kind="stable")
    figure = style.blank(4.8, 3.0)
    axes = figure.subplots()
    style.dress(axes)
    low, high = data["low"].values[order], data["high"].values[order]
    axes.fill_between(x[order], low, high, color=style.NOISE, lw=0)
    axes.plot(x[order], mean[order], color=style.BEFORE, lw=1.3)
    axes.set_xlabel(place, fontsize=style.SMALL)
    axes.set_ylabel(str(data.attrs["output"]), fontsize=style.SMALL)
    figure.subplots_adjust(0.16, 0.17, 0.97, 0.96)
    return figure


def noise_and_frequency(data: xr.Dataset) -> Figure:
    """Noise of each channel over its largest, by run.

    Parameters
    ----------
    data : xarray.Dataset
        With the noise of each channel by run.
    """
    figure = style.blank(4.8, 2.2)
    axes = figure.subplots()
    style.dress(axes)
    places = np.arange(data.sizes[schema.RUN])
    for number, (name, values) in enumerate(data.data_vars.items()):
        scale = engineering(reading.unit(values), style.magnitude(values.values))
        relative = values.values / np.nanmax(values.values)
        colour = style.ENSEMBLES[number % len(style.ENSEMBLES)]
        axes.plot(places, relative, "o-", ms=3, lw=0.8, color=colour, label=scale.label(str(name)))
    axes.set_xticks(places, [style.plain(str(run), 10) for run in data[schema.RUN].values])
    axes.set_ylim(0, 1.1)
    axes.set_ylabel("noise over its largest", fontsize=style.SMALL)
    axes.legend(frameon=False, fontsize=style.SMALL)
    figure.subplots_adjust(0.14, 0.16, 0.97, 0.96)
    return figure


#: Characters of a line from which it is wrapped where it is narrow.
LONG = 60
#: Resolution of the figure below a table in a notebook, and its greatest width in pixels.
DPI, WIDTH = 60, 640


class Showing:
    """An object that shows itself as a table, in a notebook with a small figure.

    A subclass defines ``_text`` and, where it has a figure, ``plot``. Pickles hold functions of the
    user and effects by value, which plain pickles cannot.
    """

    def _text(self) -> str:
        raise NotImplementedError

    def plot(self) -> Figure | None:
        """The figure of this object, if it has one."""
        return None

    def __repr__(self) -> str:
        return self._text()

    def _repr_html_(self) -> str:
        return html(self._text(), self.plot)

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (type(self), cloudpickle.dumps(self.__dict__))


def _restored(kind: type, state: bytes) -> Any:
    found: Any = object.__new__(kind)
    found.__dict__.update(cloudpickle.loads(state))
    return found


def html(text: str, plot: Callable[[], Figure | None]) -> str:
    """A table and a small figure for a notebook; the table alone where the figure fails."""
    try:
        figure = plot()
    except Exception:  # a figure must not hide the numbers
        figure = None
    # Columns stay aligned where a notebook would wrap lines; sentences are wrapped.
    lines = "\n".join(map(_line, text.splitlines()))
    table = f'<pre style="white-space:pre;overflow-x:auto">{lines}</pre>'
    return table + ("" if figure is None else _image(figure, text.partition("\n")[0]))


def _line(text: str) -> str:
    """A row of a table as it is, and a long sentence wrapped."""
    if "  " in text or len(text) < LONG:
        return escape(text)
    return f'<span style="white-space:pre-wrap">{escape(text)}</span>'


def _image(figure: Figure, what: str) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    code = base64.b64encode(buffer.getvalue()).decode()
    shape = f"max-width:min(100%,{WIDTH}px);height:auto"
    return f'<img src="data:image/png;base64,{code}" alt="figure: {escape(what)}" style="{shape}">'


@dataclass(frozen=True, eq=False, repr=False)
class Result(LabelledResult):
    """Labelled numbers with a table and a figure.

    Parameters
    ----------
    data : xarray.Dataset
        All numbers.
    text : str
        The table.
    kind : str
        Name of the group in a :class:`xarray.DataTree`, and of the figure.
    source : xarray.DataTree, optional
        What the figure needs beyond ``data``.
    """

    kind: str = ""
    source: xr.DataTree | None = None

    def plot(self, **options: Any) -> Figure:
        """The figure; options are those of the function of this name in :mod:`bayesoleo.plots`."""
        shown: Any = self.data if self.source is None else self.source
        draw = prediction if self.kind == "prediction" else getattr(plots, self.kind)
        figure: Figure = draw(shown, **options)
        return figure

    def _repr_html_(self) -> str:
        return html(self.text, self.plot)


def result(shown: LabelledResult, kind: str) -> Result:
    """A labelled result of the package, with its figure."""
    return Result(shown.data, shown.text, kind)


def kept[**Arguments, Value](method: Callable[Arguments, Value]) -> Callable[Arguments, Value]:
    """Keep what a method returns, and return it when it is called alike again.

    Arguments are compared by their digests; ``progress`` does not count.
    """
    signature = inspect.signature(method)

    @wraps(method)
    def call(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Value:
        given = signature.bind(*args, **kwargs)
        given.apply_defaults()
        (_, self), *rest = given.arguments.items()
        named = {name: value for name, value in rest if name != "progress"}
        store: dict[str, Any] = self.__dict__.setdefault("_kept", {})
        key = f"{method.__name__} {digest(named)}"
        if key not in store:
            with session_blas_threads():
                store[key] = method(*args, **kwargs)
        found: Value = store[key]
        return found

    return call


def number(value: float, sd: float) -> str:
    """A value in as many digits as its standard deviation leaves."""
    if not (np.isfinite([value, sd]).all() and value and sd > 0):
        return f"{value:.4g}"
    digits = int(np.floor(np.log10(abs(value))) - np.floor(np.log10(sd))) + 2
    return f"{value:.{min(max(digits, 2), 12)}g}"


def structures_data(summary: Mapping[str, Any]) -> xr.Dataset:
    """Probabilities of effects and of the leading structures as labelled arrays.

    Parameters
    ----------
    summary : mapping
        As in ``summary.json``, with ``structures``.

    Returns
    -------
    xarray.Dataset
        ``probability(effect)`` with its effects named ``effect @ target``;
        ``structure_probability``, ``has_outside`` and ``estimated`` ``(structure)``; ``member``
        ``(structure, effect)``; ``nothing``, ``outside`` and ``only_outside``.
    """
    found, single = summary["structures"], structures.of_effects(summary)
    shown = found["list"]
    member = [[one in entry["effects"] for one in single] for entry in shown]
    flat = {key: [entry[key] for entry in shown] for key in ("outside", "estimated", "probability")}
    return xr.Dataset(
        {
            "probability": (schema.EFFECT, list(single.values())),
            "member": (("structure", schema.EFFECT), np.reshape(member, (len(shown), len(single)))),
            "structure_probability": ("structure", flat["probability"]),
            "has_outside": ("structure", flat["outside"]),
            "estimated": ("structure", flat["estimated"]),
            **{key: found[key] for key in ("nothing", "outside", "only_outside")},
        },
        coords={
            schema.EFFECT: list(single),
            "structure": [structures.structure_words(entry, summary) for entry in shown],
        },
    )


def structures_text(summary: Mapping[str, Any]) -> str:
    """The table of a session: single probabilities first, then structures, then classes."""
    found = summary["structures"]
    every = [
        *structures.of_effects(summary).items(),
        (structures.NOTHING, found["nothing"]),
        (structures.OUTSIDE, found["outside"]),
    ]
    every = sorted(every, key=lambda item: -item[1])
    rows = [
        [structures.title_of(one, summary), format_probability(p)] for one, p in every if p >= SHOWN
    ]
    shown = structures.table(summary)
    texts = [columns(["acts", "probability"], rows)]
    texts += [] if shown is None else [columns(shown.head, shown.rows)]
    return "\n\n".join([*texts, *structures.classes(summary)])
