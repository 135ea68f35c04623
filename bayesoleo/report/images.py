"""Figures and formulas as addresses that hold the picture itself; a page needs no other file.

Pictures are put in ``<img>`` elements: SVG inside the page would share its ids between figures.
"""

from __future__ import annotations

import base64
import io
import re
import threading
import warnings
from dataclasses import dataclass
from typing import Any

import matplotlib
from matplotlib import mathtext
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties

LARGEST_SVG = 300_000
"""Bytes above which a figure is stored as pixels instead; a page stays below some megabytes."""
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
    """Coordinates of paths to a hundredth of a point; halves the size of a figure."""
    text = svg.decode()
    text = re.sub(r' d="[^"]*"', lambda m: re.sub(r"(\.\d\d)\d+", r"\1", m[0]), text)
    return text.encode()


def _uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
