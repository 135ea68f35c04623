"""A fit is as good with all signs turned, and a mass below zero is none."""

from __future__ import annotations

import pytest
from fitted_states import NUMERICS
from small_campaigns import DAMPING, STIFFNESS, damper, damper_campaign

from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._loop import OTHER_SIGN, close_loop


@pytest.mark.slow
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_parameters_of_the_other_sign_are_told(tmp_path, sign):
    reduced = damper_campaign(tmp_path, lambda x, v, t: sign * (STIFFNESS * x + DAMPING * v))
    loop = close_loop(
        Assembly(damper(cubic=False)), assign(reduced.records), NUMERICS, max_effects=0
    )
    told = [note for note in loop.notes if note.startswith(OTHER_SIGN)]
    assert len(told) == (sign < 0)
    for note in told:
        assert "damping = -" in note
        assert "stiffness = -" in note
