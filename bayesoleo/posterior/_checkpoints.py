"""Segments of the chains, stored so that sampling can resume.

A segment holds draws together with everything that is needed to continue. Segments are numbered
files on disk, or stay in memory. The state of the random generator is in the same file as the
draws, so that an interrupted run continues to the same draws.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from bayesoleo._storage.files import only_writer
from bayesoleo._storage.resume import Arrays, Slots
from bayesoleo._types import Array, Float, Int, Integers
from bayesoleo.posterior._mixture import Mixture
from bayesoleo.solvers._orbit import Status

#: Reasons for a density of zero, in the order of :attr:`Segment.failed`.
REASONS = tuple(status.name.lower() for status in Status if not status.ok)
Phase = Literal["start", "warm-up", "kept"]
#: ``numpy.random.RandomState.get_state()``
RandomState = tuple[str, NDArray[np.uint32], int, int, float]
_COUNTERS = ("failures", "proposed", "accepted")
_FOREIGN = "this folder holds draws of another problem, seed or setting"


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


class Store:
    """The segments that a run has, and where it puts the next one; see :func:`open_store`.

    Parameters
    ----------
    slots : Slots
        Each piece a segment.

    Raises
    ------
    ResultsError
        If the folder holds segments of another run.
    """

    def __init__(self, slots: Slots) -> None:
        self._slots = slots
        self.segments = [decode(arrays) for arrays in slots.chain()]

    def append(self, segment: Segment) -> None:
        """Write one durably.

        Raises
        ------
        ResultsError
            If it cannot be written (a full disk); what was written before is untouched.
        """
        self._slots.write(len(self.segments), encode(segment))
        self.segments.append(segment)


def encode(segment: Segment) -> Arrays:
    """A segment as named arrays."""
    name, keys, position, has_gauss, cached = segment.random_state
    counters = {key: dict(getattr(segment, key)) for key in _COUNTERS}
    about = {
        "phase": segment.phase,
        "evaluations": segment.evaluations,
        "branch_jumps": segment.branch_jumps,
        "generator": [name, int(position), int(has_gauss)],
        **counters,
    }
    return {
        "coords": segment.coords,
        "log_density": segment.log_density,
        "by_run": segment.by_run,
        "failed": segment.failed,
        "generator_keys": np.asarray(keys, dtype=np.uint32),
        "generator_cached": np.array(cached, dtype=float),
        "centres": segment.mixture.centres,
        "covariances": segment.mixture.covariances,
        "log_weights": segment.mixture.log_weights,
        "degrees": np.asarray(segment.mixture.degrees),
        "about": np.frombuffer(json.dumps(about, sort_keys=True).encode(), dtype=np.uint8),
    }


def decode(arrays: Arrays) -> Segment:
    """The segment of :func:`encode`."""
    about = json.loads(bytes(arrays["about"]).decode())
    name, position, has_gauss = about["generator"]
    mixture = Mixture(
        arrays["centres"], arrays["covariances"], arrays["log_weights"], arrays["degrees"]
    )
    return Segment(
        phase=cast("Phase", about["phase"]),
        coords=arrays["coords"],
        log_density=arrays["log_density"],
        by_run=arrays["by_run"],
        failed=arrays["failed"],
        random_state=(
            name,
            arrays["generator_keys"],
            position,
            has_gauss,
            float(arrays["generator_cached"]),
        ),
        mixture=mixture,
        evaluations=about["evaluations"],
        failures=Counter(about["failures"]),
        proposed=Counter(about["proposed"]),
        accepted=Counter(about["accepted"]),
        branch_jumps=about["branch_jumps"],
    )


@contextmanager
def open_store(folder: Path | None, fingerprint: str) -> Iterator[Store]:
    """Open the place for a run's segments and keep other processes out.

    Parameters
    ----------
    folder : Path or None
        Made if it does not exist; None keeps the segments in memory.
    fingerprint : str
        Identifies the run.

    Yields
    ------
    Store
        With the segments that are there.

    Raises
    ------
    ResultsError
        If another process writes there, or the folder holds another run.
    """
    with only_writer(folder):
        yield Store(Slots(folder, fingerprint, name="segment", foreign=_FOREIGN))
