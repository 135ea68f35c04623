"""The run that was proposed is made, the loop closed again: the class is smaller, and right."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitted_states import NUMERICS, fitted
from small_campaigns import damper, damper_campaign

from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._loop import close_loop
from bayesoleo.discovery._next_experiment import propose_runs
from bayesoleo.discovery._open_questions import named, rivals_of
from bayesoleo.discovery._predicted_experiment import Limits
from bayesoleo.discovery._round import examine
from bayesoleo.effects import find_effect

RIVALS = ("linear_stiffness", "cubic_stiffness")
EFFECTS = tuple(map(find_effect, RIVALS))
#: One amplitude: a linear and a cubic spring differ by a third harmonic below the noise.
RUNS = (("a", 1.0, 0.010, "fit"), ("b", 2.0, 0.010, "fit"), ("c", 1.5, 0.010, "hold-out"))
NOISE = 40.0


def linear(x, v, t):
    return 200 * v + 1000.0 * x


def hardening(x, v, t):
    return 200 * v + 6e6 * x**3


def proposed(reduced):
    """The best run that the rig can do, for the rivals that a round leaves."""
    model = damper(cubic=False, linear=False)
    outcome = examine(
        fitted(reduced, model),
        assign(reduced.records),
        NUMERICS,
        effects=EFFECTS,
        seed=0,
        limit="ranked only",
        callback=lambda _: None,
    )
    rivals, _ = rivals_of(outcome, named(outcome, list(RIVALS)), NUMERICS)
    free = (-np.inf, np.inf)
    limits = Limits.of(reduced.records, "displacement", ("force",))
    limits = limits.given({"amplitude": (0.005, 0.03), "force": free})
    found = propose_runs(rivals, reduced.records, outcome.before.fit_errors, limits, jobs=1)
    return found.trials[0]


def closed(records):
    model = Assembly(damper(cubic=False, linear=False))
    return close_loop(model, assign(records), NUMERICS, effects=EFFECTS, nonparametric=False)


@pytest.mark.slow
@pytest.mark.parametrize(("law", "truth"), [(linear, RIVALS[0]), (hardening, RIVALS[1])])
def test_the_class_shrinks_to_the_truth_once_the_proposed_run_is_made(law, truth, tmp_path):
    reduced = damper_campaign(tmp_path / "before", law, runs=RUNS, noise=NOISE, periods=16)
    before = closed(reduced.records)
    (first,) = [entry.accepted for entry in before.rounds if entry.accepted]
    assert {first.effect, *first.same} == set(RIVALS)
    trial = proposed(reduced)
    run = ("next", trial.frequency, trial.amplitude, "fit")
    made = damper_campaign(
        tmp_path / "made", law, runs=(run,), noise=NOISE, periods=16, seed=11
    ).records[0]
    after = closed([*reduced.records, replace(made, label="next")])
    (first,) = [entry.accepted for entry in after.rounds if entry.accepted]
    assert (first.effect, first.same) == (truth, ())
