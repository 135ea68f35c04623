"""Summary of a closed loop: the plain dicts of ``summary.json``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, cast

import numpy as np

from bayesoleo import _schema as schema
from bayesoleo.discovery._curves import CurveFacts
from bayesoleo.discovery._error_table import limit, lowest
from bayesoleo.discovery._loop import ON_LIMIT, ClosedLoop
from bayesoleo.discovery._ranking import Ranked
from bayesoleo.discovery._round import Round
from bayesoleo.discovery._state import State
from bayesoleo.effects._catalogue import titles_for, with_titles
from bayesoleo.posterior._diagnostics import Samples


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
    summary = {
        **about,
        "rounds": [_round(item, titles) for item in loop.rounds],
        "effects": list(loop.effects),
        "targets": list(loop.targets),
        "parameters": _parameters(final, samples, facts.shared),
        "error_before": _by_role(loop.first),
        "error_after": _by_role(final),
        "verdict": loop.verdict,
        "certain": loop.certain,
        "certainty": loop.certainty,
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
            *(in_words(note, titles) for note in loop.notes),
            *facts.notes,
            *([] if stability is None else stability.notes()),
            *final.fit.point.doubts,
            *_input_noise_notes(final),
            *_sampler_notes(samples),
        ],
    }
    clean = _finite(summary)
    schema.validate_summary(clean)
    return cast(dict[str, Any], clean)


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
                f"input noise dominates the noise of {output} in {len(entries)} runs: in run"
                f" {worst.run} it is {times:.1f} times the output's own"
            )
    return notes


def _sampler_notes(samples: Samples | None) -> list[str]:
    if samples is None:
        return []
    notes = [f"sampler: {samples.warning}"] if samples.warning else []
    if samples.branch_jumps:
        notes.append(
            f"sampler: {samples.branch_jumps} solutions of runs left the branch of the estimate, in"
            f" {samples.evaluations} evaluations: the posterior mixes several answers of the model"
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
