"""Keep a calculation's state on disk, so that the same calculation goes on after it was stopped.

The state is pickled: a file is only read where its first line carries the key of the calculation
that asks for it and its content is whole. Pickles are code; go on only in folders of your own.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cloudpickle

from bayesoleo.storage.atomic import replacing

Key = Mapping[str, str]
_FORMAT = "bayesoleo state 1"


def keep_state(path: str | os.PathLike[str], key: Key, state: Any) -> None:
    """Write a state in place of an older one, as a whole or not at all.

    Parameters
    ----------
    path : path-like
        File.
    key : mapping of str to str
        What the calculation depends on, each with a digest of it.
    state : object
        Anything that can be pickled.

    Raises
    ------
    ResultsError
        If the place cannot be written to.
    """
    content = cloudpickle.dumps(state)
    head = {"format": _FORMAT, "key": dict(key), "sha256": hashlib.sha256(content).hexdigest()}
    with replacing(path) as draft:
        draft.write_bytes(json.dumps(head).encode() + b"\n" + content)


def kept_state(path: str | os.PathLike[str], key: Key) -> tuple[Any, str]:
    """The state of a calculation, and why there is none.

    Parameters
    ----------
    path : path-like
        File of :func:`keep_state`.
    key : mapping of str to str
        As it must have been when the state was kept.

    Returns
    -------
    state : object
        None if there is none that can be used.
    reason : str
        In that case; empty where there is no file.
    """
    try:
        head_line, _, content = Path(path).read_bytes().partition(b"\n")
        head = json.loads(head_line)
        stored, checksum, kind = head["key"], head["sha256"], head["format"]
    except FileNotFoundError:
        return None, ""
    except (OSError, ValueError, KeyError, TypeError):
        return None, "it cannot be read"
    if kind != _FORMAT or hashlib.sha256(content).hexdigest() != checksum:
        return None, "it is damaged"
    names = [*key, *(stored.keys() - key.keys())]
    other = [name for name in names if stored.get(name) != key.get(name)]
    if other:
        return None, f"it belongs to {' and '.join(f'another {name}' for name in other)}"
    try:
        return cloudpickle.loads(content), ""
    # A pickle can fail in any way, for example where a file of the user has moved.
    except Exception as error:
        return None, f"it cannot be read ({type(error).__name__}: {error})"
