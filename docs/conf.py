"""Sphinx configuration; build with ``sphinx-build -W docs docs/_build/html``."""

from __future__ import annotations

import os
import sys
import tomllib
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "docs" / "_ext"))
sys.path.append(str(ROOT / "studies"))  # long calculations that pages of the gallery may repeat

project = "bayesoleo"
author = "The bayesoleo developers"
copyright = author  # noqa: A001 - Sphinx asks for this name
release = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
version = release

extensions = [
    "myst_parser",
    "numpydoc",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx_gallery.gen_gallery",
    "effect_table",
    "sphinx-mathjax-offline",  # formulas show without a network
]
exclude_patterns = ["_build", "_ext", "_templates"]
templates_path = ["_templates"]

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

autosummary_generate = True
autosummary_imported_members = True  # a subpackage's page lists what the subpackage exports
autosummary_ignore_module_all = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # types stand in the docstrings, with shapes and units
numpydoc_show_class_members = False  # the templates list them

sphinx_gallery_conf = {
    "examples_dirs": ["../studies"],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"/plot_",
    "ignore_pattern": r"^(?!plot_)",  # model files are no pages
    "within_subsection_order": "FileNameSortKey",
    # Pages of a section run beside each other, where the extra sphinx-gallery[parallel] is.
    "parallel": (os.cpu_count() or 1) if find_spec("joblib") else False,
    "thumbnail_size": (640, 448),
    "image_scrapers": ("matplotlib", "gallery_figures.scrape"),
    "ignore_repr_types": r"matplotlib\.",
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
}

html_theme = "pydata_sphinx_theme"
html_title = "bayesoleo"
html_theme_options = {
    "navigation_with_keys": False,
    "show_nav_level": 1,
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_sidebars = {"index": []}
html_show_sourcelink = False
html_copy_source = False
