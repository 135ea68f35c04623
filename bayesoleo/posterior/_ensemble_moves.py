"""Independent ensembles of walkers, advanced together by emcee, and their moves.

Differential evolution steps along the difference of two other walkers. A snooker update steps along
the line to another walker. The independence move proposes from a fixed mixture, wherever the walker
is. Several independent ensembles are advanced in one call, and the acceptance of each kind of move
is recorded.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import emcee
import numpy as np
from emcee.moves import DEMove, MHMove, Move, RedBlueMove
from emcee.state import State

from bayesoleo._types import Array, Flags, Integers
from bayesoleo.errors import InputError
from bayesoleo.posterior._checkpoints import REASONS, Phase, Segment
from bayesoleo.posterior._log_density import Density
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


#: Largest number of redraws of walkers whose log density is not finite.
REDRAWS = 50


@dataclass(frozen=True)
class MoveWeights:
    """How often each kind of move is chosen.

    Parameters
    ----------
    independence, differential, snooker : float
        Relative frequencies.
    """

    independence: float = 0.8
    differential: float = 0.15
    snooker: float = 0.05

    @classmethod
    def tuned(cls, acceptance: float) -> MoveWeights:
        """Weights for an acceptance of the independence move.

        An accepted independence move is worth a hundred of the others. Rejections are not uniform:
        a walker in a tail that the mixture misses, such as the tip of a bent ridge, rejects nearly
        all of them, and only the other moves bring it back.
        """
        share = float(np.clip(2 * acceptance - 0.9, 0.3, 0.9))
        return cls(share, 0.75 * (1 - share), 0.25 * (1 - share))


def default_walkers(dimension: int) -> int:
    """Walkers of one ensemble: each half spans the space and leaves differences to choose from."""
    return max(16, 4 * ((dimension + 2) // 2 + 1))


@dataclass(frozen=True)
class Ensembles:
    """Sampler that advances the walkers of several ensembles.

    Parameters
    ----------
    log_density : Density
        Target, called with rows of all ensembles.
    ensembles : int
        Number of independent ensembles.
    walkers : int
        Walkers of each, even and at least ``2 (d + 1)``.
    weights : MoveWeights
        How often each kind of move is chosen.

    Raises
    ------
    InputError
        If there are too few walkers.
    """

    log_density: Density
    ensembles: int
    walkers: int
    weights: MoveWeights = MoveWeights()

    def __post_init__(self) -> None:
        # Of one unknown too, a snooker step is made by three walkers of the other half.
        least = max(2 * (len(self.log_density.names) + 1), 6)
        if self.walkers < least or self.walkers % 2:
            raise InputError(
                "an ensemble needs an even number of walkers that spans the space twice",
                key="walkers",
                value=self.walkers,
                hint=f"write an even number from {least}, or leave it out",
            )
        if self.ensembles < 2:
            raise InputError(
                "agreement between ensembles needs at least two",
                key="ensembles",
                value=self.ensembles,
            )

    @property
    def chains(self) -> int:
        """Walkers of all ensembles."""
        return self.ensembles * self.walkers

    def start(self, mixture: Mixture, seed: int) -> Segment:
        """Draw the walkers from a mixture; those without a finite log density are drawn again.

        Parameters
        ----------
        mixture : Mixture
            Mixture to draw from.
        seed : int
            Seeds the generator of the whole run.

        Returns
        -------
        Segment
            One draw, in phase ``"start"``.

        Raises
        ------
        InputError
            If walkers without a finite log density remain after fifty redraws.
        """
        random = np.random.RandomState(np.random.MT19937(np.random.SeedSequence(seed)))
        before = _Tally.of(self.log_density)
        coords = mixture.sample(random, self.chains)
        log_density, by_run = self.log_density(coords)
        for _ in range(REDRAWS):
            bad = np.flatnonzero(~np.isfinite(log_density))
            if not bad.size:
                break
            coords[bad] = mixture.sample(random, bad.size)
            log_density[bad], by_run[bad] = self.log_density(coords[bad])
        tally = _Tally.of(self.log_density) - before
        left = int(np.sum(~np.isfinite(log_density)))
        if left:
            raise InputError(
                f"{left} of {self.chains} walkers found no point of finite log density",
                value=dict(tally.failures),
                hint="give starts further inside the priors' supports",
            )
        return Segment(
            "start",
            coords[None],
            log_density[None],
            by_run[None],
            random.get_state(legacy=True),
            mixture.defended(),
            tally.evaluations,
            tally.failures,
            branch_jumps=tally.branch_jumps,
        )

    def advance(self, last: Segment, steps: int, phase: Phase) -> Segment:
        """Continue after a segment.

        Parameters
        ----------
        last : Segment
            The new segment continues from its last draw, generator and mixture.
        steps : int
            Draws of each walker.
        phase : {"warm-up", "kept"}
            After a warm-up segment the mixture is adapted to it; after a kept one it is the same.

        Returns
        -------
        Segment
        """
        moves = self._moves(last.mixture)
        sampler = emcee.EnsembleSampler(
            self.chains, len(self.log_density.names), self._rows, moves=moves, vectorize=True
        )
        # emcee wraps the function in one that prints the traceback and all rows of whatever passes
        # through, an interrupt too.
        sampler.log_prob_fn = self._rows
        tallies = [_Tally.of(self.log_density)]
        state = State(
            last.coords[-1],
            log_prob=last.log_density[-1],
            # emcee drops an axis of length one from blobs
            blobs=last.by_run[-1].squeeze(axis=1) if len(self._runs) == 1 else last.by_run[-1],
            random_state=last.random_state,
            copy=True,
        )
        for _ in sampler.sample(state, iterations=steps, skip_initial_state_check=True):
            tallies.append(_Tally.of(self.log_density))
        coords = sampler.get_chain()
        mixture = last.mixture
        if phase == "warm-up":
            mixture = mixture.refitted(coords.reshape(-1, mixture.dimension))
        tally = tallies[-1] - tallies[0]
        return Segment(
            phase,
            coords,
            sampler.get_log_prob(),
            sampler.get_blobs().reshape(steps, self.chains, -1),
            sampler.random_state,
            mixture,
            tally.evaluations,
            tally.failures,
            Counter({move.name: move.proposed for move, _ in moves}),
            Counter({move.name: move.accepted for move, _ in moves}),
            tally.branch_jumps,
            np.array([(after - before).by_reason for before, after in pairwise(tallies)]),
        )

    @property
    def _runs(self) -> tuple[str, ...]:
        return self.log_density.runs

    def _rows(self, coords: Array) -> Array:
        log_density, by_run = self.log_density(coords)
        return np.column_stack([log_density, by_run])

    def _moves(self, mixture: Mixture) -> list[tuple[Counted, float]]:
        kinds = (
            ("independence", IndependenceMove(mixture), self.weights.independence),
            (
                "differential",
                Grouped(differential_evolution(), self.ensembles),
                self.weights.differential,
            ),
            ("snooker", Grouped(SnookerMove(), self.ensembles), self.weights.snooker),
        )
        return [(Counted(name, move), weight) for name, move, weight in kinds]


@dataclass(frozen=True)
class _Tally:
    """A density's counters at one moment, or between two."""

    evaluations: int
    failures: Counter[str]
    branch_jumps: int

    @classmethod
    def of(cls, log_density: Density) -> _Tally:
        jumps = getattr(log_density, "branch_jumps", 0)  # of densities that solve something
        return cls(log_density.evaluations, Counter(log_density.failures), jumps)

    @property
    def by_reason(self) -> list[int]:
        """Failures in the order of a segment's table."""
        return [self.failures[reason] for reason in REASONS]

    def __sub__(self, other: _Tally) -> _Tally:
        return _Tally(
            self.evaluations - other.evaluations,
            self.failures - other.failures,
            self.branch_jumps - other.branch_jumps,
        )
