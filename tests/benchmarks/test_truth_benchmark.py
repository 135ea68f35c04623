"""The benchmark of what is said runs, part by part, on a few of its cases."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="module")
def truth() -> Iterator[ModuleType]:
    """The benchmark, with its folder importable as when it is run by hand."""
    path = list(sys.path)
    sys.path.insert(0, str(Path(__file__).parent))
    import truth

    yield truth
    sys.path[:] = path


@pytest.mark.slow
def test_coverage_of_a_few_campaigns(truth):
    """Two of each kind: 52 intervals, most of which hold the truth.

    Those of a campaign go together, so that a third of them may be off at once.
    """
    found = truth.figures(["tolerances"], 0.04)
    assert found["coverage_campaigns"] == 12
    assert found["coverage_parameters"] == 26
    assert found["coverage_failed"] == 0
    assert 0.6 < found["coverage"] <= 1.0
    assert 0.6 < found["coverage_drawn"] <= 1.0
    assert 0.0 <= found["coverage_worst"] <= 1.0


def test_parts_are_modules_with_figures(truth):
    """A part that is named can be imported."""
    for name in truth.parts():
        assert (Path(__file__).parent / f"truth_{name}.py").is_file()


@pytest.mark.slow
def test_no_solver_is_silently_wrong_where_steps_could_pass_over_something(truth):
    """A microsecond's lag behind a steep function, and a stop of 1e8, by all ways."""
    found = truth.figures(["solvers"], fraction=0.1)
    assert found["silently_wrong"] == 0
    assert found["solves"] == 12
    # What is said to be usable is so to ten times the tolerance or the estimate.
    assert found["solves_ok"] >= 6
    assert found["worst_error_ratio"] < 10


def test_a_silent_error_is_one_beyond_what_was_asked_for_and_said(truth):
    import numpy as np
    import truth_solvers

    wrong = truth_solvers.Solve(True, True, 1e-8, 2e-8, 3e-7)
    assert wrong.silent
    assert not truth_solvers.Solve(True, True, 1e-8, 4e-8, 3e-7).silent
    assert not truth_solvers.Solve(False, True, 1e-8, 2e-8, 3e-7).silent
    assert truth_solvers.Solve(True, True, 1e-8, np.nan, 3e-7).silent
    assert truth_solvers.Solve(True, True, 1e-8, 1e-8, np.nan).silent


@pytest.mark.slow
def test_inputs_arrive(truth):
    """On the first twentieth of the arrow, where it is small: the prediction is that of the
    Runge-Kutta, and neither way of EMPS makes inertia of the encoder's noise."""
    if not (Path(os.environ.get("BAYESOLEO_DATA", "")) / "measured" / "emps").is_dir():
        pytest.skip("the measured sets are not here")
    found = truth.figures(["inputs"], 0.05)
    assert abs(found["arrow_mV"] - found["arrow_reference_mV"]) < 0.02
    assert abs(found["multisine_mV"] - found["multisine_reference_mV"]) < 0.02
    assert found["multisine_mV"] < 0.6
    assert found["emps_periodic_N"] < 2.7
    assert found["emps_transient_N"] < 2.7


@pytest.mark.slow
def test_no_mode_is_missed_without_a_word(truth):
    found = truth.figures(["modes"], fraction=0.1)
    assert found["mode_runs"] == 10
    assert found["mode_runs_reached"] > 0
    assert found["modes_missed"] == 0


@pytest.mark.slow
def test_true_effects_are_in_final_classes(truth):
    """One of the eighty: the marks are those of all; here, that figures are made of them."""
    told: list[str] = []
    found = truth.figures(["effects"], 0.0125, told.append)
    assert found["effect_campaigns"] == len(told) == 1
    assert found["truth_in_class"] == 1.0
    assert found["false_companions"] == 0.0
    assert found["effect_longest_s"] > 0.0  # no limit: machines are shared


@pytest.mark.slow
def test_nothing_is_missing_where_nothing_is(truth):
    """The first periodic campaign of each kind that leaves no parameter in the dark; the marks are
    those of three hundred."""
    told: list[str] = []
    found = truth.figures(["campaigns"], 0.02, told.append)
    assert found["campaigns"] == 6
    assert found["false_verdicts"] == 0.0, told
    assert found["effects_added"] == 0.0
    # Some 30 errors of a hundred coefficients each: 1.3 % by chance.
    assert 0.95 < found["ratio_to_expected"] < 1.05
