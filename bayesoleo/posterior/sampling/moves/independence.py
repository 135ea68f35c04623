"""Independence move: proposals from a fixed mixture, wherever the walker is."""

from __future__ import annotations

import numpy as np
from emcee.moves import MHMove

from bayesoleo._types import Array
from bayesoleo.posterior.approximation.mixture import Mixture


class IndependenceMove(MHMove):  # type: ignore[misc] # emcee has no types
    """Metropolis-Hastings with a proposal that does not depend on the walker.

    Parameters
    ----------
    mixture : Mixture
        Proposal density. It must not change while draws are kept: a proposal that learns from the
        chain is not stationary.

    References
    ----------
    Tierney (1994), "Markov chains for exploring posterior distributions", *Annals of Statistics*
    22, section 2.3.3.
    """

    def __init__(self, mixture: Mixture) -> None:
        self.mixture = mixture
        super().__init__(self._draw, ndim=mixture.dimension)

    def _draw(self, present: Array, random: np.random.RandomState) -> tuple[Array, Array]:
        proposed = self.mixture.sample(random, len(present))
        ratio = self.mixture.log_density(present) - self.mixture.log_density(proposed)
        return proposed, ratio
