"""What is left of transients: how much, which part an effect explains, which effects are alike."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import NUMERICS, options
from small_campaigns import _coloured, damper, damper_campaign

from bayesoleo.discovery import _fit_difference as difference, _ranking as ranking
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._fit_difference import noise_between, undecided
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._ranking import rank
from bayesoleo.discovery._refit import Refit, refit_all
from bayesoleo.discovery._score_tests import score_all
from bayesoleo.discovery._state import fit_state

POLICY = SearchPolicy()
#: Hundreds of swings a record, few samples a swing.
MANY = {"periods": 250, "per_period": 20.37, "transient": True, "noise": 1.0}


#: A few slow swings of many samples.
FEW = {"periods": 4, "per_period": 1500.37, "transient": True, "noise": 1.0}


def smooth(x, v, _):
    return 1000.0 * x + 200.0 * v + 1500.0 * v * np.abs(v)


def spiky(x, v, _):
    """A part that acts in few samples of each swing: faster than the motion."""
    return 1000.0 * x + 200.0 * v + 8.0 * np.exp(-((v / 0.02) ** 2)) * np.sign(x)


def fitted(folder, force, seed=0, **more):
    reduced = damper_campaign(folder, force, seed=seed, **(MANY | more))
    return fit_state(Assembly(damper(cubic=False)), assign(reduced.records), NUMERICS)


@pytest.mark.parametrize("force", [smooth, spiky])
def test_errors_of_hundreds_of_swings_are_seen(tmp_path, force):
    """Averages over whole swings would have left nothing of them."""
    state = fitted(tmp_path, force)
    for entry in state.fit_errors.entries:
        beyond = entry.repeating**2 - entry.noise**2
        assert beyond > 0.7 * (entry.rms**2 - 1.0)  # the noise is of 1 N
    assert not state.at_floor


@pytest.mark.parametrize("force", [smooth, spiky])
def test_shares_are_of_all_that_samples_have_beyond_their_noise(tmp_path, force):
    state = fitted(tmp_path, force)
    base = state.base()
    found = score_all(base, options(state, ["quadratic_damping", "stribeck_friction"]), jobs=1)[0]
    beyond = sum(
        record.time.size * (entry.rms**2 / entry.sigma**2 - 1.0)
        for record, entry in zip(state.fit.records, state.fit_errors.entries, strict=True)
    )
    for result in refit_all(base, found, NUMERICS):
        # What noise could feign is in the denominator.
        assert result.share == pytest.approx(result.fall / beyond, rel=0.1)
        assert result.share < 1.05


def test_shares_of_short_errors_in_slow_motions_are_of_single_samples(tmp_path):
    """Averages over thirty samples lose most of a peak of ten, which holds little of the force."""

    def peaks(x, v, _):
        return 1000.0 * x + 200.0 * v + 5.0 * np.exp(-((v / 0.001) ** 2)) * np.sign(x)

    state = fitted(tmp_path, peaks, **(FEW | {"noise": 0.2}))
    base = state.base()
    entries = state.fit_errors.entries
    averaged = sum((e.repeating**2 - e.noise**2) / e.rms**2 for e in entries) / len(entries)
    assert averaged < 0.6 * sum(1.0 - 0.04 / e.rms**2 for e in entries) / len(entries)
    sizes = [len(record.time) for record in state.fit.records]
    beyond = sum(n * (e.rms**2 / e.sigma**2 - 1.0) for n, e in zip(sizes, entries, strict=True))
    # Less two standard errors of it.
    assert 0.9 * beyond < base.excess < beyond


@pytest.mark.parametrize("swings", [MANY, FEW])
def test_noise_has_no_excess(tmp_path, swings):
    """In one of forty campaigns it seems to, and a share is then of what noise could feign."""
    excesses = []
    for seed in range(12):
        folder = tmp_path / str(seed)
        state = fitted(folder, lambda x, v, _: 1000.0 * x + 200.0 * v, seed, **swings)
        base = state.base()
        excesses.append(base.excess / base.feigned)
    assert max(excesses) < 1.5
    assert np.median(excesses) < 0.3


def saturating(x, v, _):
    return 1000.0 * x + 200.0 * v + 20.0 * np.tanh(v / 0.01)


def test_estimated_effects_are_alike_by_the_noise_along_their_difference(tmp_path, monkeypatch):
    state = fitted(tmp_path, saturating, noise=0.05)
    base = state.base()
    names = ["coulomb_friction", "dahl_friction", "quadratic_damping"]
    scores = score_all(base, options(state, names), jobs=1)[0]
    results = refit_all(base, scores, NUMERICS)
    refits = {id(score): result for score, result in zip(scores, results, strict=True)}
    by_name = {item.effect: item for item in rank(scores, 10.0, refits, base=base)}
    assert by_name["coulomb_friction"].same == ()
    assert by_name["dahl_friction"].refit.inflation > 10.0, "what it leaves is coloured and large"
    right, wrong = (by_name[name].refit for name in ("coulomb_friction", "dahl_friction"))
    assert undecided(base, right, wrong) < 2.0 * POLICY.equal_likelihood
    # However much they differ, both ways round, and each pair is looked at once.
    seen = []
    monkeypatch.setattr(ranking, "undecided", lambda *pair: seen.append(pair) or np.inf)
    monkeypatch.setattr(Refit, "_leaves_clearly_less", lambda *_: False)
    known = rank(scores, 10.0, refits, base=base)
    assert {len(item.same) for item in known} == {2}
    assert len(seen) == 3


def models(residuals, *, reached=False):
    """Two estimated effects and what both were estimated against, by what they leave of one run."""
    measured = np.zeros((1, residuals[0].size))
    run = SimpleNamespace(scale=np.ones(residuals[0].size))
    base = SimpleNamespace(runs=[run], fit=SimpleNamespace(all_periodic=False))
    made = []
    for left in residuals:
        fit = SimpleNamespace(
            predictor=SimpleNamespace(runs=[SimpleNamespace(measured=measured)]),
            predictions=[SimpleNamespace(y=-left[None])],
        )
        fall = -float(left @ left)
        made.append(SimpleNamespace(fit=fit, fall=fall, reached=reached, policy=POLICY))
    return base, *made


@pytest.mark.parametrize("colour", [0.0, 0.9])
@pytest.mark.parametrize(("size", "parts"), [(3.0, 0.5), (30.0, 0.5), (100.0, 1.0)])
def test_two_wrong_models_are_told_apart_by_chance_in_one_case_of_twenty(colour, size, parts):
    """Each errs by half of their difference; or one errs alone, and is told apart."""
    rng = np.random.default_rng(7)
    place, told = np.arange(2000), []
    change = np.sin(2 * np.pi * place / 60.0) * np.exp(-place / 1500.0)
    change *= size / np.linalg.norm(change)
    for _ in range(300):
        noise = _coloured(rng, place.size, colour)
        base, one, other = models((noise + parts * change, noise + (parts - 1.0) * change))
        told.append(abs(one.fall - other.fall) > undecided(base, one, other))
    # Near zero the odds of twenty rule; of three hundred cases a twentieth is known to 1.3 %.
    if parts == 1.0:
        assert np.mean(told) > 0.95
    else:
        assert np.mean(told) < 0.05 + 3 * 0.0126


def test_one_that_is_right_is_told_apart_by_the_odds():
    rng = np.random.default_rng(8)
    noise = rng.standard_normal(4000)
    change = np.cos(np.arange(4000) / 20.0) * 0.2
    for size in (1.0, 100.0):
        base, right, wrong = models((noise, noise + size * change), reached=True)
        by_odds = undecided(base, right, wrong)
        # The noise along one smooth direction is known from a few lines. What the wrong one
        # leaves is no part of it.
        assert by_odds == pytest.approx(POLICY.equal_likelihood, rel=0.8)
        assert right.fall - wrong.fall > by_odds
    right.reached = False
    assert undecided(base, right, wrong) > 2.0 * by_odds
    assert undecided(base, wrong, right) == undecided(base, right, wrong)


def test_fits_that_do_not_differ_or_have_no_solution_have_no_noise_between_them():
    left = np.ones(50)
    base, one, other = models((left, left))
    assert noise_between(base, one.fit, other.fit) == (1.0, 0.0)
    base, one, other = models((left, np.full(50, np.nan)))
    assert noise_between(base, one.fit, other.fit) == (1.0, 0.0)
    assert difference.undecided(base, one, other) == POLICY.equal_likelihood
