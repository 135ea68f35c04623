"""The HTML report: the case in a few sentences, then all figures and tables, in one file."""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._report import sections, sentences, structures, tables
from bayesoleo._report.page_figures import Ahead, figures_of
from bayesoleo._report.sentences import begin, in_run, role_shown
from bayesoleo._report.structures import proposal_lines, proposal_table
from bayesoleo._report.tables import (
    error_scale,
    format_ratio,
    format_short,
    parameters,
    ratio,
    ratios,
    too_large,
    words,
)
from bayesoleo._storage.files import write_text_atomic
from bayesoleo.assessment._residual_breakdown import GROUP, ORDERS, RUN, residual_breakdown
from bayesoleo.effects._catalogue import called, listed, parameter_called
from bayesoleo.effects._nonparametric import FAMILY
from bayesoleo.errors import InputError, ResultsError, number_of
from bayesoleo.plots import _reading as reading
from bayesoleo.plots._discovery import chosen, format_share, name
from bayesoleo.plots._residuals import has_excess
from bayesoleo.plots._style import DIMENSIONLESS

#: A harmonic or a coordinate is named if it holds this part of the excess.
WORTH_NAMING = 0.2
_CONSTANTS = {RUN: "a constant for each run", GROUP: "a constant for each group",
              "direction": "the direction of motion"}  # fmt: skip


def case(
    summary: Mapping[str, Any], units: Mapping[str, str], tree: xr.DataTree
) -> list[tuple[str, str]]:
    """Questions that a sceptical reader asks, each with its answer in numbers.

    Parameters
    ----------
    summary : mapping
        As in ``summary.json``.
    units : mapping of str to str
        SI unit of each output.
    tree : DataTree
        The result; the residual breakdown is shown if it holds residuals of periodic runs.

    Returns
    -------
    list of (str, str)
        Those that have an answer.
    """
    found = [
        ("Was anything wrong?", _wrong(summary)),
        ("Where?", _where(tree)),
        ("What is it?", " ".join(_what(summary))),
        ("What else could it be?", " ".join(_rivals(summary))),
        ("How sure is its name?", _sure(summary)),
        ("How large?", _large(summary)),
        ("Does it hold on data not used?", _holds(summary, units)),
        ("What is left?", _left(summary)),
        ("What would settle it?", " ".join(_next(summary))),
        ("What could not be tried?", _untried(summary)),
    ]
    return [(question, answer) for question, answer in found if answer]


def _wrong(summary: Mapping[str, Any]) -> str:
    errors = _errors(summary["rounds"][0])
    if not errors:
        return "The noise of no run is known, so that no error can be compared with it."
    worst, output, run = max((ratio(error) or 0.0, output, run) for error, output, run in errors)
    above = len({run for error, _, run in errors if too_large(error)})
    times = f"{format_ratio(worst)} times {words(summary)}"
    what = f"the largest is the error of {output} in {in_run(run)}, {times}"
    if not above:
        return f"No: no error is larger than chance allows; {what}."
    of = f"{above} of {number_of(len({run for *_, run in errors}), 'run')}"
    return f"In {of} an error is larger than chance allows; {what}."


def _errors(entry: Mapping[str, Any]) -> list[tuple[Mapping[str, Any], str, str]]:
    """Errors that have a ratio, with output and run."""
    return [
        (error, output, run)
        for output, runs in entry["error"].items()
        for run, error in runs.items()
        if ratio(error) is not None
    ]


def _where(tree: xr.DataTree) -> str:
    try:
        data = residual_breakdown(tree)
    except (InputError, KeyError):
        return ""
    texts = []
    for output in data[schema.OUTPUT].values:
        one = data.sel({schema.OUTPUT: output}).isel(stage=0)
        # An excess that noise alone may feign has no place.
        if not has_excess(float(one["excess"])):
            continue
        orders = _named(one["power"].values, [*map(str, range(ORDERS)), f"{ORDERS} and above"])
        places = [str(place) for place in one["coordinate"].values]
        words = [_CONSTANTS.get(place, f"one function of {place}") for place in places]
        shares = _named(one["share"].values, words)[:2]
        text = f"Of the excess of {output}, "
        text += ", ".join(f"{share} is at harmonic {word}" for word, share in orders)
        text += ("; " if orders else "") + ", ".join(f"{word} explains {s}" for word, s in shares)
        texts.append(f"{text}." if orders or shares else "")
    return " ".join(filter(None, texts))


def _named(shares: np.ndarray, words: list[str]) -> list[tuple[str, str]]:
    """Those worth naming, the largest first, with their share."""
    order = [k for k in np.argsort(-shares) if shares[k] >= WORTH_NAMING]
    return [(words[k], f"{100 * min(shares[k], 1.0):.0f} %") for k in order]


def _what(summary: Mapping[str, Any]) -> Iterator[str]:
    titles = sentences.titles(summary)
    for entry in summary["rounds"]:
        added = chosen(entry)
        if added is None:
            continue
        which = begin(called(name(added), titles))
        if added["effect"] not in summary["effects"]:
            yield f"{which} was added first, and removed again."
            continue
        p = sentences.significance(added)
        text = f"{which} explains {_share(added)} of the excess"
        searched = number_of(len(entry["candidates"]), "candidate")
        text += f" ({p}, corrected for the search of {searched})" if p else ""
        yield f"{text}."


#: How sure a name is, by the word of the summary.
_SURE = {
    schema.CERTAIN: (
        "Certain: it was added alone, nothing else is significant beside it, no other effect"
        " explains as much, and the error is what is expected."
    ),
    schema.PROBABLE: (
        "Probable: it explains the data best of what was tried, which is not all there is."
    ),
    schema.LIKENESS: (
        "A likeness only: more is left than expected, so that something else acts as well, or"
        " instead."
    ),
    schema.NO_CAUSE: (
        "No cause is named: curves without a name, what varies by run and what repeats with the"
        " drive take up a part of whatever is missing."
    ),
}


def _sure(summary: Mapping[str, Any]) -> str:
    """Whether the effect's name is certain, probable, or one of several; results that were stored
    without an answer have none."""
    if "certain" not in summary or not summary["effects"]:
        return ""
    sure = sentences.certainty(summary)
    alike = any(one["indistinguishable_from"] for one in sentences.accepted(summary))
    if sure == schema.LIKENESS and sentences.only_too_small(summary):
        return (
            "A likeness only: an error is smaller than chance allows, so that the noise is not"
            " what it is held to be."
        )
    if sentences.named_in_part(summary):
        return (
            "A likeness only: a part of what was missing is explained by a curve without a name, so"
            " that something else acts as well, or instead."
        )
    if sure == schema.PROBABLE and alike:
        return (
            "Probable, as one of a class: these data cannot tell it from the effects named above."
        )
    return _SURE[str(sure)]


def _share(candidate: Mapping[str, Any]) -> str:
    """Part of the excess; of nearly all of it a digit more, for there rivals differ by it."""
    digits = 1 if 0.95 <= candidate["gain"] < 0.9995 else 0
    return f"{100 * candidate['gain']:.{digits}f} %"


def _rivals(summary: Mapping[str, Any]) -> Iterator[str]:
    """What these data cannot tell from each effect that was added, or how far the next one fell
    short."""
    for entry in summary["rounds"]:
        added = chosen(entry)
        if added is None or added["effect"] not in summary["effects"]:
            continue
        alike, titles = added["indistinguishable_from"], sentences.titles(summary)
        own = called(name(added), titles)
        if alike:
            others = listed([called(other, titles) for other in alike], " or ")
            yield f"These data cannot tell {own} from {others}."
        apart = [
            c
            for c in entry["candidates"]
            if c is not added and c["effect"] not in alike and name(c) not in alike
        ]
        if apart:
            second = max(apart, key=lambda c: c["gain"])
            how = "estimated in its place" if second.get("estimated") else "by its score"
            of = "the others" if alike else f"the {number_of(len(apart), 'other')} instead of {own}"
            which = called(name(second), titles)
            yield f"Of {of} {which} comes nearest: {how} it explains {_share(second)}."


def _large(summary: Mapping[str, Any]) -> str:
    """The new parameters as the table shows them."""
    added = [chosen(entry) or {} for entry in summary["rounds"]]
    new = {
        key.split("[")[0]
        for one in added
        if one.get("family") != FAMILY  # the coefficients of a curve say nothing one by one
        for key in one.get("expected", {})
    }
    table, texts = parameters(summary), []
    for row in table.rows:
        if row[0].split("[")[0] in new:
            cells = dict(zip(table.head, row, strict=True))
            interval = cells["95 % interval"]
            what = parameter_called(row[0], sentences.titles(summary))
            if summary["parameters"][row[0]].get("shared_with"):
                texts.append(f"{what} {interval}")
                continue
            unit = "" if cells["unit"] in DIMENSIONLESS else f" {cells['unit']}"
            text = f"{what} = {cells['estimate']} ± {cells['sd']}{unit}"
            known = any(character.isdigit() for character in interval)
            texts.append(f"{text} (95 %: {interval})" if known else text)
    most = 6
    rest = f" and {len(texts) - most} more" if len(texts) > most else ""
    drawn = any(one.get("family") == FAMILY for one in added)
    curve = "The curve and its band are drawn below, in the round that added it." if drawn else ""
    return " ".join(filter(None, [f"{', '.join(texts[:most])}{rest}." if texts else "", curve]))


def _holds(summary: Mapping[str, Any], units: Mapping[str, str]) -> str:
    role = role_shown(summary)
    if not summary["effects"] or role == schema.FIT:
        return "" if not summary["effects"] else "Nothing could be held out: that is not known."
    texts = []
    for output, last in summary["error_after"][role].items():
        first = summary["error_before"][role].get(output, last)
        key = "rms" if last["repeating"] is None else "repeating"
        scale = error_scale(units.get(output, ""), (first, last))
        before, after = (
            format_short(scale.factor * e[key]) for e in (first, last) if e[key] is not None
        )
        text = f"{output} {before} → {after} {scale.unit}".rstrip()
        times = f"{ratios(first, last, two=True)} times {words(summary)}"
        texts.append(f"{text} ({times})" if ratio(last) else text)
    said = summary.get("hold_out", "")
    return f"On the {role} runs: {', '.join(texts)}{f' ({said})' if said else ''}."


def _left(summary: Mapping[str, Any]) -> str:
    last = summary["rounds"][-1]
    errors, text = _errors(last), ""
    if errors:
        worst, output, run = max((ratio(e) or 0.0, output, run) for e, output, run in errors)
        text = f"At most {format_ratio(worst)} times {words(summary)}, of {output} in {in_run(run)}"
    if last["candidates"]:
        best = max(last["candidates"], key=lambda candidate: candidate["gain"])
        lead = "; the" if text else "The"
        which = called(name(best), sentences.titles(summary))
        share = format_share(best["gain"])
        text += f"{lead} best remaining candidate, {which}, would explain {share} of it"
    return f"{text}." if text else ""


def _next(summary: Mapping[str, Any]) -> Iterator[str]:
    for entry in summary.get("proposals", []):
        yield " ".join(proposal_lines(entry, sentences.titles(summary))[1:2])


def _untried(summary: Mapping[str, Any]) -> str:
    """Candidates of the first round without a score, by reason."""
    failed = summary["rounds"][0].get("failed", {})
    if not failed:
        return ""
    texts = [f"{count} ({reason})" for reason, count in Counter(failed.values()).most_common()]
    have = "has" if len(failed) == 1 else "have"
    return f"{number_of(len(failed), 'candidate')} {have} no score: {', '.join(texts)}."


def write_report(
    tree: xr.DataTree,
    path: str | os.PathLike[str],
    before: Callable[[], object] = lambda: None,
    ahead: Ahead | None = None,
) -> list[str]:
    """Write the report of a result as a self-contained HTML page.

    Parameters
    ----------
    tree : DataTree
        As read by ``read_tree``. Any of its groups may be absent.
    path : path-like
        Replaced as a whole or not at all.
    before : callable
        What this process does before it draws, while another one draws.
    ahead : Ahead, optional
        Another process that has drawn figures, and goes on with it.

    Returns
    -------
    list of str
        Figures that could not be drawn, each with the reason; the page says so too.

    Raises
    ------
    ResultsError
        The tree holds no summary, or the place cannot be written to.
    """
    text, failed = _render(tree, before, ahead)
    write_text_atomic(path, text)
    return failed


def render_report(tree: xr.DataTree) -> str:
    """The page of :func:`write_report` as text."""
    return _render(tree, lambda: None)[0]


def _render(
    tree: xr.DataTree,
    before: Callable[[], object],
    ahead: Ahead | None = None,
) -> tuple[str, list[str]]:
    """The page, and the figures that it lacks."""
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("bayesoleo._report", "."),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["first_of"] = next
    drawing = sections.Drawing()
    summary = _summary(tree)
    figures = figures_of(tree, summary, drawing, before, ahead)
    content = _content(tree, drawing, summary, figures)
    page = environment.get_template("report.html.jinja").render(content)
    return page, drawing.failed


def _content(
    tree: xr.DataTree,
    drawing: sections.Drawing,
    summary: dict[str, Any],
    figures: Mapping[str, list[Any]],
) -> dict[str, Any]:
    """What the template fills in."""
    units = tables.output_units(tree, summary)
    averaged = reading.averaged_word(tree)
    rounds = list(_rounds(summary, figures))
    proposals = list(_proposals(summary, figures))
    return {
        "summary": summary,
        "attributes": tree.attrs,
        "description": str(tree.attrs.get(schema.CAMPAIGN_DESCRIPTION, "")).strip(),
        "headline": sentences.headline_parts(summary),
        "badge": sentences.badge(summary),
        "structures": {
            "lines": structures.section(summary),
            "table": structures.table(summary),
            "parameters": structures.parameters(summary),
            "withheld": structures.withheld(summary),
        },
        "extended": sentences.added(summary),
        "unfinished": [*sentences.unfinished(summary), *drawing.failed],
        "role": sentences.role_shown(summary),
        "tiles": sentences.tiles(summary, units, averaged),
        "averaged": averaged,
        "error_by_role": tables.error_by_role(summary, units, averaged),
        "error_by_run": tables.error_by_run(summary, units, averaged),
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
        "formulas": figures["formulas"],
        "equations": str(tree.attrs.get(schema.EQUATIONS, "")).strip(),
        "provenance": tables.provenance(tree),
        "figures": figures,
        "lead": figures["structures"] or figures["error"],
        "runs": sentences.runs_used(summary),
        "errors_word": sentences.error_model(_posterior_attributes(tree), summary),
        "viewer": next(iter(figures["viewer"]), None),
        "periodic": [run.periodic for run in reading.runs(tree)],
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


def _posterior_attributes(tree: xr.DataTree) -> dict[Any, Any]:
    return tree[schema.POSTERIOR].attrs if schema.POSTERIOR in tree.children else {}


def _rounds(summary: dict[str, Any], figures: Mapping[str, list[Any]]) -> Iterator[dict[str, Any]]:
    """Table, figure and decision of every round."""
    titles = sentences.titles(summary)
    for number, entry in enumerate(summary["rounds"]):
        yield {
            "accepted": _accepted(entry, titles),
            "reason": sentences.reason(entry, titles),
            "table": tables.candidates(entry, titles) if entry["candidates"] else None,
            "failed": tables.failed(entry, titles),
            "figures": [*figures[f"ranking {number}"], *figures[f"curve {number}"]],
        }


def _accepted(entry: dict[str, Any], titles: dict[str, str]) -> str:
    """What a round added, as it is called; nothing where it added nothing."""
    if not entry["accepted"]:
        return ""
    added = chosen(entry)
    return called(entry["accepted"] if added is None else name(added), titles)


def _proposals(
    summary: dict[str, Any], figures: Mapping[str, list[Any]]
) -> Iterator[dict[str, Any]]:
    """Sentences, table and figure for each set of effects that is left to be told apart."""
    objection = sentences.hold_out_objects(summary)
    for number, entry in enumerate(summary.get("proposals", [])):
        yield {
            "lines": proposal_lines(entry, sentences.titles(summary), objection),
            "table": proposal_table(entry, sentences.titles(summary)),
            "figures": figures[f"proposal {number}"],
        }
