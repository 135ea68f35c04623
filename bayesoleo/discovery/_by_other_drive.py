"""Candidates by the force that the measured motion needs, where the predicted motion misleads.

A score is linear in an effect, along the motion that the present model predicts. Where that is far
from the one that was measured, as beside a resonance that bends over, the slopes are those of
another motion: an effect that explains everything scores little, and its estimate ends in another
optimum. The same equations, driven by the measured output and solved for the input, have no motion
to predict. The input is linear in nearly all parameters, so that scores and estimates there are
good at any distance (Masri and Caughey 1979, J. Applied Mechanics 46, 433-447). Noise is amplified
by the derivatives and an error of the output's is treated as one of the input's, so that nothing is
judged there: estimates of the model as it is driven start from those values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._assembly import Assembly, Roles
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._ranking import ABSORBING_FAMILIES, Ranked, score_candidates
from bayesoleo.discovery._refit import Refit, new_parameters, quick_fit, refit_all, refit_at
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._score_tests import Score
from bayesoleo.discovery._state import State, state_of
from bayesoleo.effects._effect import Effect
from bayesoleo.errors import ModelError
from bayesoleo.model._drive_and_start import possible_drives
from bayesoleo.prediction._inputs import lacking

#: Error over the expected one from which a prediction counts as far from the measurement, and the
#: part of the excess that an estimate must explain where it is not.
FAR, ENOUGH = 30.0, 0.9


@dataclass(frozen=True)
class Suggestion:
    """An effect that explains the input along the measured motion.

    Parameters
    ----------
    effect, target : str
    values : mapping of str to float
        Estimates of all unknowns there, SI.
    """

    effect: str
    target: str
    values: Mapping[str, float]


def misleads(state: State, refits: Mapping[int, Refit]) -> bool:
    """Whether a model is so far from the data that slopes along its motion say little, and no
    candidate that was estimated comes near."""
    explained = max((one.share for one in refits.values()), default=0.0)
    return state.worst_ratio > FAR and not explained > ENOUGH


def suggested(
    state: State,
    effects: Sequence[Effect] | None,
    numerics: Numerics,
    callback: ProgressCallback = lambda _: None,
) -> list[Suggestion]:
    """Named effects that explain the input best, each with its estimate; none where the model has
    no drive under which it has fewer motions to predict, or nothing can be estimated there.

    Parameters
    ----------
    state : State
        The fitted model.
    effects : sequence of Effect or None
        Instead of the catalogue.
    numerics : Numerics
    callback : callable
        Told what is being done.
    """
    other = _with_fewer_motions(state)
    if other is None:
        return []
    callback("the prediction is far from the data: candidates by the force along the motion")
    records, policy = state.fit.records, numerics.policy
    fit = fit_model(
        other.model(),
        records,
        numerics,
        tolerance=1e-4,
        max_iterations=30,
        check_mesh=False,
    )
    if not fit.point.status.ok:
        return []
    base = state_of(other, fit, Roles(records, (), "none", "")).base()
    scores, _ = score_candidates(base, other, effects, numerics.jobs, callback=callback)
    named = [one for one in scores if one.option.candidate.family not in ABSORBING_FAMILIES]
    named.sort(key=lambda one: -one.share)
    near = [one for one in named if one.share > policy.near_best * named[0].share > 0.0]
    found = refit_all(base, near[: policy.refits], numerics)
    good = [one for one in found if np.isfinite(one.share) and one.fit.point.status.ok]
    best = max((one.share for one in good), default=0.0)
    return [
        Suggestion(*one.score.option.key, one.fit.values)
        for one in good
        if one.share > policy.near_best * best
    ]


def _with_fewer_motions(state: State) -> Assembly | None:
    """The same assembly in the drive that leaves the fewest dofs, if fewer than its own and all
    runs have what drives it."""
    assembly = state.assembly
    found, least = None, len(state.fit.model.dofs)
    for channel in possible_drives(assembly.native):
        drive = None if channel in assembly.native.inputs else channel
        other = replace(assembly, drive=drive)
        try:
            model = other.model()
        except ModelError:  # an effect on a channel that is no output there
            continue
        if len(model.dofs) < least and not lacking(model.inputs, state.fit.records):
            found, least = other, len(model.dofs)
    return found


def refit_from(base: Base, score: Score, values: Mapping[str, float], numerics: Numerics) -> Refit:
    """The estimate of a model extended by a candidate, from known values.

    Parameters
    ----------
    base : Base
        Residuals and sensitivities of the present model.
    score : Score
        Of the candidate, in the present drive.
    values : mapping of str to float
        Of a :class:`Suggestion`.
    numerics : Numerics
    """
    expected = [values.get(n, v) for n, v in zip(score.names, score.expected, strict=True)]
    shapes = {name: values.get(name, value) for name, value in score.shapes.items()}
    likely = replace(score, expected=np.array(expected, dtype=float), shapes=shapes)
    assembly = score.option.assembly.with_values(base.fit.shared)
    assembly = assembly.with_parameters(new_parameters(assembly, likely, base.policy))
    fit = quick_fit(base, assembly.model(), {**base.fit.values, **values}, numerics)
    return replace(refit_at(base, likely, assembly, fit), score=score)


def with_suggestions(
    state: State,
    base: Base,
    ranking: Sequence[Ranked],
    refits: Mapping[int, Refit],
    effects: Sequence[Effect] | None,
    numerics: Numerics,
    callback: ProgressCallback,
) -> dict[int, Refit]:
    """Estimates by the identity of their scores, with those that start from suggestions where they
    explain more."""
    found = dict(refits)
    for one in suggested(state, effects, numerics, callback):
        place = one.effect, one.target
        item = next((i for i in ranking if (i.effect, i.target) == place), None)
        if item is None:
            continue
        callback(f"estimate {one.effect} from the force along the motion")
        result = refit_from(base, item.score, one.values, numerics)
        known = found.get(id(item.score))
        if np.isfinite(result.share) and (known is None or not known.share >= result.share):
            found[id(item.score)] = result
    return found
