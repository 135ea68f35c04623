"""When two estimated effects are one class, and when what varies by run is taken."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from small_campaigns import damper

from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._ranking import Ranked
from bayesoleo.discovery._refit import Inflation, Refit
from bayesoleo.discovery._round import _only_absorbs
from bayesoleo.model._drive_and_start import driven_by
from bayesoleo.model._kernels import kernels
from bayesoleo.systems import system

AS_LIKELY = SearchPolicy().equal_likelihood
ALONG, ACROSS = np.array([1.0, 0.0]), np.array([0.0, 1.0])
NEARLY = np.array([1.0, 0.1])
#: Of an unknown, with eight thousand samples.
PRICE = float(np.log(8000))


def estimated(
    fall, *, contribution=ALONG, reached=True, size=1, family="friction", usual=None, value=0.0
):
    """An effect after estimation that lowers the sum of squares by so much."""
    candidate = SimpleNamespace(family=family, usual=usual or {})
    score = SimpleNamespace(
        fall=fall, size=size, inflation=1.0, option=SimpleNamespace(candidate=candidate)
    )
    remaining = 100.0 if reached else 1.0e5
    fit = SimpleNamespace(
        problem=SimpleNamespace(names=("amplitude",)), point=SimpleNamespace(theta=(value,))
    )
    noise = Inflation(1.0, 0)
    return Refit(score, None, fit, 0.5, contribution, remaining, noise, fall, reached, PRICE)


@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_at_the_noise_the_likelihood_decides(factor):
    """Whatever the effects do: twenty to one is the edge."""
    best, other = estimated(200.0), estimated(200.0 - factor * AS_LIKELY, contribution=ACROSS)
    assert best.resembles(other) == (factor < 1)
    # What is better and was not taken is told apart by more: it was not excluded.
    assert other.resembles(best)
    assert not estimated(200.0 - 2.1 * AS_LIKELY).resembles(best)
    nearly = estimated(200.0 - factor * AS_LIKELY, contribution=NEARLY)
    assert best.resembles(nearly) == (factor < 1)


def test_a_superset_that_gains_nothing_is_no_rival():
    """An offset of each run explains what a constant force does; nobody needs it for that."""
    assert not estimated(200.0).resembles(estimated(200.0, size=4))
    assert estimated(200.0).resembles(estimated(200.0 + 3 * PRICE, size=4))


@pytest.mark.parametrize(
    ("fall", "reached", "out"), [(150, True, True), (199, True, False), (150, False, False)]
)
def test_what_was_only_scored_is_outdone_where_noise_is_left(fall, reached, out):
    assert estimated(200.0, reached=reached).outdoes(estimated(float(fall)).score) == out


def test_what_contains_an_effect_is_outdone_by_what_it_costs():
    """A value for each run scores as high as one for all, and higher where outputs bend."""
    best = estimated(200.0)
    assert best.outdoes(estimated(500.0, size=12).score)
    assert not best.outdoes(estimated(500.0, size=1).score)
    assert not estimated(200.0, reached=False).outdoes(estimated(500.0, size=12).score)


@pytest.mark.parametrize(("contribution", "alike"), [(NEARLY, True), (ACROSS, False)])
def test_away_from_the_noise_likeness_decides(contribution, alike):
    """There the likelihood of a wrong model is as sure as it is wrong."""
    best = estimated(1.0e5, reached=False)
    other = estimated(9.0e4, reached=False, contribution=contribution)
    assert best.resembles(other) == alike


@pytest.mark.parametrize(
    ("physics", "reached", "last"),
    [(50.0, True, False), (190.0, True, True), (50.0, False, True)],
    ids=["needed", "physics does as well", "not enough"],
)
def test_what_varies_by_run_is_taken_where_it_is_needed(physics, reached, last):
    """Four unknowns, eight thousand samples: it has to be better by 27."""
    varies = estimated(200.0, reached=reached, size=4, family="run-to-run")
    other = estimated(physics)
    refits = {id(r.score): r for r in (varies, other)}
    item = Ranked(varies.score, 0.0, 0.5, True, ())
    assert _only_absorbs(item, refits) == last
    assert not _only_absorbs(Ranked(other.score, 0.0, 0.5, True, ()), refits)


def test_models_of_the_same_equations_share_their_code():
    """Values of parameters, and whether they are estimated, change no expression."""
    model = damper()
    other = model.with_values({"damping": 123.0})
    assert other.structure == model.structure
    assert kernels(other, backend="numpy") is kernels(model, backend="numpy")
    moved = model.with_term("output", "force", "more", "damping*dot(displacement)**3")
    assert moved.structure != model.structure
    assert kernels(moved, backend="numpy") is not kernels(model, backend="numpy")


def test_a_driven_model_keeps_the_values_of_its_own():
    """The exchange of channels is remembered by the equations, not with its first values."""
    native = system("f16n2d2")
    driven_by(native, "displacement")
    other = driven_by(native.with_values({"solubility": -2e-8}), "displacement")
    assert other.parameters["solubility"].value == -2e-8
    assert driven_by(native, "displacement").parameters == native.parameters


@pytest.mark.parametrize(
    ("value", "reached", "last"),
    [(2.0, False, False), (-2.0, False, True), (-2.0, True, False)],
    ids=["mass", "less than none", "nothing else explains it"],
)
def test_what_is_unusual_is_taken_where_it_is_needed(value, reached, last):
    mass = estimated(200.0, reached=reached, usual={"amplitude": 1}, value=value)
    spring = estimated(150.0, reached=reached)
    refits = {id(r.score): r for r in (mass, spring)}
    assert _only_absorbs(Ranked(mass.score, 0.0, 0.5, True, ()), refits) == last
