"""Rival models that the data leave undecided, and the runs that would decide.

The summary and the result tree report both.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._parallel import thread_map
from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._assembly import Added
from bayesoleo.discovery._corners import beginning
from bayesoleo.discovery._fit_and_hold_out_error import ErrorTable, error_table
from bayesoleo.discovery._loop import SURE, ClosedLoop, scored_later
from bayesoleo.discovery._next_experiment import (
    PARAMETERS,
    STRUCTURES,
    Proposals,
    ProposedRun,
    check_aim,
    drive_of,
    limits_of,
    propose_runs,
)
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._predicted_experiment import Range, Rival, sizes_of
from bayesoleo.discovery._ranking import Ranked
from bayesoleo.discovery._refit import Refit, refit
from bayesoleo.discovery._round import Round
from bayesoleo.discovery._run_predictions import predict_fitted
from bayesoleo.discovery._structure_search import structure_fits
from bayesoleo.discovery._structures import StructurePosterior
from bayesoleo.errors import InputError, ModelError, number_of
from bayesoleo.prediction._records import Record

#: Reasons to distinguish effects.
ALIKE, OPEN, ASKED = "indistinguishable", "open", "asked"
#: A structure that is as probable as this is decided; one that is less probable than that is no
#: rival.
DECIDED, LEAST = SURE, 0.01
#: Structures that together are less probable than this are not worth a run: it is decided that none
#: of them is true, and what a run tells among them is told with this probability only.
WORTH_A_RUN = 1.0 - DECIDED
#: Name of the structure without effects.
NOTHING = "nothing"
#: Runs that the summary lists.
LISTED = 5
#: Unit and meaning of what the group holds for each run.
ABOUT = {
    "information": ("bit", "expected information about which rival is true, or on parameters"),
    "sigma": ("1", "standard deviations that separate the least separated pair"),
    "rank": ("1", "place among all runs, from 1"),
}


def standing(item: Round, *, policy: SearchPolicy = SearchPolicy()) -> tuple[Ranked, ...]:
    """Candidates of a round that remain possible, the best first.

    If an effect was accepted, these are the effect and those that the data cannot distinguish from
    it. Else they are the significant effects that explain a part of the excess, without absorbing
    families. The result is empty if fewer than two remain.
    """
    if item.accepted is not None:
        names = set(item.accepted.same)
        alike = [
            other
            for other in item.ranking
            if other is not item.accepted
            and names & {other.effect, f"{other.effect} @ {other.target}"}
        ]
        chosen = [item.accepted, *alike]
    else:
        chosen = [
            other
            for other in item.ranking
            if other.p_value < policy.significance
            and other.gain >= policy.least_share
            and not other.absorbs
        ]
    return tuple(chosen[: policy.proposal_rivals]) if len(chosen) > 1 else ()


def named(item: Round, effects: Sequence[str]) -> tuple[Ranked, ...]:
    """Candidates by their ids, or by ``effect@target`` where there are several with one id.

    Raises
    ------
    InputError
        If a round has no such candidate.
    """
    return tuple(_named(item, text) for text in effects)


def _named(item: Round, text: str) -> Ranked:
    wanted = text.replace(" ", "")
    for one in item.ranking:
        if wanted in (one.effect, f"{one.effect}@{one.target}"):
            return one
    known = dict.fromkeys(one.effect for one in item.ranking)
    close = get_close_matches(wanted, known, 3)
    hint = f"write one of: {', '.join(close or known)}"
    raise InputError("no such candidate in the last round", value=text, hint=hint)


def rivals_of(
    item: Round, chosen: Sequence[Ranked], numerics: Numerics
) -> tuple[list[Rival], Mapping[str, str]]:
    """The extended models of some candidates of a round, estimated where they were not.

    Parameters
    ----------
    item : Round
    chosen : sequence of Ranked
        Of that round.
    numerics : Numerics
        Scheme, threads.

    Returns
    -------
    rivals : list of Rival
    failed : dict of str to str
        Candidates that could not be estimated, with the reason.
    """
    missing = [one for one in chosen if one.refit is None]
    base = item.before.base() if missing else None

    def estimated(one: Ranked) -> Refit:
        assert base is not None
        return refit(base, one.score, numerics)

    fresh = dict(zip(map(id, missing), thread_map(estimated, missing, numerics.jobs), strict=True))
    rivals, failed = [], {}
    for one in chosen:
        fit = (one.refit or fresh[id(one)]).fit
        name = label(one, chosen)
        if fit.point.status.ok and np.isfinite(fit.point.covariance).all():
            rivals.append(Rival(name, fit))
        else:
            failed[name] = fit.point.status.message
    return rivals, failed


def label(one: Ranked, among: Sequence[Ranked]) -> str:
    """The effect's id, with its target where another one has the same id."""
    several = sum(other.effect == one.effect for other in among) > 1
    return f"{one.effect} @ {one.target}" if several else one.effect


@dataclass(frozen=True)
class Question:
    """Effects that the data leave undecided, with the runs that would best distinguish them.

    Parameters
    ----------
    number : int
        Number of the round, from 1.
    kind : {"structures", "parameters", "indistinguishable", "open", "asked"}
        Whether structures are to be told apart by their probabilities, or parameters to be more
        precise. Where there are no probabilities: whether the round accepted one of the effects,
        accepted none, or the user named them.
    rivals : tuple of str
        The effects.
    proposals : Proposals or None
        ``None`` where no run can be predicted.
    note : str
        The reason, or the effects that were left out.
    aim : str
        The parameter that is to be more precise; empty for all.
    probability : float or None
        Of the rivals together, where structures are to be told apart.
    """

    number: int
    kind: str
    rivals: tuple[str, ...]
    proposals: Proposals | None
    note: str = ""
    aim: str = ""
    probability: float | None = None


def questions_of(
    loop: ClosedLoop,
    rig: Mapping[str, Range],
    numerics: Numerics,
    *,
    aim: str = STRUCTURES,
    effects: Sequence[str] = (),
    callback: ProgressCallback = lambda _: None,
) -> tuple[Question, ...]:
    """What the data leave open, with proposed runs.

    Parameters
    ----------
    loop : ClosedLoop
        Its rounds.
    rig : mapping of str to (float, float)
        Limits of the rig, SI, as ``Limits.given`` takes
        them.
    numerics : Numerics
        Scheme, threads.
    aim : str
        ``"structures"``, ``"parameters"`` or the name of one parameter.
    effects : sequence of str, optional
        Effects of the last round to distinguish instead.
    callback : callable
        Receives a message at each step.
    """
    every = [*loop.roles.fitted, *loop.roles.held_out]
    records = list({record.label: record for record in every}.values())
    plan = _Plan(records, rig, numerics, callback)
    if effects:
        item, number = loop.rounds[-1], len(loop.rounds)
        return (_of_round(number, ASKED, item, named(item, effects), plan),)
    if aim != STRUCTURES:
        return (_of_parameters(loop, aim, plan),)
    if loop.structures is not None:
        return _of_structures(loop, loop.structures, plan)
    found, stayed = [], set(loop.final.assembly.added)
    for number, item in enumerate(loop.rounds, start=1):
        if item.accepted and (item.accepted.effect, item.accepted.target) not in stayed:
            continue  # the effect was removed again
        chosen = standing(item, policy=numerics.policy)
        if chosen:
            kind = OPEN if item.accepted is None else ALIKE
            found.append(_of_round(number, kind, item, chosen, plan))
    return tuple(found)


@dataclass(frozen=True)
class _Plan:
    """What all questions share: existing runs, limits, and how models are solved."""

    records: Sequence[Record]
    rig: Mapping[str, Range]
    numerics: Numerics
    callback: ProgressCallback

    def proposed(
        self, rivals: Sequence[Rival], errors: ErrorTable, aim: str = STRUCTURES
    ) -> tuple[Proposals, str]:
        """Proposals, and what of the rig's limits does not count."""
        drive, outputs = drive_of(rivals, self.records), rivals[0].fit.predictor.outputs
        limits, note = limits_of(self.records, drive, outputs), ""
        rig = dict(self.rig)
        if not drive:
            unused = [name for name in rig if name not in outputs]
            rig = {name: value for name, value in rig.items() if name in outputs}
            if unused:
                note = f"measured runs are varied; limits of {', '.join(unused)} do not apply"
        found = propose_runs(
            rivals, self.records, errors, limits.given(rig), aim=aim, jobs=self.numerics.jobs
        )
        return found, note


def _of_structures(
    loop: ClosedLoop, structures: StructurePosterior, plan: _Plan
) -> tuple[Question, ...]:
    """The question which of the most probable structures is true; none where that is decided, the
    name of the one effect is certain, or most probably nothing is missing or none of them is true.
    """
    if loop.certain:
        return ()
    weights: dict[tuple[Added, ...], float] = {}
    for one in structures.structures:
        if one.effects or not one.outside:
            weights[one.effects] = weights.get(one.effects, 0.0) + one.probability
    ordered = sorted(weights, key=lambda effects: -weights[effects])
    leading = [e for e in ordered if weights[e] >= LEAST][: plan.numerics.policy.proposal_rivals]
    chosen = leading if len(leading) > 1 else ordered[:2]
    total, joint = sum(weights.values()), sum(weights[effects] for effects in chosen)
    if len(chosen) < 2 or weights[chosen[0]] > DECIDED * total or structures.nothing > 0.5 * total:
        return ()
    if joint < WORTH_A_RUN:
        return ()
    names = tuple(structure_label(effects, chosen) for effects in chosen)
    number = len(loop.rounds)
    plan.callback(f"look for a run that distinguishes {number_of(len(names), 'structure')}")
    try:
        first, corner = loop.first, loop.final.assembly.corner
        ranking, jobs = loop.rounds[0].ranking, plan.numerics.jobs
        assembly, scores = beginning(first, ranking, corner, jobs)
        scores += scored_later(loop.rounds)
        fits = structure_fits(first.base(), assembly, scores, chosen, plan.numerics)
        rivals, failed = [], []
        for effects, name, found in zip(chosen, names, fits, strict=True):
            if found is not None and np.isfinite(found.fit.point.covariance).all():
                own = tuple(unknown for key in found.effects.values() for unknown in key)
                sizes = sizes_of(found.fit, own, int(found.fit.problem.counts.sum()))
                rivals.append(Rival(name, found.fit, weights[effects], sizes))
            else:
                failed.append(name)
        if len(rivals) < 2:
            raise ModelError(f"{', '.join(failed)} could not be estimated", hint="name others")
        proposals, unused = plan.proposed(rivals, loop.final.fit_errors)
    except InputError as error:
        return (Question(number, STRUCTURES, names, None, error.problem, probability=joint),)
    notes = [f"{name}, which could not be estimated" for name in failed]
    rest = 1.0 - joint
    joint = sum(rival.weight for rival in rivals)
    if rest > LEAST:
        notes.append(f"other structures, and what predicts nothing (probability {rest:.2f})")
    notes += [unused] if unused else []
    note = "; ".join(notes)
    return (Question(number, STRUCTURES, proposals.rivals, proposals, note, probability=joint),)


def structure_label(effects: Sequence[Added], among: Sequence[Sequence[Added]]) -> str:
    """Ids of a structure's effects, with their targets where an effect has several."""
    every = {key for other in among for key in other}
    several = {effect for effect, _ in every if sum(e == effect for e, _ in every) > 1}
    names = [f"{effect} @ {target}" if effect in several else effect for effect, target in effects]
    return " + ".join(names) or NOTHING


def _of_parameters(loop: ClosedLoop, aim: str, plan: _Plan) -> Question:
    """The question which run makes the final model's parameters more precise."""
    number, name = len(loop.rounds), structure_label(loop.final.assembly.added, ())
    own = "" if aim == PARAMETERS else aim
    plan.callback(f"look for a run that makes {own or 'parameters'} more precise")
    try:
        check_aim(aim, tuple(loop.final.fit.shared))
        rivals = [Rival(name or NOTHING, loop.final.fit)]
        found, note = plan.proposed(rivals, loop.final.fit_errors, aim)
        return Question(number, PARAMETERS, (name,), found, note, own)
    except InputError as error:
        return Question(number, PARAMETERS, (name,), None, error.problem, own)


def _of_round(
    number: int, kind: str, item: Round, chosen: Sequence[Ranked], plan: _Plan
) -> Question:
    """The question which of some candidates of a round is true."""
    names = tuple(label(one, chosen) for one in chosen)
    plan.callback(f"look for a run that distinguishes {', '.join(names)}")
    try:
        rivals, failed = rivals_of(item, chosen, plan.numerics)
        notes = [f"{name} could not be estimated: {why}" for name, why in failed.items()]
        if len(rivals) < 2 and failed:
            raise ModelError(f"fewer than two rivals are left: {notes[0]}", hint="name others")
        found, unused = plan.proposed(rivals, _left(item, rivals[0], plan.numerics))
        notes += [unused] if unused else []
        return Question(number, kind, found.rivals, found, "; ".join(notes))
    except InputError as error:
        if kind == ASKED:
            raise
        return Question(number, kind, names, None, error.problem)


def _left(item: Round, best: Rival, numerics: Numerics) -> ErrorTable:
    """Errors of the best rival on the fitted runs."""
    if item.after is not None:
        return item.after.fit_errors
    predictions = predict_fitted(best.fit)
    roles = {prediction.record.label: "fit" for prediction in predictions}
    return error_table(predictions, roles, jobs=numerics.jobs, policy=numerics.policy)


def proposals_entry(question: Question, unit: str) -> dict[str, Any]:
    """One entry of the summary's ``proposals``.

    Parameters
    ----------
    question : Question
    unit : str
        SI unit of the channel that drives the model.
    """
    found = question.proposals
    entry: dict[str, Any] = {
        "round": question.number,
        "question": question.kind,
        "parameter": question.aim,
        "rivals": list(question.rivals),
        "probabilities": [] if found is None else list(found.weights),
        "probability": question.probability,
        "entropy": 0.0 if found is None else found.entropy,
        "note": question.note,
        "drive": found.drive or None if found is not None else None,
        "unit": unit,
        "runs": [],
        "repeat": None,
        "inseparable": [],
        "left_out": {},
    }
    if found is None:
        return entry
    repeat = found.best_repeat
    return entry | {
        "runs": [_trial(found, trial) for trial in found.shortlist(LISTED)],
        "repeat": None if repeat is None else {"run": repeat.label, **_trial(found, repeat)},
        "inseparable": [list(pair) for pair in found.inseparable],
        "left_out": dict(found.left_out),
    }


def _trial(found: Proposals, trial: ProposedRun) -> dict[str, Any]:
    first, second = np.triu_indices(len(found.rivals), 1)
    pairs = []
    if trial.separation is not None:
        sigma = trial.separation.sigma
        pairs = [
            {"rivals": [found.rivals[i], found.rivals[j]], "sigma": float(sigma[i, j])}
            for i, j in zip(first, second, strict=True)
        ]
    ratios = {} if trial.precision is None else trial.precision.ratio

    def number(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    return {
        "like": trial.like,
        "change": trial.change,
        "frequency": number(trial.frequency),
        "mean": number(trial.mean),
        "amplitude": number(trial.amplitude),
        "information": trial.information,
        "sigma": trial.weakest if trial.separation is not None else None,
        "pairs": pairs,
        "sd_ratio": ratios,
    }


def proposals_group(questions: Sequence[Question], unit: str) -> dict[str, xr.Dataset]:
    """The group ``proposal``: how well runs over the rig's range would separate rivals.

    Parameters
    ----------
    questions : sequence of Question
        Those without an answer are left out, and those whose runs vary measured ones.
    unit : str
        SI unit of the channel that drives the model.

    Returns
    -------
    dict of str to Dataset
        Empty where no question was answered.
    """
    answered = [
        (q, q.proposals)
        for q in questions
        if q.proposals and q.proposals.trials and q.proposals.drive
    ]
    if not answered:
        return {}
    keys = ("mean", "amplitude", "frequency")
    trials = [trial for _, found in answered for trial in found.trials]
    axes = [sorted({getattr(trial, key) for trial in trials}) for key in keys]
    shape = (len(answered), *map(len, axes))
    found_at = {name: np.full(shape, np.nan) for name in ABOUT}
    for k, (_, found) in enumerate(answered):
        for rank, trial in enumerate(found.trials, start=1):
            place = [axis.index(getattr(trial, key)) for axis, key in zip(axes, keys, strict=True)]
            sigma = np.nan if trial.separation is None else trial.weakest
            values = (trial.information, sigma, rank)
            for name, value in zip(ABOUT, values, strict=True):
                found_at[name][(k, *place)] = value
    dims = (schema.ROUND, schema.MEAN, schema.AMPLITUDE, schema.FREQUENCY)
    data = {
        name: xr.Variable(dims, found_at[name], {schema.UNITS: own, schema.LONG_NAME: text})
        for name, (own, text) in ABOUT.items()
    }
    data["rivals"] = xr.Variable(
        schema.ROUND, np.array([json.dumps(list(found.rivals)) for _, found in answered])
    )
    units = dict(zip(keys, (unit, unit, "Hz"), strict=True))
    coords = {
        key: xr.Variable(key, np.array(axis), {schema.UNITS: units[key]})
        for key, axis in zip(keys, axes, strict=True)
    }
    numbers = {schema.ROUND: [question.number for question, _ in answered]}
    group = xr.Dataset(data, coords={**numbers, **coords})
    group.attrs["drive"] = answered[0][1].drive
    return {schema.PROPOSAL: group}
