"""All figures and formulas of the page by kind, drawn in several processes, some of them ahead.

What shows the data and the search alone can be drawn while the posterior is sampled, and what shows
the draws while structures are compared.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from functools import partial
from typing import Any, Protocol, cast

import matplotlib
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._report import sections
from bayesoleo._report.sections import encode_formula
from bayesoleo._worker_processes import process_map

Maker = Callable[[xr.DataTree], list[Callable[[], Any]]]
#: A kind of figure, and a number among those of this kind.
Part = tuple[str, int]
#: What has been drawn: of a part without a figure an empty list.
Pictures = Mapping[Part, list[Any]]


def figures_of(
    tree: xr.DataTree,
    summary: dict[str, Any],
    drawing: sections.Drawing,
    before: Callable[[], object],
    ahead: Ahead | None,
) -> dict[str, list[Any]]:
    """All that is drawn, by its place on the page; in several processes."""
    known, first = dict[Part, list[Any]](), before
    if ahead is not None and ahead.goes_on:
        known, first = _drawn_ahead(tree, before, ahead), lambda: None
    elif ahead is not None:
        known |= ahead.pictures()
    makers = _makers(summary)
    every = _parts(tree, makers, drawing)
    left = [part for part in every if part not in known]
    items = [(*makers[kind], number) for kind, number in left]
    found = process_map(_draw, shared_by(tree), items, before=first)
    said = [*drawing.failed, *(text for _, failed in found for text in failed)]
    drawing.failed = list(dict.fromkeys(said))  # what fails of several figures, once
    known |= {part: drawn for part, (drawn, _) in zip(left, found, strict=True)}
    return {
        kind: [one for part in every if part[0] == kind for one in known[part]] for kind in makers
    }


class Ahead(Protocol):
    """Another process that draws figures ahead."""

    @property
    def drawn(self) -> Pictures:
        """What has been drawn in this process."""

    @property
    def goes_on(self) -> bool:
        """Whether it draws."""

    def end_with(self, tree: xr.DataTree, part: Part) -> None:
        """Have it draw this figure next, and no other after it."""

    def pictures(self) -> Pictures:
        """All that has been drawn, when it has come to its end."""


def _drawn_ahead(
    tree: xr.DataTree, before: Callable[[], object], ahead: Ahead
) -> dict[Part, list[Any]]:
    """What another process draws, and figures of the draws that are drawn here meanwhile. It ends
    with the largest one, and results are written here first."""
    here, shared = dict[Part, list[Any]](), shared_by(tree)
    others = [part for part in parts_of_draws(tree) if part not in ahead.drawn]
    if LARGEST in others:
        others.remove(LARGEST)
        ahead.end_with(tree, LARGEST)
    before()
    for part in others:
        if not ahead.goes_on:
            break
        here |= dict(filter(None, [draw_ahead(shared, part)]))
    return {**here, **ahead.pictures()}


def _parts(
    tree: xr.DataTree, makers: Mapping[str, tuple[str, Maker]], drawing: sections.Drawing
) -> list[Part]:
    """All parts of all kinds in their order."""
    counts = {
        kind: len(drawing.of(words, partial(make, tree))) for kind, (words, make) in makers.items()
    }
    return [(kind, number) for kind, count in counts.items() for number in range(count)]


def shared_by(tree: xr.DataTree) -> tuple[xr.DataTree, dict[str, Any]]:
    """What all figures of a tree need, in another process too."""
    return tree, _drawing_settings()


def parts_ahead(tree: xr.DataTree) -> list[Part]:
    """What :func:`draw_ahead` can draw of a tree without draws."""
    return _parts(tree, WITHOUT_DRAWS, sections.Drawing())


def parts_of_draws(tree: xr.DataTree) -> list[Part]:
    """What it can draw of the draws in a tree, what takes longest last."""
    return _parts(tree, OF_DRAWS, sections.Drawing())


def draw_ahead(
    shared: tuple[xr.DataTree, Mapping[str, Any]], part: Part
) -> tuple[Part, list[Any]] | None:
    """One figure, which needs nothing of structures, or none; None where that fails.

    Parameters
    ----------
    shared : tuple
        Of :func:`shared_by`.
    part : (str, int)
        Of a kind in :data:`WITHOUT_DRAWS` or :data:`OF_DRAWS`.
    """
    # The largest figure needs it, and it brings all of ArviZ: that is loaded while nobody waits.
    import corner  # noqa: F401

    kind, number = part
    drawn, failed = _draw(shared, (*(WITHOUT_DRAWS | OF_DRAWS)[kind], number))
    return None if failed else (part, drawn)


def _makers(summary: dict[str, Any]) -> dict[str, tuple[str, Maker]]:
    """What is drawn in words, and the function that draws it.

    Processes take them from both ends, so that what takes longest stands there. Another process
    begins with the last, the largest, and already holds the one before that, which is small.
    """
    first, last = ("residual", "fit", "where"), ("viewer", "formulas", "response", "data")
    makers: dict[str, tuple[str, Maker]] = {
        **{name: WITHOUT_DRAWS[name] for name in first},
        "predictive": OF_DRAWS["predictive"],
        **{name: WITHOUT_DRAWS[name] for name in last},
        "structures": ("the probabilities of structures", sections.structures_figure),
        "error": ("the error of each run", sections.error_figure),
    }
    for number, entry in enumerate(summary["rounds"]):
        ranking = partial(sections.ranking_figure, number=number)
        makers[f"ranking {number}"] = ("the ranking", ranking)
        curve = partial(sections.nonparametric_figure, entry=entry)
        makers[f"curve {number}"] = ("the curve", curve)
    for number, entry in enumerate(summary.get("proposals", [])):
        proposal = partial(sections.proposal_figure, entry=entry)
        makers[f"proposal {number}"] = ("the next run", proposal)
    return makers | {"trace": OF_DRAWS["trace"], "posterior": OF_DRAWS["posterior"]}


def _drawing_settings() -> dict[str, Any]:
    """Matplotlib's settings that the user has changed; the backend draws no figure of a page."""
    now: Mapping[Any, Any] = matplotlib.rcParams
    usual: Mapping[Any, Any] = matplotlib.rcParamsDefault
    return {key: now[key] for key in now if key != "backend" and now[key] != usual.get(key)}


def _draw(
    shared: tuple[xr.DataTree, Mapping[str, Any]], item: tuple[str, Maker, int]
) -> tuple[list[Any], list[str]]:
    """One figure of a kind or none, and what could not be drawn; also in another process."""
    (tree, settings), (words, make, number), drawing = shared, item, sections.Drawing()

    def draw() -> list[Any]:
        found = make(tree)[number]()
        return [] if found is None else [found]

    now: Mapping[Any, Any] = matplotlib.rcParams
    other = {key: value for key, value in settings.items() if now[key] != value}
    # Settings are the whole process's: here, where they hold already, none is touched.
    with matplotlib.rc_context(cast(Any, other)) if other else nullcontext():
        return drawing.of(words, draw), drawing.failed


def _formulas(tree: xr.DataTree) -> list[Callable[[], dict[str, Any]]]:
    """Every formula as a picture, or as it is written where it cannot be drawn."""
    texts = json.loads(tree.attrs.get(schema.EQUATIONS_LATEX, "[]"))
    return [partial(_formula, text) for text in texts]


def _formula(text: str) -> dict[str, Any]:
    return {"latex": text, "image": encode_formula(text)}


def _viewer(tree: xr.DataTree) -> list[Callable[[], dict[str, Any] | None]]:
    """What the page's script draws, which takes as long as a figure."""
    return [partial(sections.viewer, tree)]


#: What is drawn, in words, and the function that draws it, of the data and of the search alone.
WITHOUT_DRAWS: dict[str, tuple[str, Maker]] = {
    "residual": ("the residual", sections.residual_figures),
    "data": ("the data", sections.data_figures),
    "where": ("the residual breakdown", sections.breakdown_figure),
    "formulas": ("the equations", _formulas),
    "fit": ("the fit", sections.fit_figures),
    "response": ("the frequency response", sections.response_figures),
    "viewer": ("the curves of each run", _viewer),
}

#: The figure of all pairs of parameters, which takes as long as ten others.
LARGEST: Part = ("posterior", 0)

#: The same of the draws, what takes longest last.
OF_DRAWS: dict[str, tuple[str, Maker]] = {
    "trace": ("the sampler's chains", sections.trace_figures),
    "predictive": ("the posterior's prediction", sections.predictive_figures),
    "posterior": ("the posterior", sections.posterior_figures),
}
