"""What to measure next, in sentences and as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from bayesoleo.effects.titles import called, listed
from bayesoleo.plots.units import Scale, engineering
from bayesoleo.report.tables import Table, format_short

#: Pairs of rivals that have a column of their own.
MOST_PAIRS = 3


def proposal_lines(entry: Mapping[str, Any], titles: Mapping[str, str] | None = None) -> list[str]:
    """What one entry of the summary's ``proposals`` says, sentence by sentence.

    Parameters
    ----------
    entry : mapping
        As in ``summary.json``.
    titles : mapping of str to str, optional
        Titles of effects by id, besides those of the catalogue.
    """
    entry = _with_titles(entry, titles or {})
    lines = [_question(entry)]
    if entry["runs"]:
        lines += _answer(entry)
    elif entry["note"]:
        lines.append(f"No run can be proposed: {entry['note']}.")
    else:
        left_out = ", ".join(entry["left_out"])
        lines.append(f"No run within the limits of the rig can be foreseen ({left_out or 'none'}).")
    if entry["runs"] and entry["note"]:
        lines.append(f"Left out: {entry['note']}.")
    return lines


def _with_titles(entry: Mapping[str, Any], titles: Mapping[str, str]) -> dict[str, Any]:
    """The entry with rivals as they are called."""

    def words(names: Sequence[str]) -> list[str]:
        return [called(one, titles) for one in names]

    def run(found: Mapping[str, Any] | None) -> dict[str, Any] | None:
        if found is None:
            return None
        return {**found, "pairs": [{**p, "rivals": words(p["rivals"])} for p in found["pairs"]]}

    return {
        **entry,
        "rivals": words(entry["rivals"]),
        "runs": [run(one) for one in entry["runs"]],
        "repeat": run(entry["repeat"]),
        "inseparable": [words(pair) for pair in entry["inseparable"]],
    }


def proposal_table(
    entry: Mapping[str, Any], titles: Mapping[str, str] | None = None
) -> Table | None:
    """The runs that would tell most, the best first, and the best one of those made.

    None where there is nothing to choose.

    Parameters
    ----------
    entry : mapping
        As in ``summary.json``.
    titles : mapping of str to str, optional
        Titles of effects by id, besides those of the catalogue.
    """
    if not entry["runs"] or _all_alike(entry):
        return None
    entry = _with_titles(entry, titles or {})
    scale = _scale(entry)
    unit = f" [{scale.unit}]" if scale.unit else ""
    pairs = entry["runs"][0]["pairs"]
    by_pair = len(pairs) <= MOST_PAIRS
    named = [f"{' / '.join(pair['rivals'])} [σ]" for pair in pairs]
    head = ["run", "frequency [Hz]", f"mean{unit}", f"amplitude{unit}", "information [bit]"]
    head += named if by_pair else ["least separated pair [σ]"]
    shown = [(f"{number}", run) for number, run in enumerate(entry["runs"], start=1)]
    if entry["repeat"]:
        shown.append((f"{entry['repeat']['run']} once more", entry["repeat"]))
    rows = []
    for label, run in shown:
        values = [pair["sigma"] for pair in run["pairs"]] if by_pair else [run["sigma"]]
        place = [scale.factor * run[key] for key in ("mean", "amplitude")]
        rows.append(
            [label, *map(format_short, (run["frequency"], *place)), f"{run['information']:.2f}"]
            + [format_sigma(value) for value in values]
        )
    return Table(head, rows, 1, frozenset({0}))


def format_sigma(value: float) -> str:
    """Standard deviations, to a tenth while that matters."""
    return f"{value:.1f}" if value < 99.95 else f"{value:.0f}"


def run_text(run: Mapping[str, Any], scale: Scale) -> str:
    """A run in words: ``2.00 Hz, mean 120 mm, amplitude 30.0 mm``."""
    mean, amplitude = (format_short(scale.factor * run[key]) for key in ("mean", "amplitude"))
    unit = f" {scale.unit}" if scale.unit else ""
    return f"{format_short(run['frequency'])} Hz, mean {mean}{unit}, amplitude {amplitude}{unit}"


def _scale(entry: Mapping[str, Any]) -> Scale:
    sizes = [max(abs(run["mean"]), run["amplitude"]) for run in entry["runs"]]
    return engineering(entry["unit"], max(sizes, default=0.0))


def _question(entry: Mapping[str, Any]) -> str:
    names = listed(entry["rivals"])
    if entry["question"] == "indistinguishable":
        first, *others = entry["rivals"]
        return f"These data cannot tell {first}, which was added, from {listed(others)}."
    if entry["question"] == "open":
        return f"Each of {names} might be what is missing."
    return f"To be told apart: {names}."


def _answer(entry: Mapping[str, Any]) -> list[str]:
    best, repeat, apart = entry["runs"][0], entry["repeat"], entry["inseparable"]
    if _all_alike(entry):
        return [
            "No run within the limits of the rig would separate them by one standard deviation:"
            " they are one law in other words, or differ beyond these limits or in other channels."
        ]
    pairs = [pair for pair in best["pairs"] if pair["rivals"] not in apart]
    weakest = min(pair["sigma"] for pair in pairs)
    two = len(entry["rivals"]) == 2
    whom = listed(entry["rivals"], " from ") if two else "each pair of them"
    if apart:
        whom = "the others"
    least = "" if two else "at least "
    text = f"A run at {run_text(best, _scale(entry))} would separate {whom}"
    text += f" by {least}{format_sigma(weakest)} standard deviations"
    if repeat:
        same = [pair["sigma"] for pair in repeat["pairs"] if pair["rivals"] not in apart]
        text += f"; no present run, made once more, by more than {format_sigma(min(same))}"
    lines = [f"{text}."]
    for pair in apart:
        lines.append(
            f"No run within the limits of the rig separates {listed(pair, ' from ')} by one"
            " standard deviation."
        )
    return lines


def _all_alike(entry: Mapping[str, Any]) -> bool:
    """Whether no pair is separated by any run, so that there is nothing to choose."""
    return len(entry["inseparable"]) == len(entry["runs"][0]["pairs"])
