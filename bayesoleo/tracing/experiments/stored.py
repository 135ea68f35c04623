"""What to measure next, as the summary and the tree of a result hold it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import xarray as xr

from bayesoleo import schema
from bayesoleo.tracing.experiments.propose import Proposals, ProposedRun
from bayesoleo.tracing.experiments.questions import Question

#: Runs that the summary lists.
LISTED = 5
#: Unit and meaning of what the group holds for each run.
ABOUT = {
    "information": ("bit", "least expected information about which rival is true"),
    "sigma": ("1", "standard deviations that separate the least separated pair"),
    "rank": ("1", "place among all runs, from 1"),
}


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
    """The group ``proposal``: how well runs over the rig's range would tell rivals apart.

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
