"""Summary of a closed loop: the plain dicts of ``summary.json``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo.discovery._curves import CurveFacts
from bayesoleo.discovery._fit_and_hold_out_error import limit, lowest
from bayesoleo.discovery._loop import ON_LIMIT, ClosedLoop
from bayesoleo.discovery._ranking import Ranked
from bayesoleo.discovery._round import Round
from bayesoleo.discovery._score_basis import squared_distance
from bayesoleo.discovery._score_tests import Score
from bayesoleo.discovery._slow_noise import slow_noise, slow_noise_text
from bayesoleo.discovery._state import State
from bayesoleo.discovery._structures import Structure, StructurePosterior, total_probability
from bayesoleo.effects._catalogue import titles_for, with_titles
from bayesoleo.effects._nonparametric import FAMILY
from bayesoleo.errors import number_of
from bayesoleo.estimation._baselines import common_baselines, notes_on
from bayesoleo.posterior._diagnostics import Samples

#: Structures are listed until their probabilities add up to the first, at most so many; a class is
#: listed where so many of its effects have the last at least.
LISTED, MOST_LISTED, OF_A_CLASS, VISIBLE = 0.99, 20, 2, 0.01
#: Standard deviations on either side of an estimate that hold 95 %.
_BOUND = 1.96
#: Part of the draws that may be of another answer of the model before that is said. A part changes
#: the probability beyond an end of a 95 % interval by itself at most: 2.5 % to 1.5 or 3.5 %.
MIXED = 0.01
#: Draws for each of several parameters whose region is asked for.
MANY = 10
#: Gain of an input's sensor beyond which hardly anything of what it shows acts.
IDLE = 8.0


def summarise(
    loop: ClosedLoop,
    samples: Samples | None,
    about: Mapping[str, Any],
    facts: CurveFacts | None = None,
) -> dict[str, Any]:
    """Describe a closed loop in the terms of the summary's JSON Schema.

    Parameters
    ----------
    loop : ClosedLoop
    samples : Samples or None
        Posterior of the final model; without it the parameters have no mean and no interval.
    about : mapping
        ``campaign``, ``model``, ``drive``, ``seed`` and other keys for the top level.
    facts : CurveFacts, optional
        Of the final model's curves; found out if they are not given.

    Returns
    -------
    dict
        Checked against the schema.
    """
    final, stability, titles = loop.final, loop.final.stability, titles_of(loop)
    facts = CurveFacts.of(final) if facts is None else facts
    parameters = _parameters(final, samples, facts.shared)
    slow = slow_noise(final)
    summary = {
        **about,
        "rounds": [_round(item, titles) for item in loop.rounds],
        "effects": list(loop.effects),
        "targets": list(loop.targets),
        "parameters": parameters,
        "error_before": _by_role(loop.first),
        "error_after": _by_role(final),
        "verdict": loop.verdict,
        "certain": loop.certain,
        "certainty": loop.certainty,
        "structures": structures_entry(loop, titles),
        "titles": titles,
        "policy": loop.policy.changed(),
        "hold_out": loop.roles.description,
        "re_estimated": max((p.re_estimated for p in final.held_out), default=0),
        "units": {name: final.fit.model.outputs[name].unit for name in final.fit.predictor.outputs},
        "stability": {} if stability is None else stability.as_plain(),
        "branch_jumps": {
            "estimate": 0 if stability is None else stability.branch_jumps,
            "posterior": None if samples is None else samples.branch_jumps,
        },
        "notes": [
            *(
                in_words(note, titles)
                for note in (*loop.notes, *_may_be_absent(final, parameters, samples))
            ),
            *facts.notes,
            *([] if stability is None else stability.notes()),
            *final.fit.point.doubts,
            *notes_on(
                common_baselines(
                    final.fit.problem, final.fit.point.theta, final.fit.point.covariance
                )
            ),
            *_input_noise_notes(final),
            *_idle_inputs(final),
            *([slow_noise_text(slow)] if slow else []),
            *_sampler_notes(samples),
        ],
        "slow_noise": slow,
    }
    clean = _finite(summary)
    schema.validate_summary(clean)
    return cast(dict[str, Any], clean)


def structures_entry(loop: ClosedLoop, titles: Mapping[str, str]) -> dict[str, Any] | None:
    """The probabilities of structures as plain values; None where there are none.

    Parameters
    ----------
    loop : ClosedLoop
    titles : mapping of str to str
        Title of each effect.
    """
    found = loop.structures
    if found is None:
        return None
    prior, shown, total = found.prior, list[Structure](), 0.0
    for one in found.structures[:MOST_LISTED]:
        shown.append(one)
        total += one.probability
        if total >= LISTED:
            break
    whole = prior.nothing + prior.catalogue + prior.outside
    return {
        "prior": {
            "nothing": prior.nothing / whole,
            "catalogue": prior.catalogue / whole,
            "outside": prior.outside / whole,
            "numbers": [number / sum(prior.numbers) for number in prior.numbers],
            "families": dict(prior.families),
            "effects": dict(prior.effects),
        },
        "nothing": found.nothing,
        "outside": found.outside,
        "only_outside": found.only_outside,
        "together": _together(loop, found),
        "effects": [
            {"effect": e, "target": t, "title": titles.get(e, e), "probability": probability}
            for (e, t), probability in found.effects.items()
        ],
        "classes": _classes(loop, found),
        "list": [
            {
                "effects": [f"{effect} @ {target}" for effect, target in one.effects],
                "outside": one.outside,
                "probability": one.probability,
                "estimated": one.estimated,
            }
            for one in shown
        ],
        "parameters": _averages(loop, found),
    }


def _together(loop: ClosedLoop, found: StructurePosterior) -> float | None:
    """Probability that all added effects act; None without any, or where one was not compared."""
    own = set(loop.added)
    if not own or not own <= found.effects.keys():
        return None
    return total_probability(one for one in found.structures if own <= set(one.effects))


def _averages(loop: ClosedLoop, found: StructurePosterior) -> dict[str, Any]:
    """Parameters of the declared model: its estimate, that of the final model, and the average over
    structures, SI; the final model may have a parameter by run instead."""
    if not found.parameters:
        return {}
    states = {"declared": loop.rounds[0].before if loop.rounds else loop.final, "final": loop.final}
    entries: dict[str, Any] = {}
    for name, one in found.parameters.items():
        entries[name] = {"unit": loop.final.assembly.model().parameters[name.split("[")[0]].unit}
        for key, state in states.items():
            sd = state.sd_of(name)
            entries[name][key] = None if sd is None else {"mean": state.fit.values[name], "sd": sd}
        entries[name]["averaged"] = {
            "mean": one.mean,
            "sd": one.sd,
            "interval": None if one.reason else [one.low, one.high],
            "median": one.median,
            **({"reason": one.reason} if one.reason else {}),
        }
    return entries


def _classes(loop: ClosedLoop, found: StructurePosterior) -> list[dict[str, Any]]:
    """Classes of similar effects with the probability that at least one of each acts.

    The class of an added effect holds those that the data cannot distinguish from it, or else its
    family. Where none was added, the family of the most probable effect is given.
    """
    same = {(one.effect, one.target): one.same for r in loop.rounds if (one := r.accepted)}
    family = {s.option.key: s.option.candidate.family for s in _scores(loop)}
    classes = []
    for key in loop.added or tuple(found.effects)[:1]:
        alike = same.get(key, ())
        # An id without a place stands for the effect at each of its places.
        members = [k for k in found.effects if k == key or {k[0], f"{k[0]} @ {k[1]}"} & {*alike}]
        if not alike:
            members = [k for k in found.effects if family.get(k) == family.get(key, "")]
        if sum(found.effects[k] >= VISIBLE for k in members) < OF_A_CLASS:
            continue
        acts = total_probability(s for s in found.structures if set(s.effects) & set(members))
        entry = {
            "effects": [f"{effect} @ {target}" for effect, target in members],
            "family": None if alike else family.get(key),
            "probability": acts,
        }
        if entry not in classes:
            classes.append(entry)
    return classes


def _scores(loop: ClosedLoop) -> list[Score]:
    """The scores of the first round, about which structures are compared."""
    return [item.score for item in loop.rounds[0].ranking] if loop.rounds else []


def titles_of(loop: ClosedLoop) -> dict[str, str]:
    """Title of every effect that a loop names, by id."""
    ranked = [item for entry in loop.rounds for item in entry.ranking]
    steps = [item.score.option.assembly.steps[-1] for item in ranked]
    own = {step.effect.id: step.effect.title for step in (*steps, *loop.final.assembly.steps)}
    alike = (name for item in ranked for name in (*item.same, *(n for n, _ in item.closest)))
    return titles_for([*own, *alike], own)


def in_words(text: str, titles: Mapping[str, str]) -> str:
    """A sentence about effects with their titles in place of their ids.

    A note on parameters stays as it is: an effect's parameter may be called like the effect.
    """
    return text if text.startswith(ON_LIMIT) else with_titles(text, titles)


def _round(item: Round, titles: Mapping[str, str]) -> dict[str, Any]:
    return {
        "error": _by_run(item.before),
        "candidates": [_candidate(ranked) for ranked in item.ranking],
        "accepted": item.accepted.effect if item.accepted else None,
        "accepted_target": item.accepted.target if item.accepted else None,
        "reason": in_words(item.reason, titles),
        "failed": {label: in_words(reason, titles) for label, reason in item.failed.items()},
    }


def _by_run(state: State) -> dict[str, dict[str, dict[str, Any]]]:
    """Errors of single runs, each with the ratio that chance hardly exceeds."""
    table = state.errors.by_run()
    for own in (state.fit_errors, state.hold_errors):
        for entry in own.entries:
            if any(entry is shown for shown in state.errors.entries):
                table[entry.output][entry.run]["limit"] = limit(
                    [entry], len(own.entries), policy=state.policy
                )
    return table


def _by_role(state: State) -> dict[str, dict[str, dict[str, Any]]]:
    """Pooled errors, each with the ratios that chance hardly exceeds or falls below."""
    found: dict[str, dict[str, dict[str, Any]]] = dict(state.by_role)
    policy = state.policy
    for table in (state.fit_errors, state.hold_errors):
        for role in {entry.role for entry in table.entries}:
            for output in table.outputs:
                chosen = [e for e in table.entries if (e.role, e.output) == (role, output)]
                least = min(lowest(chosen, policy=policy), policy.least_ratio)
                most = limit(chosen, policy=policy)
                found[role][output] |= {"limit": most, "lowest": least}
    return found


def _candidate(ranked: Ranked) -> dict[str, Any]:
    score, candidate = ranked.score, ranked.score.option.candidate
    expected = dict(zip(score.names, map(float, score.expected), strict=True))
    expected |= {name: float(value) for name, value in score.shapes.items()}
    declared = score.option.model.parameters
    near = [{"effect": effect, "cosine": cosine} for effect, cosine in ranked.closest]
    return {
        "effect": candidate.effect,
        "title": score.option.assembly.steps[-1].effect.title,
        "target": candidate.target,
        "family": candidate.family,
        "gain": ranked.gain,
        "p_value": ranked.p_value,
        "expected": expected,
        "expected_units": {name: declared[name.split("[")[0]].unit for name in expected},
        "estimated": ranked.refitted,
        "indistinguishable_from": list(ranked.same),
    } | ({"closest": near} if near else {})


def _parameters(
    state: State, samples: Samples | None, shared: Mapping[str, str]
) -> dict[str, dict[str, Any]]:
    fit, table = state.fit, {}
    for k, name in enumerate(fit.problem.names):
        owner = fit.predictor.layout.parameters[fit.predictor.layout.names.index(name)]
        declared, prior = fit.model.parameters[owner], fit.problem.priors[k]
        known = {"value": float(prior.mean), "sd": float(prior.sd)}
        entry: dict[str, Any] = {
            "estimate": float(fit.point.theta[k]),
            "mean": None,
            "sd": float(fit.point.sd[k]),
            "interval": None,
            "unit": declared.unit,
            "tolerance": known if declared.toleranced else None,
        }
        if samples is not None:
            draws = samples.draws[:, :, samples.names.index(name)]
            low, high = np.quantile(draws, [0.025, 0.975])
            entry |= {
                "mean": float(draws.mean()),
                "sd": float(draws.std()),
                "interval": [float(low), float(high)],
            }
        if name in shared:  # what is shown for certain would be the convention's, not the data's
            entry |= {"sd": None, "interval": None, "shared_with": shared[name]}
        table[name] = entry
    return table


def _may_be_absent(
    state: State, parameters: Mapping[str, Mapping[str, Any]], samples: Samples | None = None
) -> list[str]:
    """Say which added effects have amplitudes that zero is as likely for, beside the others.

    What a round says of an effect is said of its estimate at that time. Amplitudes of one effect
    are judged together: what varies from run to run may be known to a thousandth of what all runs
    have in common, which a parameter of the model can take up.
    """
    notes = []
    for step in state.assembly.steps:
        own = [name for name in parameters if name.split("[")[0] in step.amplitudes]
        if not own or step.effect.family == FAMILY:
            continue
        if not all(_includes_zero(parameters[name]) for name in own):
            continue
        if len(own) == 1:
            what = "interval of its amplitude"
        elif _are_zero_together(state, own, samples):
            what = "region of its amplitudes"
        else:
            continue
        notes.append(
            f"{step.effect.id} at {step.target} may be absent: beside the other effects the"
            f" 95 % {what} includes zero; the share that its round states is that of the"
            f" estimate then"
        )
    return notes


def _are_zero_together(state: State, names: Sequence[str], samples: Samples | None) -> bool:
    """Whether the 95 % region of several parameters, as of a normal density, includes zero."""
    if samples is None:
        place = [state.fit.problem.names.index(name) for name in names]
        mean = state.fit.point.theta[place]
        covariance = state.fit.point.covariance[np.ix_(place, place)]
    else:
        draws = samples.draws[:, :, [samples.names.index(name) for name in names]]
        rows = draws.reshape(-1, len(names))
        if len(rows) < MANY * len(names):
            return False  # their covariance is not known
        mean, covariance = rows.mean(axis=0), np.cov(rows, rowvar=False)
    if not (np.isfinite(mean).all() and np.isfinite(covariance).all()):
        return False
    return bool(squared_distance(mean, covariance) <= distributions.chi2.isf(0.05, len(names)))


def _includes_zero(parameter: Mapping[str, Any]) -> bool:
    """Whether a parameter's 95 % interval includes zero; without draws, that of its estimate."""
    interval, sd = parameter["interval"], parameter["sd"]
    if interval is None and sd is None:
        return False
    low, high = interval or (parameter["estimate"] + k * _BOUND * sd for k in (-1, 1))
    return bool(low <= 0.0 <= high)


def _input_noise_notes(state: State) -> list[str]:
    """Say where the noise of the input, sent through the model, is the larger part of the noise
    floor."""
    notes = []
    for output in state.errors.outputs:
        entries = [
            e
            for e in state.errors.entries
            if e.output == output and e.input_noise > e.average.noise
        ]
        if entries:
            worst = max(entries, key=lambda e: e.input_noise / e.average.noise)
            times = worst.input_noise / worst.average.noise
            notes.append(
                f"input noise dominates the noise of {output} in"
                f" {number_of(len(entries), 'run')}: in run {worst.run} it is {times:.1f} times the"
                " output's own"
            )
    return notes


def _idle_inputs(state: State) -> list[str]:
    """Say where a gain that an input was given leaves next to nothing of it."""
    model, values = state.fit.model, state.fit.values
    notes = []
    for step in state.assembly.steps:
        if step.effect.id != "sensor_gain" or step.target not in model.inputs:
            continue
        gain = 1.0 + values.get(step.amplitudes[0], 0.0)
        if abs(gain) > IDLE:
            notes.append(
                f"the gain error of {step.target} leaves {100 / abs(gain):.2g} % of what the"
                " channel shows to act on the model. A sensor that idles shows its noise alone:"
                " where nothing acts, write zeros in its column"
            )
    return notes


def _sampler_notes(samples: Samples | None) -> list[str]:
    if samples is None:
        return []
    notes = [f"sampler: {samples.warning}"] if samples.warning else []
    if samples.jumped_part > MIXED:
        notes.append(
            f"sampler: {number_of(samples.branch_jumps, 'solution')} of runs left the branch of"
            f" the estimate, in {samples.evaluations} evaluations, which may be"
            f" {100 * samples.jumped_part:.2g} % of the draws: the posterior may mix"
            " several answers of the model"
        )
    return notes


def _finite(value: Any) -> Any:
    """Replace numbers that JSON has no words for by None."""
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value.item() if isinstance(value, np.generic) else value
