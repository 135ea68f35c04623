"""The closed loop, and its verdict.

The loop fits the model, searches for missing effects, adds the best and compares models until no
further effect is found.

An effect counts as found if the model predicts all runs to within the expected error, or if
physical effects explain nine tenths of the missing part. By-run parameters, forces that repeat with
the drive and nonparametric curves absorb part of any model error. Their share is therefore no
evidence that a cause was found.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._first_compilation import has_others
from bayesoleo._parallel import single_blas_thread
from bayesoleo._types import ProgressCallback
from bayesoleo.discovery._alternatives import best_of_beam, eliminated
from bayesoleo.discovery._assembly import Added, Assembly, Roles
from bayesoleo.discovery._compile_ahead import compile_shooting_meanwhile
from bayesoleo.discovery._corners import beginning, cornered
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._fit_and_hold_out_error import RunError, least_noise, limit
from bayesoleo.discovery._judged_together import TOGETHER, judged_together
from bayesoleo.discovery._kept_progress import Kept
from bayesoleo.discovery._nonparametric_round import nonparametric_notes, with_nonparametric
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._ranking import (
    ABSORBING_FAMILIES,
    Ranked,
    forget_options,
    prepare_options,
)
from bayesoleo.discovery._review import reviewed
from bayesoleo.discovery._round import JUDGED, Progress, Round, examine
from bayesoleo.discovery._scanned_columns import Scanned
from bayesoleo.discovery._score_tests import Score
from bayesoleo.discovery._state import State, better_start, fit_state, state_of
from bayesoleo.discovery._structure_search import DEFAULT_PRIOR, structure_posterior
from bayesoleo.discovery._structures import StructurePosterior, StructurePrior
from bayesoleo.discovery._work import ENDED, ENDS, work_of
from bayesoleo.effects._effect import Effect
from bayesoleo.effects._forces import ARCTANGENT, CORNERS
from bayesoleo.effects._nonparametric import FAMILY

#: Families of effects that name no cause.
NO_CAUSE = ABSORBING_FAMILIES | {FAMILY}
#: How SciPy says, with a ValueError, that a matrix is not finite.
NOT_FINITE = "infs or NaNs"

#: Probability that the effect of a certain name has at least, where probabilities were computed.
SURE = 0.95
#: Movement of a parameter by a finer mesh, in standard deviations, beyond which no name is certain.
UNRESOLVED = 1.0
#: Part of the mean square of an excess, and of the expected error, that finer steps would change
#: where the excess may be the error of the solution.
OF_THE_MESH, LEAST_OF_THE_MESH = 0.5, 0.1
#: Said of effects in transients where a search was stopped before it judged them together.
UNJUDGED = (
    "the search was stopped: effects in transients may be on trial, and are not yet judged beside"
    " each other"
)
#: Beginning of the note on probabilities that could not be computed.
NO_PROBABILITIES = "the probabilities of structures could not be computed"
#: Beginning of a note that lists parameters.
ON_LIMIT = "at the limit of their prior's support"
#: Beginning of the note on a declared model that was estimated from another start than its own.
OTHER_OPTIMUM = "the estimate from the declared values ended in a local optimum, lower"
#: Beginning of the note on the corner of dry friction, where it is not the usual one.
OTHER_CORNER = "the sign of the velocity v is not that of the catalogue"
#: Beginning of the note on parameters whose sign is not the declared one.
OTHER_SIGN = "opposite in sign to the declared value"


def verdict_of(
    rounds: Sequence[Round], first: State, final: State, *, policy: SearchPolicy = SearchPolicy()
) -> str:
    """One of the three verdicts of the summary.

    Parameters
    ----------
    rounds : sequence of Round
        In order.
    first, final : State
        The model as declared, and with all effects.
    policy : SearchPolicy
        Its ``explained`` is the part of the excess that physical effects must explain where the
        errors exceed the expected ones.
    """
    if _as_expected(final):
        return schema.EFFECT_ADDED if final.assembly.added else schema.NOTHING_MISSING
    if final.too_quiet:
        return schema.UNEXPLAINED  # too large a noise explains everything
    found = explained_by_physics(rounds, first, final) > policy.explained
    return schema.EFFECT_ADDED if found else schema.UNEXPLAINED


def certainty_of(final: State, certain: bool) -> str | None:
    """How sure the names of the added effects are; None where none was added.

    Parameters
    ----------
    final : State
        With all effects.
    certain : bool
        Whether the data exclude all alternatives to its only effect.
    """
    steps = final.assembly.steps
    if not steps:
        return None
    if all(step.effect.family in NO_CAUSE for step in steps):
        return schema.NO_CAUSE
    # What a curve without a name had to explain is more than the named effects do.
    if not _as_expected(final) or any(step.effect.family == FAMILY for step in steps):
        return schema.LIKENESS
    return schema.CERTAIN if certain and not final.fit.shift > UNRESOLVED else schema.PROBABLE


def _as_expected(final: State) -> bool:
    """Whether all errors are as expected. Errors that are smaller than chance allows show a wrong
    noise and prove nothing."""
    return final.at_floor and not final.too_quiet


def explained_by_physics(rounds: Sequence[Round], first: State, final: State) -> float:
    """Part of the excess that the physical effects of the final model explain.

    The share of an effect is the fall of the excess in the round that added it.
    """
    added, unit = final.assembly.added, yardstick(first, final)
    whole = max(excess(first, unit), 1e-300)
    if all(step.effect.family not in NO_CAUSE for step in final.assembly.steps):
        return (excess(first, unit) - excess(final, unit)) / whole if added else 0.0
    # A round that replaced an effect begins without that effect.
    return sum(
        (excess(item.before, unit) - excess(item.after, unit)) / whole
        for item in rounds
        if item.after is not None and _is_physics(item, added)
    )


def _is_physics(item: Round, added: Sequence[Added]) -> bool:
    """Whether a round added a physical effect that is in the final model."""
    found = item.accepted
    if found is None or (found.effect, found.target) not in added:
        return False
    return found.score.option.candidate.family not in NO_CAUSE


def yardstick(*states: State) -> dict[tuple[str, str], float]:
    """What to measure an excess by: of each run and output the smallest expected error, SI.

    A model whose parameters are open expects any error. By its own measure it would have explained
    what it has not, as a sensor with a gain of about zero.
    """
    least: dict[tuple[str, str], float] = {}
    for state in states:
        for entry in _judged(state):
            key = entry.run, entry.output
            least[key] = min(entry.expected, least.get(key, np.inf))
    return least


def excess(state: State, unit: Mapping[tuple[str, str], float]) -> float:
    """Excess of the squared ratio to an expected error over one, of hold-out runs if any."""
    ratios = [entry.repeating / unit[entry.run, entry.output] for entry in _judged(state)]
    return float(sum(max(ratio**2 - 1.0, 0.0) for ratio in ratios))


def _judged(state: State) -> tuple[RunError, ...]:
    """Errors of the hold-out runs; where there are none, of the fitted ones."""
    return (state.hold_errors if state.hold_errors.entries else state.fit_errors).entries


@dataclass(frozen=True)
class ClosedLoop:
    """The course and the outcome of a search.

    Parameters
    ----------
    rounds : tuple of Round
        In order; the last one accepts no effect.
    first, final : State
        The model as declared, and with all effects that were added.
    roles : Roles
    notes : tuple of str
        Remarks on the result, as sentences.
    complete : bool
        Whether the search was not stopped early.
    policy : SearchPolicy
        The numbers by which the search decided.
    structures : StructurePosterior or None
        Probabilities of what the declared model lacks; None where no candidate was scored, or the
        search was stopped early.
    without_structures : Progress or None
        The search that :func:`structures_of` would compare, where that was left to the caller.
    """

    rounds: tuple[Round, ...]
    first: State
    final: State
    roles: Roles
    notes: tuple[str, ...]
    complete: bool = True
    policy: SearchPolicy = SearchPolicy()
    structures: StructurePosterior | None = None
    without_structures: Progress | None = None

    @property
    def added(self) -> tuple[tuple[str, str], ...]:
        """Effects of the final model with their targets."""
        return tuple(self.final.assembly.added)

    @property
    def effects(self) -> tuple[str, ...]:
        """Ids of the effects in the final model, in the order in which they were added."""
        return tuple(effect for effect, _ in self.final.assembly.added)

    @property
    def targets(self) -> tuple[str, ...]:
        """Places of the added effects in the model."""
        return tuple(target for _, target in self.final.assembly.added)

    @property
    def _scanned(self) -> Scanned | None:
        """What the candidates of the last round change in the outputs, where it was kept."""
        return self.rounds[-1]._scanned if self.rounds else None

    @property
    def verdict(self) -> str:
        """One of the three verdicts of the summary."""
        return verdict_of(self.rounds, self.first, self.final, policy=self.policy)

    @property
    def certainty(self) -> str | None:
        """How sure the names of the added effects are, in one word; None where none was added."""
        return certainty_of(self.final, self.certain)

    @property
    def certain(self) -> bool:
        """Whether the data exclude all alternatives to the one effect that was added.

        The effect must explain everything alone: the errors are at the noise floor and no other
        effect is significant. The data must distinguish it from all other effects of the catalogue.
        It must be so large that a merely similar effect would have left a significant remainder,
        and none of its family may leave only noise too: laws of one family differ by conventions,
        such as how a friction turns about, and a small difference of the likelihood shows no more.
        Hold-out runs must have confirmed it, and without it be beyond what chance allows. Where the
        probabilities of structures are known, its own must be 0.95 at least.
        """
        if not self.complete or self.final.too_quiet or not self.final.hold_errors.entries:
            return False
        accepted = [item.accepted for item in self.rounds if item.accepted]
        accepted = [item for item in accepted if (item.effect, item.target) in self.added]
        if len(self.added) != 1 or not accepted or not self.final.at_floor:
            return False
        if self.structures and self.structures.effects.get(self.added[0], 0.0) < SURE:
            return False
        found, last = accepted[-1], self.rounds[-1]
        estimate = found.beside or found.refit
        if found.same or estimate is None:
            return False
        if found.score.option.candidate.family == FAMILY:
            return False  # a nonparametric function names no effect
        if self._has_sibling(found) or not self._shown_by_hold_out:
            return False
        level, same = self.policy.significance, self.policy.same_cosine
        if any(item.p_value < level for item in last.ranking):
            return False
        local = -np.expm1(np.log1p(-level) / last.tests)
        fall = estimate.fall / estimate.inflation
        return bool((1.0 - same) * fall > distributions.chi2.isf(local, 1))

    def _has_sibling(self, found: Ranked) -> bool:
        """Whether another effect of the same family and place leaves only noise too."""
        own = found.score.option
        return any(
            item.refit is not None
            and item.refit.reached
            and item.score.option.key != own.key
            and item.score.option.key[1] == own.key[1]
            and item.score.option.candidate.family == own.candidate.family
            for entry in self.rounds
            if entry.accepted is not None and entry.accepted.score.option.key == own.key
            for item in entry.ranking
        )

    @property
    def _shown_by_hold_out(self) -> bool:
        """Whether the error of the declared model in a hold-out run is beyond what chance allows
        now, or there is no solution without what was added. Where the parameters are so little
        known there that it is not, the run tests nothing.
        """
        final = self.final.hold_errors
        return any(
            not before.repeating
            <= limit([after], len(final.entries), policy=self.policy) * after.expected_error
            for before in self.first.hold_errors.entries
            for after in [final.at(before.output, before.run)]
            if after.expected_error is not None
        )


#: Receives a result that may be replaced. Returns a function to call when it may be.
type Provisional = Callable[[ClosedLoop], Callable[[], None]]


@single_blas_thread()  # matrices are small: threads take longer to meet than to work
def close_loop(
    assembly: Assembly,
    roles: Roles,
    numerics: Numerics,
    *,
    effects: Sequence[Effect] | None = None,
    seed: int = 0,
    max_effects: int = 6,
    nonparametric: bool = True,
    most_work: float = np.inf,
    known: Progress | None = None,
    prior: StructurePrior = DEFAULT_PRIOR,
    keep: Callable[[Progress], None] = lambda _: None,
    keep_columns: bool = False,
    declared: ModelFit | None = None,
    provisional: Provisional | None = None,
    callback: ProgressCallback = lambda _: None,
) -> ClosedLoop:
    """Fit a model and add the effects that it lacks, one after the other.

    Parameters
    ----------
    assembly : Assembly
        The declared model and its drive.
    roles : Roles
        Runs to fit and to hold out.
    numerics : Numerics
        Scheme, mesh, threads.
    effects : sequence of Effect, optional
        Instead of the catalogue.
    seed : int
        For the correction for the search.
    max_effects : int
        Largest number of effects to add.
    nonparametric : bool
        Whether a smooth function may be added where no named effect explains the residual.
    most_work : float
        Work after which the search goes no further: what was added is judged, but nothing else is
        added, reviewed or replaced. Samples that estimates predicted, times their unknowns.
    known : Progress, optional
        Progress of the same search, stopped before, from which it resumes.
    prior : StructurePrior, optional
        Prior probabilities of what may be missing.
    keep : callable
        Receives the progress once the model is estimated, and after each round.
    keep_columns : bool
        Whether to keep what the candidates of the last round change in the outputs, for the choice
        of an error model.
    declared : ModelFit, optional
        The declared model's estimate, if it was made before: by :func:`fit_model`, by these runs
        and numerics.
    provisional : callable, optional
        Where it is given, the caller compares structures, by :func:`structures_of` and
        :func:`judged`: no estimate depends on that. It receives the result that stands unless
        another first effect does better. What it returns is called where the search is done again
        with another one.
    callback : callable
        Receives a message at each step.

    Returns
    -------
    ClosedLoop
    """
    # Nobody waits for a process that is alone, and a round of a long search is worth more than the
    # half second for which others do.
    kept = Kept(keep, at_once=provisional is None or not has_others(numerics.jobs))
    search = SearchOptions(
        roles, numerics, effects, seed, max_effects, nonparametric, kept, callback, keep_columns,
        most_work,
    )  # fmt: skip
    with kept:
        if known is None:
            known = _begun(assembly, roles, numerics, declared, effects, callback)
            kept.later(known)
        return _closed(searched(known, search), search, prior, provisional)


def _closed(
    known: Progress, search: SearchOptions, prior: StructurePrior, provisional: Provisional | None
) -> ClosedLoop:
    """The result of a search that has ended, or of one that begins with another effect."""
    drop: Callable[[], None] | None = None

    def follow(other: Progress, most: int) -> Progress:
        if drop is not None:
            drop()
        quiet = replace(
            search,
            max_effects=most,
            nonparametric=False,
            kept=Kept(),
            keep_columns=False,
            most_work=np.inf,
        )
        return searched(other, quiet)

    numerics, callback = search.numerics, search.callback
    roles = _with_noise(search.roles, known)
    if _went_no_further(known):
        # What it would have found is not among what probabilities are of.
        return loop_of(known.ended(ENDED), roles)
    loop = replace(loop_of(known, roles), without_structures=known)
    if provisional is not None:
        drop = provisional(loop)
    search.kept.now()
    best = best_of_beam(
        known, roles, numerics, follow, search.effects, search.max_effects, callback
    )
    if best is not known:
        loop = replace(loop_of(best, roles), without_structures=best)
    if provisional is not None:
        return loop
    return judged(loop, structures_of(best, numerics, prior, callback))


def judged(loop: ClosedLoop, found: StructurePosterior | str | None) -> ClosedLoop:
    """A loop with what :func:`structures_of` found."""
    if isinstance(found, str):  # what was found stands without them
        return replace(loop, notes=(*loop.notes, found), without_structures=None)
    return replace(loop, structures=found, without_structures=None)


def structures_of(
    progress: Progress,
    numerics: Numerics,
    prior: StructurePrior = DEFAULT_PRIOR,
    callback: ProgressCallback = lambda _: None,
) -> StructurePosterior | str | None:
    """The result of :func:`probabilities`, or a note why there is none."""
    try:
        return probabilities(progress, numerics, prior, callback)
    except (np.linalg.LinAlgError, ArithmeticError, ValueError) as error:
        numerical = isinstance(error, np.linalg.LinAlgError | ArithmeticError)
        if not numerical and NOT_FINITE not in str(error):
            raise
        return f"{NO_PROBABILITIES}: {error}"


def probabilities(
    progress: Progress, numerics: Numerics, prior: StructurePrior, callback: ProgressCallback
) -> StructurePosterior | None:
    """Probabilities of what the declared model lacks, by a search that has ended.

    None where no candidate of the first round was scored.
    """
    first, final = progress.first, progress.state
    ranking = progress.rounds[0].ranking if progress.rounds else ()
    if not ranking or not all(item.score.signature.size for item in ranking):
        return None
    callback("compare structures")
    items = [item for entry in progress.rounds for item in entry.ranking]
    refits = [one for item in items for one in (item.refit, item.beside) if one is not None]
    refits = [one for one in refits if np.isfinite(one.share)]
    corner = final.assembly.corner
    known = [(one.assembly, one.fit) for one in refits if one.assembly.fits(corner)]
    known += [(final.assembly, final.fit)] if final.assembly.steps else []
    # The noise is that which the best model has left.
    errors = {(entry.run, entry.output): entry for entry in final.fit_errors.entries}
    assembly, scores = beginning(first, ranking, corner, numerics.jobs)
    return structure_posterior(
        first.base(),
        assembly,
        scores,
        errors,
        numerics,
        prior=prior,
        known=known,
        later=scored_later(progress.rounds),
        callback=callback,
    )


def scored_later(rounds: Sequence[Round]) -> list[Score]:
    """Scores of candidates that the first round did not have, as they were at first."""
    first = {item.score.option.key for item in rounds[0].ranking}
    found: dict[Added, Score] = {}
    for entry in rounds[1:]:
        for item in entry.ranking:
            named = item.score.option.candidate.family != FAMILY
            if named and item.score.option.key not in first:
                found.setdefault(item.score.option.key, item.score)
    return list(found.values())


@dataclass(frozen=True)
class SearchOptions:
    """How a search is done; see :func:`close_loop`."""

    roles: Roles
    numerics: Numerics
    effects: Sequence[Effect] | None
    seed: int
    max_effects: int
    nonparametric: bool
    kept: Kept
    callback: ProgressCallback
    keep_columns: bool = False
    most_work: float = np.inf

    def ends(self, known: Progress) -> bool:
        """Whether a search has done the work after which it goes no further.

        One whose errors are as expected is near its end, and an effect on trial waits for the one
        that it was added for.
        """
        if self.most_work == np.inf or not known.rounds or known.rounds[-1].on_trial:
            return False
        return not known.state.at_floor and work_of(known) > self.most_work


def _went_no_further(known: Progress) -> bool:
    """Whether a search was ended by the work that it had done."""
    return known.finished and str(known.rounds[-1].reason).startswith(ENDS)


def searched(known: Progress, search: SearchOptions) -> Progress:
    """Continue a search to its end, with a review of its final effects."""
    if not (known.finished or known.state.at_floor):
        compile_shooting_meanwhile(known.state.fit.predictor, search.numerics.jobs)
    for left in reversed(range(search.max_effects + 1)):
        known = _rounds(known, search)
        if _went_no_further(known):
            break
        roles = _with_noise(search.roles, known)
        known = reviewed(
            known,
            roles,
            search.numerics,
            search.effects,
            search.callback,
            replacing=left > 0,
            before=search.kept.now,
        )
        if known.finished:
            break
        search.kept.later(known)
    return known


def _rounds(known: Progress, search: SearchOptions) -> Progress:
    """Continue a search until a round accepts no effect."""
    numerics, callback, max_effects = search.numerics, search.callback, search.max_effects
    roles, refused, together = _with_noise(search.roles, known), None, None
    ahead: tuple[Round, Roles] | None = None
    while not known.finished:
        rounds, state, notes = known.rounds, known.state, list(known.notes)
        callback(f"round {len(rounds) + 1}: {_ratios(state)}")
        limit = JUDGED if state is together else _limit(state, len(rounds), max_effects)
        if limit in ("", JUDGED) and search.ends(known):
            limit = ENDED
        outcome = None if limit else _looked_at(ahead, state, roles)
        if outcome is not None:
            search.kept.now()
        outcome = outcome or examine(
            state,
            roles,
            numerics,
            effects=search.effects,
            seed=search.seed,
            limit=limit,
            ahead=state is not refused and len(state.assembly.steps) + 2 <= max_effects,
            keep_columns=search.keep_columns,
            before=search.kept.now,
            callback=callback,
        )
        ahead = None if outcome._ahead is None else (outcome._ahead, roles)
        outcome = replace(outcome, _ahead=None)
        if rounds and rounds[-1].on_trial and _names_no_cause(outcome):
            callback("take back the last effect: no other one is confirmed with it")
            refused = rounds[-1].before
            known = replace(known, state=refused, rounds=rounds[:-1])
            roles = _with_noise(search.roles, known)
            continue
        if outcome.after is None and state is not together:
            tests = max(entry.tests for entry in (*rounds, outcome))
            together = judged_together(state, roles, numerics, tests, notes, callback)
            if together is not state:
                known = replace(known, state=together, notes=tuple(notes))
                continue
        curves = search.nonparametric and max_effects > 0 and outcome.reason != ENDED
        if outcome.after is None and curves:
            opening = rounds[0] if rounds else outcome
            room = len(state.assembly.steps) < max_effects
            outcome = with_nonparametric(
                outcome, opening, roles, numerics, room=room, callback=callback
            )
        if outcome.after is not None:
            notes = [note for note in notes if not note.startswith(TOGETHER)]
            before, state = state, outcome.after
            state = eliminated(state, before, roles, numerics, notes, callback)
            state = _in_corner(state, before, roles, numerics, notes, callback)
            noise = least_noise(roles.measured, state.errors.record_noise)
            roles = replace(roles, measured=noise)
        known = known.after(outcome, state, notes)
        if not _went_no_further(known):  # a longer search goes on with what was on trial
            search.kept.later(known)
    return known


def _in_corner(
    state: State,
    before: State,
    roles: Roles,
    numerics: Numerics,
    notes: list[str],
    callback: ProgressCallback,
) -> State:
    """The state with the corner of dry friction that is likeliest, and no effect that only made up
    for another one."""
    for _ in CORNERS:
        turned = cornered(state, roles, numerics, callback)
        if turned is state:
            break
        gone = [key for key in state.assembly.added if key not in turned.assembly.added]
        if gone:
            which = " and ".join(f"{effect} at {target}" for effect, target in gone)
            notes.append(
                f"removed again: {which}. With {turned.assembly.corner} as the corner of friction"
                " nothing is left for that to explain"
            )
        state = eliminated(turned, before, roles, numerics, notes, callback, last_too=True)
    return state


def _looked_at(ahead: tuple[Round, Roles] | None, state: State, roles: Roles) -> Round | None:
    """A round that was looked at before, by roles with the same noise; None if it was another."""
    if ahead is None:
        return None
    found, before = ahead
    same = found.before is state and before.measured == roles.measured
    return found if same and found.after is not None else None


def _names_no_cause(outcome: Round) -> bool:
    """Whether a round added nothing that names a cause."""
    return outcome.after is None or outcome.accepted is None or outcome.accepted.absorbs


def _with_noise(roles: Roles, known: Progress) -> Roles:
    """The roles with the smallest noise that the models of a search have found, including those
    of a resumed search."""
    for found in (known.first, known.state):
        noise = least_noise(roles.measured, found.errors.record_noise)
        roles = replace(roles, measured=noise)
    return roles


def _begun(
    assembly: Assembly,
    roles: Roles,
    numerics: Numerics,
    declared: ModelFit | None,
    effects: Sequence[Effect] | None,
    callback: ProgressCallback,
) -> Progress:
    """The declared model, estimated."""
    notes = [] if roles.strategy == "declared" else [roles.description]
    if declared is None:
        state = fit_state(assembly, roles, numerics, progress=callback)
    else:
        state = state_of(assembly, declared, roles)
    if not state.at_floor:
        callback("the residual exceeds the expected error: try other starts")
        start = better_start(state.fit, numerics, partial(_prepare, state, effects))
        if start is not None:
            found = fit_state(assembly, roles, numerics, start=start, progress=callback)
            rise = found.fit.point.objective - state.fit.point.objective
            if rise > 0:  # else the start, which was followed to near its optimum, promised more
                forget_options()
                state = found
                notes.append(
                    f"{OTHER_OPTIMUM} by {rise:.3g} in log density: check the declared values and"
                    " priors"
                )
    return Progress(state, state, notes=tuple(notes))


def _prepare(state: State, effects: Sequence[Effect] | None) -> None:
    """Look for the candidates of the first round, while another process tries other starts. What
    fails is met again in that round, if the state is still the one it is about."""
    with suppress(Exception):
        prepare_options(state.base(), state.assembly, effects)


def loop_of(progress: Progress, roles: Roles) -> ClosedLoop:
    """The result of a search, with remarks on its final model.

    Parameters
    ----------
    progress : Progress
        Ended; see :meth:`Progress.ended`.
    roles : Roles
    """
    progress = progress.with_same_noise()
    state = progress.state
    notes = [*progress.notes, *_warnings(state.fit), *_turned(progress.first.fit, state.fit)]
    notes += nonparametric_notes(progress.rounds)
    if state.assembly.has_corner and state.assembly.corner != ARCTANGENT:
        notes.append(
            f"{OTHER_CORNER} in {', '.join(state.assembly.cornered)}: {state.assembly.corner}, with"
            f" half the friction at v0; {ARCTANGENT} was not clearly likelier"
        )
    notes += [f"could not be predicted: run {text}" for text in state.unsolved]
    notes += state.too_quiet
    judged = any(note.startswith(TOGETHER) for note in notes)
    periodic = state.fit.all_periodic
    if progress.broken and state.assembly.steps and not (periodic or judged):
        notes.append(UNJUDGED)
    if not state.at_floor:
        notes.append(
            "a repeating error remains: intervals under independent errors would be too narrow"
        )
    return ClosedLoop(
        progress.rounds,
        progress.first,
        state,
        roles,
        tuple(notes),
        not progress.broken,
        state.policy,
    )


def _limit(state: State, rounds: int, max_effects: int) -> str:
    """Why a round may only rank; empty where it may add an effect."""
    steps, fit = state.assembly.steps, state.fit
    added = len(steps)
    if max_effects == 0:
        return "effects were to be ranked only, not added"
    if any(step.effect.family == FAMILY for step in steps):
        return "a nonparametric effect was added: the residual may be the error of its splines"
    if added >= max_effects:
        return f"the largest allowed number of effects, {max_effects}, has been added"
    if rounds > 2 * max_effects:
        return f"effects were added and removed again for {rounds} rounds"
    if _left_by_the_mesh(state):
        return (
            f"the mesh of {fit.steps} steps is too coarse: what is left may be the error of the"
            " solution"
        )
    return ""


def _left_by_the_mesh(state: State) -> bool:
    """Whether what finer steps would change is a large part of what is left of an output."""
    change = np.sqrt(np.mean(np.square(state.fit.mesh_error), axis=0))
    for output, size in zip(state.fit.predictor.outputs, change, strict=False):
        chosen = [e for e in state.fit_errors.entries if e.output == output]
        expected = np.mean([e.expected**2 for e in chosen])
        excess = max(float(np.mean([e.repeating**2 for e in chosen]) - expected), 0.0)
        if size**2 > max(OF_THE_MESH * excess, LEAST_OF_THE_MESH * expected):
            return True
    return False


def _ratios(state: State) -> str:
    parts = [
        f"{role} {output} {values['ratio_to_expected']:.2f}"
        for role, table in state.by_role.items()
        for output, values in table.items()
    ]
    return "ratio to the expected error: " + ", ".join(parts)


def _turned(first: ModelFit, final: ModelFit) -> list[str]:
    """A note on parameters that are opposite in sign to their declared values."""
    turned, least = [], final.policy.opposite_sign
    for name, value, sd in zip(final.problem.names, final.point.theta, final.point.sd, strict=True):
        declared = first.model.parameters.get(name)
        if declared is not None and declared.value * value < 0 and abs(value) > least * sd:
            turned.append(f"{name} = {value:.3g}")
    if not turned:
        return []
    return [f"{OTHER_SIGN}: {', '.join(turned)}; check the signs of equations and channels"]


def _warnings(fit: ModelFit) -> list[str]:
    found = []
    if not fit.point.status.ok:
        found.append(
            f"the estimate of the final model did not converge: {fit.point.status.message}"
        )
    if fit.point.on_limit:
        found.append(f"{ON_LIMIT}: {', '.join(fit.point.on_limit)}")
    found += fit.doubts
    return found
