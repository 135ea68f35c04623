"""Where a result comes from: versions, seed and time, as root attributes."""

from __future__ import annotations

import json
import platform
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from bayesoleo import schema

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
        Further attributes, named as in :mod:`bayesoleo.schema` (``campaign=``, ``model=``, …).
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
