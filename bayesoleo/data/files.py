"""Columns out of run files: delimited text, MATLAB v5, Parquet and netCDF."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from pathlib import Path

import numpy as np

from bayesoleo._types import Array
from bayesoleo.data.text import read_text
from bayesoleo.errors import CampaignError, MissingExtraError, import_extra

_SPREADSHEETS = (".xlsx", ".xlsm", ".xls", ".ods")


def read_columns(
    path: Path,
    delimiter: str | None = None,
    header_delimiter: str | None = None,
    wanted: Collection[str] | None = None,
) -> Mapping[str, Array]:
    """Read all numeric columns of a run file.

    Parameters
    ----------
    path : Path
        ``.mat`` (up to version 7), ``.parquet``, ``.nc``; anything else is delimited text with a
        header.
    delimiter, header_delimiter : str, optional
        Of text files; sniffed by default. ``whitespace`` stands for any run of blanks.
    wanted : collection of str, optional
        Columns that must be numbers; text in others does not matter. All, by default.

    Returns
    -------
    mapping of str to ndarray, shape (N,)
        As written, not converted.

    Raises
    ------
    CampaignError
        If the file is missing, empty or not what its name says.
    MissingExtraError
        If the file is Parquet and pyarrow is not installed.
    """
    if not path.is_file():
        raise CampaignError("no such file", file=path.name, hint=_neighbours(path))
    if path.stat().st_size == 0:
        raise CampaignError("file is empty", file=path.name, hint="record the run again")
    if path.suffix.lower() in _SPREADSHEETS:
        raise CampaignError(
            "is a spreadsheet", file=path.name, value=path.suffix, hint="export it as CSV"
        )
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        return read_text(path, delimiter, header_delimiter, wanted)
    try:
        columns = reader(path)
    except (CampaignError, MissingExtraError):
        raise
    except Exception as error:  # each format's library raises its own types on a broken file
        raise CampaignError(
            f"cannot be read as {path.suffix}: {str(error)[:120]}", file=path.name
        ) from error
    if not columns:
        raise CampaignError("file has no numeric column", file=path.name)
    return columns


def _neighbours(path: Path) -> str:
    if not path.parent.is_dir():
        return f"there is no folder {path.parent.name!r}"
    names = sorted(item.name for item in path.parent.iterdir() if item.suffix != ".toml")
    return f"the folder holds {', '.join(names[:12]) or 'no files'}"


def _read_mat(path: Path) -> dict[str, Array]:
    from scipy.io import loadmat

    try:
        variables = loadmat(path)
    except NotImplementedError as error:
        raise CampaignError(
            "MATLAB version 7.3 file", file=path.name, hint="save it in MATLAB with '-v7'"
        ) from error
    vectors = {}
    for name, value in variables.items():
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "biuf":
            continue
        if value.size > 1 and value.size == max(value.shape):
            vectors[name] = value.ravel().astype(float)
    return vectors


def _read_parquet(path: Path) -> dict[str, Array]:
    import pandas as pd

    import_extra("pyarrow", "parquet")
    table = pd.read_parquet(path)
    return {str(name): table[name].to_numpy(dtype=float) for name in table.select_dtypes("number")}


def _read_netcdf(path: Path) -> dict[str, Array]:
    import xarray as xr

    with xr.open_dataset(path, decode_times=False) as dataset:
        return {
            str(name): np.asarray(variable.values, dtype=float)
            for name, variable in dataset.variables.items()
            if variable.ndim == 1 and variable.dtype.kind in "biuf"
        }


_READERS: dict[str, Callable[[Path], dict[str, Array]]] = {
    ".mat": _read_mat,
    ".parquet": _read_parquet,
    ".nc": _read_netcdf,
}
