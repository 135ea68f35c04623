"""Sentences of the report: the result, how certain it is, and what remains."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._report import structures
from bayesoleo._report.tables import (
    error_scale,
    format_ratio,
    format_short,
    ratio,
    ratios,
    too_large,
    too_small,
    words,
)
from bayesoleo.data import _frequency_response as response
from bayesoleo.discovery._inference import MORE, NO_MORE
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._work import ENDS
from bayesoleo.effects._catalogue import (
    PROPER,
    called,
    catalogue_titles,
    listed,
    titles_for,
    with_titles,
)
from bayesoleo.effects._nonparametric import FAMILY
from bayesoleo.errors import number_of
from bayesoleo.plots._discovery import chosen, format_p, format_probability, format_share, name
from bayesoleo.plots._style import Scale, format_value

#: Said of errors that two judgements put on either side of what chance allows.
_AT_THE_LIMIT = "the error in the fitted runs is at the limit of what chance allows"


def role_shown(summary: Mapping[str, Any]) -> str:
    """The runs that count: those held out, if there are any."""
    return schema.HOLD_OUT if summary["error_after"].get(schema.HOLD_OUT) else schema.FIT


def significance(added: Mapping[str, Any]) -> str:
    """The p-value of an effect that was added; empty where there is none.

    One that was added while others were missing may be significant only beside those that followed:
    its own p-value is then that beside what the model had before.
    """
    p = format_p(added["p_value"])
    if not p or added["p_value"] < SearchPolicy().significance:
        return p
    return f"{p} on the fitted runs, beside what the model had until then"


def headline(summary: Mapping[str, Any]) -> str:
    """The result as a sentence, which begins with how sure it is."""
    broken = any(item["stage"] == "search" for item in summary.get(schema.UNFINISHED, []))
    lead = "Unfinished, the search did not come to its end. " if broken else ""
    return f"{lead}{_said(summary)}{_ended_early(summary)}{_not_tried(summary)}"


def headline_parts(summary: Mapping[str, Any]) -> tuple[str, str]:
    """The headline as a title of what was found, and the rest of it as sentences."""
    text, names = headline(summary), added(summary)
    place = text.find(f" {names} w") if names else -1
    if place < 0:
        end = text.find(". ", text.find(":"))
        return (text, "") if end < 0 else (text[: end + 1], text[end + 2 :])
    verb = place + len(names) + 2
    ends = [
        text.find(word, verb) + len(word) for word in (" missing", " added") if word in text[verb:]
    ]
    first = min(ends)
    # One effect has its probability in the title; of several they are in the figure.
    likely = structures.with_probability(summary) if len(summary["effects"]) == 1 else ""
    if likely and text.startswith(likely, first):
        first += len(likely)
    rest = text[first:].lstrip(",;. ")
    subject = "It explains" if len(summary["effects"]) == 1 else "They explain"
    # A title of its own leaves its participle without a sentence.
    rest = re.sub("^explaining", subject, rest)
    return f"{text[:first]}.", begin(re.sub("^(and|but) ", "", rest))


def _ended_early(summary: Mapping[str, Any]) -> str:
    """A sentence on a quick search that went no further; empty of any other."""
    last = summary["rounds"][-1] if summary["rounds"] else {}
    if not str(last.get("reason", "")).startswith(ENDS):
        return ""
    return " The quick search ended there: without --quick (in Python quick=False) it goes on."


def _not_tried(summary: Mapping[str, Any]) -> str:
    """A sentence on effects of the catalogue that the search was not given; empty if none."""
    left_out = summary.get("effects_left_out", 0)
    if not left_out or not summary["effects"]:
        return ""
    return f" The search was not given {number_of(left_out, 'other effect')} of the catalogue."


def _said(summary: Mapping[str, Any]) -> str:
    sure, found = certainty(summary), added(summary)
    was = "was" if len(summary["effects"]) == 1 else "were"
    apart = structures.disagreement(summary)
    apart = f" {apart}" if apart else ""
    if sure is None:
        return f"{_nothing_added(summary)}{apart}"
    likely = structures.with_probability(summary)
    outside = structures.outside_acts(summary, structures.of_set(summary))
    down = f"the error is then down to {words(summary)}"
    if any(map(too_large, _errors_of(summary))):
        down = f"but {_size_left(summary)}"
    if sure == schema.CERTAIN:
        return f"Certain: {found} {was} missing{likely}; {down}.{structures.next_best(summary)}"
    if sure == schema.PROBABLE:
        lead = _probable(summary, f"{found} {was}")
        return f"{lead}{likely}; {down}.{outside}{_class(summary)}{apart}"
    if sure == schema.NO_CAUSE and summary["verdict"] == schema.EFFECT_ADDED:
        return f"No cause is named: {found} {was} added; {down}.{outside or _class(summary)}"
    lead = "No cause is named" if sure == schema.NO_CAUSE else "A likeness only"
    if named_in_part(summary):
        unnamed = "; but a curve without a name had to explain a part"
        return f"{lead}: {found} {was} added{likely}; {down}{unnamed}.{outside}{apart}"
    left = f"and {_size_left(summary)}{_unexplained(summary)}"
    if summary["verdict"] == schema.EFFECT_ADDED:
        left = f"explaining most of the excess, but {_size_left(summary)}{_unexplained(summary)}"
    return f"{lead}: {found} {was} added{likely}, {left}.{outside}{apart}"


def named_in_part(summary: Mapping[str, Any]) -> bool:
    """Whether effects with a name leave only noise together with a curve that has none."""
    pooled = [e for outputs in summary["error_after"].values() for e in outputs.values()]
    single = [e for runs in summary["rounds"][-1]["error"].values() for e in runs.values()]
    left = any(too_small(e) or too_large(e) or ratio(e) is None for e in (*pooled, *single))
    curve = any(one.startswith(FAMILY) for one in summary["effects"])
    return curve and not left and certainty(summary) == schema.LIKENESS


def _nothing_added(summary: Mapping[str, Any]) -> str:
    """The result where no effect was added."""
    found = structures.known(summary)
    if summary["verdict"] == schema.NOTHING_MISSING and not any(
        map(too_large, _errors_of(summary))
    ):
        explains = f"the model explains the measurements down to {words(summary)}"
        if found is None:
            return f"Nothing is missing: {explains}."
        p = structures.spoken(found["nothing"])
        if found["nothing"] >= structures.LIKELY:
            return f"Nothing is missing, with probability {p}: {explains}."
        text = f"Nothing was added: {explains}; but that nothing is missing has probability {p}."
        return text + structures.outside_unsaid(summary, found["nothing"])
    lead = "No verdict" if only_too_small(summary) else structures.lead_of_unexplained(summary)
    outside = "" if summary.get("slow_noise") else structures.outside_unsaid(summary)
    return f"{lead}: {_size_left(summary)}{_unexplained(summary)}.{outside}"


def _probable(summary: Mapping[str, Any], found: str) -> str:
    """Beginning of the headline for effects that explain everything but have alternatives."""
    of, every = structures.of_set(summary), structures.known(summary)
    if of is None or of >= structures.LIKELY:
        return f"Probable: {found} missing"
    # That each effect, or one like it, is probable does not make all of them probable together.
    together = [] if every is None else [one["probability"] for one in every["classes"]]
    if len(summary["effects"]) == 1 and together and min(together) >= structures.LIKELY:
        return f"Probable as one of a class: {found} added"
    return f"One explanation of several: {found} added"


def certainty(summary: Mapping[str, Any]) -> str | None:
    """How sure the names of the added effects are.

    Of results that were stored without an answer it follows from what they hold.
    """
    if not summary["effects"]:
        return None
    if "certainty" in summary:
        return str(summary["certainty"])
    if summary["verdict"] == schema.UNEXPLAINED:
        return schema.LIKENESS
    return schema.CERTAIN if summary.get("certain") else schema.PROBABLE


#: How a name that is not certain is called beside the verdict.
_WORDS = {schema.LIKENESS: "a likeness only", schema.NO_CAUSE: "no cause named"}


def badge(summary: Mapping[str, Any]) -> str:
    """The verdict with how sure it is: ``effect added · a likeness only``."""
    sure, found = certainty(summary), structures.known(summary)
    text = str(summary["verdict"])
    if sure is not None:
        return f"{text} · {_WORDS.get(sure, sure)}"
    if text == schema.NOTHING_MISSING and found is not None:
        return f"{text} · {format_probability(found['nothing'])}"
    return text


def titles(summary: Mapping[str, Any]) -> dict[str, str]:
    """Titles of effects by id, as far as the summary says them."""
    return dict(summary.get("titles", {}))


def added(summary: Mapping[str, Any]) -> str:
    """What was added, by title, each with its place where that is known."""
    effects = list(summary["effects"])
    places = list(summary.get("targets", [])) or [""] * len(effects)
    names = [
        f"{one} @ {place}" if place else one for one, place in zip(effects, places, strict=True)
    ]
    return listed([called(name, titles(summary)) for name in names])


def _class(summary: Mapping[str, Any]) -> str:
    """What these data cannot tell from what was added."""
    texts = []
    for one in accepted(summary):
        alike = [called(other, titles(summary)) for other in one["indistinguishable_from"]]
        if alike:
            own = "it" if len(summary["effects"]) == 1 else called(name(one), titles(summary))
            texts.append(f"{own} from {listed(alike, ' or ')}")
    if texts:
        return f" These data cannot tell {'; '.join(texts)}."
    if certainty(summary) == schema.NO_CAUSE or len(summary["effects"]) > 1:
        return ""
    return " Nothing else that was tried explains as much, but something that was not may."


def accepted(summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The candidates that were added and stayed, in order."""
    found = (chosen(entry) for entry in summary["rounds"])
    return [one for one in found if one is not None and one["effect"] in summary["effects"]]


def _size_left(summary: Mapping[str, Any]) -> str:
    """How large the error is that remains: of an output over all runs of a role, or in one run
    where that alone is too large; else which runs have no prediction."""
    pooled = {
        f"{output} on the {role} runs": errors
        for role, outputs in summary["error_after"].items()
        for output, errors in outputs.items()
    }
    single = {
        f"{output} in {in_run(run)}": errors
        for output, runs in summary["rounds"][-1]["error"].items()
        for run, errors in runs.items()
    }
    if only_too_small(summary):
        where = min(
            (one for one in pooled if too_small(pooled[one])),
            key=lambda one: ratio(pooled[one]) or 0.0,
        )
        times = f"{format_ratio(ratio(pooled[where]))} times {words(summary)}"
        return f"the error of {where} is {times}, less than chance allows: its noise is overstated"
    large = [{w: e for w, e in found.items() if too_large(e)} for found in (pooled, single)]
    unknown = [where for where, errors in single.items() if ratio(errors) is None]
    known = {where: errors for where, errors in single.items() if ratio(errors) is not None}
    if known and unknown and not any(large):
        return f"there is no prediction of {listed(unknown)}"
    for found in (*large, known):
        where = max(found, key=lambda one: ratio(found[one]) or 0.0, default="")
        if where:
            times = f"{format_ratio(ratio(found[where]))} times {words(summary)}"
            return f"the error of {where} is {times}"
    return "an error is left"


def only_too_small(summary: Mapping[str, Any]) -> bool:
    """Whether no error is too large, but one is smaller than chance allows."""
    pooled = [e for outputs in summary["error_after"].values() for e in outputs.values()]
    single = [e for runs in summary["rounds"][-1]["error"].values() for e in runs.values()]
    return any(map(too_small, pooled)) and not any(map(too_large, (*pooled, *single)))


def hold_out_objects(summary: Mapping[str, Any]) -> str:
    """That the hold-out runs leave more error than chance allows, as the end of a sentence; empty
    where they do not.

    Probabilities of structures follow from the fitted runs alone.
    """
    single = summary["rounds"][-1].get("error", {})
    after = summary["error_after"].get(schema.HOLD_OUT, {})
    pooled = {f"{output} there": errors for output, errors in after.items()}
    of_runs = {
        f"{output} in {in_run(run)}": errors
        for output, runs in single.items()
        for run, errors in runs.items()
        if errors.get("role") == schema.HOLD_OUT
    }
    for errors in (pooled, of_runs):
        large = {where: ratio(one) or 0.0 for where, one in errors.items() if too_large(one)}
        if large:
            where = max(large, key=lambda one: large[one])
            times = f"{format_ratio(large[where])} times {words(summary)}"
            return (
                "; yet the hold-out runs say that more is missing: the final model's error of"
                f" {where} is {times}"
            )
    return ""


def unfinished(summary: Mapping[str, Any]) -> list[str]:
    """Which stages did not finish, and why."""
    return [
        f"Unfinished stage: {item['stage']}. {begin(item['reason']).rstrip('.')}."
        for item in summary.get(schema.UNFINISHED, [])
    ]


def _unexplained(summary: Mapping[str, Any]) -> str:
    """What the catalogue has to say to an error that remains, as the end of a sentence."""
    if only_too_small(summary):
        return ""
    last = summary["rounds"][-1]
    policy = SearchPolicy(**summary.get("policy", {}))
    open_ = [
        c
        for c in last["candidates"]
        if c["p_value"] is not None
        and c["p_value"] < policy.significance
        and c["gain"] >= policy.least_share
    ]
    if not last["candidates"]:
        return ""
    if not open_:
        return "; no effect in the catalogue explains it"
    best = max(open_, key=lambda candidate: candidate["gain"])
    nearest = called(name(best), titles(summary))
    if any(c.get("estimated") for c in last["candidates"]):
        return f"; no further effect was confirmed, the nearest is {nearest}"
    share = f"{100 * best['gain']:.0f} %"
    earlier = any(
        (c["effect"], c["target"]) == (best["effect"], best["target"]) and c.get("estimated")
        for one in summary["rounds"]
        for c in one["candidates"]
    )
    tried = "was tried in an earlier round" if earlier else "was not tried"
    return f"; {nearest} would explain {share} of the excess, and {tried}"


def tiles(
    summary: Mapping[str, Any], units: Mapping[str, str], averaged: str = "repeating"
) -> list[dict[str, str]]:
    """For each output the numbers that matter: the error on the runs not used, before and after."""
    role = role_shown(summary)
    two = len(summary["rounds"]) > 1
    shown = []
    for output, last in summary["error_after"].get(role, {}).items():
        first = summary["error_before"].get(role, {}).get(output, last)
        key = "rms" if last["repeating"] is None else "repeating"
        scale = error_scale(units.get(output, ""), (first, last))
        known = ratio(last) is not None
        shown.append(
            {
                "title": f"{output}, {role} runs",
                "before": _number(first[key], scale) if two else "",
                "after": _number(last[key], scale),
                "unit": scale.unit,
                "what": f"{averaged} error" if key == "repeating" else "rms error",
                "ratio": f"{ratios(first, last, two)} × {words(summary)}" if known else "",
                "change": _change(first[key], last[key]) if two else "",
            }
        )
    return shown


#: Labels of runs that are named in a sentence; of more the number is enough.
MOST_LABELS = 6


def runs_used(summary: Mapping[str, Any]) -> str:
    """On which runs the model was fitted, and on which it was tried."""
    roles = {
        run: str(error["role"])
        for runs in summary["rounds"][0]["error"].values()
        for run, error in runs.items()
    }
    fitted, held = (
        [run for run, own in roles.items() if own == role] for role in (schema.FIT, schema.HOLD_OUT)
    )
    text = f"Fitted on {_runs(fitted)}" if fitted else "Fitted on no run"
    if held:
        return (
            f"{text}; tested on {_runs(held)} that {'was' if len(held) == 1 else 'were'} not used."
        )
    return f"{text}; no run was held out to test it."


def _runs(labels: list[str]) -> str:
    number = number_of(len(labels), "run")
    return f"{number} ({', '.join(labels)})" if len(labels) <= MOST_LABELS else number


def error_model(attributes: Mapping[Any, Any], summary: Mapping[str, Any]) -> str:
    """Which error model the intervals assume, and why; empty where nothing was sampled.

    Parameters
    ----------
    attributes : mapping
        Of the group of the posterior.
    summary : mapping
        As in ``summary.json``; its titles are used.
    """
    why = _agreeing(str(attributes.get(schema.ERROR_MODEL_REASON, "")), summary)
    if why:
        return f"{begin(with_titles(why, catalogue_titles() | titles(summary)))}."
    word = str(attributes.get("error_model", ""))
    return f"The intervals assume {word} errors." if word else ""


def _agreeing(why: str, summary: Mapping[str, Any]) -> str:
    """The reason for an error model, where the errors of the search are judged alike.

    They are judged together with the hold-out runs, so that one at the limit of chance may be
    within it for one of the two and beyond it for the other.
    """
    large = any(map(too_large, _errors_of(summary, schema.FIT)))
    if NO_MORE in why:
        return why.replace(NO_MORE, _AT_THE_LIMIT) if large else why
    return why if large else why.replace(MORE, _AT_THE_LIMIT)


def _errors_of(summary: Mapping[str, Any], role: str | None = None) -> list[Mapping[str, Any]]:
    """Errors of the final model, of each output over all runs of a role and in each run."""
    pooled = [
        errors
        for one, outputs in summary["error_after"].items()
        for errors in outputs.values()
        if role in (None, one)
    ]
    single = [
        errors
        for runs in summary["rounds"][-1].get("error", {}).values()
        for errors in runs.values()
        if role in (None, errors.get("role", role))
    ]
    return [*pooled, *single]


def reason(entry: Mapping[str, Any], known: Mapping[str, str] | None = None) -> str:
    """Why a round ended as it did, as a sentence.

    Parameters
    ----------
    entry : mapping
        A round of the summary.
    known : mapping of str to str, optional
        Titles of effects by id, for results that were stored with ids.
    """
    text = entry["reason"].strip().rstrip(".")
    ids = [str(c["effect"]) for c in entry["candidates"]]
    text = with_titles(text, titles_for(ids, known or {}))
    return f"{text[0].upper()}{text[1:]}." if text else ""


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
    went = (
        f" Solutions changed branch or stability {number_of(jumps, 'time')} on the way."
        if jumps
        else ""
    )
    return f"{text}; {end}.{went}"


def remainder(summary: Mapping[str, Any]) -> list[str]:
    """What is still unexplained, sentence by sentence."""
    last = summary["rounds"][-1]
    lines = [_above_floor(output, runs, words(summary)) for output, runs in last["error"].items()]
    if last["candidates"]:
        best = max(last["candidates"], key=lambda candidate: candidate["gain"])
        p = format_p(best["p_value"])
        which = called(name(best), titles(summary))
        share = format_share(best["gain"])
        text = f"The best remaining candidate, {which}, would explain {share} of the excess"
        lines.append(f"{text} ({p})." if p else f"{text}.")
    if last["reason"]:
        lines.append(f"The search ended: {_small(reason(last, titles(summary)))}")
    return [line for line in lines if line]


def in_run(label: str) -> str:
    """A run in a sentence: ``run 3``, and not ``run run 3``."""
    return label if label.lower().startswith("run") else f"run {label}"


def begin(text: str) -> str:
    """Text as the beginning of a sentence."""
    return text[:1].upper() + text[1:]


def _small(sentence: str) -> str:
    """A sentence after a colon: with a small first letter, but for names."""
    return sentence if sentence.split()[0] in PROPER else sentence[0].lower() + sentence[1:]


def _above_floor(output: str, runs: Mapping[str, Any], than: str) -> str:
    """In how many runs the error of an output is larger than chance allows, and the worst."""
    known = {run: ratio(e) or 0.0 for run, e in runs.items() if ratio(e) is not None}
    if not known:
        return f"The noise of {output} is not known in any run: only the rms of the residual is."
    worst = max(known, key=lambda run: known[run])
    above = sum(too_large(runs[run]) for run in known)
    lead = "No run" if above == 0 else f"{above} of {number_of(len(known), 'run')}"
    verb = "has" if above <= 1 else "have"
    largest = f"the largest is {format_ratio(known[worst])} times {than}, in {worst}"
    return f"{lead} {verb} an error of {output} beyond what chance allows; {largest}."


def _number(value: float | None, scale: Scale) -> str:
    return format_short(None if value is None else scale.factor * value)


def _change(before: float | None, after: float | None) -> str:
    """How much the error fell or rose."""
    if not before or after is None:
        return ""
    change = 100 * (after / before - 1)
    # Nearly all of it is not all of it.
    change = max(change, -99.9) if after else change
    return f"{change:+.{1 if -100 < change < -99 else 0}f} %".replace("-", "−")


#: Amplitude of an input at detection lines, as a part of that at excited lines, that is told.
_INPUT_SHARE = 1e-3


def response_entries(data: xr.Dataset) -> list[dict[str, Any]]:
    """What multisine runs show before any model, by level and output, as plain values.

    Parameters
    ----------
    data : Dataset
        Of :func:`bayesoleo.data.frequency_response`, or as a result holds it.

    Returns
    -------
    list of dict
        As in ``summary.json``; SI, None where nothing is known.
    """
    found = []
    for place in range(data.sizes[response.LEVEL]):
        level = data.isel({response.LEVEL: place})
        lines = level[schema.FREQUENCY].values[level[response.KIND].values == response.EXCITED]
        shared = {
            "drive": data.attrs["drive"],
            "drive_unit": str(level["input_rms"].attrs[schema.UNITS]),
            "runs": json.loads(str(level[schema.RUNS].values)),
            "realisations": int(level["realisations"]),
            "periods": int(level[schema.PERIODS]),
            "input_rms": float(level["input_rms"]),
            "input_share": _known(level["input_share"]),
            "lines": int(lines.size),
            "band": [float(lines[0]), float(lines[-1])],
        }
        for output in data[schema.OUTPUT].values:
            one = level.sel({schema.OUTPUT: output})
            kinds = {
                str(kind): _sizes(one.sel({response.PARITY: kind}), "distortion")
                for kind in one[response.PARITY].values
            }
            found.append(
                {
                    **shared,
                    "output": str(output),
                    "distortion": {kind: sizes for kind, sizes in kinds.items() if sizes},
                    "stochastic": _sizes(one, "stochastic"),
                }
            )
    return found


def _sizes(one: xr.Dataset, name: str) -> dict[str, float | None] | None:
    """Rms of a distortion, of its noise, and probability; None where there are no such lines."""
    rms, noise, p = (_known(one[key]) for key in (name, f"{name}_noise", f"{name}_p"))
    return None if rms is None else {"rms": rms, "noise": noise, "p_value": p}


def _known(value: xr.DataArray) -> float | None:
    return float(value) if np.isfinite(float(value)) else None


def response_sentence(entry: Mapping[str, Any]) -> str:
    """What one level of multisine runs shows of one output.

    Parameters
    ----------
    entry : mapping
        Of :func:`response_entries`.
    """
    size = format_value(entry["input_rms"], entry["drive_unit"])
    low, high = (f"{one:.3g}" for one in entry["band"])
    many = number_of(entry["realisations"], "realisation")
    lines = number_of(entry["lines"], "excited line")
    shown = [
        f"{kind} distortion {_times_noise(sizes)}" for kind, sizes in entry["distortion"].items()
    ]
    if entry["stochastic"]:
        shown.append(f"scatter between realisations {_times_noise(entry['stochastic'])}")
    else:
        shown.append("one realisation, so that stochastic distortion is not known")
    share = entry["input_share"]
    if share is not None and share >= _INPUT_SHARE:
        shown.append(f"the input has {100 * share:.2g} % of its amplitude at unexcited lines too")
    return (
        f"from {entry['drive']} to {entry['output']} at {size} rms ({many}, "
        f"{lines} from {low} to {high} Hz): {'; '.join(shown)}"
    )


def _times_noise(sizes: Mapping[str, float | None]) -> str:
    if not sizes["noise"] or sizes["rms"] is None:
        return "without a noise to compare it with"
    ratio, p = sizes["rms"] / sizes["noise"], format_p(sizes["p_value"])
    return f"{ratio:.3g} times the noise" + (f" ({p})" if p else "")
