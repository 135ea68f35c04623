"""Fits that leave a run out give the same wherever they are made."""

import numpy as np
import pytest
from small_campaigns import DAMPER_RUNS, damper, damper_campaign

from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._state import fit_state


@pytest.mark.slow
def test_other_processes_leave_out_the_same_runs(tmp_path):
    runs = [run for run in DAMPER_RUNS if run[3] == "fit"]
    roles = assign(damper_campaign(tmp_path, runs=runs).records)
    assert roles.strategy == "leave-one-run-out"
    assembly = Assembly(damper(), None)
    here = fit_state(assembly, roles, Numerics(jobs=1))
    there = fit_state(assembly, roles, Numerics(jobs=1, scheduler="local:2"))
    assert [p.record.label for p in there.held_out] == ["a", "b", "c"]
    for one, other in zip(here.held_out, there.held_out, strict=True):
        assert one.theta == other.theta
        np.testing.assert_array_equal(one.y, other.y)
