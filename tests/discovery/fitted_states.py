"""Models fitted to small campaigns, and the candidates scored against them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayesoleo.data import ReducedCampaign
from bayesoleo.discovery._assembly import Assembly, Option, assign
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._ranking import scales_of
from bayesoleo.discovery._score_tests import Score, score_all
from bayesoleo.discovery._state import State, fit_state
from bayesoleo.effects import find_effect
from bayesoleo.model import Model
from bayesoleo.prediction._records import Record

#: One thread, for tests run side by side.
NUMERICS = Numerics(jobs=1)
Array = NDArray[np.float64]


def fitted(
    reduced: ReducedCampaign,
    model: Model,
    drive: str | None = None,
    numerics: Numerics = NUMERICS,
) -> State:
    """A model fitted to a campaign's runs."""
    return fit_state(Assembly(model, drive), assign(reduced.records), numerics)


def options(state: State, effects: Sequence[str]) -> list[Option]:
    """Candidates of some effects."""
    scales = scales_of(state.fit, state.assembly.drive, state.assembly.native)
    return state.assembly.options(scales, [find_effect(name) for name in effects])


def scored(state: State, *effects: str) -> dict[str, Score]:
    """Scores of some effects by id, or by id and target where there are several."""
    scores, _ = score_all(state.base(), options(state, effects), jobs=1)
    return {score.option.candidate.effect: score for score in scores}


def motion(record: Record, channel: str = "displacement") -> tuple[Array, Array]:
    """Value and rate of a channel at the raw samples, summed harmonic by harmonic."""
    item, t = record.harmonics[channel], record.time - record.time[0]
    x, v = np.zeros(t.size), np.zeros(t.size)
    for order, c in zip(item.orders, item.coefficients, strict=True):
        omega = 2 * np.pi * record.frequency * order
        x += c.real * np.cos(omega * t) - c.imag * np.sin(omega * t)
        v += -omega * (c.real * np.sin(omega * t) + c.imag * np.cos(omega * t))
    return x, v
