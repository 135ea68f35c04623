"""Registered data sets: a folder of the user's, or a verified download."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from bayesoleo.errors import CampaignError, import_extra

#: Environment variable with a folder laid out as ``measured/<name>``, ``campaigns/<name>``,
#: ``nist``.
VARIABLE = "BAYESOLEO_DATA"


@dataclass(frozen=True)
class RegisteredSet:
    """A measured set that can be fetched.

    Parameters
    ----------
    url : str
        Upstream folder, pinned to a commit.
    hashes : dict of str to str
        SHA-256 of each file.
    """

    url: str
    hashes: dict[str, str]


REGISTERED = {
    "silverbox": RegisteredSet(
        "https://raw.githubusercontent.com/antonior92/sysid-neuralnet/"
        "8da23c9810f738aececa6058a53e40e9a621e5bc/data/SilverboxFiles/",
        {
            "Schroeder80mV.mat": "ec5a9740a4789aa20b9d84f387424c0218e843844807b30b367c218778339fb6",
        },
    ),
    "mr_damper": RegisteredSet(
        "https://raw.githubusercontent.com/labcontrol-data/mr-damper/"
        "e42439f08b227bb08e9923ee2736bedf2f4fe59a/data/",
        {
            "ensaio1.1.mat": "b7e1a8303ac125f147857db1d020c52bd9c471e7866ab5344b62d91191eddcf2",
            "ensaio3.1.mat": "fa929378aea5f85655eb5746fe230556f592f6abc28b152b03c2b807c17a85c8",
            "ensaio5.1.mat": "7c610cd351fd2e3f684d0f8ff34c32e507d657ae9f695e9c34ac691212f4ee3b",
            "ensaio7.1.mat": "e5519b81cd7df238a20a0cb61f7d860828eddf23a4a315ff9b727508062033fa",
        },
    ),
    "mbari_gas_spring": RegisteredSet(
        "https://raw.githubusercontent.com/osrf/mbari_wec_gz/"
        "71fe25a249e74a220e1448354f979f42a7ae9208/buoy_tests/test_inputdata/",
        {
            "2022.01.28T16.46.31.exp": (
                "f18f9ee7f744d79baf2474cbdb01afdf2287e0e3979da8e8f3442d2d7453cd2d"
            ),
            "2022.12.21T15.44.24_VentedSpring.exp": (
                "925dcd71cdef0c4d48a07a18989428fbead86d3d53d04cce9518bfbb20941269"
            ),
        },
    ),
}


def dataset_folder(name: str, files: Sequence[str] = ()) -> Path:
    """Folder that holds the files of a data set.

    Looked up in the folder that ``BAYESOLEO_DATA`` names; else, for measured sets, fetched once
    into the user's cache. Files with a registered SHA-256 are verified either way.

    Parameters
    ----------
    name : str
        ``silverbox``, ``mr_damper``, ``mbari_gas_spring``, ``nist``, or a campaign such as
        ``shaker-plain``.
    files : sequence of str
        Files wanted; by default all registered ones.

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    CampaignError
        If the set is unknown or not there, or a file is not the registered one.
    MissingExtraError
        If the set has to be fetched and pooch is not installed.
    """
    known = REGISTERED.get(name)
    wanted = tuple(files) or (tuple(known.hashes) if known else ())
    local = _local_folder(name)
    if local is not None and all((local / file).is_file() for file in wanted):
        for file in wanted:
            _verify(local / file, known.hashes.get(file) if known else None)
        return local
    if known is None:
        raise CampaignError(
            "data set is not here and cannot be fetched",
            key="dataset",
            value=name,
            hint=f"set {VARIABLE} to a folder with campaigns/<name> or nist, "
            f"or name one of {', '.join(REGISTERED)}",
        )
    return _fetch(name, known, wanted)


def _local_folder(name: str) -> Path | None:
    root = os.environ.get(VARIABLE)
    if not root or Path(name).name != name:
        return None
    candidates = (
        Path(root) / "measured" / name,
        Path(root) / "campaigns" / name,
        Path(root) / name,
    )
    return next((folder for folder in candidates if folder.is_dir()), None)


def _verify(path: Path, expected: str | None) -> None:
    if expected is None:
        return
    state = path.stat()
    found = _digest(path, state.st_mtime_ns, state.st_size)
    if found != expected:
        raise CampaignError(
            "file is not the registered one (SHA-256 differs)",
            file=path.name,
            value=found[:12],
            hint=f"expected {expected[:12]}; remove it, and it is fetched again",
        )


@cache
def _digest(path: Path, modified: int, size: int) -> str:
    """SHA-256 of a file; modification time and size make a changed file a new entry."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _fetch(name: str, known: RegisteredSet, wanted: Sequence[str]) -> Path:
    pooch = import_extra("pooch", "data")
    unknown = [file for file in wanted if file not in known.hashes]
    if unknown:
        raise CampaignError(
            f"{name} has no such registered file",
            file=unknown[0],
            hint=f"it has {', '.join(known.hashes)}",
        )
    folder = Path(pooch.os_cache("bayesoleo")) / name
    try:
        fetcher = pooch.create(path=folder, base_url=known.url, registry=known.hashes)
        for file in wanted:
            fetcher.fetch(file)
    except (
        Exception
    ) as error:  # network libraries raise many types; all mean that the file is not here
        raise CampaignError(
            f"cannot fetch {name}: {str(error)[:120]}",
            key="dataset",
            value=name,
            hint=f"put the files into measured/{name} under a folder and set {VARIABLE} to it",
        ) from error
    return folder
