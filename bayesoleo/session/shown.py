"""What all objects of a session have in common: they show themselves, are pickled, keep results."""

from __future__ import annotations

import base64
import inspect
import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from html import escape
from typing import Any

import cloudpickle
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from bayesoleo import plots
from bayesoleo.estimation.shown import LabelledResult
from bayesoleo.session import figures
from bayesoleo.storage.digest import digest

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
    return f"<pre>{escape(text)}</pre>" + ("" if figure is None else _image(figure))


def _image(figure: Figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI)
    code = base64.b64encode(buffer.getvalue()).decode()
    return f'<img src="data:image/png;base64,{code}" style="max-width:{WIDTH}px">'


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
        draw = figures.prediction if self.kind == "prediction" else getattr(plots, self.kind)
        figure: Figure = draw(shown, **options)
        return figure

    def _repr_html_(self) -> str:
        return html(self.text, self.plot)


def result(shown: LabelledResult, kind: str) -> Result:
    """What a function of the package returns, with its figure."""
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
