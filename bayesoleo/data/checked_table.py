"""Values out of ``campaign.toml``: every key checked, so that a typing slip does not pass as a
default."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np

from bayesoleo.errors import CampaignError
from bayesoleo.units import Unit, check_kind, parse_unit

FILE = "campaign.toml"


def choose(wrong: str, allowed: Sequence[str] | Mapping[str, Any]) -> str:
    """What to write instead of ``wrong``: the closest of ``allowed``, or all of them."""
    names = [str(name) for name in allowed]
    close = get_close_matches(wrong, names, n=1)
    listed = ", ".join(names[:30]) + (", ..." if len(names) > 30 else "")
    return (f"did you mean {close[0]!r}? " if close else "") + f"one of: {listed}"


def load_table(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise _no_campaign(path)
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise CampaignError(
            f"not valid TOML: {error}", file=path.name, hint=_slip(path, str(error))
        ) from error


def _slip(path: Path, problem: str) -> str | None:
    """What to write in a line that holds text without quotes."""
    place = re.search(r"at line (\d+)", problem)
    lines = path.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    line = lines[int(place[1]) - 1] if place and int(place[1]) <= len(lines) else ""
    key, _, value = (part.strip() for part in line.partition("="))
    if re.match(r"[^\s\"'\[{#]*[A-Za-z]", value) and value not in ("true", "false"):
        return f'text needs quotes: {key} = "{value}"'
    number = re.match(r"([+-]?[\d.]+(?:[eE][+-]?\d+)?)\s*[A-Za-z/%°]+$", value)
    if number:
        return f"a number stands alone: {key} = {number[1]}"
    return None


def _no_campaign(path: Path) -> CampaignError:
    """What is there instead of the file, or how far its path leads."""
    hint, folder = f"a campaign is a folder with a {FILE}", path.parent
    if folder.is_file():
        return CampaignError("is a file; a folder is expected", file=folder, hint=hint)
    if not folder.exists():
        return CampaignError("no such folder", file=folder, hint=hint)
    return CampaignError("no such file", file=path, hint=hint)


def get_value(
    table: Mapping[str, Any],
    key: str,
    kind: type,
    hint: str,
    run: str | None = None,
    **default: Any,
) -> Any:
    """A value of the expected kind; ``default=`` makes it optional."""
    if key not in table:
        if "default" in default:
            return default["default"]
        raise CampaignError("missing", file=FILE, run=run, key=key, hint=f"write {hint}")
    value = table[key]
    good = isinstance(value, Real) if kind is float else isinstance(value, kind)
    if isinstance(value, bool) or not good or (kind is float and not np.isfinite(value)):
        raise CampaignError(
            "wrong kind of value", file=FILE, run=run, key=key, value=value, hint=f"write {hint}"
        )
    return float(value) if kind is float else value


def check_keys(
    table: Mapping[str, Any], allowed: Sequence[str], run: str | None, inside: str = ""
) -> None:
    for key in table:
        if key not in allowed:
            raise CampaignError(
                "unknown key", file=FILE, run=run, key=inside + key, hint=choose(key, allowed)
            )


def get_unit(name: str, text: str, key: str, run: str | None = None) -> Unit:
    """Parse a unit and add where it stood to what is wrong with it."""
    try:
        unit = parse_unit(text)
        check_kind(name, unit)
    except CampaignError as error:
        raise CampaignError(
            error.problem, file=FILE, run=run, key=key, value=error.value, hint=error.hint
        ) from error
    return unit
