"""The catalogue of effects as tables, by family: what is listed is what is built in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from docutils.nodes import Node
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from bayesoleo.effects import FAMILIES, catalogue, describe

SIDES = {-1: ", negative", 0: "", 1: ", positive"}
HEAD = ("effect", "formula", "amplitudes, null 0", "shapes and what is scanned", "source")


def tables() -> list[str]:
    """Lines of Markdown: a heading and a table a family."""
    lines: list[str] = []
    listed = [describe(effect) for effect in catalogue()]
    for family in FAMILIES:
        rows = [_row(item) for item in listed if item["family"] == family]
        if rows:
            lines += [f"**{family}**", "", _cells(HEAD), _cells(("---",) * len(HEAD)), *rows, ""]
    return lines


def _row(item: Mapping[str, Any]) -> str:
    parameters = item["parameters"].values()
    amplitudes = [p for p in parameters if p["kind"].startswith("amplitude")]
    shapes = [p for p in parameters if p["kind"] == "shape"]
    title = item["title"][0].lower() + item["title"][1:]
    return _cells(
        (
            f"`{item['id']}`: {title} ({item['applies_to']})",
            f"${item['formula']}$",
            _amplitudes(amplitudes),
            "; ".join(f"${p['latex']}$ {_unit(p)}: {p['scan']}" for p in shapes),
            item["source"],
        )
    )


def _amplitudes(found: list[Mapping[str, Any]]) -> str:
    if len(found) > 2:  # a series: its formula says what the others are
        found = [found[0], found[-1]]
        return " … ".join(f"${p['latex']}$" for p in found) + f" {_unit(found[0])}"
    by_run = {True: ", by run", False: ""}
    return "; ".join(
        f"${p['latex']}$ {_unit(p)}{SIDES[p['sign']]}{by_run['by run' in p['kind']]}" for p in found
    )


def _unit(parameter: Mapping[str, Any]) -> str:
    return f"[{parameter['unit'] or '1'}]".replace("**", "^").replace("*", r"\*")


def _cells(texts: tuple[str, ...]) -> str:
    # A bar within a formula would end its cell.
    shown = (text.replace("|", r"\vert ") if "$" in text else text for text in texts)
    return "| " + " | ".join(shown) + " |"


class EffectTable(SphinxDirective):
    """``{effect-table}``: all effects."""

    def run(self) -> list[Node]:
        """The tables, parsed as the page is."""
        return self.parse_text_to_nodes("\n".join(tables()))


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the directive."""
    app.add_directive("effect-table", EffectTable)
    return {"parallel_read_safe": True}
