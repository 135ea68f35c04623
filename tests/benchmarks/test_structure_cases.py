"""Effects between two bodies, in one term, and in series: named, with their size and the rest."""

from __future__ import annotations

import numpy as np
import pytest
from structure_cases import CASES, behind_gap, closed, judged


def test_a_slider_behind_a_gap_gives_way_where_the_gap_is_taken_up():
    """Along a triangle of swing 2 and a gap of 1 in all the force is on for half of each way."""
    way = np.concatenate([np.linspace(-1.0, 1.0, 4001)[:-1], np.linspace(1.0, -1.0, 4001)[:-1]])
    force = behind_gap(way, 3.0, 0.5, 1e-3)
    assert force.max() == pytest.approx(3.0)
    assert np.mean(np.abs(force) > 2.999) == pytest.approx(0.5, abs=2e-3)
    assert np.mean(force == 0.0) == pytest.approx(0.5, abs=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_the_effect_is_named_with_its_size_and_the_base(name):
    """A seed for which every interval of 95 % holds; over seeds one in twenty misses."""
    case = CASES[name]()
    found = judged(case, closed(case, seed=2))
    assert found["named"], found["added"]
    assert found["size_inside"]
    assert found["base_inside"] >= found["base"] - 1, found["outside"]
