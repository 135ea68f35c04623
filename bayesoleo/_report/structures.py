"""Sentences and the table of the probabilities of structures; empty where a result has none."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._display import columns
from bayesoleo._report.tables import Table
from bayesoleo.effects._catalogue import called, listed
from bayesoleo.effects._nonparametric import FAMILY
from bayesoleo.plots._discovery import SHOWN, format_probability, name
from bayesoleo.plots._style import Scale, engineering, format_number

#: More probable than not.
LIKELY = 0.5
NOTHING, OUTSIDE = "nothing missing", "something outside the catalogue"
#: Structures of the table that are shown before the others are asked for.
LEAD = 6


def spoken(probability: float) -> str:
    """A probability in a sentence: ``0.97``, ``above 0.99``."""
    return format_probability(probability).replace(">", "above").replace("<", "below")


def known(summary: Mapping[str, Any]) -> Mapping[str, Any] | None:
    """The probabilities of structures, if a result has any."""
    return summary.get("structures")


def of_effects(summary: Mapping[str, Any]) -> dict[str, float]:
    """Probability of each effect that was compared, by ``effect @ target``."""
    found = known(summary)
    return {} if found is None else {name(e): e["probability"] for e in found["effects"]}


def added_names(summary: Mapping[str, Any]) -> list[str]:
    """Each added effect as ``effect @ target``."""
    pairs = zip(summary["effects"], summary.get("targets", []), strict=False)
    return [f"{effect} @ {target}" for effect, target in pairs]


def of_added(summary: Mapping[str, Any]) -> list[float]:
    """Probability of each added effect; empty where one of them was not compared."""
    every = of_effects(summary)
    found = [every.get(one) for one in added_names(summary)]
    return [p for p in found if p is not None] if None not in found else []


def with_probability(summary: Mapping[str, Any]) -> str:
    """``, with probability 0.97`` after the effects that were added."""
    found = [spoken(p) for p in of_added(summary)]
    word = "probability" if len(found) == 1 else "probabilities"
    return f", with {word} {listed(found)}" if found else ""


def next_best(summary: Mapping[str, Any]) -> str:
    """The most probable alternative to the added effects, as a sentence."""
    found, own = known(summary), set(added_names(summary))
    if found is None or not of_added(summary):
        return ""
    sums: dict[tuple[str, ...], float] = {}
    for one in found["list"]:
        key = tuple(one["effects"]) if one["effects"] else (OUTSIDE if one["outside"] else NOTHING,)
        if not own <= set(one["effects"]):
            sums[key] = sums.get(key, 0.0) + one["probability"]
    best = max(sums, key=lambda key: sums[key], default=None)
    if best is None or sums[best] < SHOWN:
        return ""
    return f" The next is {_listed(best, summary)}, {spoken(sums[best])}."


def _listed(names: Sequence[str], summary: Mapping[str, Any]) -> str:
    return listed([_called(one, summary) for one in names])


def _called(one: str, summary: Mapping[str, Any]) -> str:
    """An effect by its title; the words for nothing and for what is outside stay."""
    return one if one in (NOTHING, OUTSIDE) else called(one, summary.get("titles", {}))


def structure_words(one: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """The members of a structure."""
    every = of_effects(summary)
    effects = sorted(one["effects"], key=lambda member: -every.get(member, 0.0))
    names = [*effects, *([OUTSIDE] if one["outside"] else [])] or [NOTHING]
    return listed([_called(member, summary) for member in names])


def disagreement(summary: Mapping[str, Any]) -> str:
    """Where the most probable structure is not what the search added: a sentence that says so."""
    found = known(summary)
    if found is None or not found["list"] or not _ended(summary):
        return ""
    first = found["list"][0]
    curves = {one for one in added_names(summary) if one.startswith(FAMILY)}
    own = set(added_names(summary)) - curves
    if own == set(first["effects"]) and (bool(curves) or not first["outside"]):
        return ""
    if not own and not curves and summary["verdict"] == schema.UNEXPLAINED and _something(first):
        return ""  # the search found no cause either
    what = f"{structure_words(first, summary)} ({spoken(first['probability'])})"
    if not own and not curves:
        return f"The search added nothing, but the most probable structure is {what}."
    mine = [one for one in found["list"] if set(one["effects"]) == own]
    p = max((one["probability"] for one in mine), default=None)
    beside = "" if p is None else f" ({spoken(p)})"
    return (
        f"The search added {_listed(added_names(summary), summary)}{beside}, but the most probable"
        f" structure is {what}."
    )


def _something(structure: Mapping[str, Any]) -> bool:
    return bool(structure["effects"]) or bool(structure["outside"])


def _ended(summary: Mapping[str, Any]) -> bool:
    """Whether the search came to its end."""
    return not any(item["stage"] == "search" for item in summary.get(schema.UNFINISHED, []))


def classes(summary: Mapping[str, Any]) -> Iterator[str]:
    """What similar effects have together, as sentences."""
    found, single = known(summary), of_effects(summary)
    for one in [] if found is None else found["classes"]:
        shown = [member for member in one["effects"] if single.get(member, 0.0) >= SHOWN]
        if len(shown) < 2:
            continue
        names = listed([_called(member, summary) for member in shown], " or ")
        rest = len(one["effects"]) - len(shown)
        family = f" or another effect of the family {one['family']}" if one["family"] else ""
        more = f"{family}" if rest and family else " or a similar effect" if rest else ""
        p = spoken(one["probability"])
        yield f"{names[0].upper()}{names[1:]}{more}: together {p}."


def lead_of_unexplained(summary: Mapping[str, Any]) -> str:
    """Beginning of the headline where an error is left and nothing was added."""
    found, lead = known(summary), "Something is missing"
    if found is None:
        return lead
    if found["only_outside"] >= LIKELY:
        p = spoken(found["only_outside"])
        return f"{lead} that the catalogue does not have ({p})"
    best = next(iter(found["effects"]), None)
    if best is not None and best["probability"] >= LIKELY:
        p = spoken(best["probability"])
        return f"{lead}, probably {_called(name(best), summary)} ({p})"
    if found["nothing"] >= LIKELY:
        p = spoken(found["nothing"])
        return f"An error is left that is not noise, yet that nothing is missing has {p}"
    return lead


def outside_acts(summary: Mapping[str, Any]) -> str:
    """That something outside the catalogue acts, as a sentence, where it probably does."""
    found = known(summary)
    if found is None or found["outside"] < LIKELY:
        return ""
    p = spoken(found["outside"])
    return f" Something outside the catalogue acts, with probability {p}."


def lines(summary: Mapping[str, Any], most: int = 4) -> list[str]:
    """The leading probabilities for a terminal, and those of classes."""
    found = known(summary)
    if found is None:
        return []
    every = list(of_effects(summary).items())[:most]
    every += [(NOTHING, found["nothing"]), (OUTSIDE, found["outside"])]
    shown = [(one, p) for one, p in every if p >= SHOWN]
    shown = sorted(shown, key=lambda item: -item[1])
    texts = [f"{_called(one, summary)} {format_probability(p)}" for one, p in shown]
    return [f"Probabilities: {'; '.join(texts)}.", *classes(summary)]


def table(summary: Mapping[str, Any]) -> Table | None:
    """The most probable structures, with the sum of the others."""
    found = known(summary)
    if found is None:
        return None
    own, rows, marked = set(added_names(summary)), [], set()
    for number, one in enumerate(found["list"]):
        basis = "estimate" if one["estimated"] else "scores"
        rows.append([structure_words(one, summary), format_probability(one["probability"]), basis])
        if own and set(one["effects"]) == own and not one["outside"]:
            marked.add(number)
    rest = 1.0 - sum(one["probability"] for one in found["list"])
    if rest >= 0.5 * SHOWN:
        rows.append(["all others", format_probability(rest), ""])
    head = ["what is missing", "probability", "from"]
    return Table(head, rows, 1, frozenset(marked), LEAD)


def parameters(summary: Mapping[str, Any]) -> Table | None:
    """Parameters of the declared model: its estimate, the final one, and the average."""
    found = known(summary)
    if found is None or not found.get("parameters"):
        return None
    rows = []
    for parameter, one in found["parameters"].items():
        average = one["averaged"]
        scale = engineering(one["unit"], abs(average["mean"]))
        cells = [_with_sd(one[key], scale) for key in ("declared", "final", "averaged")]
        low, high = (
            format_number(scale.factor * end, scale.factor * average["sd"])
            for end in average["interval"]
        )
        rows.append([parameter, *cells, f"{low} … {high}", scale.unit])
    head = ["parameter", "declared model", "final model", "averaged", "90 % interval", "unit"]
    return Table(head, rows)


def _with_sd(estimate: Mapping[str, Any] | None, scale: Scale) -> str:
    if estimate is None:
        return "–"
    sd = scale.factor * estimate["sd"]
    return f"{format_number(scale.factor * estimate['mean'], sd)} ± {sd:.2g}"


def section(summary: Mapping[str, Any]) -> list[str]:
    """The sentences of the report's section."""
    found = known(summary)
    if found is None:
        return []
    prior = {key: format_probability(found["prior"][key]) for key in ("nothing", "catalogue")}
    outside = format_probability(found["prior"]["outside"])
    texts = [disagreement(summary)]
    if texts[0]:
        texts.append(
            "The search decides by estimates and by runs that were held out, the probabilities by"
            " the fitted runs and the prior."
        )
    texts += classes(summary)
    texts.append(
        "The probabilities follow from marginal likelihoods about each estimate and from the prior"
        f" that nothing is missing ({prior['nothing']}), that effects of the catalogue are"
        f" ({prior['catalogue']}), or only something outside of it ({outside})."
    )
    return [text for text in texts if text]


def structures_data(summary: Mapping[str, Any]) -> xr.Dataset:
    """Probabilities of effects and of the leading structures as labelled arrays.

    Parameters
    ----------
    summary : mapping
        As in ``summary.json``, with ``structures``.

    Returns
    -------
    xarray.Dataset
        ``probability(effect)`` with its effects named ``effect @ target``;
        ``structure_probability``, ``has_outside`` and ``estimated`` ``(structure)``; ``member``
        ``(structure, effect)``; ``nothing``, ``outside`` and ``only_outside``.
    """
    found, single = summary["structures"], of_effects(summary)
    shown = found["list"]
    member = [[one in entry["effects"] for one in single] for entry in shown]
    flat = {key: [entry[key] for entry in shown] for key in ("outside", "estimated", "probability")}
    return xr.Dataset(
        {
            "probability": (schema.EFFECT, list(single.values())),
            "member": (("structure", schema.EFFECT), np.reshape(member, (len(shown), len(single)))),
            "structure_probability": ("structure", flat["probability"]),
            "has_outside": ("structure", flat["outside"]),
            "estimated": ("structure", flat["estimated"]),
            **{key: found[key] for key in ("nothing", "outside", "only_outside")},
        },
        coords={
            schema.EFFECT: list(single),
            "structure": [structure_words(entry, summary) for entry in shown],
        },
    )


def structures_text(summary: Mapping[str, Any]) -> str:
    """The table of a session: single probabilities first, then structures, then classes."""
    found = summary["structures"]
    every = [*of_effects(summary).items(), (NOTHING, found["nothing"]), (OUTSIDE, found["outside"])]
    every = sorted(every, key=lambda item: -item[1])
    rows = [[_called(one, summary), format_probability(p)] for one, p in every if p >= SHOWN]
    shown = table(summary)
    texts = [columns(["acts", "probability"], rows)]
    texts += [] if shown is None else [columns(shown.head, shown.rows)]
    return "\n\n".join([*texts, *classes(summary)])
