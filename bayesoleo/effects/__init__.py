"""Physical effects that a model may lack, and how each is added to it.

Examples
--------
A catalogue effect, and one of your own:

>>> from bayesoleo.effects import force_effect
>>> mine = force_effect("drag", "damping", "k*velocity**3", {"k": "force/(position/s)**3"})
>>> mine.id
'drag'
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
