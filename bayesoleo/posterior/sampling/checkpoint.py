"""Where segments go: numbered pieces on disk, or memory.

The generator's state lies in the same file as the draws, so that a killed run continues to the same
draws.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import numpy as np

from bayesoleo.posterior.approximation.mixture import Mixture
from bayesoleo.posterior.sampling.segment import Phase, Segment
from bayesoleo.storage.lock import only_writer
from bayesoleo.storage.slots import Arrays, Slots

_COUNTERS = ("failures", "proposed", "accepted")
_FOREIGN = "this folder holds draws of another problem, seed or setting"


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
