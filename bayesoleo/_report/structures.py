"""What might be missing: probabilities of structures, and the runs that would tell rivals apart.

Sentences and tables are empty where a result has none.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from bayesoleo import _schema as schema
from bayesoleo._report.tables import Table, format_short
from bayesoleo.effects._catalogue import called, listed
from bayesoleo.effects._nonparametric import FAMILY
from bayesoleo.plots._discovery import SHOWN, format_probability, name
from bayesoleo.plots._style import Scale, engineering, format_number

#: More probable than not.
LIKELY = 0.5
#: Probability of something outside from which on no effect is named without it.
NEARLY_SURE = 0.95
NOTHING, OUTSIDE = "nothing missing", "something outside the catalogue"
#: Estimates beside which averages over structures stand.
COMPARED = ("declared", "final")
#: Instead of an interval that is withheld; standard deviations in an interval of 90 %.
NOT_STATED, _WIDTH = "not stated", 3.29
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


def of_set(summary: Mapping[str, Any]) -> float | None:
    """Probability that all added effects act together; None where one of them was not compared."""
    found, single = known(summary), of_added(summary)
    if found is None or not single:
        return None
    if len(single) == 1:
        return single[0]
    if found.get("together") is not None:
        return float(found["together"])
    own = set(added_names(summary))  # of a result that was stored without it
    return float(sum(one["probability"] for one in found["list"] if own <= set(one["effects"])))


def with_probability(summary: Mapping[str, Any]) -> str:
    """``, with probability 0.97`` after the effects that were added; of several also that of all
    together, which may be much smaller than each."""
    single, together = of_added(summary), of_set(summary)
    if not single or together is None:
        return ""
    found = [spoken(p) for p in single]
    if len(found) == 1:
        return f", with probability {found[0]}"
    every = "both" if len(found) == 2 else f"all {len(found)}"
    return f", with probabilities {listed(found)}, and {spoken(together)} for {every} together"


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
    only = "only " if best == (OUTSIDE,) else ""  # beside effects it has a probability of its own
    return f" The next is {only}{_listed(best, summary)}, {spoken(sums[best])}."


def _listed(names: Sequence[str], summary: Mapping[str, Any]) -> str:
    return listed([title_of(one, summary) for one in names])


def title_of(one: str, summary: Mapping[str, Any]) -> str:
    """An effect by its title; the words for nothing and for what is outside stay."""
    return one if one in (NOTHING, OUTSIDE) else called(one, summary.get("titles", {}))


def structure_words(one: Mapping[str, Any], summary: Mapping[str, Any]) -> str:
    """The members of a structure."""
    every = of_effects(summary)
    effects = sorted(one["effects"], key=lambda member: -every.get(member, 0.0))
    names = [*effects, *([OUTSIDE] if one["outside"] else [])] or [NOTHING]
    return listed([title_of(member, summary) for member in names])


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
        names = listed([title_of(member, summary) for member in shown], " or ")
        rest = len(one["effects"]) - len(shown)
        family = f" or another effect of the family {one['family']}" if one["family"] else ""
        more = f"{family}" if rest and family else " or a similar effect" if rest else ""
        p = spoken(one["probability"])
        yield f"{names[0].upper()}{names[1:]}{more}: together {p}."


def beside_outside(summary: Mapping[str, Any]) -> str:
    """What probabilities of effects mean where no set of them explains the data: a sentence.

    An effect may then stand for a part of the unknown law that the functions by which that is
    represented cannot make. A friction that is missing had been told as a stiffness.
    """
    found = known(summary)
    if found is None or found["outside"] < NEARLY_SURE:
        return ""
    best = max((one["probability"] for one in found["effects"]), default=0.0)
    if best < SHOWN:
        return ""
    return (
        f"Something outside the catalogue acts ({spoken(found['outside'])}). Probabilities of"
        " effects assume that its law resembles one of those that were compared. Read the effects"
        " as similar to what is missing, not as its causes."
    )


def lead_of_unexplained(summary: Mapping[str, Any]) -> str:
    """Beginning of the headline where an error is left and nothing was added."""
    found, lead = known(summary), "Something is missing"
    if summary.get("slow_noise"):
        return "Slow noise is left, or something is missing"
    if found is None:
        return lead
    if found["only_outside"] >= LIKELY:
        p = spoken(found["only_outside"])
        return f"{lead} that the catalogue does not have ({p})"
    best = next(iter(found["effects"]), None)
    if found["outside"] >= NEARLY_SURE:
        p = spoken(found["outside"])
        return f"{lead} that effects of the catalogue do not explain alone ({p})"
    if best is not None and best["probability"] >= LIKELY:
        p = spoken(best["probability"])
        return f"{lead}, probably {title_of(name(best), summary)} ({p})"
    if found["nothing"] >= LIKELY:
        p = spoken(found["nothing"])
        # The probabilities know the colour of what is left.
        return (
            "More is left than is expected, which may be coloured noise; nothing is missing with"
            f" probability {p}"
        )
    return lead


def outside_acts(summary: Mapping[str, Any], than: float | None = None) -> str:
    """That something outside the catalogue acts, as a sentence, where it probably does or is more
    probable than what the headline names.

    Parameters
    ----------
    summary : mapping
    than : float, optional
        Probability of what the headline names.
    """
    found = known(summary)
    if found is None:
        return ""
    p = spoken(found["outside"])
    if found["outside"] >= LIKELY:
        return f" Something outside the catalogue acts, with probability {p}."
    if than is not None and found["outside"] > max(than, SHOWN):
        return f" That something outside the catalogue acts is more probable: {p}."
    return ""


def outside_unsaid(summary: Mapping[str, Any], than: float | None = None) -> str:
    """The same sentence where nothing was added; empty where the headline names it already."""
    found = known(summary)
    leads = found is not None and (
        found["only_outside"] >= LIKELY or found["outside"] >= NEARLY_SURE
    )
    if summary["verdict"] == schema.UNEXPLAINED and leads:
        return ""
    alone = f"structure is {OUTSIDE} (" in disagreement(summary)
    return "" if alone else outside_acts(summary, than)


def lines(summary: Mapping[str, Any], most: int = 4) -> list[str]:
    """The leading probabilities for a terminal, and those of classes."""
    found = known(summary)
    if found is None:
        return []
    every = list(of_effects(summary).items())[:most]
    every += [(NOTHING, found["nothing"]), (OUTSIDE, found["outside"])]
    shown = [(one, p) for one, p in every if p >= SHOWN]
    shown = sorted(shown, key=lambda item: -item[1])
    texts = [f"{title_of(one, summary)} {format_probability(p)}" for one, p in shown]
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
        # A mean may lie outside the interval, where an improbable structure is far off, and may be
        # too large for a number.
        middle = average.get("median", average["mean"])
        numbers = [average["mean"], middle, *(one[k]["mean"] for k in COMPARED if one[k]), 0.0]
        spreads = [average["sd"], *(one[k]["sd"] for k in COMPARED if one[k])]
        # What is zero but for round-off has the size of its deviation.
        least = min((sd for sd in spreads if sd is not None), default=0.0)
        size = max(abs(next(value for value in numbers if value is not None)), least)
        scale = engineering(one["unit"], size)
        cells = [_with_sd(one[key], scale) for key in COMPARED]
        if average["interval"] is None:
            rows.append([parameter, *cells, "–", NOT_STATED, scale.unit])
            continue
        low, high = (scale.factor * end for end in average["interval"])
        sd = (high - low) / _WIDTH if average["sd"] is None else scale.factor * average["sd"]
        cells.append(format_number(scale.factor * middle, sd))
        low, high = (format_number(end, sd) for end in (low, high))
        rows.append([parameter, *cells, f"{low} … {high}", scale.unit])
    head = [
        "parameter",
        "declared model",
        "final model",
        "averaged (median)",
        "90 % interval",
        "unit",
    ]
    return Table(head, rows)


def withheld(summary: Mapping[str, Any]) -> str:
    """Why the averages of some parameters are not stated, as sentences; empty where all are."""
    found = known(summary) or {}
    reasons: dict[str, list[str]] = {}
    for parameter, one in (found.get("parameters") or {}).items():
        if reason := one["averaged"].get("reason"):
            reasons.setdefault(reason, []).append(parameter)
    return " ".join(f"{', '.join(names)}: {reason}" for reason, names in reasons.items())


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
    texts += [beside_outside(summary), *classes(summary)]
    texts.append(
        "The probabilities follow from marginal likelihoods about each estimate and from the prior"
        f" that nothing is missing ({prior['nothing']}), that effects of the catalogue are"
        f" ({prior['catalogue']}), or only something outside of it ({outside})."
    )
    return [text for text in texts if text]


#: Pairs of rivals that have a column of their own.
MOST_PAIRS = 3


def proposal_lines(
    entry: Mapping[str, Any], titles: Mapping[str, str] | None = None, objection: str = ""
) -> list[str]:
    """What one entry of the summary's ``proposals`` says, sentence by sentence.

    Parameters
    ----------
    entry : mapping
        As in ``summary.json``.
    titles : mapping of str to str, optional
        Titles of effects by id, besides those of the catalogue.
    objection : str
        What the hold-out runs say against the probabilities, as the end of a sentence.
    """
    entry = _with_titles(entry, titles or {})
    lines = [_question(entry, objection)]
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
    """The entry with rivals as they are called, without the effects that all of them have."""
    shared = set.intersection(*(set(one.split(" + ")) for one in entry["rivals"] or [""]))
    shared = shared if len(entry["rivals"]) > 1 else set()
    every = [e for e in (entry["rivals"] or [""])[0].split(" + ") if e in shared]

    def words(names: Sequence[str]) -> list[str]:
        own = [[e for e in one.split(" + ") if e not in shared] for one in names]
        titled = [[called(e, titles) for e in one] for one in own]
        # "A with B" reads well; of three or more it is not seen where one rival ends.
        return [(" with " if len(t) < 3 else " + ").join(t) or "nothing more" for t in titled]

    def run(found: Mapping[str, Any] | None) -> dict[str, Any] | None:
        if found is None:
            return None
        return {**found, "pairs": [{**p, "rivals": words(p["rivals"])} for p in found["pairs"]]}

    return {
        **entry,
        "shared": [called(e, titles) for e in every],
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
    head = ["run", *_place_head(entry), "information [bit]", *_told_head(entry)]
    shown = [(f"{number}", run) for number, run in enumerate(entry["runs"], start=1)]
    if entry["repeat"]:
        shown.append((f"{entry['repeat']['run']} once more", entry["repeat"]))
    rows = [
        [label, *_place(entry, run), f"{run['information']:.2f}", *_told(entry, run)]
        for label, run in shown
    ]
    return Table(head, rows, 1, frozenset({0}))


def _varies(entry: Mapping[str, Any]) -> bool:
    """Whether proposed runs vary measured ones."""
    return bool(entry["runs"][0].get("change"))


def _place_head(entry: Mapping[str, Any]) -> list[str]:
    """Heads of the columns that say which run it is."""
    if _varies(entry):
        return ["as run", "changed"]
    unit = _scale(entry).unit
    unit = f" [{unit}]" if unit else ""
    return ["frequency [Hz]", f"mean{unit}", f"amplitude{unit}"]


def _place(entry: Mapping[str, Any], run: Mapping[str, Any]) -> list[str]:
    if _varies(entry):
        return [run["like"], run["change"] or "nothing"]
    factor = _scale(entry).factor
    place = [factor * run[key] for key in ("mean", "amplitude")]
    return [format_short(value) for value in (run["frequency"], *place)]


def _told_head(entry: Mapping[str, Any]) -> list[str]:
    """Heads of the columns that say how far a run separates rivals, or which parameters it makes
    more precise."""
    pairs = entry["runs"][0]["pairs"]
    if not pairs:
        return [f"sd of {name} [%]" for name in _most_improved(entry)]
    by_pair = len(pairs) <= MOST_PAIRS
    named = [f"{' / '.join(pair['rivals'])} [σ]" for pair in pairs]
    return named if by_pair else ["least separated pair [σ]"]


def _told(entry: Mapping[str, Any], run: Mapping[str, Any]) -> list[str]:
    if not run["pairs"]:
        return [f"{100 * run['sd_ratio'][name]:.0f}" for name in _most_improved(entry)]
    by_pair = len(run["pairs"]) <= MOST_PAIRS
    values = [pair["sigma"] for pair in run["pairs"]] if by_pair else [run["sigma"]]
    return [format_sigma(value) for value in values]


def _most_improved(entry: Mapping[str, Any]) -> list[str]:
    """Parameters whose standard deviations the best run reduces most."""
    ratio = entry["runs"][0].get("sd_ratio", {})
    return sorted(ratio, key=lambda name: float(ratio[name]))[:MOST_PAIRS]


def format_sigma(value: float) -> str:
    """Standard deviations, to a tenth while that matters."""
    return f"{value:.1f}" if value < 99.95 else f"{value:.0f}"


def run_text(run: Mapping[str, Any], scale: Scale) -> str:
    """A run in words: ``at 2.00 Hz, mean 120 mm, amplitude 30.0 mm``."""
    if run.get("change"):
        return f"like {run['like']} with {run['change']}"
    mean, amplitude = (format_short(scale.factor * run[key]) for key in ("mean", "amplitude"))
    unit = f" {scale.unit}" if scale.unit else ""
    place = f"mean {mean}{unit}, amplitude {amplitude}{unit}"
    return f"at {format_short(run['frequency'])} Hz, {place}"


def _scale(entry: Mapping[str, Any]) -> Scale:
    sizes = [max(abs(run["mean"] or 0.0), run["amplitude"] or 0.0) for run in entry["runs"]]
    return engineering(entry["unit"], max(sizes, default=0.0))


def _question(entry: Mapping[str, Any], objection: str) -> str:
    names = listed(entry["rivals"])
    if entry["question"] == "parameters":
        what = entry.get("parameter") or "the parameters"
        return f"To know {what} more precisely:"
    if entry["question"] == "structures":
        pairs = zip(entry["rivals"], entry.get("probabilities") or [], strict=False)
        known = [f"{name} ({chance:.2f})" for name, chance in pairs]
        beside = f" beside {listed(entry['shared'])}" if entry["shared"] else ""
        among = _among(entry)
        listing = listed(known or entry["rivals"])
        return f"What is missing{beside}, by probability{among}: {listing}{objection}."
    if entry["question"] == "indistinguishable":
        first, *others = entry["rivals"]
        return f"These data cannot tell {first}, which was added, from {listed(others)}."
    if entry["question"] == "open":
        return f"Each of {names} might be what is missing."
    return f"To be told apart: {names}."


def _among(entry: Mapping[str, Any]) -> str:
    """That structures are not all that may be missing, and what they have together."""
    together = entry.get("probability")
    if entry["question"] != "structures" or (together or 0.0) > 1.0 - SHOWN:
        return ""
    if together is None:  # of results that were stored without it
        return " among these" if entry["note"] else ""
    return f" among these, which have {spoken(together)} together"


def _answer(entry: Mapping[str, Any]) -> list[str]:
    best, repeat, apart = entry["runs"][0], entry["repeat"], entry["inseparable"]
    if _all_alike(entry):
        return [
            "No run within the limits of the rig would separate them by one standard deviation:"
            " they are one law in other words, or differ beyond these limits or in other channels."
        ]
    gain = "is expected to tell"
    text = f"A run {run_text(best, _scale(entry))} {gain} {best['information']:.2f} bits"
    if best["pairs"]:
        among = " among these" if _among(entry) else ""
        text += f" of the {entry['entropy']:.2f} that are open{among}"
    else:
        name = _most_improved(entry)[0]
        text += f" and to leave {100 * best['sd_ratio'][name]:.0f} % of the standard deviation"
        text += f" of {name}"
    if repeat and repeat["information"] > best["information"]:
        text = f"{repeat['run']}, made once more, {gain} {repeat['information']:.2f} bits, more"
        text += f" than any new run: one {run_text(best, _scale(entry))} {gain}"
        text += f" {best['information']:.2f}"
    elif repeat and best["information"] - repeat["information"] < 0.01:
        text += f"; {repeat['run']}, made once more, as much"
    elif repeat:
        text += f"; no present run, made once more, more than {repeat['information']:.2f}"
    lines = [f"{text}."]
    for pair in apart:
        lines.append(
            f"No run within the limits of the rig separates {listed(pair, ' from ')} by one"
            " standard deviation."
        )
    return lines


def _all_alike(entry: Mapping[str, Any]) -> bool:
    """Whether no pair is separated by any run, so that there is nothing to choose."""
    pairs = len(entry["runs"][0]["pairs"])
    return pairs > 0 and len(entry["inseparable"]) == pairs
