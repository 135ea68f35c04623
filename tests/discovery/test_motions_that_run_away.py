"""A motion that runs away has sensitivities whose products overflow: nothing follows from it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from bayesoleo.discovery import _parameter_section as section
from bayesoleo.discovery._structure_parameters import GivenStructure


def given(size: float) -> SimpleNamespace:
    with np.errstate(over="ignore"):
        products = np.full((1, 3, 3), size) ** 2
    found = SimpleNamespace(products=products)
    found.is_finite = GivenStructure.is_finite.fget(found)  # type: ignore[attr-defined]
    return found


@pytest.mark.parametrize(("size", "known"), [(1e3, True), (1e157, False), (np.nan, False)])
def test_a_value_of_a_parameter_at_which_products_overflow_is_left_out(size, known, monkeypatch):
    along = object.__new__(section._Along)
    predictor = SimpleNamespace(runs=[])
    fit = SimpleNamespace(predictor=predictor)
    along.section = SimpleNamespace(anchor=SimpleNamespace(fit=fit), is_spent=False)
    along.about = {0.0: given(1.0)}
    along.patterns = 1
    along.frame = SimpleNamespace(about=lambda here, patterns: here)
    there = SimpleNamespace(found=[], here=given(size))
    monkeypatch.setattr(along, "_solved_so_far", lambda: [(0.0, there)], raising=False)
    monkeypatch.setattr(along, "_evaluated", lambda theta: there, raising=False)
    monkeypatch.setattr(along, "_moved", lambda *_: (np.zeros(1), 0.0), raising=False)
    assert (along._solved(1.0) is there) == known
    assert (1.0 in along.about) == known
