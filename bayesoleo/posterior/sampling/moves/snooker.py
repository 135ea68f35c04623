"""Snooker update: a step along the line to another walker."""

from __future__ import annotations

import numpy as np
from emcee.moves import RedBlueMove

from bayesoleo._types import Array


class SnookerMove(RedBlueMove):  # type: ignore[misc] # emcee has no types
    """Step along the line to another walker, by the difference of two more projected on it.

    Parameters
    ----------
    factor : float
        Mean stretch of the projected difference.

    Notes
    -----
    emcee 3.1.6's ``DESnookerMove`` divides by the root of the distance instead of the distance and
    halves the exponent, so that it has another target.

    References
    ----------
    Ter Braak and Vrugt (2008), "Differential evolution Markov chain with snooker updater and fewer
    chains", *Statistics and Computing* 18, eq. 3-4.
    """

    def __init__(self, factor: float = 1.7) -> None:
        super().__init__(nsplits=2)
        self.factor = factor

    def get_proposal(
        self, sample: Array, complement: list[Array], random: np.random.RandomState
    ) -> tuple[Array, Array]:
        """Proposals (W, d) and log ratios ``(d - 1) ln(|x' - z| / |x - z|)`` (W,)."""
        others = np.concatenate(complement)
        walkers, dimension = sample.shape
        # Three distinct others for each walker: the smallest of random keys.
        picks = np.argsort(random.uniform(size=(walkers, len(others))), axis=1)[:, :3]
        anchor, first, second = (others[picks[:, k]] for k in range(3))
        line = sample - anchor
        length = np.linalg.norm(line, axis=1)
        direction = line / length[:, None]
        factor = self.factor * random.uniform(0.7, 1.3, size=walkers)  # 1.2 to 2.2
        travel = factor * np.sum((first - second) * direction, axis=1)
        # Along the line the new distance is |length + travel|, without rounding of a difference of
        # points.
        log_ratio = np.log(np.abs(length + travel)) - np.log(length)
        return sample + travel[:, None] * direction, (dimension - 1) * log_ratio
