"""Results on disk: one DataTree as netCDF (one file) or Zarr (a folder), with its provenance.

A tree is read as it was written: NaN padding, text, booleans, units. Encodings of an earlier file
that xarray remembers (chunks, compression, fill values) are dropped, since a tree read from one
format could not be written as the other otherwise.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import platform
import re
import warnings
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._storage.files import (
    SUMS,
    changed_files,
    current,
    read_sums,
    replacing,
    sha256,
    write_bytes_atomic,
)
from bayesoleo.errors import DataWarning, MissingExtraError, ResultsError, import_extra

PACKAGES = (
    "bayesoleo",
    "numpy",
    "scipy",
    "sympy",
    "numba",
    "xarray",
    "emcee",
    "arviz-stats",
    "h5netcdf",
)
"""Those whose version can change a number in the result."""


def provenance(seed: int | None, **more: Any) -> dict[str, Any]:
    """Root attributes that say where a result comes from.

    Parameters
    ----------
    seed : int or None
        Seed of the random generator; None where nothing was drawn.
    **more
        Further attributes, named as in :mod:`bayesoleo._schema` (``campaign=``, ``model=``, …).
        Dicts and lists become JSON; those that are None are left out, since a file has no place for
        them.

    Returns
    -------
    dict
        Ready for ``tree.attrs.update``.
    """
    attributes: dict[str, Any] = {schema.FORMAT_ATTRIBUTE: schema.FORMAT}
    for package in PACKAGES:
        attributes[f"{package}_version"] = package_version(package)
    attributes["python_version"] = platform.python_version()
    attributes["platform"] = f"{platform.system()} {platform.machine()}"
    attributes[schema.CREATED] = datetime.now(UTC).isoformat(timespec="seconds")
    attributes[schema.SEED] = seed
    attributes.update(more)
    return {name: _plain(value) for name, value in attributes.items() if value is not None}


def package_version(package: str) -> str:
    """Installed version; a source tree on the path has none."""
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _plain(value: Any) -> Any:
    """A value as an attribute can hold it."""
    if isinstance(value, dict | list | tuple):
        return json.dumps(value, ensure_ascii=False)
    return value if isinstance(value, int | float) else str(value)


LARGE = 4096
"""Arrays with more elements than this are compressed; below it a chunk's overhead eats the gain."""


def write_tree(tree: xr.DataTree, path: str | os.PathLike[str]) -> None:
    """Write a result as a whole or not at all.

    Parameters
    ----------
    tree : DataTree
        Laid out as :mod:`bayesoleo._schema` names it. It is not changed.
    path : path-like
        Ends in ``.zarr`` for Zarr; netCDF otherwise. Missing parents are made, an older result is
        replaced.

    Raises
    ------
    ResultsError
        The place cannot be written to; an older result there is untouched.
    MissingExtraError
        The path ends in ``.zarr`` and Zarr is not installed.
    MemoryError
        A copy of the result does not fit into memory.
    """
    if _is_zarr(path):
        import_extra("zarr", "zarr")
    storable = _storable(tree)
    if _is_zarr(path):
        with replacing(path) as draft:
            _write_zarr(storable, draft)
    else:
        write_bytes_atomic(path, netcdf_bytes(storable))


def read_tree(path: str | os.PathLike[str]) -> xr.DataTree:
    """Read a result into memory and close its file.

    Parameters
    ----------
    path : path-like
        Written by :func:`write_tree`.

    Returns
    -------
    DataTree

    Raises
    ------
    ResultsError
        The file is missing, empty, cut short, changed, of another kind or from a later version.
    MissingExtraError
        The path ends in ``.zarr`` and Zarr is not installed.
    """
    place = Path(path)
    path = current(place)
    _check_exists(path)
    try:
        tree = _read_zarr(path) if _is_zarr(path) else _read_netcdf(path)
    except (MissingExtraError, ResultsError, MemoryError):
        raise
    # A damaged file shows itself as almost anything, depending on where it is damaged.
    except Exception as error:
        problem = "cannot be read; it is damaged, cut short or not a netCDF or Zarr result"
        raise _damaged(path, problem) from error
    _check_format(tree, path)
    tree.attrs.pop(_ZARR_SUM, None)
    _check_beside(place)
    return tree.map_over_datasets(_clean)


def read_attributes(path: str | os.PathLike[str]) -> dict[str, Any]:
    """What a netCDF result says of itself, without its arrays; nothing if it cannot be read."""
    try:
        _check_sum(current(Path(path)))
        with xr.open_dataset(current(Path(path)), engine="h5netcdf", decode_times=False) as root:
            return dict(root.attrs)
    except Exception:  # as above: damage has many faces
        return {}


def _storable(tree: xr.DataTree) -> xr.DataTree:
    """A copy without remembered encodings and with the marks by which a reader knows the file."""
    copy = tree.map_over_datasets(_clean)
    copy.attrs = {
        schema.FORMAT_ATTRIBUTE: schema.FORMAT,
        schema.VERSION_ATTRIBUTE: _own_version(),
        **{name: _attribute(value) for name, value in tree.attrs.items() if value is not None},
    }
    return copy


def _clean(data: xr.Dataset) -> xr.Dataset:
    """Without encodings; text as fixed-width strings, which both formats give back alike."""
    plain = data.drop_encoding()
    for name, variable in plain.variables.items():
        if variable.dtype.kind in "OT" and _is_text(variable.values):
            text = variable.copy(data=variable.values.astype(str))
            plain = (
                plain.assign_coords({name: text})
                if name in plain.coords
                else plain.assign({name: text})
            )
    return plain


def _is_text(values: np.ndarray[Any, Any]) -> bool:
    return values.dtype.kind == "T" or all(isinstance(value, str) for value in values.flat)


def _attribute(value: Any) -> Any:
    """Python's bool has no counterpart in netCDF attributes."""
    return int(value) if isinstance(value, bool | np.bool_) else value


def _compression(tree: xr.DataTree) -> dict[str, dict[str, dict[str, Any]]]:
    """Encoding of the large numeric arrays, by group."""
    settings = {"zlib": True, "complevel": 4, "shuffle": True}
    encoding = {}
    for node in tree.subtree:
        variables = node.to_dataset(inherit=False).variables
        large = {
            str(name): dict(settings)
            for name, variable in variables.items()
            if variable.size > LARGE and variable.dtype.kind in "fiu"
        }
        if large:
            encoding[node.path] = large
    return encoding


class _Image(io.RawIOBase):
    """A file in memory to which writing never fails before it is closed.

    The HDF5 library crashes the process where closing a file fails: a full disk, or memory that
    runs out, must not reach it.

    Parameters
    ----------
    size : int
        Bytes to begin with.
    """

    def __init__(self, size: int) -> None:
        self._content, self._end, self._at = np.zeros(size, np.uint8), 0, 0
        self.failed: MemoryError | None = None

    def readable(self) -> bool:
        return True

    def writable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._end}[whence]
        self._at = start + offset
        return self._at

    def readinto(self, buffer: Any) -> int:
        view = memoryview(buffer).cast("B")
        found = self._content[self._at : min(self._at + len(view), self._end)]
        view[: found.size] = found.data
        self._at += found.size
        return int(found.size)

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        end = self._at + len(view)
        if end > self._content.size:
            self._grow(end)
        if self.failed is None:
            self._content[self._at : end] = view
        self._at, self._end = end, max(self._end, end)
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        size = self._at if size is None else size
        if size > self._content.size:
            self._grow(size)
        self._end = size
        return size

    def _grow(self, size: int) -> None:
        try:
            larger = np.zeros(size + size // 4, np.uint8)
        except MemoryError as error:
            self.failed = self.failed or error
        else:
            larger[: self._content.size] = self._content
            self._content = larger

    def content(self) -> memoryview:
        """All that was written."""
        if self.failed is not None:
            raise self.failed
        return self._content[: self._end].data


#: Bytes that must be free besides the arrays while a file is made.
_SPARE = 32 * 2**20
_SUM_LINE = b"\nbayesoleo sha256 %s\n"
_SUM_LENGTH = len(_SUM_LINE % bytes(64))


def netcdf_bytes(tree: xr.DataTree) -> bytes:
    """A tree as a netCDF file, with the checksum of its content in the last line.

    Readers of netCDF and HDF5 pass over what follows the content.

    Raises
    ------
    MemoryError
        If there is no room for it.
    """
    sizes = [item.nbytes for node in tree.subtree for item in node.variables.values()]
    # Asked for before the library is: see _Image.
    np.zeros(2 * max(sizes, default=0) + _SPARE, np.uint8)
    image = _Image(sum(sizes) + _SPARE // 8)
    tree.to_netcdf(image, engine="h5netcdf", encoding=_compression(tree))
    content = image.content()
    digest = hashlib.sha256(content).hexdigest().encode()
    return b"".join((content, _SUM_LINE % digest))


def _check_sum(path: Path) -> None:
    """Raise where a netCDF file has a checksum that is another than that of its content.

    One of another program has none.
    """
    with path.open("rb") as stream:
        left = path.stat().st_size - _SUM_LENGTH
        if left <= 0:
            return
        stream.seek(left)
        line = stream.read()
        if not re.fullmatch(re.escape(_SUM_LINE % b"X").replace(b"X", b"[0-9a-f]{64}"), line):
            return
        stream.seek(0)
        digest = hashlib.sha256()
        while left > 0:
            block = stream.read(min(left, 2**20))
            digest.update(block)
            left -= len(block)
    if digest.hexdigest().encode() not in line:
        raise _damaged(path, "was changed since it was written, or is damaged")


def _check_beside(path: Path) -> None:
    """Warn of files that were written with a result and are no longer what they were."""
    if path.name not in read_sums(path.parent):
        return
    for name in changed_files(path.parent):
        text = f"file {path.parent / name}: is not as {SUMS} has it; one of them was changed"
        if name == path.name:
            text += f", or {name} is of another result than the files beside it"
        warnings.warn(text, DataWarning, stacklevel=3)


_ROOT, _ZARR_SUM = "zarr.json", "bayesoleo_sha256"


def _zarr_sum(path: Path, attributes: dict[str, Any]) -> str:
    """Digest of the files of a Zarr result; that of the root's attributes without their digest."""
    total = hashlib.sha256(json.dumps(attributes, sort_keys=True).encode())
    for file in sorted(item for item in path.rglob("*") if item.is_file()):
        if file != path / _ROOT:
            total.update(file.relative_to(path).as_posix().encode())
            total.update(sha256(file).encode())
    return total.hexdigest()


def _check_zarr_sum(path: Path) -> None:
    """As :func:`_check_sum`."""
    attributes = json.loads((path / _ROOT).read_text(encoding="utf-8")).get("attributes", {})
    noted = attributes.pop(_ZARR_SUM, None)
    if noted is not None and noted != _zarr_sum(path, attributes):
        raise _damaged(path, "was changed since it was written, or is damaged")


def _damaged(path: Path, problem: str) -> ResultsError:
    hint = "run the command that wrote it once more, or give the results.nc of another run"
    return ResultsError(problem, file=path, hint=hint)


def _write_zarr(tree: xr.DataTree, path: Path) -> None:
    with warnings.catch_warnings():
        # Zarr 3 has not settled how fixed-width text is written; what we write, we read (tested).
        warnings.filterwarnings("ignore", message=".*does not have a Zarr V3 specification.*")
        tree.to_zarr(path, mode="w", consolidated=False)
    root = json.loads((path / _ROOT).read_text(encoding="utf-8"))
    attributes = root.setdefault("attributes", {})
    attributes[_ZARR_SUM] = _zarr_sum(path, attributes)
    (path / _ROOT).write_text(json.dumps(root, indent=2), encoding="utf-8")


def _read_netcdf(path: Path) -> xr.DataTree:
    _check_sum(path)
    with xr.open_datatree(path, engine="h5netcdf", decode_times=False) as tree:
        return tree.load()


def _read_zarr(path: Path) -> xr.DataTree:
    import_extra("zarr", "zarr")
    if (path / _ROOT).is_file():
        _check_zarr_sum(path)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*does not have a Zarr V3 specification.*")
        options: dict[str, Any] = {"engine": "zarr", "decode_times": False, "consolidated": False}
        with xr.open_datatree(path, **options) as tree:
            return tree.load()


def _check_exists(path: Path) -> None:
    if not path.exists():
        hint = "give the results.nc that `bayesoleo close` wrote"
        raise ResultsError("there is no such file", file=path, hint=hint)
    if path.is_dir() and not _is_zarr(path):
        raise ResultsError("is a folder", file=path, hint=f"give {path / 'results.nc'}")
    if path.is_file() and path.stat().st_size == 0:
        hint = "run the command that wrote it once more"
        raise ResultsError("is empty", file=path, hint=hint)


def _check_format(tree: xr.DataTree, path: Path) -> None:
    if schema.FORMAT_ATTRIBUTE not in tree.attrs:
        hint = "give the results.nc that `bayesoleo close` wrote"
        raise ResultsError("is not a result of bayesoleo", file=path, hint=hint)
    found = int(tree.attrs[schema.FORMAT_ATTRIBUTE])
    if found > schema.FORMAT:
        hint = "update bayesoleo to read it"
        raise ResultsError("was written by a later version", file=path, value=found, hint=hint)


def _is_zarr(path: str | os.PathLike[str]) -> bool:
    return Path(path).suffix == ".zarr"


def _own_version() -> str:
    try:
        return version("bayesoleo")
    except PackageNotFoundError:
        return "not installed"
