"""From a campaign folder and a model to results: the verbs that the command line and scripts call.

In the order in which a user meets them: ``reduce``, ``check``, ``estimate``, ``estimate_each``,
``sample``, ``trace``, ``close``, ``close_each``, ``propose``, ``simulate``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
