"""The curved posteriors on which samplers are compared have the moments that are said."""

from __future__ import annotations

import pytest
from posterior_curved import z_of
from posterior_curved_cases import CASES

from bayesoleo.posterior import sample


@pytest.mark.parametrize(
    "name", ["bent", *(pytest.param(n, marks=pytest.mark.slow) for n in ("funnel", "wide"))]
)
def test_draws_have_the_moments_of_quadrature(name):
    case = CASES[name]()
    found = sample(case.density, case.mixture, effective_size=400, seed=1, progress=False)
    assert found.reached
    # The largest of fifty differences exceeds four standard errors once in three hundred times.
    assert z_of(case, found.draws, found.effective_size) < 4.0
