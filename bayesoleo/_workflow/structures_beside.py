"""Probabilities of structures, and the runs that would tell them apart, computed in another process
while this one draws from the posterior, which does not depend on them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bayesoleo._parallel import single_blas_thread
from bayesoleo._worker_processes import Beside
from bayesoleo.discovery._loop import ClosedLoop, judged, structures_of
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._open_questions import Question, questions_of
from bayesoleo.discovery._predicted_experiment import Range
from bayesoleo.discovery._structures import StructurePosterior, StructurePrior


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
class Answer:
    """What it answers.

    Parameters
    ----------
    structures : StructurePosterior, str or None
        As of :func:`~bayesoleo.discovery._loop.structures_of`.
    questions : tuple of Question
    failed : Exception or None
        Why there are no questions.
    """

    structures: StructurePosterior | str | None
    questions: tuple[Question, ...] = ()
    failed: Exception | None = None

    def asked(self) -> tuple[Question, ...]:
        """The questions, or the error on the way to them."""
        if self.failed is not None:
            raise self.failed
        return self.questions


@single_blas_thread()  # as in the process that goes on meanwhile
def answer(asked: Asked) -> Answer:
    """Compare structures, then look for runs; nobody is told how far it has come."""
    loop = asked.loop
    assert loop.without_structures is not None
    found = structures_of(loop.without_structures, asked.numerics, asked.prior)
    try:
        questions = questions_of(judged(loop, found), asked.rig, asked.numerics, aim=asked.aim)
    except Exception as error:
        return Answer(found, failed=error)
    return Answer(found, questions)


def answer_later(asked: Asked, jobs: int | None) -> Beside[Asked, Answer] | None:
    """The answer when it is asked for; None where the loop has structures, or there are none."""
    return None if asked.loop.without_structures is None else Beside(answer, asked, jobs)
