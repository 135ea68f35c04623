"""An estimate that ended in a wrong optimum is no missing effect, and is not passed over."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from fitted_states import NUMERICS
from small_campaigns import MASS, oscillator_campaign

import bayesoleo._worker_processes as processes
from bayesoleo.discovery import _loop, _ranking
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._loop import OTHER_OPTIMUM, _begun, close_loop
from bayesoleo.discovery._ranking import prepare_options
from bayesoleo.discovery._state import State, better_start, fit_state
from bayesoleo.effects import find_effect
from bayesoleo.model import Model, Output, Parameter

#: Driven on both sides of the resonance, and far above it.
RUNS = (("a", 9.0, 20.0, "fit"), ("b", 12.0, 20.0, "fit"), ("c", 16.0, 20.0, "fit"))
RESONANCE = 10.4
STIFFNESS = MASS * (2 * np.pi * RESONANCE) ** 2


def oscillator(resonance):
    start = MASS * (2 * np.pi * resonance) ** 2
    return Model(
        "oscillator",
        inputs={"force": "N"},
        dofs={"x": "m"},
        parameters={
            "stiffness": Parameter(start, "N/m", sd=start / 2, bounds=(0.0, np.inf)),
            "damping": Parameter(2.0, "N*s/m", sd=2.0, bounds=(0.0, np.inf)),
        },
        equations={"x": f"{MASS}*ddot(x) + damping*dot(x) + stiffness*x - force"},
        outputs={"displacement": Output("x", "m")},
    )


@pytest.fixture(scope="module")
def beyond(tmp_path_factory):
    """Estimated on the wrong side of the frequencies that were driven."""
    law = partial(force, damping=3.0)
    reduced = oscillator_campaign(tmp_path_factory.mktemp("beyond"), restoring=law, runs=RUNS)
    return fit_state(Assembly(oscillator(17.0)), assign(reduced.records), NUMERICS)


def force(x, v, damping):
    return STIFFNESS * x + damping * v


def test_the_better_start_does_not_depend_on_processes(beyond, monkeypatch):
    alone = better_start(beyond.fit, replace(NUMERICS, jobs=1))
    problem = beyond.fit.problem
    assert alone[problem.names.index("stiffness")] == pytest.approx(STIFFNESS, rel=1e-2)
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    monkeypatch.setattr(processes, "WORTH_ASKING", 0.0)
    processes.process_of(0)  # none is started before an item is done here
    asked, kinds, read = [], [], processes.content_of

    def noted(*given):
        found = read(*given)
        kinds.append(found[0])
        return found

    monkeypatch.setattr(processes, "content_of", noted)

    def before():  # the other process has all starts but one meanwhile, once it has its libraries
        asked.append(beyond)
        deadline = time.monotonic() + 60.0
        while not kinds and time.monotonic() < deadline:
            time.sleep(0.05)

    two = better_start(beyond.fit, replace(NUMERICS, jobs=2), before)
    np.testing.assert_array_equal(two, alone)
    assert asked == [beyond]
    assert processes.VALUE in kinds  # of another process


def test_a_start_that_ends_in_a_worse_optimum_is_not_taken(beyond, monkeypatch):
    roles, theta = assign(beyond.fit.records), beyond.fit.point.theta
    better = better_start(beyond.fit, replace(NUMERICS, jobs=1))
    right = fit_state(beyond.assembly, roles, NUMERICS, start=better).fit
    monkeypatch.setattr(State, "at_floor", False)
    monkeypatch.setattr(_loop, "better_start", lambda *_: theta)
    found = _begun(beyond.assembly, roles, NUMERICS, right, None, lambda _: None)
    assert found.state.fit is right
    assert not any(note.startswith(OTHER_OPTIMUM) for note in found.notes)


def test_candidates_that_were_prepared_are_those_that_are_scored(beyond):
    base, assembly = beyond.base(), beyond.assembly
    effects = (find_effect("cubic_stiffness"), find_effect("sensor_lag"))
    other = effects[:1]
    prepare_options(base, assembly, effects)
    (kept,) = (options for *_, options in _ranking._prepared)
    assert _ranking._options_of(base, assembly, effects) is kept
    # Given away once, and to nobody else.
    assert _ranking._options_of(base, assembly, effects) is not kept
    prepare_options(base, assembly, effects)
    found = _ranking._options_of(base, assembly, other)
    assert {option.candidate.effect for option in found} == {"cubic_stiffness"}
    assert not _ranking._prepared


def test_a_wrong_optimum_whose_candidates_cannot_be_looked_for_is_left(beyond, monkeypatch):
    """What goes wrong there is met again only where no other start is better."""

    def broken(state):
        raise np.linalg.LinAlgError

    monkeypatch.setattr(State, "base", broken)
    roles = assign(beyond.fit.records)
    found = _begun(Assembly(oscillator(17.0)), roles, NUMERICS, beyond.fit, None, lambda _: None)
    assert found.state.fit.shared["stiffness"] == pytest.approx(STIFFNESS, rel=1e-2)
    assert not _ranking._prepared


@pytest.mark.slow
@pytest.mark.parametrize(("start", "told"), [(10.0, False), (17.0, True)])
def test_the_other_side_of_a_frequency_that_was_driven(tmp_path, start, told):
    reduced = oscillator_campaign(
        tmp_path, restoring=lambda x, v: STIFFNESS * x + 3.0 * v, runs=RUNS
    )
    roles = assign(reduced.records)
    loop = close_loop(Assembly(oscillator(start)), roles, NUMERICS, max_effects=0)
    found = dict(zip(loop.final.fit.problem.names, loop.final.fit.point.theta, strict=True))
    assert found["stiffness"] == pytest.approx(STIFFNESS, rel=1e-2)
    assert loop.verdict == "nothing missing"
    assert any(note.startswith(OTHER_OPTIMUM) for note in loop.notes) == told
