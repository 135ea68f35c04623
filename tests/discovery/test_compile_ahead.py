"""What is compiled ahead is what a comparison of structures calls, with the same types."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.discovery import _structure_evidence as evidence, _structure_moments as moments
from bayesoleo.discovery._structure_columns import Group, Likelihood, Reduced

COMPILED = (evidence.singles, evidence.pairs, evidence.beside, moments._over)


def signatures() -> list[set[object]]:
    return [set(function.signatures) for function in COMPILED]


@pytest.mark.skipif(not hasattr(moments._over, "signatures"), reason="nothing is compiled")
def test_a_comparison_needs_nothing_that_was_not_compiled_ahead():
    evidence.compile_evidence()
    before = signatures()
    assert all(before)
    rng = np.random.default_rng(5)
    rows = rng.standard_normal((7, 40))
    products = rows @ rows.T
    likelihood, sizes = Likelihood(40, 30.0), np.array([0.2, 1.0])
    groups = [Group((0,), 0.9), Group((1,)), Group((2, 3))]
    for count in (1, 3):
        part = Reduced.of(np.stack([products] * count), np.zeros(count), 2, np.zeros(2))
        evidence.effect_evidence(part, likelihood, groups, sizes)
        evidence.pair_evidence(part, likelihood, groups[0], groups[1:2], sizes)
        one = part.with_effects(groups[:1], [1.0])
        evidence.effect_evidence(one, likelihood, [Group((0,)), Group((1, 2))], sizes)
        for own in (one, part.with_effects(groups, [0.2, 1.0, 1.0])):
            own.log_moment(likelihood)
    assert signatures() == before
