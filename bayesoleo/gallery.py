"""Results of long studies for the gallery, computed or stored, and the table of errors.

A page of the gallery computes a long study where data and time allow it, and otherwise shows the
stored result. The store is the folder ``studies/figures`` of the repository. A page that was
downloaded alone has no store; it says so, and shows its own short computation only. A run with
``BAYESOLEO_STORE_FIGURES=1`` renews the store.

The table compares the errors of a model before and after effects were added.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib.image
from matplotlib.figure import Figure
from PIL import Image

from bayesoleo.effects._catalogue import called
from bayesoleo.errors import number_of
from bayesoleo.plots._discovery import chosen
from bayesoleo.plots._style import engineering, format_number

__all__ = ["Study", "print_added", "print_before_after"]

DPI = 100
#: Of an effect with more parameters than these only their number is printed.
MOST_NAMES = 6


def _where(data: str) -> str:
    """How to get a data set."""
    if data.startswith("measured/"):
        return f'bayesoleo.data.dataset_folder("{Path(data).name}") fetches it'
    return "BAYESOLEO_DATA names the folder in which it is looked for"


def _folder_of(data: str) -> Path | None:
    """Folder of a data set below ``BAYESOLEO_DATA``, or of a measured one fetched before."""
    root = os.environ.get("BAYESOLEO_DATA")
    if root:
        return Path(root) / data
    if data.startswith("measured/") and find_spec("pooch") is not None:
        cache: Path = import_module("pooch").os_cache("bayesoleo")
        return cache / data.removeprefix("measured/")
    return None


def studies_folder() -> Path | None:
    """Return the repository's folder ``studies`` if the running page is in it."""
    page = Path(sys.argv[0]).resolve()
    return next((place for place in page.parents if place.name == "studies"), None)


class Study:
    """What a page shows, computed or from the store.

    Parameters
    ----------
    name : str
        Of the page; names of stored files begin with it.
    data : str, optional
        Folder of the data set below ``BAYESOLEO_DATA``. Nothing is downloaded.
    slow : bool
        Whether to compute only when the store is to be renewed.
    needs : sequence of str
        Modules of the repository's folder ``studies`` that the computation imports.
    declaration : str, optional
        Text of the ``campaign.toml`` of a measured set, which names its files.

    Attributes
    ----------
    folder : Path or None
        Of the data set.
    campaign : Path or None
        Folder with its ``campaign.toml``: a new one with the text given, else the data set's.
    live : bool
        Whether results are computed.
    """

    def __init__(
        self,
        name: str,
        data: str | None = None,
        *,
        slow: bool = False,
        needs: Sequence[str] = (),
        declaration: str = "",
    ) -> None:
        self.name = name
        self.studies = studies_folder()
        self.folder = None if data is None else _folder_of(data)
        self.campaign = self.folder
        if declaration:
            self.campaign = Path(tempfile.mkdtemp())
            (self.campaign / "campaign.toml").write_text(declaration, encoding="utf-8")
        self.storing = os.environ.get("BAYESOLEO_STORE_FIGURES") == "1"
        reason = self._reason(data, slow, needs)
        self.live = not reason
        if reason:
            print(reason, self._instead(), sep="\n")

    def _reason(self, data: str | None, slow: bool, needs: Sequence[str]) -> str:
        """Say why results are not computed; empty if they are."""
        if data is not None and (self.folder is None or not self.folder.is_dir()):
            return f"The data set {data} is not on this machine; {_where(data)}."
        if slow and not self.storing:
            return "This takes minutes; to compute it, set BAYESOLEO_STORE_FIGURES=1."
        missing = [module for module in needs if find_spec(module) is None]
        if missing:
            return f"This needs studies/{missing[0]}.py of the repository (PYTHONPATH=studies)."
        return ""

    def _instead(self) -> str:
        if self._figures() is None:
            return "The results are in the folder studies of the repository."
        return "Shown are the stored results of the last run."

    def _figures(self) -> Path | None:
        return None if self.studies is None else self.studies / "figures"

    def run[R](self, work: Callable[[], R]) -> R | None:
        """Do the work if results are computed."""
        return work() if self.live else None

    def helper(self, module: str) -> ModuleType | None:
        """Import a module of the folder ``studies`` if results are computed."""
        return self.run(lambda: import_module(module))

    def text(self, name: str, write: Callable[[], object]) -> None:
        """Print what ``write`` prints, or printed in the last run."""
        store, file = self._figures(), f"{self.name}-{name}.txt"
        if not self.live:
            if store is not None:
                print((store / file).read_text(encoding="utf-8"), end="")
            return
        caught = io.StringIO()
        with contextlib.redirect_stdout(caught):
            write()
        lines = "".join(f"{line.rstrip()}\n" for line in caught.getvalue().strip("\n").split("\n"))
        print(lines, end="")
        if self.storing and store is not None:
            (store / file).write_text(lines, encoding="utf-8")

    def figure(self, name: str, draw: Callable[[], Figure]) -> Figure | None:
        """Return the figure that ``draw`` makes, or made in the last run; None without a store."""
        store, file = self._figures(), f"{self.name}-{name}.png"
        if not self.live:
            return None if store is None else _framed(store / file)
        figure = draw()
        if self.storing and store is not None:
            _write_png(figure, store / file)
        return figure


def _write_png(figure: Figure, path: Path) -> None:
    """Write PNG with 128 colours, which is a third of the size."""
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=DPI, format="png")
    image = Image.open(drawn).convert("RGB")
    image.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


def _framed(path: Path) -> Figure:
    """Return a stored picture as a figure of its own size."""
    pixels = matplotlib.image.imread(path)
    height, width = pixels.shape[:2]
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(pixels, aspect="auto", interpolation="none")
    axes.set_axis_off()
    return figure


ROLES = ("fit", "hold-out")


def print_before_after(summary: Mapping[str, Any], unit: str, per_si: float) -> None:
    """Print both tables.

    Parameters
    ----------
    summary : mapping
        As in ``summary.json``.
    unit : str
        In which errors are shown.
    per_si : float
        How many of it one SI unit is.
    """
    head = ("rms before", "after", "repeating before", "after", "over what is expected")
    print(f"{f'error in {unit}':26}" + "".join(f"{text:>{len(text) + 3}}" for text in head))
    for role in ROLES:
        for output, last in summary["error_after"].get(role, {}).items():
            first = summary["error_before"][role][output]
            cells = [per_si * e[key] for key in ("rms", "repeating") for e in (first, last)]
            ratio = " → ".join(f"{e['ratio_to_expected']:.1f}" for e in (first, last))
            row = "".join(
                f"{value:{len(text) + 3}.3g}" for value, text in zip(cells, head, strict=False)
            )
            print(f"{f'{output}, {role}':26}{row}{ratio:>24}")
    print()
    print_added(summary)


def print_added(summary: Mapping[str, Any]) -> None:
    """Print the posterior of the effects that were added.

    Parameters
    ----------
    summary : mapping
        As in ``summary.json``.
    """
    print(f"{'posterior of what was added':34}{'mean':>10}{'sd':>10}   95 % interval")
    for effect, names in added_parameters(summary):
        print(effect)
        if len(names) > MOST_NAMES:  # such as the values of a spline
            print(f"  {number_of(len(names), 'parameter')}")
            continue
        for name in names:
            print(_line(name, summary["parameters"][name]))


def title_of(summary: Mapping[str, Any], effect: str | None) -> str:
    """What an effect is called; a dash for none."""
    return called(effect, summary.get("titles", {})) if effect else "–"


def added_parameters(summary: Mapping[str, Any]) -> Iterator[tuple[str, list[str]]]:
    """Every effect that was added and stayed, with its parameters that were estimated.

    One that was replaced and added again is told once, as it was added last.
    """
    stayed = set(zip(summary["effects"], summary["targets"], strict=True))
    found = {
        (added["effect"], added["target"]): added
        for entry in summary["rounds"]
        if (added := chosen(entry)) is not None
    }
    for key, added in found.items():
        if key not in stayed:
            continue
        names = [name for name in added["expected"] if name in summary["parameters"]]
        yield title_of(summary, f"{added['effect']} @ {added['target']}"), names


def _line(name: str, entry: Mapping[str, Any]) -> str:
    scale = engineering(entry["unit"], abs(entry["mean"]))
    if entry["interval"] is None:
        mean = f"{scale.factor * entry['mean']:.4g}"
        return f"  {name:32}{mean:>10} {scale.unit:>9}   shared with {entry['shared_with']}"
    sd = scale.factor * entry["sd"]
    mean, low, high = (
        format_number(scale.factor * value, sd) for value in (entry["mean"], *entry["interval"])
    )
    return f"  {name:32}{mean:>10}{sd:>10.2g}   {low} … {high} {scale.unit}".rstrip()
