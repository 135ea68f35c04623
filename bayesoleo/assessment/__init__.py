"""How good an estimate is, by what it leaves and by what it foresees."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
