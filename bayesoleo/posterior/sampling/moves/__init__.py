"""Proposals for emcee's ensembles, each tested for stationarity."""

from bayesoleo.posterior.sampling.moves.differential import differential_evolution
from bayesoleo.posterior.sampling.moves.grouped import Counted, Grouped
from bayesoleo.posterior.sampling.moves.independence import IndependenceMove
from bayesoleo.posterior.sampling.moves.snooker import SnookerMove

__all__ = ["Counted", "Grouped", "IndependenceMove", "SnookerMove", "differential_evolution"]
