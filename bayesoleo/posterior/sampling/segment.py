"""A stretch of the chains together with everything that continuing after it needs."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array, Float, Int, Integers
from bayesoleo.posterior.approximation.mixture import Mixture
from bayesoleo.solvers.status import Status

#: Reasons for a density of zero, in the order of :attr:`Segment.failed`.
REASONS = tuple(status.name.lower() for status in Status if not status.ok)
Phase = Literal["start", "warm-up", "kept"]
#: ``numpy.random.RandomState.get_state()``
RandomState = tuple[str, NDArray[np.uint32], int, int, float]


@dataclass(frozen=True)
class Segment:
    """Consecutive draws of all walkers.

    Parameters
    ----------
    phase : {"start", "warm-up", "kept"}
        What the draws are for.
    coords : ndarray, shape (draws, chains, d)
        Coordinates without bounds.
    log_density : ndarray, shape (draws, chains)
        Log density of each draw.
    by_run : ndarray, shape (draws, chains, N)
        Log-likelihood of each draw by run.
    random_state : tuple
        Generator's state after the last draw.
    mixture : Mixture
        What the independence move proposes from after this segment.
    evaluations : int
        Rows of the log density that the segment took.
    failures : collections.Counter
        Rows of density zero by reason.
    proposed, accepted : collections.Counter
        Proposals by kind of move.
    failed : ndarray of int, shape (draws, reasons)
        Proposals of density zero on the way to each draw, by :data:`REASONS`.
    branch_jumps : int
        Solutions of runs that left the branch of the one they started from.
    """

    phase: Phase
    coords: Float[Array, "draws chains coordinates"]
    log_density: Float[Array, "draws chains"]
    by_run: Float[Array, "draws chains runs"]
    random_state: RandomState
    mixture: Mixture
    evaluations: int
    failures: Counter[str] = field(default_factory=Counter)
    proposed: Counter[str] = field(default_factory=Counter)
    accepted: Counter[str] = field(default_factory=Counter)
    branch_jumps: int = 0
    failed: Int[Integers, "_draws reasons"] = field(
        default_factory=lambda: np.zeros((0, len(REASONS)), dtype=np.int64)
    )

    @property
    def draws(self) -> int:
        """Number of draws of each walker."""
        return len(self.coords)
