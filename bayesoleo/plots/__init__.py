"""How a result is shown as figures: each function takes the DataTree and returns one Figure.

Figures are made without pyplot, hence without global state: they can be drawn in threads and on
machines without a display, and are saved with ``figure.savefig(path)``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
