"""Which physical effects can be missing in a model, and how each is added to it.

Examples
--------
A catalogue effect, and one of your own:

>>> from bayesoleo.effects import force_effect
>>> mine = force_effect("drag", "damping", "k*velocity**3", {"k": "force/(position/s)**3"})
>>> mine.id
'drag'
"""

from bayesoleo.effects.catalogue import candidates, catalogue, describe, find_effect
from bayesoleo.effects.effect import FAMILIES, Candidate, Effect
from bayesoleo.effects.force_effect import InternalState, force_effect
from bayesoleo.effects.parts import Amplitude, Constant, Scales, ShapeParameter

__all__ = [
    "FAMILIES",
    "Amplitude",
    "Candidate",
    "Constant",
    "Effect",
    "InternalState",
    "Scales",
    "ShapeParameter",
    "candidates",
    "catalogue",
    "describe",
    "find_effect",
    "force_effect",
]
