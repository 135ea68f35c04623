"""How a result is written and read: atomically, as one DataTree in netCDF or Zarr."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
