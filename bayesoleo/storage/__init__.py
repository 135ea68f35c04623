"""How a result is written and read: atomically, as one DataTree in netCDF or Zarr."""

from bayesoleo.storage.atomic import write_text_atomic
from bayesoleo.storage.provenance import provenance
from bayesoleo.storage.tree import read_attributes, read_tree, write_tree

__all__ = ["provenance", "read_attributes", "read_tree", "write_text_atomic", "write_tree"]
