"""Moves of emcee's ensembles: differential evolution, snooker, independence proposals.

Differential evolution steps along the difference of two other walkers. A snooker update steps along
the line to another walker. The independence move proposes from a fixed mixture, wherever the walker
is. Several independent ensembles are advanced in one call, and the acceptance of each kind of move
is recorded.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from emcee.moves import DEMove, MHMove, Move, RedBlueMove
from emcee.state import State

from bayesoleo._types import Array, Flags, Integers
from bayesoleo.posterior._mixture import Mixture


def differential_evolution() -> DEMove:
    """emcee's own move, which passes the stationarity tests.

    Returns
    -------
    emcee.moves.DEMove
        With the usual factor ``2.38 / sqrt(2 d)`` and a jitter of 0.1 of it: emcee's 1e-5 would
        leave a walker on a finite set of points if no other move were mixed in.

    References
    ----------
    Ter Braak (2006), "A Markov chain Monte Carlo version of the genetic algorithm differential
    evolution", *Statistics and Computing* 16, eq. 2.
    """
    return DEMove(sigma=0.1)


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


class Grouped(Move):  # type: ignore[misc] # emcee has no types
    """Apply a move to several ensembles at once, each with complements from itself alone.

    The ensembles stay independent, but one call of the log density has rows of all of them.

    Parameters
    ----------
    move : emcee.moves.RedBlueMove
        The move within one ensemble.
    ensembles : int
        Number of ensembles; walkers of one lie next to each other.

    References
    ----------
    Foreman-Mackey et al. (2013), "emcee: the MCMC hammer", *PASP* 125, section 3 (the split in
    halves).
    """

    def __init__(self, move: RedBlueMove, ensembles: int) -> None:
        self.move, self.ensembles = move, ensembles

    def propose(self, model: Any, state: State) -> tuple[State, Flags]:
        """Advance every walker once; returns the state and who was accepted, shape (walkers,)."""
        walkers, splits = len(state.coords), self.move.nsplits
        each = walkers // self.ensembles
        self.move.setup(state.coords)
        halves = np.concatenate(
            [model.random.permutation(np.arange(each) % splits) for _ in range(self.ensembles)]
        )
        accepted = np.zeros(walkers, dtype=bool)
        for half in range(splits):
            active = halves == half
            proposed, ratio = self._proposals(state.coords, halves, half, model.random)
            log_density, blobs = model.compute_log_prob_fn(proposed)
            gain = ratio + log_density - state.log_prob[active]
            accepted[active] = np.log(model.random.uniform(size=len(gain))) < gain
            new = State(proposed, log_prob=log_density, blobs=blobs)
            state = self.update(state, new, accepted, active)
        return state, accepted

    def _proposals(
        self, coords: Array, halves: Integers, half: int, random: np.random.RandomState
    ) -> tuple[Array, Array]:
        proposals, ratios = [], []
        for mine in np.split(np.arange(len(coords)), self.ensembles):
            sets = [coords[mine[halves[mine] == k]] for k in range(self.move.nsplits)]
            others = sets[:half] + sets[half + 1 :]
            proposed, ratio = self.move.get_proposal(sets[half], others, random)
            proposals.append(proposed)
            ratios.append(ratio)
        return np.concatenate(proposals), np.concatenate(ratios)


class Counted(Move):  # type: ignore[misc] # emcee has no types
    """Count how often a move is accepted.

    Parameters
    ----------
    name : str
        What the move is called in the results.
    move : emcee.moves.Move
        The move.

    Attributes
    ----------
    proposed, accepted : int
        Rows so far.
    """

    def __init__(self, name: str, move: Move) -> None:
        self.name, self.move = name, move
        self.proposed = self.accepted = 0

    def propose(self, model: Any, state: State) -> tuple[State, Flags]:
        """Pass on, and count."""
        state, accepted = self.move.propose(model, state)
        self.proposed += len(accepted)
        self.accepted += int(np.sum(accepted))
        return state, accepted
