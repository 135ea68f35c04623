"""What is said of a search that follows another first effect."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from bayesoleo.discovery import _alternatives as beam
from bayesoleo.discovery._hold_out_confirmation import Fall
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._round import Progress

TRIED, ROLES = "play was removed again", "run b is held out"


def ended(*effects: str, notes: tuple[str, ...] = ()) -> Progress:
    """A finished search with these effects, as far as notes ask for it."""
    assembly = SimpleNamespace(added=tuple((effect, "stroke") for effect in effects))
    return Progress(None, SimpleNamespace(assembly=assembly, at_floor=False), (), notes)


@pytest.mark.parametrize("notes", [(TRIED,), (ROLES, TRIED)])
def test_what_befell_one_search_is_not_said_of_another(monkeypatch, notes):
    """The note on the roles holds for both."""
    monkeypatch.setattr(beam, "confirmed", lambda *_: (SimpleNamespace(), "it explains more"))
    monkeypatch.setattr(beam, "lacks_input", lambda *_: None)
    opening = SimpleNamespace(before=None, ranking=(), failed={}, tests=1.0, accepted=None)
    progress = Progress(None, ended("play").state, (opening,), notes)
    first = SimpleNamespace(refit=SimpleNamespace())
    roles = SimpleNamespace(description=ROLES)
    found = beam._followed(progress, first, roles, None, lambda other, _: other, 4, print)
    assert found.notes == tuple(note for note in notes if note == ROLES)


def test_no_search_begins_with_what_hold_out_runs_lack_an_input_for(monkeypatch):
    monkeypatch.setattr(beam, "lacks_input", lambda *_: "no first harmonic")
    monkeypatch.setattr(beam, "confirmed", lambda *_: pytest.fail("it cannot be predicted"))
    opening = SimpleNamespace(before=None, ranking=(), failed={}, tests=1.0, accepted=None)
    progress = Progress(None, ended("play").state, (opening,), ())
    first = SimpleNamespace(refit=SimpleNamespace())
    assert beam._followed(progress, first, None, None, lambda other, _: other, 4, print) is None


def test_a_model_that_leaves_more_is_not_said_to_leave_less():
    """Causes go before what merely varies from run to run, at a small price."""
    told = [
        beam._with_notes(ended("offset"), ended("play"), gap, print).notes[-1]
        for gap in (12.0, -3.0)
    ]
    assert "instead of offset the model has play" in told[0]
    assert told[0].endswith("falls by 12")
    assert told[1].endswith("rises by 3 only, and they name causes")
    told = beam._with_notes(ended("offset"), ended("play"), -3.0, print, symptom=False).notes[-1]
    assert told.endswith("rises by 3, and hold-out runs speak for them by more")


@pytest.mark.parametrize("turn", [1.0, -1.0])
def test_hold_out_runs_count_as_likelihoods_with_the_fitted_ones(monkeypatch, turn):
    """A fall of noise with the variance I is I times twice a logarithm of likelihoods."""
    rng = np.random.default_rng(2)
    change, inflation = rng.standard_normal(200), 7.0
    noise = np.sqrt(inflation) * rng.standard_normal(200)
    one, other = noise + change, noise
    size, fall = float(change @ change), float(np.sum(one**2) - np.sum(other**2))
    found = Fall(turn * fall, 2.0 * np.sqrt(inflation * size), size)
    monkeypatch.setattr(beam, "judged", lambda *states: states)
    monkeypatch.setattr(beam, "fall_on_hold_out", lambda *_: found)
    exact = np.sum(stats.norm.logpdf(other, scale=np.sqrt(inflation)))
    exact -= np.sum(stats.norm.logpdf(one, scale=np.sqrt(inflation)))
    assert beam.hold_out_gap(None, None) == pytest.approx(2.0 * turn * exact)
    # Where parameters of either model are known less, hold-out runs say less.
    found = Fall(fall, 1.0, size, 20.0 * np.sqrt(size))
    assert abs(beam.hold_out_gap(None, None)) < 0.1 * abs(fall)


@pytest.mark.parametrize(("by_others", "taken"), [(-30.0, "one"), (0.0, "both"), (30.0, "other")])
@pytest.mark.parametrize("declared", [True, False])
def test_of_two_models_that_fit_alike_hold_out_runs_take_one(
    monkeypatch, declared, by_others, taken
):
    """Those that are held out in turn took part in the fits already, and count once."""
    monkeypatch.setattr(beam, "likelihood_gap", lambda *_: (1.0, 2.0))
    monkeypatch.setattr(beam, "hold_out_gap", lambda *_: by_others)
    monkeypatch.setattr(beam, "contradicted", lambda *_: False)
    monkeypatch.setattr(beam, "_with_classes", lambda *_: "both")
    monkeypatch.setattr(beam, "_absorbs", lambda _: False)
    one, other = (
        SimpleNamespace(
            state=SimpleNamespace(
                assembly=SimpleNamespace(added=(name,), steps=()), at_floor=False
            ),
            rounds=(),
        )
        for name in ("one", "other")
    )
    monkeypatch.setattr(beam, "_with_notes", lambda _, found, *__, **___: found)
    found = beam._better(one, other, declared, SearchPolicy(), print)
    known = {id(one): "one", id(other): "other"}
    assert known.get(id(found), found) == (taken if declared else "both")


@pytest.mark.parametrize(
    ("added", "floor", "goes_on"), [(2, False, True), (1, False, False), (2, True, False)]
)
def test_a_search_that_was_stopped_for_a_comparison_goes_on(monkeypatch, added, floor, goes_on):
    """Only its first rounds are compared with equally many effects; what it may add is the user's
    limit."""
    opening = SimpleNamespace(accepted=None)
    taken = tuple(f"cause {k}" for k in range(added))
    state = SimpleNamespace(
        assembly=SimpleNamespace(added=[(one, "stroke") for one in taken], steps=taken),
        at_floor=floor,
    )
    first = SimpleNamespace(effect=taken[0], target="stroke")
    stopped = Progress(None, state, (opening, "added", "ranked only"), ())
    asked = []

    def follow(progress, most):
        asked.append((progress.rounds, most))
        return "carried on"

    monkeypatch.setattr(beam, "followed", lambda *_: [first])
    monkeypatch.setattr(beam, "leads_as_far", lambda *_: True)
    monkeypatch.setattr(beam, "_followed", lambda *_: stopped)
    monkeypatch.setattr(beam, "_better", lambda best, other, *_: other)
    progress = Progress(None, ended("play").state, (opening,), ())
    numerics, roles = SimpleNamespace(policy=None), SimpleNamespace(strategy="declared")
    found = beam.best_of_beam(progress, roles, numerics, follow, None, 6, lambda _: None)
    assert (found == "carried on") is goes_on
    assert asked == ([((opening, "added"), 6)] if goes_on else [])
