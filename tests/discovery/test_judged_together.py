"""Effects in transients: taken on trial by the colour of what is left, kept by its level."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import NUMERICS, options
from scipy import stats
from small_campaigns import FRICTION, _coloured, damper, damper_campaign

from bayesoleo.discovery import _judged_together as judging
from bayesoleo.discovery._alternatives import Loss, likelihood_gap, plainly_needed
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._hold_out_confirmation import Fall, fall_error
from bayesoleo.discovery._judged_together import TOGETHER, Evidence, judged_together
from bayesoleo.discovery._loop import UNJUDGED, loop_of
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._ranking import Ranked
from bayesoleo.discovery._refit import Inflation, new_parameters, refit
from bayesoleo.discovery._round import Progress, Round
from bayesoleo.discovery._score_tests import corrected_p, score_all
from bayesoleo.discovery._state import State, fit_state

POLICY = SearchPolicy()
STEP = SimpleNamespace(effect=SimpleNamespace(id="coulomb_friction", family="friction"))


def plain(x, v, _):
    return 1000.0 * x + 200.0 * v


def with_friction(x, v, _):
    return plain(x, v, _) + FRICTION * np.sign(v)


def campaign(folder, force, seed, coloured=0.97):
    return damper_campaign(folder, force, seed=seed, coloured=coloured, transient=True, noise=1.0)


def with_effects(reduced, *names):
    """The damper with some effects added one after the other."""
    roles = assign(reduced.records)
    state = fit_state(Assembly(damper(cubic=False)), roles, NUMERICS)
    for name in names:
        score = score_all(state.base(), options(state, [name]), jobs=1)[0][0]
        assembly = score.option.assembly
        assembly = assembly.with_parameters(new_parameters(assembly, score, NUMERICS.policy))
        state = fit_state(assembly, roles, NUMERICS)
    return state, roles


@pytest.mark.slow
@pytest.mark.parametrize("coloured", [0.0, 0.97])
def test_the_inflation_of_a_transient_holds_colour_and_level(tmp_path, coloured):
    """Sums of squares are in units of what differences of neighbours show of the noise."""
    ratios, tried = [], []
    for seed in range(6):
        reduced = campaign(tmp_path / str(seed), plain, seed, coloured)
        state = fit_state(Assembly(damper(cubic=False)), assign(reduced.records), NUMERICS)
        base = state.base()
        score = score_all(base, options(state, ["quadratic_damping"]), jobs=1)[0][0]
        result = refit(base, score, NUMERICS)
        shown = np.mean([entry.average.sigma**2 for entry in state.fit_errors.entries])
        assert result.inflation / result.noise.on_trial == pytest.approx(1.0 / shown, rel=0.35)
        ratios.append(result.fall / result.inflation)
        tried.append(result.fall / result.noise.on_trial)
    # Six chi-square variates of one degree of freedom, about as known as noise is from few lines.
    assert np.mean(ratios) < 3.0
    if coloured:
        assert np.mean(tried) > 10.0, "by the colour alone an absent effect is far too significant"


def test_an_effect_is_tried_by_one_p_value_and_stated_with_the_other():
    item = Ranked(None, 0.2, 0.5, True, (), p_on_trial=1e-6)
    assert item.may_be_tried(0.01)
    assert item.p_value == 0.2
    assert not Ranked(None, 0.2, 0.5, False, ()).may_be_tried(0.01)
    assert Fall(150.0, 100.0, 900.0).may_be_tried
    assert not Fall(150.0, 100.0, 900.0).confirms
    assert not Fall(50.0, 100.0, 900.0).may_be_tried
    assert not Fall(3.0, 0.1, 3.0).may_be_tried, "one superfluous unknown would do as much"


def evidence(value, rise, *, declared=True, held_out=True, freedom=20):
    loss = Loss(STEP, rise, 2, 2.0, Inflation(10.0, freedom, 3.0))
    return Evidence(loss, Fall(value, 100.0, 500.0) if held_out else None, 12.0, declared)


def test_declared_runs_decide_by_the_errors_that_the_policy_asks_for():
    assert evidence(190.0, 1e6).missing > 0.0
    assert evidence(200.0, 0.0).missing < 0.0
    assert evidence(-50.0, 1e6).missing > evidence(150.0, 1e6).missing
    # As small as the fall of a superfluous unknown: not confirmed, however sure.
    loss = Loss(STEP, 1e6, 2, 2.0, Inflation(10.0, 20, 3.0))
    assert Evidence(loss, Fall(2.0, 0.1, 2.0), 12.0, declared=True).missing > 0.0


@pytest.mark.parametrize(("rise", "stays"), [(5.0, False), (2000.0, True)])
def test_noise_that_is_assumed_judges_too(rise, stays):
    """Where no degrees of freedom are known: white noise, or none was measured."""
    assert (evidence(np.nan, rise, declared=False, held_out=False, freedom=0).missing < 0) == stays


def test_an_effect_that_no_hold_out_run_shows_is_judged_on_the_fitted_ones():
    for rise, stays in ((5.0, False), (2000.0, True)):
        found = replace(evidence(0.0, rise), fall=Fall(0.0, 0.0, 0.0))
        assert found.is_known
        assert (found.missing < 0.0) == stays
        assert "on fitted runs" in str(found)


@pytest.mark.parametrize("held_out", [True, False])
def test_runs_that_chose_an_effect_do_not_confirm_it_alone(held_out):
    """The rise on fitted runs is an F variate, corrected for the search."""
    edge = 1.0 - (1.0 - POLICY.significance) ** (1.0 / 12.0)
    rise = 10.0 * 2 * stats.f.isf(edge, 2, 20)
    for factor, stays in ((0.9, False), (1.1, True)):
        found = evidence(300.0, factor * rise, declared=False, held_out=held_out)
        assert (found.missing < 0.0) == stays
    assert not evidence(np.nan, rise).is_known
    assert not evidence(300.0, np.nan).is_known


def test_a_friction_stays_and_what_slow_noise_feigned_goes(tmp_path):
    state, roles = with_effects(campaign(tmp_path, with_friction, 4), "coulomb_friction", "preload")
    assert len(state.assembly.steps) == 2
    notes: list[str] = []
    found = judged_together(state, roles, NUMERICS, 12.0, notes, lambda _: None)
    assert [effect for effect, _ in found.assembly.added] == ["coulomb_friction"]
    removed, kept = notes
    assert removed.startswith("preload was removed again: beside the other effects")
    assert "±" in removed
    assert kept.startswith(f"{TOGETHER}; coulomb_friction: without it the weighted squared error")
    again = [f"{TOGETHER}; preload: as before", removed]
    assert judged_together(found, roles, NUMERICS, 12.0, again, lambda _: None) is found
    assert again == [removed, kept], "what was confirmed beside another model is not said of this"


class Effects:
    """A model with some effects, as far as their removal asks for it."""

    def __init__(self, *names):
        self.added, self.steps = names, [step(name) for name in names]
        self.assembly, self.fit = self, SimpleNamespace(all_periodic=False, values={})
        self.hold_errors = SimpleNamespace(entries=[])

    def without(self, one):
        return Effects(*(name for name in self.added if name != one.effect.id))

    def base(self):
        return SimpleNamespace(fit=self.fit)

    def model(self):
        return None


def step(name):
    return SimpleNamespace(effect=SimpleNamespace(id=name, family="friction"))


@pytest.mark.parametrize(
    ("together", "left"),
    # A second chance has half as many false alarms: 2.24 standard errors instead of 1.96.
    [(150.0, ()), (215.0, ()), (250.0, ("drag",))],
    ids=["chance", "second chance", "confirmed"],
)
def test_effects_that_mask_each_other_do_not_all_go(monkeypatch, together, left):
    """Each removed one leaves more, beside which the next is hardly seen; the whole model knows."""

    def alone(state, base, chosen, *_):
        return [
            replace(evidence(10.0 * k, 0.0), loss=Loss(one, 0.0, 1, 1.0, Inflation(1.0, 9)))
            for k, one in enumerate(chosen)
        ]

    def lost(base, one, fit):
        return Loss(one, together, 1, 1.0, Inflation(1.0, 9))

    monkeypatch.setattr(judging, "_evidence", alone)
    monkeypatch.setattr(judging, "fit_state", lambda assembly, *_, **__: assembly)
    monkeypatch.setattr(judging, "start_from", lambda *_: None)
    monkeypatch.setattr(judging, "loss_of", lost)
    monkeypatch.setattr(judging, "judged", lambda *states: states)
    monkeypatch.setattr(judging, "fall_on_hold_out", lambda *_: Fall(together, 100.0, 500.0))
    whole = Effects("friction", "drag")
    whole.hold_errors = SimpleNamespace(entries=["held out"])
    notes: list[str] = []
    roles = SimpleNamespace(strategy="declared")
    found = judged_together(whole, roles, None, 12.0, notes, lambda _: None)
    assert found.added == left
    assert notes[0].startswith("friction was removed again")
    if left:
        assert notes[1].startswith(f"{TOGETHER}; drag: without it and those removed before it")
    else:
        assert notes[1].startswith("drag was removed again")


def test_effects_together_are_corrected_for_the_search_of_as_many(monkeypatch):
    """Of a hundred candidates there are ten thousand pairs."""
    monkeypatch.setattr(judging, "loss_of", lambda *_: Loss(STEP, 60.0, 2, 1.0, Inflation(1.0, 0)))
    whole = judging._Whole(Effects("friction", "drag", "play"), None)
    alone = Evidence(Loss(STEP, 60.0, 1, 1.0, Inflation(1.0, 0)), None, 100.0, declared=False)
    joint = whole.evidence(alone, Effects("play"))
    assert joint.p == pytest.approx(2.0 * 100.0**2 * stats.chi2.sf(60.0, 2), rel=1e-3)
    one = whole.evidence(alone, Effects("play", "drag"))
    assert one.p == pytest.approx(2.0 * 100.0 * stats.chi2.sf(60.0, 2), rel=1e-3)


def test_what_confirmed_effects_that_went_is_not_said_of_none(tmp_path):
    state, roles = with_effects(campaign(tmp_path, plain, 4))
    notes = [f"{TOGETHER}; preload: as before", "another"]
    assert judged_together(state, roles, NUMERICS, 12.0, notes, lambda _: None) is state
    assert notes == ["another"]


def test_periodic_runs_are_judged_where_effects_are_added(tmp_path):
    reduced = damper_campaign(tmp_path, with_friction)
    state, roles = with_effects(reduced, "coulomb_friction", "preload")
    assert judged_together(state, roles, NUMERICS, 12.0, [], lambda _: None) is state


def test_what_slow_noise_feigns_is_not_plainly_needed(tmp_path):
    """In white noise Wald's statistic would be that of thousands of independent samples."""
    said, by_white = 0, 0
    for seed in range(5):
        state, _ = with_effects(campaign(tmp_path / str(seed), plain, seed), "quadratic_damping")
        step = state.assembly.steps[0]
        said += plainly_needed(state, state.base(), step, just_added=True)
        by_white += plainly_needed(*_as_periodic(state), step, just_added=True)
    assert by_white >= 2
    assert said == 0


def _as_periodic(state: State):
    fit = SimpleNamespace(point=state.fit.point, problem=state.fit.problem, all_periodic=True)
    return SimpleNamespace(fit=fit), state.base()


@pytest.mark.slow
def test_p_values_of_absent_effects_in_slow_noise_are_seldom_small(tmp_path):
    small, tried = 0, 0
    for seed in range(8):
        reduced = campaign(tmp_path / str(seed), plain, seed)
        state = fit_state(Assembly(damper(cubic=False)), assign(reduced.records), NUMERICS)
        base = state.base()
        for score in score_all(base, options(state, ["quadratic_damping"]), jobs=1)[0]:
            result = refit(base, score, NUMERICS)
            noise = {"fall": result.fall, "freedom": result.noise.freedom}
            stated = replace(score, inflation=result.inflation, **noise)
            small += corrected_p(stated, 1.0) < 0.05
            tried += corrected_p(replace(stated, inflation=result.noise.on_trial), 1.0) < 0.05
    assert small <= 2  # of eight at 5 %, three or more with a probability of 0.6 %
    assert tried >= 5


@pytest.mark.slow
def test_two_models_are_compared_by_the_noise_along_their_difference(tmp_path):
    """As the better of them leaves it: what the worse one lacks is no noise."""
    said, drawn, rng = [], [], np.random.default_rng(1)
    for seed in range(4):
        reduced = campaign(tmp_path / str(seed), with_friction, seed, 0.9)
        without, _ = with_effects(reduced)
        state, _ = with_effects(reduced, "coulomb_friction")
        one, other = Progress(without, without), Progress(without, state)
        gap, scale = likelihood_gap(one, other)
        assert gap > 50.0 * scale
        assert likelihood_gap(other, one) == pytest.approx((-gap, scale))
        pairs = zip(state.fit.predictions, without.fit.predictions, strict=True)
        changes = [(new.y - old.y)[0] for new, old in pairs]
        noise = [[_coloured(rng, change.size, 0.9) for change in changes] for _ in range(100)]
        along = [sum(c @ n for c, n in zip(changes, row, strict=True)) for row in noise]
        drawn.append(np.mean(np.square(along)) / sum(change @ change for change in changes))
        said.append(scale * np.mean([1.0 / run.scale.max() ** 2 for run in without.base().runs]))
    # Of 400 draws a variance is known to 7 %, and the spectrum of a few runs to about as much.
    assert np.mean(said) == pytest.approx(np.mean(drawn), rel=0.25)


@pytest.mark.parametrize(("rise", "inflation"), [(0.0, 1.0), (0.0, 300.0), (900.0, 30.0)])
def test_the_error_of_a_fall_is_that_of_a_chi_square_in_units_of_the_noise(rise, inflation):
    rng, size = np.random.default_rng(3), 2
    beyond = np.sqrt(rise / inflation)
    draws = inflation * ((rng.standard_normal(40_000) + beyond) ** 2 + rng.chisquare(1, 40_000))
    mean = rise + size * inflation
    assert np.mean(draws) == pytest.approx(mean, rel=0.03)
    assert fall_error(mean, size, inflation) == pytest.approx(np.std(draws), rel=0.03)


@pytest.mark.slow
def test_a_quiet_run_tells_as_much_as_it_does(tmp_path):
    """The level of all runs together is far above its noise; the colour makes up for it."""
    stated = []
    for seed in range(8):
        reduced = campaign(tmp_path / str(seed), plain, seed, 0.0)
        rng = np.random.default_rng(seed)
        loud = [
            replace(
                record,
                samples={
                    **record.samples,
                    "force": record.samples["force"] + 30.0 * rng.standard_normal(record.time.size),
                },
            )
            if record.label in "bc"
            else record
            for record in reduced.records
        ]
        state = fit_state(Assembly(damper(cubic=False)), assign(loud), NUMERICS)
        score = score_all(state.base(), options(state, ["quadratic_damping"]), jobs=1)[0][0]
        result = refit(state.base(), score, NUMERICS)
        stated.append(result.inflation)
        assert result.noise.on_trial >= 1.0
    # Weights of the fit are common, so that noise of the loud runs counts, but not a thousandfold.
    assert np.median(stated) < 400.0


@pytest.mark.slow
@pytest.mark.parametrize("judged", [True, False])
@pytest.mark.parametrize("broken", [True, False])
def test_a_stopped_search_says_that_its_effects_are_on_trial(tmp_path, broken, judged):
    """Unless it was stopped later, during its review."""
    state, roles = with_effects(campaign(tmp_path, with_friction, 4), "coulomb_friction")
    notes = (f"{TOGETHER}; coulomb_friction: as found",) if judged else ()
    last = Round(state, (), {}, None, None, "stopped", 1.0)
    found = loop_of(Progress(state, state, (last,), notes, broken), roles)
    assert (UNJUDGED in found.notes) == (broken and not judged)
