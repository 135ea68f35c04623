"""Models declared as named terms, their derivatives, and the kernels that evaluate them."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
