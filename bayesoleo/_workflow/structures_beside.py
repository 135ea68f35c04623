"""Probabilities of structures, and the runs that would tell them apart, computed in another process
while this one draws from the posterior, which does not depend on them; then figures of the search.

While this one would wait for the answer, it draws figures of the posterior.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Self

import xarray as xr

from bayesoleo._parallel import single_blas_thread
from bayesoleo._report.page_figures import (
    Part,
    Pictures,
    draw_ahead,
    parts_ahead,
    parts_of_draws,
    shared_by,
)
from bayesoleo._types import ProgressCallback
from bayesoleo._worker_processes import Beside, start_ahead
from bayesoleo._workflow.output import PROPOSALS_STAGE, SEARCH_STAGE, reason_of
from bayesoleo.discovery._loop import ClosedLoop, judged, structures_of
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._open_questions import Question, questions_of
from bayesoleo.discovery._predicted_experiment import Range
from bayesoleo.discovery._refit import Refit
from bayesoleo.discovery._score_tests import Score
from bayesoleo.discovery._structures import StructurePosterior, StructurePrior

#: What candidates were ranked by, and nothing asks for once they are: a fifth of all that is sent.
ONLY_RANKED_BY = {Score: ("contribution",), Refit: ("contribution",)}


@dataclass(frozen=True)
class Asked:
    """What the other process is asked.

    Parameters
    ----------
    loop : ClosedLoop
        Without its structures.
    numerics : Numerics
    prior : StructurePrior
    rig : mapping of str to (float, float)
        Limits of new runs, SI.
    aim : str
        What new runs are for.
    """

    loop: ClosedLoop
    numerics: Numerics
    prior: StructurePrior
    rig: Mapping[str, Range]
    aim: str


@dataclass(frozen=True)
class Failure:
    """A stage that failed.

    Parameters
    ----------
    stage, reason : str
        The reason names the place in the code, which an error forgets on its way here.
    error : Exception
    """

    stage: str
    reason: str
    error: Exception


@dataclass(frozen=True)
class Answer:
    """What it answers.

    Parameters
    ----------
    structures : StructurePosterior, str or None
        As of :func:`~bayesoleo.discovery._loop.structures_of`.
    questions : tuple of Question
    failure : Failure or None
        Of the stage ``search``, without structures, or ``proposals``, without questions.
    """

    structures: StructurePosterior | str | None = None
    questions: tuple[Question, ...] = ()
    failure: Failure | None = None


@single_blas_thread()  # as in the process that goes on meanwhile
def answer(asked: Asked, callback: ProgressCallback = lambda _: None) -> Answer:
    """Compare structures, then look for runs."""
    loop, found, stage = asked.loop, None, SEARCH_STAGE
    assert loop.without_structures is not None
    try:
        found = structures_of(loop.without_structures, asked.numerics, asked.prior, callback)
        loop, stage = judged(loop, found), PROPOSALS_STAGE
        if not loop.complete:
            return Answer(found)
        questions = questions_of(loop, asked.rig, asked.numerics, aim=asked.aim, callback=callback)
    except Exception as error:
        return Answer(found, failure=Failure(stage, reason_of(error), error))
    return Answer(found, questions)


def answered(asked: Asked, callback: ProgressCallback) -> Answer | None:
    """The answer, found here; None where nothing is asked."""
    return None if asked.loop.without_structures is None else answer(asked, callback)


def begun_beside(asked: Asked, jobs: int | None) -> Beside[Asked, Answer] | None:
    """The answer, which another process begins to look for; None where that has to be done here, or
    nothing is asked. Nobody is told how far the other process has come.

    Parameters
    ----------
    asked : Asked
    jobs : int, optional
        Processes, this one included.
    """
    if asked.loop.without_structures is None:
        return None
    return Beside.begun(answer, asked, jobs, without=ONLY_RANKED_BY)


def drawn_beside(beside: Beside[Asked, Answer], shown: xr.DataTree) -> None:
    """Have the process draw figures once it has the answer, until they are wanted.

    Parameters
    ----------
    beside : Beside
    shown : DataTree
        Of the search alone. What cannot be sent is drawn here, later.
    """
    with suppress(Exception):
        beside.go_on_with(draw_ahead, shared_by(shown), parts_ahead(shown))


class Early[K]:
    """The answer to what a search asks, begun before it is known whether its result stands.

    An exception that leaves it ends the other process.

    Parameters
    ----------
    begin : callable
        Of a loop: anything to keep with the answer, and the answer as of :func:`begun_beside`. What
        it raises is not passed on: what no other process does is done here.
    jobs : int, optional
        Processes, this one included.
    """

    def __init__(
        self,
        begin: Callable[[ClosedLoop], tuple[K | None, Beside[Asked, Answer] | None]],
        jobs: int | None,
    ) -> None:
        self._begin, self._jobs = begin, jobs
        self._loop: ClosedLoop | None = None
        self._known: K | None = None
        self._beside: Beside[Asked, Answer] | None = None

    def __call__(self, loop: ClosedLoop) -> Callable[[], None]:
        """Begin, for a result that may be replaced; returns :meth:`drop`."""
        self._loop = loop
        with suppress(Exception):
            self._known, self._beside = self._begin(loop)
        return self.drop

    def drop(self) -> None:
        """End what was begun, and have a process ready for what comes."""
        if self._beside is not None:
            self._beside.drop()
            start_ahead(jobs=self._jobs)
        self._loop = self._known = self._beside = None

    def of(self, loop: ClosedLoop) -> tuple[K | None, Beside[Asked, Answer] | None]:
        """What was begun for this loop, or is now."""
        if loop is not self._loop:
            self.drop()
            self(loop)
        return self._known, self._beside

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if kind is not None and self._beside is not None:
            self._beside.drop()


@dataclass(frozen=True)
class DrawnAhead:
    """Figures drawn ahead: an :class:`~bayesoleo._report.page_figures.Ahead`.

    Parameters
    ----------
    beside : Beside
        Has its answer.
    drawn : mapping
        Figures that were drawn in this process.
    """

    beside: Beside[Asked, Answer]
    drawn: Pictures

    @property
    def goes_on(self) -> bool:
        """Whether the other process draws."""
        return self.beside.goes_on

    def end_with(self, tree: xr.DataTree, part: Part) -> None:
        """Have it draw this figure next, and no other after it. What cannot be sent is drawn here,
        later."""
        with suppress(Exception):
            self.beside.end_with(draw_ahead, shared_by(tree), part)

    def pictures(self) -> Pictures:
        """Figures that the other process has drawn, and those from here."""
        found = self.beside.taken().values()
        return {**dict(drawn for drawn in found if drawn is not None), **self.drawn}


def pictures_meanwhile(beside: Beside[Asked, Answer], tree: xr.DataTree) -> Pictures:
    """Figures of the draws in a tree, drawn here until the other process has its answer.

    No more of them: that process draws too once it has answered, and this one has to write.
    """
    found, shared = dict[Part, list[Any]](), shared_by(tree)
    for part in parts_of_draws(tree):
        if beside.answered:
            break
        found |= dict(filter(None, [draw_ahead(shared, part)]))
    return found
