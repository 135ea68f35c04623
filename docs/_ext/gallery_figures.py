"""Show figures in the gallery that were made without pyplot, as those of bayesoleo.plots are."""

from __future__ import annotations

from typing import Any
from weakref import WeakSet

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst

_shown: WeakSet[Figure] = WeakSet()


def scrape(block: Any, block_vars: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save every figure that a block left in a variable or as its last expression, once.

    Parameters
    ----------
    block : tuple
        Not used.
    block_vars : dict
        Of sphinx-gallery: the page's variables and an iterator over image paths.
    gallery_conf : dict
        Of sphinx-gallery.

    Returns
    -------
    str
        reStructuredText that shows the images.
    """
    paths = []
    for value in list(block_vars["example_globals"].values()):
        # pyplot numbers its figures; sphinx-gallery shows those itself.
        if isinstance(value, Figure) and not hasattr(value, "number") and value not in _shown:
            _shown.add(value)
            paths.append(next(block_vars["image_path_iterator"]))
            value.savefig(paths[-1], format="png", dpi=gallery_conf.get("dpi", 100))
    return figure_rst(paths, gallery_conf["src_dir"])
