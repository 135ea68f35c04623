"""An estimate that the declared start leads astray is found from another one."""

from __future__ import annotations

import numpy as np
import pytest
from truth_systems import make

from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._other_starts import doubtful

NUMERICS = Numerics(steps=128, jobs=1)


@pytest.mark.slow
def test_two_masses_whose_resonances_were_mistaken_for_each_other():
    """With stiff ground the nominal values lead to a coupling on its limit and nine times the
    noise."""
    made = make("two dofs", 10, weak=True, toleranced=True, within=np.inf)
    said: list[str] = []
    fit = fit_model(made.model, made.campaign.records, NUMERICS, progress=said.append)
    assert any("other starts" in text for text in said)
    assert fit.point.on_limit == ()
    for name, value, sd in zip(fit.point.names, fit.point.theta, fit.point.sd, strict=True):
        assert abs(value - made.truth[name]) < 4 * sd, name


def test_an_ordinary_estimate_is_not_doubted():
    made = make("linear", 1, toleranced=True)
    said: list[str] = []
    fit = fit_model(made.model, made.campaign.records, NUMERICS, progress=said.append)
    assert not doubtful(fit.problem, fit.point, fit.policy)
    assert not any("other starts" in text for text in said)
