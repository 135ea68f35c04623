"""Lists of what is built in: ``systems`` and ``effects``, with formulas and units."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from bayesoleo._cli import options, shell

PANEL = "What is built in"
#: How parts of LaTeX read in a terminal; longer ones first, since some begin alike.
_READABLE = {
    r"\ddot q": "q̈",
    r"\ddot x": "ẍ",
    r"\dot x": "ẋ",
    r"\ddot y": "ÿ",
    r"\dot q": "q̇",
    r"\dot w": "ẇ",
    r"\dot y": "ẏ",
    r"\dot Q": "Q̇",
    r"\dot T": "Ṫ",
    r"\operatorname{": "{",
    r"\mathrm{": "{",
    r"\left": "",
    r"\right": "",
    r"\arctan": "arctan",
    r"\arg": "arg",
    r"\cos": "cos",
    r"\sin": "sin",
    r"\sum_{k=1}^{3}": "Σ_k",
    r"\varphi": "φ",
    r"\max": "max",
    r"\dots": "…",
    r"\;": " ",
    r"\quad": "  ",
    r"\approx": "≈",
    r"\Delta": "Δ",
    r"\delta": "δ",
    r"\epsilon": "ε",
    r"\kappa": "κ",
    r"\lambda": "λ",
    r"\mu": "μ",
    r"\rho": "ρ",
    r"\sigma": "σ",
    r"\tau": "τ",
    r"\theta": "θ",
    r"\pi": "π",
    r"\,": " ",
}


def add_to(app: typer.Typer) -> None:
    """Add the commands of this module."""
    shell.add(app, PANEL, systems, effects)


def systems(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[MODEL]", show_default=False, help="Built-in system, or file.py:object."
        ),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """List the built-in systems, or show one with its equations, parameters, priors and units.

    \b
    Examples:
      bayesoleo systems
      bayesoleo systems f16n2d2
      bayesoleo systems model.py:model --json
    """
    from bayesoleo._workflow.model_files import load_model
    from bayesoleo.model._drive_and_start import possible_drives
    from bayesoleo.systems._systems import describe, systems as names

    def facts(text: str) -> dict[str, Any]:
        model = load_model(text)
        return describe(model) | {"drives": list(possible_drives(model))}

    if name is not None:
        one = facts(name)
        if as_json:
            shell.print_json(one)
        else:
            _print_system(one, shell.console())
        return
    # By the name it is asked for, which need not be the one it has in reports.
    found = {text: facts(text) for text in names()}
    if as_json:
        shell.print_json(found)
        return
    rows = [
        [text, ", ".join(item["inputs"]) or "–", ", ".join(item["outputs"]), item["description"]]
        for text, item in found.items()
    ]
    shell.console().print(shell.table(["system", "inputs", "outputs", "what it is"], rows, 4))


def _print_system(item: Mapping[str, Any], console: Console) -> None:
    console.print(Text(item["name"], style="bold"))
    console.print(Text(item["description"]))
    for kind in ("inputs", "dofs", "outputs"):
        shown = ", ".join(f"{name} [{unit or '1'}]" for name, unit in item[kind].items())
        console.print(Text.assemble((f"{kind:<16}", "dim"), shown or "–"), soft_wrap=True)
    drives = ", ".join(item["drives"]) or "–"
    console.print(Text.assemble((f"{'can be driven by':<16} ", "dim"), drives), soft_wrap=True)
    console.print()
    for line in item["equations"].values():
        console.print(Text(f"  {line}"), soft_wrap=True)
    rows = [
        [name, entry["value"], entry["unit"] or "1", _prior(entry), entry["description"]]
        for name, entry in item["parameters"].items()
    ]
    if rows:
        console.print()
        head = ["parameter", "value", "unit", "prior", "what it is"]
        console.print(_left(head, rows, numbers={1}))
    rows = [
        [name, entry["default"], entry["unit"] or "1", entry["description"]]
        for name, entry in item["conditions"].items()
    ]
    if rows:
        console.print()
        head = ["condition of a run", "default", "unit", "what it is"]
        console.print(_left(head, rows, numbers={1}))


def _left(head: list[str], rows: list[list[Any]], numbers: set[int]) -> Any:
    """A table with words in every column but those."""
    made = shell.table(head, rows, words=len(head))
    for column in numbers:
        made.columns[column].justify = "right"
    return made


def _prior(entry: Mapping[str, Any]) -> str:
    """A prior in words."""
    prior = entry["prior"]
    by_run = ", one a run" if entry["by_run"] else ""
    if prior is None:
        return ("fixed" if entry["fixed"] else "none") + by_run
    low, high = prior["low"], prior["high"]
    limits = ""
    if low is not None or high is not None:
        edges = [
            cell if edge is None else f"{edge:.4g}" for edge, cell in ((low, "−∞"), (high, "∞"))
        ]
        limits = f" in {edges[0]} … {edges[1]}"
    return f"{prior['kind']} {prior['mean']:.4g} ± {prior['sd']:.2g}{limits}{by_run}"


def effects(
    identifier: Annotated[
        str | None,
        typer.Argument(metavar="[ID]", show_default=False, help="Id of an effect, as listed."),
    ] = None,
    as_json: options.Json = False,
) -> None:
    """List the effects that can be found, or show one with formula, units and source.

    q is the position where an effect acts, s its smooth sign of velocity; units are in words of
    that place: force, position, channel, parameter. Every amplitude is zero where the effect is
    absent. With --json, formulas are LaTeX.

    \b
    Examples:
      bayesoleo effects
      bayesoleo effects coulomb_friction
      bayesoleo effects --json
    """
    from bayesoleo.effects._catalogue import catalogue, describe, find_effect

    if identifier is not None:
        one = describe(find_effect(identifier))
        if as_json:
            shell.print_json(one)
        else:
            _print_effect(one, shell.console())
        return
    found = [describe(effect) for effect in catalogue()]
    if as_json:
        shell.print_json(found)
        return
    rows = [
        [item["id"], item["family"], readable(item["formula"]), _units(item["parameters"])]
        for item in found
    ]
    shell.console().print(shell.table(["effect", "family", "formula", "amplitude in"], rows, 4))


def _units(parameters: Mapping[str, Any]) -> str:
    """Units of the amplitudes."""
    amplitudes = [p for p in parameters.values() if p["kind"].startswith("amplitude")]
    return ", ".join(dict.fromkeys(item["unit"] or "1" for item in amplitudes))


def _print_effect(item: Mapping[str, Any], console: Console) -> None:
    console.print(Text(item["id"], style="bold"))
    console.print(Text(item["title"]))
    for key in ("family", "applies_to", "source"):
        label = f"{key.replace('_', ' '):<12}"
        console.print(Text.assemble((label, "dim"), item[key] or "–"), soft_wrap=True)
    console.print()
    console.print(Text(f"  {readable(item['formula'])}"), soft_wrap=True)
    console.print()
    sides = {-1: "negative only", 0: "either", 1: "positive only"}
    rows = [
        [
            name,
            entry["unit"] or "1",
            entry["kind"],
            sides[entry["sign"]] if "sign" in entry else "–",
            entry.get("scan") or ("0" if "null" in entry else "–"),
            entry["description"],
        ]
        for name, entry in item["parameters"].items()
    ]
    head = ["parameter", "unit", "kind", "sign", "null or scan", "what it is"]
    console.print(shell.table(head, rows, 6))


def readable(latex: str) -> str:
    """A formula as a terminal can show it; what has no plain form stays LaTeX."""
    text = latex
    for part, plain in _READABLE.items():
        text = text.replace(part, plain)
    previous = ""
    while text != previous:  # from the innermost braces outwards
        previous = text
        text = re.sub(r"_\{([^{}]*)\}", r"_\1", text)
        text = re.sub(r"\^\{([^{}]*)\}", r"^(\1)", text)
        text = re.sub(r"\\frac\{([^{}]*)\}\{([^{}]*)\}", _quotient, text)
        text = re.sub(r"(?<![_^}c])\{(\w+)\}", r"\1", text)
    text = re.sub(r"\^2(?!\d)", "²", text)
    text = re.sub(r"\^3(?!\d)", "³", text)
    return " ".join(text.split())


def _quotient(found: re.Match[str]) -> str:
    """A fraction on one line, with brackets where they count."""
    above, below = (text.strip() for text in found.groups())
    above = f"({above})" if re.search(r" [-+] ", above) else above
    below = f"({below})" if re.search(r"[-+ ]", below) else below
    return f"{above}/{below}"
