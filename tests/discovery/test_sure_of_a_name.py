"""Effects that are one in other words, significance that only an estimate shows, and certainty."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bayesoleo.discovery import _loop
from bayesoleo.discovery._loop import ClosedLoop
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._round import _hidden, _may_be_significant
from bayesoleo.discovery._score_tests import Score, corrected_p, without_twins
from bayesoleo.discovery._structures import Structure, StructurePosterior, StructurePrior
from bayesoleo.discovery._summary import structures_entry
from bayesoleo.errors import InputError

TESTS, POLICY = 60.0, SearchPolicy()
LEVEL, SAME = POLICY.significance, POLICY.same_cosine


def score(effect, column, *, family="damping", target="stroke", fall=100.0, inflation=1.0):
    """A score of one unknown along a column."""
    column = np.asarray(column, dtype=float)
    candidate = SimpleNamespace(effect=effect, family=family, target=target, sign={}, shapes={})
    option = SimpleNamespace(candidate=candidate, key=(effect, target))
    rows = (column / np.linalg.norm(column))[None]
    return Score(option, ("a",), np.ones(1), {}, fall, 0.5, inflation, rows, column, np.sqrt(fall))


@pytest.mark.parametrize(
    ("change", "kept"),
    [
        ({}, 1),
        ({"family": "sensor"}, 2),
        ({"target": "other"}, 2),
        ({"column": [-1.0, -2.0]}, 1),
        ({"column": [1.0, 2.1]}, 2),
    ],
    ids=["same", "another cause", "another place", "other sign", "another direction"],
)
def test_twins_do_the_same_in_one_place_by_one_cause(change, kept):
    first = score("extension", [1.0, 2.0])
    second = score("compression", **({"column": [1.0, 2.0]} | change))
    found, twins = without_twins([first, second])
    assert len(found) == kept
    assert found[0] is first
    place = second.option.candidate.target
    said = {f"compression at {place}": "the same as extension in other words"}
    assert twins == (said if kept == 1 else {})


def ranked(one, gain):
    """As a round ranks it."""
    p = corrected_p(one, TESTS)
    return SimpleNamespace(score=one, absorbs=False, p_value=p, gain=gain)


def test_what_a_step_from_the_null_describes_badly_is_estimated_all_the_same():
    found = ranked(score("viscous", [1.0, 0.0], fall=50.0), 0.4)
    hidden = ranked(score("lag", [0.0, 1.0], fall=90.0, inflation=60.0), 0.3)
    noise = ranked(score("play", [1.0, 1.0], fall=5.0), 0.3)
    small = ranked(score("preload", [1.0, 1.0], fall=90.0, inflation=60.0), 0.05)
    assert found.p_value < LEVEL < hidden.p_value
    assert _hidden([found, hidden, noise, small], [found], TESTS, POLICY) == [hidden]
    assert _may_be_significant(small, TESTS, POLICY)
    assert not _may_be_significant(noise, TESTS, POLICY)


@pytest.fixture(autouse=True)
def twice(monkeypatch):
    """By chance an error is at most twice what is expected."""
    monkeypatch.setattr(_loop, "limit", lambda entries, tests, *, policy: 2.0)


def sibling(*, reached=True, family="contact", target="stroke"):
    """Another effect as the round ranked it."""
    option = SimpleNamespace(key=("preload", target), candidate=SimpleNamespace(family=family))
    return SimpleNamespace(
        score=SimpleNamespace(option=option), refit=SimpleNamespace(reached=reached)
    )


def loop(
    *, fall=2000.0, same=(), floor=True, left=0.5, effects=1, family="contact", held_out=1,
    ranking=(), before=10.0,
):  # fmt: skip
    """A loop that added effects, the first explaining so much."""
    refit = SimpleNamespace(fall=fall, inflation=1.0)
    option = SimpleNamespace(candidate=SimpleNamespace(family=family), key=("play", "stroke"))
    score = SimpleNamespace(option=option)
    accepted = SimpleNamespace(
        effect="play", target="stroke", same=same, refit=refit, beside=None, score=score
    )
    after = SimpleNamespace(accepted=None, ranking=[SimpleNamespace(p_value=left)], tests=TESTS)
    added = [SimpleNamespace(accepted=accepted, ranking=ranking, tests=TESTS)] * effects
    entry = SimpleNamespace(output="force", run="h", repeating=before, expected_error=1.0)
    first = SimpleNamespace(hold_errors=SimpleNamespace(entries=[entry] * held_out))
    final = SimpleNamespace(
        at_floor=floor,
        too_quiet=(),
        hold_errors=SimpleNamespace(entries=[entry] * held_out, at=lambda output, run: entry),
        assembly=SimpleNamespace(added=[("play", "stroke")] * effects),
    )
    return ClosedLoop((*added, after), first, final, None, ())


@pytest.mark.parametrize(
    ("change", "certain"),
    [
        ({}, True),
        ({"same": ("preload",)}, False),
        ({"floor": False}, False),
        ({"left": LEVEL / 2}, False),
        ({"effects": 2}, False),
        ({"effects": 0}, False),
        ({"family": "nonparametric"}, False),
        ({"held_out": 0}, False),
        ({"ranking": [sibling()]}, False),
        ({"ranking": [sibling(reached=False)]}, True),
        ({"ranking": [sibling(family="friction")]}, True),
        ({"ranking": [sibling(target="other")]}, True),
        # What the run would have shown without the effect is no more than chance allows with it.
        ({"before": 1.9}, False),
        ({"before": 2.1}, True),
        ({"before": np.nan}, True),
        # One in twenty of it would have to be found if a mere likeness had been named.
        ({"fall": 0.9 * 14.2 / (1 - SAME)}, False),
        ({"fall": 1.1 * 14.2 / (1 - SAME)}, True),
    ],
)
def test_a_name_is_certain_where_nothing_else_could_be(change, certain):
    # A hundredth shared by sixty tests leaves 1.7e-4 to each: 14.2 of chi-square.
    assert loop(**change).certain is certain


PLAY, OTHER = ("play", "stroke"), ("preload", "stroke")


def posterior(table):
    """Probabilities of structures, each ``(effects, outside)``."""
    found = [Structure(effects, outside, p, 0.0, True) for (effects, outside), p in table.items()]
    return StructurePosterior(tuple(found), StructurePrior())


@pytest.mark.parametrize(
    ("table", "certain"),
    [
        ({((PLAY,), False): 0.9, ((PLAY,), True): 0.06, ((), False): 0.04}, True),
        ({((PLAY,), False): 0.94, ((), False): 0.06}, False),
        ({((OTHER,), False): 1.0}, False),
    ],
)
def test_a_certain_name_is_probable_as_well(table, certain):
    assert replace(loop(), structures=posterior(table)).certain is certain


def weighed(table, same=()):
    """The entry of the summary where play was added, of a family with preload."""
    found = loop(same=same)
    ranking = [
        SimpleNamespace(score=score(effect, [1.0], family="contact"))
        for effect in ("play", "preload")
    ]
    rounds = (SimpleNamespace(accepted=found.rounds[0].accepted, ranking=ranking),)
    return structures_entry(replace(found, rounds=rounds, structures=posterior(table)), {})


def test_the_summary_lists_structures_down_to_99_percent():
    many = {((PLAY,), False): 0.6, ((OTHER,), False): 0.3}
    many |= {(((f"effect {k}", "x"),), False): 0.1 / 40 for k in range(40)}
    assert [one["probability"] for one in weighed(many)["list"][:2]] == [0.6, 0.3]
    assert len(weighed(many)["list"]) == 20
    assert len(weighed({((PLAY,), False): 0.992, ((OTHER,), False): 0.008})["list"]) == 1
    assert sum(weighed(many)["prior"][key] for key in ("nothing", "catalogue", "outside")) == 1.0


def test_a_class_counts_structures_with_several_of_its_effects_once():
    table = {((PLAY, OTHER), False): 0.5, ((PLAY,), False): 0.2, ((OTHER,), False): 0.2,
             ((), False): 0.1}  # fmt: skip
    (by_family,) = weighed(table)["classes"]
    (alike,) = weighed(table, same=("preload",))["classes"]
    assert by_family["family"] == "contact"
    assert alike["family"] is None
    # Not 0.7 + 0.7, which the single effects have together.
    assert by_family["probability"] == pytest.approx(0.9)
    assert alike["probability"] == pytest.approx(0.9)


def test_an_effect_that_stands_out_of_its_family_needs_no_class():
    assert weighed({((PLAY,), False): 0.995, ((OTHER,), False): 0.005})["classes"] == []


def test_a_search_without_probabilities_has_none_in_its_summary():
    assert structures_entry(loop(), {}) is None


@pytest.mark.parametrize(
    "error",
    [
        np.linalg.LinAlgError("Matrix is not positive definite"),
        ValueError("array must not contain infs or NaNs"),
        FloatingPointError("overflow"),
    ],
)
def test_what_was_found_stands_where_probabilities_fail(error, monkeypatch):
    found, ended = closed_without_probabilities(error, monkeypatch)
    assert ended.structures is None
    assert ended.rounds == found.rounds
    (note,) = ended.notes
    assert note == f"{_loop.NO_PROBABILITIES}: {error}"


def closed_without_probabilities(error, monkeypatch):
    """What was found, and the loop that ends with an error where probabilities are computed."""
    found, progress = loop(), SimpleNamespace(first=None, state=None, finished=False)

    def fails(*_):
        raise error

    for name, value in {
        "searched": lambda known, _: known, "best_of_beam": lambda known, *_: known,
        "_with_noise": lambda roles, _: roles, "loop_of": lambda *_: found, "probabilities": fails,
    }.items():  # fmt: skip
        monkeypatch.setattr(_loop, name, value)
    return found, _loop.close_loop(None, None, None, known=progress)


@pytest.mark.parametrize(
    "error", [ValueError("operands could not be broadcast"), InputError("no such effect", key="x")]
)
def test_mistakes_are_not_hidden_as_failures_of_numbers(error, monkeypatch):
    with pytest.raises(type(error)):
        closed_without_probabilities(error, monkeypatch)


def test_rounding_leaves_no_probability_above_one():
    quarter = np.nextafter(0.25, 1.0)
    outside = [((), True), ((PLAY,), True), ((OTHER,), True), ((PLAY, OTHER), True)]
    found = posterior(dict.fromkeys(outside, quarter))
    assert sum(one.probability for one in found.structures) > 1.0
    assert found.outside == 1.0
    acts = [((PLAY,), True), ((PLAY,), False), ((PLAY, OTHER), True), ((PLAY, OTHER), False)]
    assert posterior(dict.fromkeys(acts, quarter)).effects[PLAY] == 1.0
