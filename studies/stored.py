"""For pages whose data set is not part of the repository: show the last run's figures without it.

With ``BAYESOLEO_STORE_FIGURES=1`` a run of a page renews what is stored.
"""

from __future__ import annotations

import contextlib
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import matplotlib.image
from matplotlib.figure import Figure
from PIL import Image

HERE = Path(__file__).resolve().parent
FIGURES = HERE / "figures"
DPI = 100
Result = TypeVar("Result")


class Study:
    """What a page shows, run anew or from the store.

    Parameters
    ----------
    name : str
        Of the page; names of stored files begin with it.
    data : str, optional
        Folder of the data set below ``BAYESOLEO_DATA``; without one the page needs none. Nothing is
        ever fetched.
    slow : bool
        Whether to run only when the store is to be renewed.
    """

    def __init__(self, name: str, data: str | None = None, *, slow: bool = False) -> None:
        self.name = name
        root = os.environ.get("BAYESOLEO_DATA")
        self.folder = Path(root) / data if root and data else None
        self.storing = os.environ.get("BAYESOLEO_STORE_FIGURES") == "1"
        present = data is None or (self.folder is not None and self.folder.is_dir())
        self.live = present and (self.storing or not slow)
        if not present:
            print(
                f"The data set {data} is not on this machine (BAYESOLEO_DATA).\n"
                "Shown are the stored results of the last run."
            )
        elif not self.live:
            print(
                "This takes minutes: shown are the stored results of the last run.\n"
                "To run it, set BAYESOLEO_STORE_FIGURES=1."
            )

    def run(self, work: Callable[[], Result]) -> Result | None:
        """Do the work if the data are there."""
        return work() if self.live else None

    def text(self, name: str, write: Callable[[], None]) -> None:
        """Print what ``write`` prints, or printed in the last run."""
        path = FIGURES / f"{self.name}-{name}.txt"
        if not self.live:
            print(path.read_text(encoding="utf-8"), end="")
            return
        caught = io.StringIO()
        with contextlib.redirect_stdout(caught):
            write()
        lines = "".join(f"{line.rstrip()}\n" for line in caught.getvalue().strip("\n").split("\n"))
        print(lines, end="")
        if self.storing:
            path.write_text(lines, encoding="utf-8")

    def figure(self, name: str, draw: Callable[[], Figure]) -> Figure:
        """The figure that ``draw`` makes, or made in the last run."""
        path = FIGURES / f"{self.name}-{name}.png"
        if not self.live:
            return _framed(path)
        figure = draw()
        if self.storing:
            _store(figure, path)
        return figure


def _store(figure: Figure, path: Path) -> None:
    """As PNG with 128 colours, which is a third of the size."""
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=DPI, format="png")
    image = Image.open(drawn).convert("RGB")
    image.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


def _framed(path: Path) -> Figure:
    """A stored picture as a figure of its own size."""
    pixels = matplotlib.image.imread(path)
    height, width = pixels.shape[:2]
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(pixels, aspect="auto", interpolation="none")
    axes.set_axis_off()
    return figure
