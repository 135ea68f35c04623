"""Data: campaigns of run files, their reduction to records, and the noise of records."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
