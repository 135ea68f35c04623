"""The table of a closed loop: errors before and after, and the posterior of what was added."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from bayesoleo.effects.titles import called
from bayesoleo.plots.rankings import chosen
from bayesoleo.plots.units import engineering, format_number

ROLES = ("fit", "hold-out")


def print_before_after(summary: Mapping[str, Any], unit: str, per_si: float) -> None:
    """Print both tables.

    Parameters
    ----------
    summary : mapping
        As in ``summary.json``.
    unit : str
        In which errors are shown.
    per_si : float
        How many of it one SI unit is.
    """
    head = ("rms before", "after", "repeating before", "after", "over what is expected")
    print(f"{f'error in {unit}':26}" + "".join(f"{text:>{len(text) + 3}}" for text in head))
    for role in ROLES:
        for output, last in summary["error_after"].get(role, {}).items():
            first = summary["error_before"][role][output]
            cells = [per_si * e[key] for key in ("rms", "repeating") for e in (first, last)]
            ratio = " → ".join(f"{e['ratio_to_expected']:.1f}" for e in (first, last))
            row = "".join(
                f"{value:{len(text) + 3}.3g}" for value, text in zip(cells, head, strict=False)
            )
            print(f"{f'{output}, {role}':26}{row}{ratio:>24}")
    print(f"\n{'posterior of what was added':34}{'mean':>10}{'sd':>10}   95 % interval")
    for effect, names in added_parameters(summary):
        print(effect)
        for name in names:
            print(_line(name, summary["parameters"][name]))


def title_of(summary: Mapping[str, Any], effect: str | None) -> str:
    """What an effect is called; a dash for none."""
    return called(effect, summary.get("titles", {})) if effect else "–"


def added_parameters(summary: Mapping[str, Any]) -> Iterator[tuple[str, list[str]]]:
    """Every effect that was added and stayed, with its parameters that were estimated."""
    for entry in summary["rounds"]:
        added = chosen(entry)
        if added is None or added["effect"] not in summary["effects"]:
            continue
        names = [name for name in added["expected"] if name in summary["parameters"]]
        yield title_of(summary, f"{added['effect']} @ {added['target']}"), names


def _line(name: str, entry: Mapping[str, Any]) -> str:
    scale = engineering(entry["unit"], abs(entry["mean"]))
    if entry["interval"] is None:
        mean = f"{scale.factor * entry['mean']:.4g}"
        return f"  {name:32}{mean:>10}{scale.unit:>10}   shared with {entry['shared_with']}"
    sd = scale.factor * entry["sd"]
    mean, low, high = (
        format_number(scale.factor * value, sd) for value in (entry["mean"], *entry["interval"])
    )
    return f"  {name:32}{mean:>10}{sd:>10.2g}   {low} … {high} {scale.unit}".rstrip()
