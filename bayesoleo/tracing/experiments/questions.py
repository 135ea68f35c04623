"""What a closed loop leaves to be told apart, and the runs that would."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from bayesoleo._types import ProgressCallback
from bayesoleo.errors import InputError, ModelError
from bayesoleo.prediction.records import Record
from bayesoleo.tracing.deciding.loop import ClosedLoop
from bayesoleo.tracing.deciding.ranking import Ranked
from bayesoleo.tracing.deciding.rounds import Round
from bayesoleo.tracing.errors.errors_table import ErrorTable, error_table
from bayesoleo.tracing.errors.holdout import predict_fitted
from bayesoleo.tracing.experiments.foresee import Rival
from bayesoleo.tracing.experiments.propose import Proposals, drive_of, propose_runs
from bayesoleo.tracing.experiments.rig import Limits, Range
from bayesoleo.tracing.experiments.rivals import label, named, rivals_of, standing
from bayesoleo.tracing.fitting.fit import Numerics

#: Why effects are to be told apart.
ALIKE, OPEN, ASKED = "indistinguishable", "open", "asked"


@dataclass(frozen=True)
class Question:
    """Effects to be told apart, with the runs that would tell most.

    Parameters
    ----------
    number : int
        Of the round, from 1.
    kind : {"indistinguishable", "open", "asked"}
        Whether the round accepted one of them, accepted none, or the user named them.
    rivals : tuple of str
        The effects.
    proposals : Proposals or None
        ``None`` where no run can be foreseen.
    note : str
        Why not, or which of the effects were left out.
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
    """What each round leaves to be told apart.

    Parameters
    ----------
    loop : ClosedLoop
        Its rounds.
    rig : mapping of str to (float, float)
        Limits of the rig, SI, as :meth:`~bayesoleo.tracing.experiments.rig.Limits.given` takes
        them.
    numerics : Numerics
        Scheme, threads.
    effects : sequence of str, optional
        These effects of the last round instead.
    callback : callable
        Told what is being done.
    """
    records = [*loop.roles.fitted, *loop.roles.held_out]
    records = list({record.label: record for record in records}.values())
    found, stayed = [], set(loop.final.assembly.added)
    for number, item in enumerate(loop.rounds, start=1):
        last = number == len(loop.rounds)
        if effects and not last:
            continue
        if item.accepted and (item.accepted.effect, item.accepted.target) not in stayed:
            continue  # what was taken out again needs no telling from others
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
    callback(f"what would tell {', '.join(names)} apart")
    try:
        # Before anything is estimated.
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
    """What the best rival leaves in the fitted runs."""
    if item.after is not None:
        return item.after.fit_errors
    predictions = predict_fitted(best.fit)
    roles = {prediction.record.label: "fit" for prediction in predictions}
    return error_table(predictions, roles, jobs=numerics.jobs, policy=numerics.policy)
