"""A verdict counts what effects of physics explain, and says nothing is well where noise is odd."""

from __future__ import annotations

from types import SimpleNamespace as Stub

import numpy as np
import pytest

from bayesoleo import _schema as schema
from bayesoleo.discovery._loop import certainty_of, explained_by_physics, verdict_of
from bayesoleo.discovery._summary import _idle_inputs, _may_be_absent


def state(ratio, *families, floor=1.15, quiet=(), shift=0.05, expected=1.0):
    """A model with effects of some families, whose one held-out run has a ratio."""
    steps = [Stub(effect=Stub(id=family, family=family)) for family in families]
    entries = [Stub(run="a", output="y", repeating=ratio * expected, expected=expected)]
    return Stub(
        assembly=Stub(steps=steps, added=[(family, "x") for family in families]),
        at_floor=ratio < floor,
        too_quiet=quiet,
        hold_errors=Stub(entries=entries),
        fit_errors=Stub(entries=[]),
        fit=Stub(shift=shift),
    )


def added(family, before, after):
    """A round that added an effect, whose id is its family here."""
    candidate = Stub(candidate=Stub(family=family))
    accepted = Stub(effect=family, target="x", score=Stub(option=candidate))
    return Stub(before=before, after=after, accepted=accepted)


NONE = state(100.0)


def searched(*ratios_and_families):
    """Rounds that lower the ratio by effects of some families, one after the other."""
    rounds, present, families = [], NONE, []
    for ratio, family in ratios_and_families:
        families.append(family)
        after = state(ratio, *families)
        rounds.append(added(family, present, after))
        present = after
    return rounds, NONE, present


def test_down_to_what_is_expected_is_found_whatever_was_added():
    for family in ("friction", "nonparametric", "run-to-run"):
        assert verdict_of(*searched((1.0, family))) == schema.EFFECT_ADDED
    assert verdict_of([], state(1.0), state(1.0)) == schema.NOTHING_MISSING
    assert verdict_of([], NONE, NONE) == schema.UNEXPLAINED


def test_nine_tenths_must_be_explained_by_physics():
    # Squared: 100 to 13.6 is 98 %, and to 50 three quarters.
    assert verdict_of(*searched((13.6, "friction"))) == schema.EFFECT_ADDED
    assert verdict_of(*searched((50.0, "friction"))) == schema.UNEXPLAINED
    for symptom in ("run-to-run", "clock", "nonparametric"):
        assert verdict_of(*searched((13.6, symptom))) == schema.UNEXPLAINED
        mixed = searched((20.0, symptom), (13.6, "friction"))
        assert verdict_of(*mixed) == schema.UNEXPLAINED
        assert explained_by_physics(*mixed) == pytest.approx((20.0**2 - 13.6**2) / (100.0**2 - 1))
        assert verdict_of(*searched((13.6, "friction"), (10.0, symptom))) == schema.EFFECT_ADDED


@pytest.mark.parametrize("expected", [10.0, 300.0])
def test_a_model_that_expects_any_error_explains_none(expected):
    """Of 26 mm a gain of about zero left 21, and expected 7.7 where the noise was 0.02."""
    dead = state(80.0 / expected, "sensor", floor=0.0, expected=expected)
    rounds = [added("sensor", NONE, dead)]
    assert verdict_of(rounds, NONE, dead) == schema.UNEXPLAINED
    assert explained_by_physics(rounds, NONE, dead) == pytest.approx(0.36, abs=0.01)


def test_a_declared_model_that_expects_much_is_no_better():
    vague = state(10.0, expected=10.0)
    found = state(3.0, "friction")
    rounds = [added("friction", vague, found)]
    assert explained_by_physics(rounds, vague, found) == pytest.approx(1 - 8 / 9999)


def test_less_error_than_chance_allows_is_no_success():
    quiet = state(0.16, quiet=("too little",))
    assert verdict_of([], quiet, quiet) == schema.UNEXPLAINED
    found = state(0.16, "run-to-run", quiet=("too little",))
    assert verdict_of([added("run-to-run", NONE, found)], NONE, found) == schema.UNEXPLAINED
    physics = state(0.16, "friction", quiet=("too little",))
    assert verdict_of([added("friction", NONE, physics)], NONE, physics) == schema.UNEXPLAINED


def test_no_name_is_certain_on_a_mesh_that_moves_the_estimate():
    found = state(1.0, "friction", shift=2.0)
    assert certainty_of(found, certain=True) == "probable"


def test_certainty_of_names():
    assert certainty_of(state(1.0), certain=False) is None
    assert certainty_of(state(1.0, "friction"), certain=True) == schema.CERTAIN
    assert certainty_of(state(1.0, "friction", "nonparametric"), certain=False) == schema.LIKENESS
    assert certainty_of(state(13.6, "friction"), certain=False) == schema.LIKENESS
    assert certainty_of(state(1.0, "nonparametric", "clock"), certain=False) == schema.NO_CAUSE
    quiet = state(0.16, "friction", quiet=("too little",))
    assert certainty_of(quiet, certain=False) == schema.LIKENESS


@pytest.mark.parametrize(
    ("interval", "sd", "said"),
    [
        ([-1.0, 4.0], 9.0, True),
        ([1.0, 4.0], 9.0, False),  # draws know better than the curvature at the estimate
        (None, 1.5, True),
        (None, 0.5, False),
        (None, None, False),  # shared with a curve
    ],
)
def test_an_effect_whose_amplitude_may_be_zero_is_said_to_be_doubtful(interval, sd, said):
    """A round tells what its estimate explained; the final model may do without it."""
    effect = Stub(id="cubic_stiffness", family="stiffness")
    step = Stub(effect=effect, target="upper", amplitudes=("cubic_stiffness_upper",))
    state = Stub(assembly=Stub(steps=(step,)))
    own = {"estimate": 2.0, "interval": interval, "sd": sd}
    other = {"estimate": 0.0, "interval": [-1.0, 1.0], "sd": 1.0}
    notes = _may_be_absent(state, {"cubic_stiffness_upper": own, "gain": other})
    assert len(notes) == said
    assert all("cubic_stiffness at upper may be absent" in note for note in notes)


@pytest.mark.parametrize("drawn", [False, True])
@pytest.mark.parametrize("difference", [0.3, 30.0])
def test_amplitudes_of_which_only_differences_are_known_are_judged_together(drawn, difference):
    """What a run has more than others is known; what all have, the model's own parameter takes."""
    names = [f"varies[{run}]" for run in "abc"]
    mean = difference * np.array([-1.0, 0.0, 1.0])
    covariance = np.eye(3) + 1e6 * np.ones((3, 3))
    point = Stub(theta=mean, covariance=covariance)
    effect = Stub(id="varies_by_run", family="run-to-run")
    step = Stub(effect=effect, target="k", amplitudes=("varies",))
    fit = Stub(point=point, problem=Stub(names=names))
    state = Stub(assembly=Stub(steps=(step,)), fit=fit)
    samples = None
    if drawn:
        random = np.random.default_rng(1)
        draws = random.multivariate_normal(mean, covariance, size=(4, 500))
        samples = Stub(names=names, draws=draws)
    wide = {"estimate": 0.0, "interval": None, "sd": 1000.0}
    notes = _may_be_absent(state, dict.fromkeys(names, wide), samples)
    # Of three standard deviations of one difference the region holds nothing, of a third it does.
    assert [("95 % region of its amplitudes" in note) for note in notes] == [True] * (
        difference == 0.3
    )


@pytest.mark.parametrize(
    ("effect", "target", "error", "told"),
    [
        ("sensor_gain", "force", 24.0, True),
        ("sensor_gain", "force", -26.0, True),
        ("sensor_gain", "force", 0.2, False),
        ("sensor_gain", "place", 24.0, False),  # an output's gain says nothing of what acts
        ("sensor_offset", "force", 24.0, False),
    ],
)
def test_an_input_of_which_next_to_nothing_acts_is_told(effect, target, error, told):
    step = Stub(effect=Stub(id=effect), target=target, amplitudes=("amount",))
    fit = Stub(model=Stub(inputs={"force": "N"}), values={"amount": error})
    state = Stub(fit=fit, assembly=Stub(steps=[step]))
    found = _idle_inputs(state)
    assert len(found) == told
    assert all("leaves 4 % of what the channel shows" in note for note in found)
