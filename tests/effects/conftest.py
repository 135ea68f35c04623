"""Models that every effect is tried on, and the sizes of a motion that suits all of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from bayesoleo.effects import Candidate, Scales, candidates
from bayesoleo.model import Model
from bayesoleo.systems import system

NAMES = ("f16n1d2", "f16n2d2", "f16n1d1_thesis", "duffing", "viscous_damper", "gas_spring")


@pytest.fixture(scope="session")
def scales() -> Scales:
    coordinates = ("stroke", "position", "displacement", "compression", "x", "y", "z")
    return Scales(
        position=dict.fromkeys(coordinates, (0.01, 0.25)),
        velocity=dict.fromkeys(coordinates, 0.14),
        output={},
        shortest_period=0.5,
        longest_period=25.0,
    )


@pytest.fixture(scope="session")
def offered(scales) -> Callable[[Model], list[Candidate]]:
    """Every candidate of a model, in periodic runs or in transients."""

    def of(model: Model) -> list[Candidate]:
        found = candidates(model, scales)
        known = {(item.effect, item.target) for item in found}
        transient = candidates(
            model, replace(scales, kinds=frozenset({"transient"}), dominant_frequency=7.0)
        )
        return found + [item for item in transient if (item.effect, item.target) not in known]

    return of


@pytest.fixture(scope="session", params=[*NAMES, "lorenz"])
def model(request):
    return system(request.param)


@pytest.fixture(scope="session", params=NAMES)
def united_model(request):
    """A model whose units are consistent (Lorenz has none)."""
    return system(request.param)
