"""The work of a search, after which a quick one goes no further.

Most searches end by themselves. Where a model lacks what the catalogue has not, each effect that is
added leaves another one significant, and a search of hundreds of estimates tells little more than
its first rounds. A quick search is to answer soon. It is ended by what it has done, not by a clock:
its result must not depend on the machine.
"""

from __future__ import annotations

from collections.abc import Iterable

from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._round import Progress

#: Work of a quick search.
QUICK = 3e8
#: How the reason begins why a quick search goes no further; of results that are stored too.
ENDS = "a quick search goes no further"
ENDED = (
    f"{ENDS}; without --quick (in Python quick=False) it looks for further effects, reviews those"
    " that were added, and says how probable they are"
)


def work_of(progress: Progress) -> float:
    """Samples that the estimates of a search predicted, times the unknowns that each had.

    Every evaluation predicts all samples of the fitted runs, and their change by each unknown.
    """
    return float(sum(map(_of_fit, _fits(progress))))


def _fits(progress: Progress) -> Iterable[ModelFit]:
    yield progress.first.fit
    for entry in progress.rounds:
        yield from (item.refit.fit for item in entry.ranking if item.refit is not None)
        if entry.after is not None:
            yield entry.after.fit


def _of_fit(fit: ModelFit) -> float:
    points = {id(point): point.evaluations for point in (fit.mbe, fit.point)}
    return sum(points.values()) * float(fit.problem.counts.sum()) * (1 + len(fit.problem.names))
