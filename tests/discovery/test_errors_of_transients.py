"""What is left of transients: how much, which part an effect explains, which effects are alike."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import NUMERICS, options
from small_campaigns import DAMPER_RUNS, _coloured, damper, damper_campaign

from bayesoleo.data._noise import local_average, local_means
from bayesoleo.discovery import _fit_difference as difference, _ranking as ranking
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._fit_difference import Undecided, noise_between, undecided
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


def fitted(folder, force, seed=0, masked=0.0, **more):
    """The damper's linear law, a part of the samples masked at random."""
    reduced = damper_campaign(folder, force, seed=seed, **(MANY | more))
    rng = np.random.default_rng(seed)
    records = tuple(
        replace(record, kept=rng.random(record.time.size) > masked) if masked else record
        for record in reduced.records
    )
    return fit_state(Assembly(damper(cubic=False)), assign(records), NUMERICS)


@pytest.mark.slow
@pytest.mark.parametrize("force", [smooth, spiky])
def test_errors_of_hundreds_of_swings_are_seen(tmp_path, force):
    """Averages over whole swings would have left nothing of them."""
    state = fitted(tmp_path, force)
    for entry in state.fit_errors.entries:
        beyond = entry.repeating**2 - entry.noise**2
        # The noise is of 1 N; differences see a part of the peaks, and chance is left out.
        assert beyond > 0.6 * (entry.rms**2 - 1.0)
    assert not state.at_floor


@pytest.mark.slow
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
        # Three standard errors are left to the noise, and the denominator holds what it feigns.
        assert result.share == pytest.approx(result.fall / beyond, rel=0.15)
        assert result.share < 1.15


def peaks(x, v, _):
    return 1000.0 * x + 200.0 * v + 5.0 * np.exp(-((v / 0.001) ** 2)) * np.sign(x)


@pytest.mark.slow
def test_shares_of_short_errors_in_slow_motions_are_of_single_samples(tmp_path):
    """Averages over thirty samples lose most of a peak of ten, which holds little of the force."""
    state = fitted(tmp_path, peaks, **(FEW | {"noise": 0.2}))
    base, entries = state.base(), state.fit_errors.entries
    averaged = sum((e.average.repeating**2 - e.noise**2) / e.rms**2 for e in entries)
    assert averaged < 0.6 * sum(1.0 - 0.04 / e.rms**2 for e in entries)
    sizes = [len(record.time) for record in state.fit.records]
    beyond = sum(n * (e.rms**2 / e.sigma**2 - 1.0) for n, e in zip(sizes, entries, strict=True))
    # Less three standard errors of it.
    assert 0.85 * beyond < base.excess < beyond


def plain(x, v, _):
    return 1000.0 * x + 200.0 * v


@pytest.mark.slow
@pytest.mark.parametrize("swings", [MANY, FEW])
@pytest.mark.parametrize("masked", [0.0, 0.1, 0.3])
def test_noise_has_no_excess(tmp_path, swings, masked):
    """In one of forty campaigns it seems to, and a share is then of what noise could feign. What
    bridges masked samples is smooth, and no part of the noise."""
    excesses, ratios = [], []
    for seed in range(4):
        state = fitted(tmp_path / str(seed), plain, seed, masked, **swings)
        base = state.base()
        excesses.append(base.excess / base.feigned)
        ratios += [entry.ratio for entry in state.errors.entries]
        assert state.at_floor
    assert max(excesses) < 1.5
    assert np.median(excesses) < 0.5
    # Twenty ratios of two hundred averages; masked ones know their noise from fewer differences.
    assert np.mean(np.square(ratios)) == pytest.approx(1.0, abs=0.1)


@pytest.mark.slow
def test_slow_errors_beside_fast_motions_are_seen(tmp_path):
    def drifting(x, v, time):
        return plain(x, v, time) + 0.6 * np.sin(2 * np.pi * 1.3 * time / time[-1])

    state = fitted(tmp_path, drifting, **MANY)
    assert not state.at_floor
    assert all(entry.ratio > 1.5 for entry in state.fit_errors.entries)


@pytest.mark.slow
def test_a_short_burst_at_the_start_is_seen(tmp_path):
    def begun(x, v, time):
        return plain(x, v, time) + 6.0 * np.sin(time * 900.0) * (time < 0.02 * time[-1])

    state = fitted(tmp_path, begun, **(FEW | {"noise": 0.3}))
    assert not state.at_floor


@pytest.mark.slow
@pytest.mark.parametrize("masked", [0.0, 0.3])
def test_errors_of_poorly_known_unknowns_are_no_missing_effect(tmp_path, masked):
    """They are as fast as the motion: single samples of hold-out runs show them."""
    runs = (("a", 1.0, 0.0002, "fit"), ("d", 1.5, 0.010, "hold-out"), ("e", 1.0, 0.012, "hold-out"))
    for seed, swings in enumerate((MANY, FEW, MANY, FEW)):
        state = fitted(tmp_path / str(seed), plain, seed, masked, runs=runs, **swings)
        assert state.at_floor
        assert not state.too_quiet


def test_averages_of_masked_samples_are_of_the_others():
    values, kept = np.arange(12.0), np.ones(12, dtype=bool)
    kept[[1, 2, 8, 9, 10, 11]] = False
    np.testing.assert_allclose(local_means(values, kept)[[0, 4, 8]], [1.5, 5.5, 0.0])
    found = local_average(values, 2.0, kept)
    # Blocks of two, four and no samples.
    assert found.noise == pytest.approx(2.0 * np.sqrt((1 / 2 + 1 / 4) / 3))
    assert (found.samples, found.number, found.differences) == (6, 3, 1)


def saturating(x, v, _):
    return plain(x, v, _) + 20.0 * np.tanh(v / 0.01)


@pytest.mark.slow
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
    assert undecided(base, right, wrong).most < 2.0 * POLICY.equal_likelihood
    # However much they differ, both ways round, and each pair is looked at once.
    seen = []
    monkeypatch.setattr(ranking, "undecided", lambda *pair: seen.append(pair) or Undecided(np.inf))
    monkeypatch.setattr(Refit, "_leaves_clearly_less", lambda *_: False)
    known = rank(scores, 10.0, refits, base=base)
    assert {len(item.same) for item in known} == {2}
    assert len(seen) == 3


def models(residuals, *, reached=False):
    """Two estimated effects and what both were estimated against, by what they leave of one run."""
    measured = np.zeros((1, residuals[0].size))
    run = SimpleNamespace(scale=np.ones(residuals[0].size))
    record = SimpleNamespace(periodic=False)
    base = SimpleNamespace(runs=[run], fit=SimpleNamespace(all_periodic=False, records=[record]))
    made = []
    for left in residuals:
        fit = SimpleNamespace(
            predictor=SimpleNamespace(runs=[SimpleNamespace(measured=measured)]),
            predictions=[SimpleNamespace(y=-left[None])],
        )
        fall = -float(left @ left)
        made.append(SimpleNamespace(fit=fit, fall=fall, reached=reached, policy=POLICY))
    return base, *made


@pytest.mark.slow
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
        told.append(abs(one.fall - other.fall) > undecided(base, one, other).most)
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
        by_odds = undecided(base, right, wrong).most
        # The noise along one smooth direction is known from a few lines. What the wrong one
        # leaves is no part of it.
        assert by_odds == pytest.approx(POLICY.equal_likelihood, rel=0.8)
        assert right.fall - wrong.fall > by_odds
    right.reached = False
    assert undecided(base, right, wrong).most > 2.0 * by_odds
    assert undecided(base, wrong, right) == undecided(base, right, wrong)


def test_fits_that_do_not_differ_or_have_no_solution_have_no_noise_between_them():
    left = np.ones(50)
    base, one, other = models((left, left))
    assert noise_between(base, one.fit, other.fit) == (1.0, 0.0)
    base, one, other = models((left, np.full(50, np.nan)))
    assert noise_between(base, one.fit, other.fit) == (1.0, 0.0)
    assert difference.undecided(base, one, other).most == POLICY.equal_likelihood


@pytest.mark.slow
@pytest.mark.parametrize("transients", [False, True])
def test_white_noise_between_fits_is_that_of_the_samples(tmp_path, transients):
    """Of periodic runs, and of these beside transients."""
    records = damper_campaign(tmp_path / "periodic", plain, noise=0.5).records
    if transients:
        named = tuple((f"t{run[0]}", *run[1:]) for run in DAMPER_RUNS)
        more = damper_campaign(tmp_path / "more", plain, noise=0.5, runs=named, transient=True)
        records = (*records, *more.records)
    state = fit_state(Assembly(damper(cubic=False)), assign(records), NUMERICS)
    base = state.base()
    names = ["quadratic_damping", "cubic_stiffness"]
    scores = score_all(base, options(state, names), jobs=1)[0]
    one, other = refit_all(base, scores, NUMERICS)
    noise, length = noise_between(base, one.fit, other.fit)
    assert noise_between(base, other.fit, one.fit) == pytest.approx((noise, length))
    assert length > 0.0
    # A spectrum of a few lines knows it to a half.
    assert 1.0 <= noise < 2.0
