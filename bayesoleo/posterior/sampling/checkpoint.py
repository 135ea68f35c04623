"""Where segments go: files that are never changed, or memory.

A segment is written under another name, synchronised and renamed, so that a file with a segment's
name is whole; a checksum inside tells if it is not after all. The generator's state lies in the
same file, so that a killed run continues to the same draws.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from bayesoleo.errors import ResultsError
from bayesoleo.posterior.approximation.mixture import Mixture
from bayesoleo.posterior.sampling.segment import Phase, Segment
from bayesoleo.storage.atomic import replacing
from bayesoleo.storage.lock import only_writer

_NAME = "segment-{:06d}.npz"
_COUNTERS = ("failures", "proposed", "accepted")


class Store(Protocol):
    """Where a run finds the segments it has and puts the next one."""

    @property
    def segments(self) -> list[Segment]:
        """All segments so far."""

    def append(self, segment: Segment) -> None:
        """Add one."""


class MemoryStore:
    """Segments of a run that is not saved."""

    def __init__(self) -> None:
        self.segments: list[Segment] = []

    def append(self, segment: Segment) -> None:
        """Add one."""
        self.segments.append(segment)


class FolderStore:
    """Segments in a folder; use :func:`open_store`, which holds the lock.

    Parameters
    ----------
    folder : Path
        An existing folder.
    fingerprint : str
        Identifies the run: problem, priors, seed, settings.

    Raises
    ------
    ResultsError
        If the folder holds segments of another run.
    """

    def __init__(self, folder: Path, fingerprint: str) -> None:
        self.folder, self.fingerprint = folder, fingerprint
        self.segments: list[Segment] = []
        for leftover in folder.glob(".segment-*"):  # of a run that was killed amid writing
            leftover.unlink()
        self._load_good_prefix()

    def append(self, segment: Segment) -> None:
        """Write one durably.

        Raises
        ------
        ResultsError
            If it cannot be written (a full disk); what was written before is untouched.
        """
        with replacing(self.folder / _NAME.format(len(self.segments))) as draft:
            draft.write_bytes(encode(segment, self.fingerprint, len(self.segments)))
        self.segments.append(segment)

    def _load_good_prefix(self) -> None:
        """Load up to the first segment that is missing or broken; set aside what comes after it."""
        for index in range(len(list(self.folder.glob("segment-*.npz")))):
            path = self.folder / _NAME.format(index)
            try:
                segment, fingerprint = decode(path.read_bytes(), index)
            except _BROKEN:
                break
            if fingerprint != self.fingerprint:
                raise ResultsError(
                    "this folder holds draws of another problem, seed or setting",
                    file=self.folder,
                    hint=f"remove {self.folder} to draw anew, or write to another folder",
                )
            self.segments.append(segment)
        for path in sorted(self.folder.glob("segment-*.npz")):
            if int(path.stem.split("-")[1]) >= len(self.segments):
                set_aside(path)


class _BrokenSegmentError(Exception):
    """The file is not a whole segment."""


#: What reading a truncated or altered archive can raise.
_BROKEN = (
    _BrokenSegmentError,
    OSError,
    EOFError,
    KeyError,
    ValueError,
    zipfile.BadZipFile,
    zlib.error,
)


def set_aside(path: Path) -> None:
    """Rename a broken file so that it is neither read nor overwritten."""
    number = 0
    while (aside := path.with_suffix(f".broken-{number}")).exists():
        number += 1
    path.rename(aside)


def encode(segment: Segment, fingerprint: str, index: int) -> bytes:
    """Bytes of an ``npz`` archive that holds a segment and its checksum."""
    name, keys, position, has_gauss, cached = segment.random_state
    counters = {key: dict(getattr(segment, key)) for key in _COUNTERS}
    about = {
        "index": index,
        "fingerprint": fingerprint,
        "phase": segment.phase,
        "evaluations": segment.evaluations,
        "branch_jumps": segment.branch_jumps,
        "generator": [name, int(position), int(has_gauss)],
        **counters,
    }
    arrays: dict[str, NDArray[Any]] = {
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
    arrays["checksum"] = _checksum(arrays)
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, **cast("dict[str, Any]", arrays))
    return buffer.getvalue()


def decode(content: bytes, index: int) -> tuple[Segment, str]:
    """Segment and fingerprint out of an archive's bytes; one of many errors if it is not whole."""
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = {key: archive[key] for key in archive.files}
    checksum = arrays.pop("checksum")
    about = json.loads(bytes(arrays["about"]).decode())
    if not np.array_equal(checksum, _checksum(arrays)) or about["index"] != index:
        raise _BrokenSegmentError
    name, position, has_gauss = about["generator"]
    mixture = Mixture(
        arrays["centres"], arrays["covariances"], arrays["log_weights"], arrays["degrees"]
    )
    segment = Segment(
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
        branch_jumps=about.get("branch_jumps", 0),  # absent from segments of older versions
    )
    return segment, about["fingerprint"]


def _checksum(arrays: dict[str, NDArray[Any]]) -> NDArray[np.uint8]:
    digest = hashlib.sha256()
    for key in sorted(arrays):
        array = np.ascontiguousarray(arrays[key])
        digest.update(f"{key}{array.dtype.str}{array.shape}".encode())
        digest.update(array.tobytes())
    return np.frombuffer(digest.digest(), dtype=np.uint8)


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
    if folder is None:
        yield MemoryStore()
        return
    with only_writer(folder):
        yield FolderStore(Path(folder), fingerprint)
