"""An effect stays beside later ones only as long as it is worth its unknowns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitted_states import NUMERICS, options
from small_campaigns import damper, damper_campaign

from bayesoleo.discovery import _alternatives as elimination
from bayesoleo.discovery._alternatives import dispersion, eliminated, loss_without, plainly_needed
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._refit import new_parameters
from bayesoleo.discovery._score_tests import score_all
from bayesoleo.discovery._state import fit_state

PIN, RUB = 12.0, 5.0


def law(pin, friction, unknown=0.0):
    """A metering pin, dry friction, and a force that no effect is like."""

    def force(x, v, t):
        fifth = np.cos(2 * np.pi * 5 * 8 * t / t[-1])
        return 1000 * x + 200 * (1 + pin * x) * v + friction * np.sign(v) + unknown * fifth

    return force


def with_effects(reduced, *names):
    """The damper with some effects added one after the other."""
    roles = assign(reduced.records)
    state = fit_state(Assembly(damper(cubic=False)), roles, NUMERICS)
    for name in names:
        base = state.base()
        score = score_all(base, options(state, [name]), jobs=1)[0][0]
        assembly = score.option.assembly
        assembly = assembly.with_parameters(new_parameters(assembly, score, NUMERICS.policy))
        state = fit_state(assembly, roles, NUMERICS)
    return state, roles


def without_last(state, roles):
    """The state before the last effect was added."""
    return fit_state(state.assembly.without(state.assembly.steps[-1]), roles, NUMERICS)


BOTH = ("coulomb_friction", "stroke_dependent_damping")


@pytest.mark.parametrize(
    ("pin", "friction", "left"), [(PIN, 0.0, BOTH[1:]), (PIN, RUB, BOTH), (0.0, RUB, BOTH)]
)
@pytest.mark.parametrize("coloured", [0.0, 0.9])
def test_friction_that_was_near_goes_once_the_pin_is_in(tmp_path, pin, friction, left, coloured):
    """The last one stays: it was found to be needed, and no optimum was wrong."""
    reduced = damper_campaign(tmp_path, law(pin, friction), coloured=coloured, per_period=60.3)
    state, roles = with_effects(reduced, *BOTH)
    notes: list[str] = []
    before = without_last(state, roles)
    found = eliminated(state, before, roles, NUMERICS, notes, lambda _: None)
    assert tuple(effect for effect, _ in found.assembly.added) == left
    assert len(notes) == len(BOTH) - len(left)
    for note in notes:
        assert "coulomb_friction was removed again" in note
        assert "±" in note


def test_a_loss_is_the_squared_distance_in_standard_deviations(tmp_path):
    """Of a term that is linear in its parameter: Wald and likelihood ratio agree."""
    reduced = damper_campaign(tmp_path, law(PIN, 0.0), per_period=60.3)
    state, _ = with_effects(reduced, "stroke_dependent_damping", "constant_force")
    loss = loss_without(state, state.base(), state.assembly.steps[1], NUMERICS)
    k = state.fit.problem.names.index("constant_force")
    expected = (state.fit.point.theta[k] / state.fit.point.sd[k]) ** 2
    assert loss.size == 1
    # The noise of the samples and that of the fit are two estimates, from some 1500 samples.
    assert loss.rise == pytest.approx(expected, rel=0.1, abs=0.02)


def test_what_is_left_beyond_the_noise_makes_unknowns_dearer(tmp_path):
    state, _ = with_effects(damper_campaign(tmp_path, law(PIN, RUB, 3.0), per_period=60.3), *BOTH)
    base = state.base()
    loss = loss_without(state, base, state.assembly.steps[0], NUMERICS)
    assert dispersion(base) > 3.0
    assert loss.scale >= dispersion(base)
    quiet = replace(base, excess=0.0)
    assert dispersion(quiet) == 1.0
    assert loss_without(state, quiet, state.assembly.steps[0], NUMERICS).scale < loss.scale


@pytest.mark.parametrize("left_to_explain", [0.0, 3.0])
def test_what_is_plainly_needed_is_not_tried_without(tmp_path, monkeypatch, left_to_explain):
    """It would have been kept: what is lost is far more than its unknowns are worth."""
    reduced = damper_campaign(tmp_path, law(5 * PIN, 20 * RUB, left_to_explain), per_period=60.3)
    state, roles = with_effects(reduced, *BOTH)
    base, step = state.base(), state.assembly.steps[0]
    assert plainly_needed(state, base, step)
    assert loss_without(state, base, step, NUMERICS).worth > 100.0
    monkeypatch.setattr(elimination, "loss_without", lambda *_: pytest.fail("tried without"))
    assert eliminated(state, state, roles, NUMERICS, [], lambda _: None) is state


def test_what_is_small_is_tried_without(tmp_path):
    state, _ = with_effects(damper_campaign(tmp_path, law(PIN, 0.0), per_period=60.3), *BOTH)
    assert not plainly_needed(state, state.base(), state.assembly.steps[0])


def test_an_effect_that_led_to_a_better_optimum_is_not_what_was_missing(tmp_path):
    """Beside a wrong optimum, any effect that frees the estimate from it seems to be needed."""
    reduced = damper_campaign(tmp_path, law(0.0, RUB), per_period=60.3)
    state, roles = with_effects(reduced, *BOTH)
    right = without_last(state, roles)
    off = [replace(run, y=run.y + np.std(run.y)) for run in right.fit.predictions]
    wrong = replace(right, fit=replace(right.fit, predictions=off))
    notes: list[str] = []
    found = eliminated(state, wrong, roles, NUMERICS, notes, lambda _: None)
    assert found.assembly.added == right.assembly.added
    assert len(notes) == 1
    assert "led the model without it to a better optimum" in notes[0]
    assert found.fit.point.objective == pytest.approx(right.fit.point.objective, abs=0.1)
