"""A model as a key: equal to all models of the same expressions, whatever their parameters' values.

Computer algebra is the slowest part of a search that tries a hundred models on each campaign, and
its results hold for every campaign.
"""

from __future__ import annotations

from dataclasses import dataclass

from bayesoleo.model.model import Model


@dataclass(frozen=True, eq=False)
class Structured:
    """A model that compares by :attr:`~bayesoleo.model.Model.structure`, to key a cache.

    Parameters
    ----------
    model : Model
    """

    model: Model

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Structured):
            return NotImplemented
        return self.model is other.model or self.model.structure == other.model.structure

    def __hash__(self) -> int:
        return hash(self.model.structure)
