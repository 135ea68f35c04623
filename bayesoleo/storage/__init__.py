"""How a result is written and read: atomically, as one DataTree in netCDF or Zarr."""

from bayesoleo.storage.atomic import write_text_atomic
from bayesoleo.storage.folder import check_writable, path_of
from bayesoleo.storage.provenance import provenance
from bayesoleo.storage.tree import read_attributes, read_tree, write_tree

__all__ = [
    "check_writable",
    "path_of",
    "provenance",
    "read_attributes",
    "read_tree",
    "write_text_atomic",
    "write_tree",
]
