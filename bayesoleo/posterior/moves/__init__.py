"""Proposals for emcee's ensembles, each tested for stationarity."""

from bayesoleo.posterior.moves.differential import differential_evolution
from bayesoleo.posterior.moves.grouped import Counted, Grouped
from bayesoleo.posterior.moves.independence import IndependenceMove
from bayesoleo.posterior.moves.snooker import SnookerMove

__all__ = ["Counted", "Grouped", "IndependenceMove", "SnookerMove", "differential_evolution"]
