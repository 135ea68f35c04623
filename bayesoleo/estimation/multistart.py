"""Several starts, and the distinct modes that they lead to."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from bayesoleo.errors import InputError
from bayesoleo.estimation.estimate import estimate, polish
from bayesoleo.estimation.point import PointEstimate
from bayesoleo.estimation.problem import Array, Problem
from bayesoleo.model.correlated import sample_of
from bayesoleo.parallel import thread_map
from bayesoleo.solvers.status import count


@dataclass(frozen=True, eq=False)
class Modes:
    """Distinct modes of the posterior, the highest first.

    Parameters
    ----------
    modes : tuple of PointEstimate
        Each the best of the estimates that ended there.
    hits : tuple of int
        Number of estimates that ended in each.
    status : dict of str to int
        How all estimates ended, by name.
    """

    modes: tuple[PointEstimate, ...]
    hits: tuple[int, ...]
    status: dict[str, int]

    def __len__(self) -> int:
        return len(self.modes)

    def __iter__(self) -> Iterator[PointEstimate]:
        return iter(self.modes)

    def __getitem__(self, index: int) -> PointEstimate:
        return self.modes[index]


def multistart(
    problem: Problem,
    starts: int | ArrayLike = 8,
    rng: np.random.Generator | None = None,
    *,
    distance: float = 0.1,
    tolerance: float = 1e-6,
    max_iterations: int = 50,
    jobs: int | None = 1,
    progress: Callable[[int, PointEstimate], None] | None = None,
) -> Modes:
    """Find the posterior's modes from several starts.

    From each start two ways are gone: MBE followed by BE, which reaches the mode that the data
    want, and BE alone, which also reaches a mode near the prior's centre.

    Parameters
    ----------
    problem : Problem
    starts : int or array_like, shape (m, l), optional
        Number of starts drawn from the priors, or the starts. The problem's own comes on top.
    rng : numpy.random.Generator, optional
        Draws the starts; needed if ``starts`` is a number above zero.
    distance : float, optional
        Modes nearer than this, in posterior standard deviations, are one.
    tolerance, max_iterations
        As in :func:`~bayesoleo.estimation.estimate`.
    jobs : int, optional
        Threads over starts; None for all cores. The default leaves the threads to the problem.
    progress : callable, optional
        Called with the index and the result of each start that is done.

    Returns
    -------
    Modes
        Empty of modes if no estimate converged; ``status`` tells why.

    Raises
    ------
    InputError
        If ``rng`` is missing, or a given start does not fit.
    """
    options = {"tolerance": tolerance, "max_iterations": max_iterations}

    def both_ways(item: tuple[int, Array]) -> list[PointEstimate]:
        index, start = item
        direct = estimate(problem, "be", start=start, **options)  # type: ignore[arg-type]
        robust = estimate(problem, "mbe", start=start, **options)  # type: ignore[arg-type]
        found = [direct]
        if np.isfinite(robust.objective):
            found.append(polish(problem, robust, **options))  # type: ignore[arg-type]
        if progress is not None:
            progress(index, found[-1])
        return found

    begins = enumerate(_starts(problem, starts, rng))
    points = [point for pair in thread_map(both_ways, begins, jobs) for point in pair]
    modes, hits = _merge([point for point in points if point.status.ok], distance)
    return Modes(modes, hits, count([int(point.status) for point in points]))


def _starts(
    problem: Problem, starts: int | ArrayLike, rng: np.random.Generator | None
) -> list[Array]:
    own = np.array(problem.start, dtype=float)
    if not isinstance(starts, int):
        given = np.array(starts, dtype=float).reshape(-1, own.size)
        return [own, *given]
    if starts < 0:
        raise InputError("number of starts must not be negative", key="starts", value=starts)
    if starts and rng is None:
        raise InputError(
            "drawing starts needs a generator", key="rng", hint="pass numpy.random.default_rng(1)"
        )
    if not starts or rng is None:
        return [own]
    return [own, *sample_of(problem.priors, rng, starts)]


def _merge(
    points: list[PointEstimate], distance: float
) -> tuple[tuple[PointEstimate, ...], tuple[int, ...]]:
    modes: list[PointEstimate] = []
    hits: list[int] = []
    for point in sorted(points, key=lambda point: -point.objective):
        for index, mode in enumerate(modes):
            if _separation(mode, point) < distance:
                hits[index] += 1
                break
        else:
            modes.append(point)
            hits.append(1)
    return tuple(modes), tuple(hits)


def _separation(mode: PointEstimate, other: PointEstimate) -> float:
    """Mahalanobis distance by the higher mode's covariance."""
    away, sd = (other.theta - mode.theta) / mode.sd, mode.sd
    try:
        factor = cho_factor(mode.covariance / np.outer(sd, sd))
    except LinAlgError:
        return float(np.linalg.norm(away))
    return float(np.sqrt(max(0.0, away @ cho_solve(factor, away))))
