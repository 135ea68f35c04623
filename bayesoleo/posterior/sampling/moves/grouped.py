"""Several independent ensembles advanced in one call, and the acceptance of each kind of move."""

from __future__ import annotations

from typing import Any

import numpy as np
from emcee.moves import Move, RedBlueMove
from emcee.state import State

from bayesoleo._types import Array, Flags, Integers


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
