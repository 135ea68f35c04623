"""The page: everything a sceptical engineer asks for, in one file that needs no other."""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterator
from functools import partial
from typing import Any

import xarray as xr

from bayesoleo import schema
from bayesoleo.effects.titles import called
from bayesoleo.errors import ResultsError
from bayesoleo.plots import reading
from bayesoleo.plots.rankings import chosen, name
from bayesoleo.report import sections, sentences, tables
from bayesoleo.report.case import case
from bayesoleo.report.images import encode_formula
from bayesoleo.report.proposals import proposal_lines, proposal_table
from bayesoleo.storage import write_text_atomic


def write_report(tree: xr.DataTree, path: str | os.PathLike[str]) -> list[str]:
    """Write the report of a result as a self-contained HTML page.

    Parameters
    ----------
    tree : DataTree
        As read by :func:`bayesoleo.storage.read_tree`. Of its groups any may be absent.
    path : path-like
        Replaced as a whole or not at all.

    Returns
    -------
    list of str
        Figures that could not be drawn, each with the reason; the page says so too.

    Raises
    ------
    ResultsError
        The tree holds no summary, or the place cannot be written to.
    """
    text, failed = _render(tree)
    write_text_atomic(path, text)
    return failed


def render_report(tree: xr.DataTree) -> str:
    """The page of :func:`write_report` as text."""
    return _render(tree)[0]


def _render(tree: xr.DataTree) -> tuple[str, list[str]]:
    """The page, and the figures that it lacks."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("bayesoleo.report", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["first_of"] = next
    drawing = sections.Drawing()
    content = _content(tree, drawing)
    page = environment.get_template("report.html.jinja").render(content)
    return page, drawing.failed


def _content(tree: xr.DataTree, drawing: sections.Drawing) -> dict[str, Any]:
    """What the template fills in."""
    summary = _summary(tree)
    units = tables.output_units(tree, summary)
    figures = _figures(tree, drawing)
    rounds = list(_rounds(tree, summary, drawing))
    proposals = list(_proposals(tree, summary, drawing))
    return {
        "summary": summary,
        "attributes": tree.attrs,
        "description": str(tree.attrs.get(schema.CAMPAIGN_DESCRIPTION, "")).strip(),
        "headline": sentences.headline(summary),
        "extended": sentences.added(summary),
        "unfinished": [*sentences.unfinished(summary), *drawing.failed],
        "role": sentences.role_shown(summary),
        "tiles": sentences.tiles(summary, units),
        "error_by_role": tables.error_by_role(summary, units),
        "error_by_run": tables.error_by_run(summary, units),
        "case": case(summary, units, tree),
        "remainder": sentences.remainder(summary),
        "proposals": proposals,
        "stability": sentences.stability(summary),
        "records": tables.records(tree),
        "rounds": rounds,
        "parameters": tables.parameters(summary),
        "diagnostics": tables.diagnostics(tree),
        "diagnostics_by_parameter": tables.diagnostics_by_parameter(tree),
        "point": tables.point_status(tree),
        "formulas": _formulas(tree),
        "equations": str(tree.attrs.get(schema.EQUATIONS, "")).strip(),
        "provenance": tables.provenance(tree),
        "figures": figures,
        "residual_title": sections.residual_title(tree),
        "number": itertools.count(1),
    }


def _summary(tree: xr.DataTree) -> dict[str, Any]:
    summary = reading.summary(tree)
    if not summary:
        hint = "give the results.nc of `bayesoleo close`, or run it once more"
        raise ResultsError("the result holds no summary to report", key=schema.SUMMARY, hint=hint)
    schema.validate_summary(summary)
    return summary


def _rounds(
    tree: xr.DataTree, summary: dict[str, Any], drawing: sections.Drawing
) -> Iterator[dict[str, Any]]:
    """Table, figure and decision of every round."""
    titles = sentences.titles(summary)
    for number, entry in enumerate(summary["rounds"]):
        yield {
            "accepted": _accepted(entry, titles),
            "reason": sentences.reason(entry, titles),
            "table": tables.candidates(entry, titles) if entry["candidates"] else None,
            "failed": tables.failed(entry, titles),
            "figures": [
                *drawing.of("the ranking", partial(sections.ranking_figure, tree, number)),
                *drawing.of("the curve", partial(sections.nonparametric_figure, tree, entry)),
            ],
        }


def _accepted(entry: dict[str, Any], titles: dict[str, str]) -> str:
    """What a round added, as it is called; nothing where it added nothing."""
    if not entry["accepted"]:
        return ""
    added = chosen(entry)
    return called(entry["accepted"] if added is None else name(added), titles)


def _proposals(
    tree: xr.DataTree, summary: dict[str, Any], drawing: sections.Drawing
) -> Iterator[dict[str, Any]]:
    """Sentences, table and figure for each set of effects that is left to be told apart."""
    for entry in summary.get("proposals", []):
        yield {
            "lines": proposal_lines(entry, sentences.titles(summary)),
            "table": proposal_table(entry, sentences.titles(summary)),
            "figures": drawing.of("the next run", partial(sections.proposal_figure, tree, entry)),
        }


def _figures(
    tree: xr.DataTree, drawing: sections.Drawing
) -> dict[str, list[sections.CaptionedFigure]]:
    makers = {
        "data": ("the data", sections.data_figures),
        "fit": ("the fit", sections.fit_figures),
        "where": ("where the error lives", sections.whereabouts_figure),
        "residual": ("the residual", sections.residual_figures),
        "posterior": ("the posterior", sections.posterior_figures),
        "predictive": ("the posterior's prediction", sections.predictive_figures),
        "trace": ("the sampler's chains", sections.trace_figures),
        "error": ("the error of each run", sections.error_figure),
    }
    return {name: drawing.of(words, partial(make, tree)) for name, (words, make) in makers.items()}


def _formulas(tree: xr.DataTree) -> list[dict[str, Any]]:
    """Every formula as a picture, or as it is written where it cannot be drawn."""
    texts = json.loads(tree.attrs.get(schema.EQUATIONS_LATEX, "[]"))
    return [{"latex": text, "image": encode_formula(text)} for text in texts]
