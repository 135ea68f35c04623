"""Pieces of a calculation on disk: whole, absent, or refused."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo._storage.resume import Slots
from bayesoleo.errors import ResultsError


def test_pieces_come_back_in_any_order(tmp_path):
    slots = Slots(tmp_path / "new", "a")
    for number in (3, 0):
        slots.write(number, {"x": np.arange(number), "flag": np.array([True])})
    again = Slots(tmp_path / "new", "a")
    assert again.read(1) is None
    found = again.read(3)
    np.testing.assert_array_equal(found["x"], [0, 1, 2])
    assert set(found) == {"x", "flag"}
    assert sorted(p.name for p in (tmp_path / "new").iterdir()) == [
        "slot-000000.npz",
        "slot-000003.npz",
    ]


def test_without_a_folder_pieces_stay_in_memory():
    slots = Slots(None, "a")
    slots.write(2, {"x": np.ones(2)})
    assert slots.read(1) is None
    np.testing.assert_array_equal(slots.read(2)["x"], 1.0)


def test_pieces_of_another_calculation_are_refused(tmp_path):
    Slots(tmp_path, "a").write(0, {"x": np.ones(2)})
    with pytest.raises(ResultsError, match=r"slot-000000.*belongs to another calculation"):
        Slots(tmp_path, "b").read(0)


def test_damaged_piece_is_named(tmp_path):
    slots = Slots(tmp_path, "a")
    slots.write(0, {"x": np.ones(200)})
    whole = slots.path(0).read_bytes()
    slots.path(0).write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ResultsError, match=r"slot-000000\.npz: is damaged"):
        slots.read(0)
