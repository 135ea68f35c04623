"""Lists in the documentation against the code that they describe."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from bayesoleo import _schema as schema
from bayesoleo.data import _campaign_toml as declaration
from bayesoleo.effects import FAMILIES, catalogue
from bayesoleo.model._expressions import FUNCTIONS

DOCS = Path(__file__).resolve().parents[2] / "docs"


def page(name: str) -> str:
    return (DOCS / name).read_text(encoding="utf-8")


def test_every_key_of_a_campaign_is_described() -> None:
    keys = (*declaration._TOP, *declaration._CHANNEL, *declaration._RUN, *declaration._CONDITION)
    text = page("data-format.md")
    assert [key for key in keys if key not in text] == []


@pytest.mark.parametrize("name", ["results.md", "architecture.md"])
def test_every_group_of_a_result_is_described(name: str) -> None:
    assert [group for group in schema.GROUPS if f"`{group}`" not in page(name)] == []


def test_every_key_of_the_summary_is_described() -> None:
    text = page("results.md")
    whole = schema.summary_schema()
    parts = ("round", "candidate", "run_error", "proposal", "trial", "structures")
    tables = [whole, *(whole["$defs"][part] for part in parts)]
    keys = {key for table in tables for key in table["properties"]}
    # In words of code within the text, alone or in braces that stand for an object.
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    described = set(re.findall(r"\w+", " ".join(re.findall(r"`([^`]+)`", prose))))
    assert keys - described == set()
    assert [verdict for verdict in schema.VERDICTS if f"`{verdict}`" not in text] == []


def test_every_function_of_expressions_is_described() -> None:
    text = page("models.md")
    assert [name for name in FUNCTIONS if f"`{name}" not in text] == []


def test_families_in_the_catalogue_are_mentioned() -> None:
    text = page("effects.md")
    present = {effect.family for effect in catalogue()}
    assert present <= set(FAMILIES)
    assert [family for family in sorted(present) if f"`{family}`" not in text] == []


def test_the_table_of_effects_holds_every_one_with_formula_scan_and_source(monkeypatch) -> None:
    pytest.importorskip("sphinx")
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    import effect_table

    assert "```{effect-table}" in page("effects.md")
    rows = [line for line in effect_table.tables() if line.startswith("| `")]
    assert len(rows) == len(catalogue())
    by_id = {row.split("`")[1]: row for row in rows}
    for effect in catalogue():
        row = by_id[effect.id]
        name, formula, amplitudes, shapes, source = row.strip("| ").split(" | ")
        assert name.startswith(f"`{effect.id}`: ")
        assert formula.startswith("$")
        assert "[" in amplitudes
        assert shapes.count("$") == 2 * len(effect.shapes)
        assert source == effect.source


def test_every_option_is_described_as_help_does(monkeypatch) -> None:
    monkeypatch.syspath_prepend(str(DOCS / "_ext"))
    import command_options

    assert command_options.written(page("command-line.md")) == page("command-line.md")


def test_every_command_is_described() -> None:
    cli = pytest.importorskip("bayesoleo._cli")
    import typer.main

    commands = typer.main.get_command(cli.app).commands
    text = page("command-line.md")
    assert [name for name in commands if f"`{name}" not in text] == []
