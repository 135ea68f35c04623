"""Models that every effect is tried on, and the sizes of a motion that suits all of them."""

from __future__ import annotations

import pytest

from bayesoleo.effects import Scales
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


@pytest.fixture(scope="session", params=[*NAMES, "lorenz"])
def model(request):
    return system(request.param)


@pytest.fixture(scope="session", params=NAMES)
def united_model(request):
    """A model whose units are consistent (Lorenz has none)."""
    return system(request.param)
