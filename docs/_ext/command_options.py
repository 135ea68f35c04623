"""Every command with every option, as Markdown for ``command-line.md``, made from the code.

``python docs/_ext/command_options.py`` writes it between the two marks of that page.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import typer.main

from bayesoleo._cli import app

PAGE = Path(__file__).resolve().parents[1] / "command-line.md"
FIRST = "<!-- made by docs/_ext/command_options.py: do not edit by hand -->"
LAST = "<!-- end of what is made -->"


def reference() -> str:
    """The lines between the marks."""
    lines: list[str] = []
    for name, command in typer.main.get_command(app).commands.items():  # type: ignore[attr-defined]
        what = " ".join((command.help or "").split("\n\n")[0].split())
        arguments = [one for one in command.params if one.param_type_name == "argument"]
        usage = " ".join(["bayesoleo", name, *(_argument(one) for one in arguments)])
        lines += [f"### {name}", "", what, "", f"`{usage} [OPTIONS]`", ""]
        lines += ["| about | option | meaning |", "|---|---|---|"]
        lines += [_row(one) for one in _by_panel(command.params) if one.name != "help"]
        lines.append("")
    return "\n".join(lines)


def _argument(one: Any) -> str:
    return str(one.metavar or one.name.upper())


def _by_panel(params: list[Any]) -> list[Any]:
    """Options in the order of the panels in which they first appear."""
    options = [one for one in params if one.param_type_name == "option"]
    panels = list(dict.fromkeys(_panel(one) for one in options))
    return sorted(options, key=lambda one: panels.index(_panel(one)))


def _panel(one: Any) -> str:
    return str(getattr(one, "rich_help_panel", None) or "what it is about")


def _row(one: Any) -> str:
    flags = ", ".join(f"`{flag}`" for flag in one.opts)
    value = f" `{one.metavar}`" if one.metavar and not one.is_flag else ""
    text = " ".join((one.help or "").split())
    shown = one.show_default if isinstance(one.show_default, str) else None
    if shown is None and one.show_default and not one.is_flag and one.default is not None:
        shown = _default(one.default)
    default = f" Default: {shown}." if shown else ""
    needed = " Required." if one.required else ""
    cells = (_panel(one), f"{flags}{value}", f"{text}{default}{needed}")
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _default(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ",".join(map(str, value))
    return "" if callable(value) else str(value)


def written(text: str) -> str:
    """The page with the lines in place."""
    before, _, rest = text.partition(FIRST)
    _, _, after = rest.partition(LAST)
    return f"{before}{FIRST}\n\n{reference()}\n{LAST}{after}"


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
