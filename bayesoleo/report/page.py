"""The page: everything a sceptical engineer asks for, in one file that needs no other."""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterator
from typing import Any

import xarray as xr

from bayesoleo import schema
from bayesoleo.errors import ResultsError
from bayesoleo.plots import reading
from bayesoleo.report import sections, sentences, tables
from bayesoleo.report.case import case
from bayesoleo.report.images import encode_formula
from bayesoleo.report.proposals import proposal_lines, proposal_table
from bayesoleo.storage import write_text_atomic


def write_report(tree: xr.DataTree, path: str | os.PathLike[str]) -> None:
    """Write the report of a result as a self-contained HTML page.

    Parameters
    ----------
    tree : DataTree
        As read by :func:`bayesoleo.storage.read_tree`. Of its groups any may be absent.
    path : path-like
        Replaced as a whole or not at all.

    Raises
    ------
    ResultsError
        The tree holds no summary, or the place cannot be written to.
    """
    write_text_atomic(path, render_report(tree))


def render_report(tree: xr.DataTree) -> str:
    """The page of :func:`write_report` as text."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("bayesoleo.report", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["first_of"] = next
    return environment.get_template("report.html.jinja").render(_content(tree))


def _content(tree: xr.DataTree) -> dict[str, Any]:
    """What the template fills in."""
    summary = _summary(tree)
    units = tables.output_units(tree, summary)
    return {
        "summary": summary,
        "attributes": tree.attrs,
        "description": str(tree.attrs.get(schema.CAMPAIGN_DESCRIPTION, "")).strip(),
        "headline": sentences.headline(summary),
        "role": sentences.role_shown(summary),
        "tiles": sentences.tiles(summary, units),
        "error_by_role": tables.error_by_role(summary, units),
        "error_by_run": tables.error_by_run(summary, units),
        "case": case(summary, units, tree),
        "remainder": sentences.remainder(summary),
        "proposals": list(_proposals(tree, summary)),
        "stability": sentences.stability(summary),
        "records": tables.records(tree),
        "rounds": list(_rounds(tree, summary)),
        "parameters": tables.parameters(summary),
        "diagnostics": tables.diagnostics(tree),
        "diagnostics_by_parameter": tables.diagnostics_by_parameter(tree),
        "point": tables.point_status(tree),
        "formulas": _formulas(tree),
        "equations": str(tree.attrs.get(schema.EQUATIONS, "")).strip(),
        "provenance": tables.provenance(tree),
        "figures": _figures(tree),
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


def _rounds(tree: xr.DataTree, summary: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Table, figure and decision of every round."""
    for number, entry in enumerate(summary["rounds"]):
        yield {
            "accepted": entry["accepted"],
            "reason": sentences.reason(entry),
            "table": tables.candidates(entry) if entry["candidates"] else None,
            "failed": tables.failed(entry),
            "figures": [
                *sections.ranking_figure(tree, number),
                *sections.unnamed_figure(tree, entry),
            ],
        }


def _proposals(tree: xr.DataTree, summary: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Sentences, table and figure for each set of effects that is left to be told apart."""
    for entry in summary.get("proposals", []):
        yield {
            "lines": proposal_lines(entry),
            "table": proposal_table(entry),
            "figures": sections.proposal_figure(tree, entry),
        }


def _figures(tree: xr.DataTree) -> dict[str, list[sections.Shown]]:
    return {
        "data": sections.data_figures(tree),
        "fit": sections.fit_figures(tree),
        "where": sections.whereabouts_figure(tree),
        "residual": sections.residual_figures(tree),
        "posterior": sections.posterior_figures(tree),
        "predictive": sections.predictive_figures(tree),
        "trace": sections.trace_figures(tree),
        "error": sections.error_figure(tree),
    }


def _formulas(tree: xr.DataTree) -> list[dict[str, Any]]:
    """Every formula as a picture, or as it is written where it cannot be drawn."""
    texts = json.loads(tree.attrs.get(schema.EQUATIONS_LATEX, "[]"))
    return [{"latex": text, "image": encode_formula(text)} for text in texts]
