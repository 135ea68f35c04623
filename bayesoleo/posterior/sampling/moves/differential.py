"""Differential evolution: a step along the difference of two other walkers."""

from __future__ import annotations

from emcee.moves import DEMove


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
