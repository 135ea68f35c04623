"""What the result says, in sentences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from bayesoleo import schema
from bayesoleo.effects.unnamed import FAMILY
from bayesoleo.plots.rankings import format_p, name
from bayesoleo.plots.units import Scale
from bayesoleo.report.tables import error_scale, format_short
from bayesoleo.tracing.deciding.confirmation import LEAST_SHARE
from bayesoleo.tracing.deciding.rounds import LEVEL

FLOOR = 1.15
"""A ratio of repeating error to noise below which a run is taken to be explained."""


def role_shown(summary: Mapping[str, Any]) -> str:
    """The runs that count: those held out, if there are any."""
    return schema.HOLD_OUT if summary["error_after"].get(schema.HOLD_OUT) else schema.FIT


def headline(summary: Mapping[str, Any]) -> str:
    """The verdict as a sentence."""
    names = _told_apart(summary)
    found = " and ".join([part for part in (", ".join(names[:-1]), *names[-1:]) if part])
    lacked = "an effect" if len(summary["effects"]) == 1 else "effects"
    if summary["verdict"] == schema.NOTHING_MISSING:
        return "Nothing is missing: the model explains the measurements down to their noise."
    if summary["verdict"] == schema.EFFECT_ADDED:
        return f"The model lacked {lacked}: {found} found and added."
    rest = _unexplained(summary["rounds"][-1])
    if found:
        return f"The model lacked {lacked}: {found} added, but an error remains{rest}."
    return f"Something is missing{rest}."


def unfinished(summary: Mapping[str, Any]) -> list[str]:
    """Which stages did not finish, and why."""
    return [
        f"Unfinished: the stage {item['stage']} failed. {item['reason']}"
        for item in summary.get(schema.UNFINISHED, [])
    ]


def _told_apart(summary: Mapping[str, Any]) -> list[str]:
    """What was added, by name; one that was added at several places with each of them."""
    effects, names = list(summary["effects"]), list[str]()
    for k, effect in enumerate(effects):
        rounds = [item for item in summary["rounds"] if item.get("accepted") == effect]
        # Of one that was taken out again at one place it is not known here which.
        several = len(rounds) == effects.count(effect) > 1
        place = f" @ {rounds[effects[:k].count(effect)]['accepted_target']}" if several else ""
        names.append(_called(effect) + place)
    return names


def _called(effect: str) -> str:
    """An effect's id; of one without a name it must not pass for a name."""
    return f"one without a name ({effect})" if effect.startswith(f"{FAMILY}_") else effect


def _unexplained(last: Mapping[str, Any]) -> str:
    """What the catalogue has to say to an error that remains, as the end of a sentence."""
    open_ = [
        c
        for c in last["candidates"]
        if c["p_value"] is not None and c["p_value"] < LEVEL and c["gain"] >= LEAST_SHARE
    ]
    if not open_:
        return " that no effect in the catalogue explains"
    best = max(open_, key=lambda candidate: candidate["gain"])
    if any(c.get("estimated") for c in last["candidates"]):
        return f", and no effect was confirmed; the nearest is {name(best)}"
    share = f"{100 * best['gain']:.0f} %"
    return f"; {name(best)} would explain {share} of the excess, and was not tried"


def tiles(summary: Mapping[str, Any], units: Mapping[str, str]) -> list[dict[str, str]]:
    """For each output the numbers that matter: the error on the runs not used, before and after."""
    role = role_shown(summary)
    two = len(summary["rounds"]) > 1
    shown = []
    for output, last in summary["error_after"].get(role, {}).items():
        first = summary["error_before"].get(role, {}).get(output, last)
        key = "rms" if last["repeating"] is None else "repeating"
        scale = error_scale(units.get(output, ""), (first, last))
        ratio = [format_short(e["ratio_to_noise"]) for e in (first, last)]
        known = last["ratio_to_noise"] is not None
        shown.append(
            {
                "title": f"{output}, {role} runs",
                "before": _number(first[key], scale) if two else "",
                "after": _number(last[key], scale),
                "unit": scale.unit,
                "what": "repeating error" if key == "repeating" else "rms error",
                "ratio": f"{' → '.join(ratio) if two else ratio[1]} × the noise" if known else "",
                "change": _change(first[key], last[key]) if two else "",
            }
        )
    return shown


def reason(entry: Mapping[str, Any]) -> str:
    """Why a round ended as it did, as a sentence; an id at its start stays as it is written."""
    text = entry["reason"].strip().rstrip(".")
    if not text:
        return ""
    first = text.split()[0]
    ids = {str(entry["accepted"])}
    ids |= {str(c[key]) for c in entry["candidates"] for key in ("effect", "target")}
    return f"{text if first in ids or '_' in first else text[0].upper() + text[1:]}."


def stability(summary: Mapping[str, Any]) -> str:
    """Whether the periodic solutions are such that a rig can stay on; empty if there are none."""
    known = {
        run: max(np.hypot(*pair) for pair in entry["multipliers"])
        for run, entry in summary.get("stability", {}).items()
        if entry["multipliers"]
    }
    if not known:
        return ""
    largest = max(known, key=lambda run: known[run])
    end = f"largest Floquet multiplier {format_short(known[largest])}, in {largest}"
    lost = [run for run in known if not summary["stability"][run]["stable"]]
    jumps = summary["branch_jumps"]["estimate"]
    text = (
        f"The periodic solution of {', '.join(lost)} is unstable"
        if lost
        else f"The periodic solutions of all {len(known)} runs are stable"
        if len(known) > 1
        else "The periodic solution is stable"
    )
    went = f" Solutions changed branch or stability {jumps} times on the way." if jumps else ""
    return f"{text}; {end}.{went}"


def remainder(summary: Mapping[str, Any]) -> list[str]:
    """What is still unexplained, sentence by sentence."""
    last = summary["rounds"][-1]
    lines = [_above_floor(output, runs) for output, runs in last["error"].items()]
    if last["candidates"]:
        best = max(last["candidates"], key=lambda candidate: candidate["gain"])
        p = format_p(best["p_value"])
        share = f"{100 * best['gain']:.1f} %".replace("-", "−")
        text = f"The best remaining candidate, {name(best)}, would explain {share} of the excess"
        lines.append(f"{text} ({p})." if p else f"{text}.")
    if last["reason"]:
        reason = last["reason"].rstrip(".")
        lines.append(f"The search ended because {reason}." if len(reason) > 1 else "")
    return [line for line in lines if line]


def _above_floor(output: str, runs: Mapping[str, Any]) -> str:
    """How many runs of an output lie above their noise, and the worst of them."""
    ratios = {
        run: e["ratio_to_noise"] for run, e in runs.items() if e["ratio_to_noise"] is not None
    }
    if not ratios:
        return f"No run has a noise floor for {output}: only the rms of the residual is known."
    worst = max(ratios, key=lambda run: ratios[run])
    above = sum(ratio > FLOOR for ratio in ratios.values())
    largest = f"the largest ratio is {format_short(ratios[worst])}, in {worst}"
    of = f"of {len(ratios)} runs"
    lead = "no run" if above == 0 else f"{above} {of}"
    verb = "has" if above <= 1 else "have"
    text = f"{lead} {verb} a repeating {output} error above {FLOOR} times its noise; {largest}."
    return text[0].upper() + text[1:]


def _number(value: float | None, scale: Scale) -> str:
    return format_short(None if value is None else scale.factor * value)


def _change(before: float | None, after: float | None) -> str:
    """How much the error fell or rose."""
    if not before or after is None:
        return ""
    change = 100 * (after / before - 1)
    return f"{change:+.0f} %".replace("-", "−")
