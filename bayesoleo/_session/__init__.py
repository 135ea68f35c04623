"""A session in Python: objects that show themselves, from a campaign to what its model lacks.

``load_campaign`` → ``Problem`` → ``Fit`` → ``Posterior`` or ``Explanation``. A user's function goes
the same way as a campaign and a model.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
