"""Discovery: the closed loop that finds the physical effects a model lacks.

The loop scores candidate effects, estimates the best, confirms them on hold-out runs, and states
which models remain possible and which run would decide between them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
