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
from bayesoleo.discovery._error_table import ErrorTable, error_table
from bayesoleo.discovery._fit import Numerics
from bayesoleo.discovery._hold_out_error import predict_fitted
from bayesoleo.discovery._loop import ClosedLoop
from bayesoleo.discovery._next_experiment import Proposals, ProposedRun, drive_of, propose_runs
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._predicted_experiment import Limits, Range, Rival
from bayesoleo.discovery._ranking import Ranked
from bayesoleo.discovery._refit import Refit, refit
from bayesoleo.discovery._round import Round
from bayesoleo.errors import InputError, ModelError
from bayesoleo.prediction._records import Record

#: Reasons to distinguish effects.
ALIKE, OPEN, ASKED = "indistinguishable", "open", "asked"
#: Runs that the summary lists.
LISTED = 5
#: Unit and meaning of what the group holds for each run.
ABOUT = {
    "information": ("bit", "least expected information about which rival is true"),
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
    kind : {"indistinguishable", "open", "asked"}
        Whether the round accepted one of them, accepted none, or the user named them.
    rivals : tuple of str
        The effects.
    proposals : Proposals or None
        ``None`` where no run can be predicted.
    note : str
        The reason, or the effects that were left out.
    """

    number: int
    kind: str
    rivals: tuple[str, ...]
    proposals: Proposals | None
    note: str = ""


def questions_of(
    loop: ClosedLoop,
    rig: Mapping[str, Range],
    numerics: Numerics,
    *,
    effects: Sequence[str] = (),
    callback: ProgressCallback = lambda _: None,
) -> tuple[Question, ...]:
    """The effects that each round leaves undecided, with proposed runs.

    Parameters
    ----------
    loop : ClosedLoop
        Its rounds.
    rig : mapping of str to (float, float)
        Limits of the rig, SI, as ``Limits.given`` takes
        them.
    numerics : Numerics
        Scheme, threads.
    effects : sequence of str, optional
        Effects of the last round to distinguish instead.
    callback : callable
        Receives a message at each step.
    """
    records = [*loop.roles.fitted, *loop.roles.held_out]
    records = list({record.label: record for record in records}.values())
    found, stayed = [], set(loop.final.assembly.added)
    for number, item in enumerate(loop.rounds, start=1):
        last = number == len(loop.rounds)
        if effects and not last:
            continue
        if item.accepted and (item.accepted.effect, item.accepted.target) not in stayed:
            continue  # the effect was removed again
        chosen = named(item, effects) if effects else standing(item, policy=numerics.policy)
        if chosen:
            kind = ASKED if effects else OPEN if item.accepted is None else ALIKE
            found.append(_answer(number, kind, item, chosen, records, rig, numerics, callback))
    return tuple(found)


def _answer(
    number: int,
    kind: str,
    item: Round,
    chosen: Sequence[Ranked],
    records: Sequence[Record],
    rig: Mapping[str, Range],
    numerics: Numerics,
    callback: ProgressCallback,
) -> Question:
    names = tuple(label(one, chosen) for one in chosen)
    callback(f"look for a run that distinguishes {', '.join(names)}")
    try:
        # A campaign without a possible next run fails before rivals are estimated.
        drive_of([Rival("", item.before.fit)] * 2, records)
        rivals, failed = rivals_of(item, chosen, numerics)
        note = "; ".join(f"{name} could not be estimated: {why}" for name, why in failed.items())
        if len(rivals) < 2 and failed:
            raise ModelError(f"fewer than two rivals are left: {note}", hint="name others")
        drive = drive_of(rivals, records)
        limits = Limits.of(records, drive, rivals[0].fit.predictor.outputs).given(rig)
        errors = _left(item, rivals[0], numerics)
        found = propose_runs(rivals, records, errors, limits, jobs=numerics.jobs)
        return Question(number, kind, found.rivals, found, note)
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
        "rivals": list(question.rivals),
        "note": question.note,
        "drive": None if found is None else found.drive,
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
    sigma = trial.separation.sigma
    pairs = [
        {"rivals": [found.rivals[i], found.rivals[j]], "sigma": float(sigma[i, j])}
        for i, j in zip(first, second, strict=True)
    ]
    return {
        "frequency": trial.frequency,
        "mean": trial.mean,
        "amplitude": trial.amplitude,
        "information": trial.separation.information,
        "sigma": trial.separation.weakest,
        "pairs": pairs,
    }


def proposals_group(questions: Sequence[Question], unit: str) -> dict[str, xr.Dataset]:
    """The group ``proposal``: how well runs over the rig's range would separate rivals.

    Parameters
    ----------
    questions : sequence of Question
        Those without an answer are left out.
    unit : str
        SI unit of the channel that drives the model.

    Returns
    -------
    dict of str to Dataset
        Empty where no question was answered.
    """
    answered = [(q, q.proposals) for q in questions if q.proposals and q.proposals.trials]
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
            values = (trial.separation.information, trial.separation.weakest, rank)
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
