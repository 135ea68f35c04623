"""Systems that are declared ready to use, with known answers."""

from bayesoleo.model.text import as_text
from bayesoleo.systems.catalogue import system, systems
from bayesoleo.systems.describe import as_latex, describe, equations, equations_latex

__all__ = [
    "as_latex",
    "as_text",
    "describe",
    "equations",
    "equations_latex",
    "system",
    "systems",
]
