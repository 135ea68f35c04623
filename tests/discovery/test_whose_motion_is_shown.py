"""Residuals are shown over the coordinate that an effect acts on, by its name."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from bayesoleo.discovery._result_tree import _place
from bayesoleo.model import Model, Output

TWO = Model(
    "two masses on one another",
    inputs={"road": "m"},
    dofs={"wheel": "m", "strut": "m", "memory": "N"},
    equations={
        "wheel": "45*ddot(wheel) + 300*(ddot(wheel) + ddot(strut)) + 2e5*(wheel - road)",
        "strut": "300*(ddot(wheel) + ddot(strut)) + 16e3*strut + memory",
        "memory": "dot(memory) + memory",
    },
    outputs={"travel": Output("strut", "m")},
)


def loop(added, ranked):
    ranking = [SimpleNamespace(target=target) for target in ranked]
    return SimpleNamespace(
        final=SimpleNamespace(assembly=SimpleNamespace(native=TWO)),
        targets=tuple(added),
        rounds=(SimpleNamespace(ranking=ranking),),
    )


@pytest.mark.parametrize(
    ("added", "ranked", "shown"),
    [
        ([], [], "wheel"),
        ([], ["strut", "wheel"], "strut"),
        (["strut"], ["wheel"], "strut"),
        (["travel", "strut"], ["wheel"], "strut"),
        (["memory"], ["travel"], "wheel"),
    ],
)
def test_the_place_of_an_effect_comes_first(added, ranked, shown):
    assert _place(loop(added, ranked)).name == shown


def test_a_model_without_motion_has_none():
    still = Model("still", inputs={"x": "m"}, outputs={"y": Output("2*time", "1")})
    empty = loop([], [])
    empty.final.assembly.native = still
    assert _place(empty) is None
