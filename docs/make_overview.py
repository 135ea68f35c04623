"""Draw the picture of the README: what comes out of ``bayesoleo demo``.

Run with ``python docs/make_overview.py``; it takes less than a minute and replaces
``docs/_static/overview.png``.
"""

from __future__ import annotations

import io
import tempfile
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

import bayesoleo as bo
from bayesoleo import plots
from bayesoleo._workflow.simulating import DEMO_SYSTEM, demo_campaign

TARGET = Path(__file__).resolve().parent / "_static" / "overview.png"
DPI = 110


def picture(figure: Figure) -> Image.Image:
    """Return a figure as an image."""
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=DPI, format="png")
    return Image.open(drawn).convert("RGB")


def stacked(images: list[Image.Image]) -> Image.Image:
    """Return images one below the other, in 64 colours to keep the file small."""
    whole = Image.new("RGB", (max(i.width for i in images), sum(i.height for i in images)), "white")
    top = 0
    for image in images:
        whole.paste(image, (0, top))
        top += image.height
    return whole.quantize(64, dither=Image.Dither.NONE)


def main() -> None:
    """Close the loop on the campaign of the demo; store residual and ranking of the effects."""
    with tempfile.TemporaryDirectory() as folder:
        campaign = demo_campaign(Path(folder) / "campaign", seed=0)
        found = bo.Problem(campaign, bo.system(DEMO_SYSTEM), seed=0, quick=True).fit().explain()
    shown = [plots.residual(found.tree, "force"), plots.ranking(found.tree, most=6)]
    stacked([picture(figure) for figure in shown]).save(TARGET, optimize=True)


if __name__ == "__main__":
    main()
