"""A search that was stopped goes on after its last finished round to the same end."""

from __future__ import annotations

from dataclasses import replace

import cloudpickle
import numpy as np
import pytest
from small_campaigns import damper, damper_campaign

from bayesoleo.discovery import _state
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._loop import close_loop, loop_of
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.effects import find_effect

EFFECTS = tuple(map(find_effect, ("coulomb_friction", "quintic_stiffness", "constant_force")))
NUMERICS = Numerics(jobs=1)


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    reduced = damper_campaign(tmp_path_factory.mktemp("campaign"))
    roles, kept = assign(reduced.records), []
    loop = close_loop(
        Assembly(damper()), roles, NUMERICS, effects=EFFECTS, seed=3, keep=kept.append
    )
    return roles, loop, kept


def test_progress_is_kept_after_the_estimate_and_each_round(searched):
    _, loop, kept = searched
    assert [len(item.rounds) for item in kept] == list(range(len(loop.rounds) + 1))
    assert [item.finished for item in kept] == [False] * len(loop.rounds) + [True]


@pytest.mark.parametrize("rounds", [0, 1, 2])
def test_it_goes_on_from_any_round_to_the_same_end(searched, rounds):
    roles, loop, kept = searched
    # As it comes back from a file: nothing is shared with the search that was stopped.
    known = cloudpickle.loads(cloudpickle.dumps(kept[rounds]))
    later: list[object] = []
    again = close_loop(
        Assembly(damper()), roles, NUMERICS, effects=EFFECTS, seed=3,
        known=known, keep=later.append,
    )  # fmt: skip
    assert len(later) == len(loop.rounds) - rounds
    assert (again.effects, again.verdict) == (loop.effects, loop.verdict)
    np.testing.assert_array_equal(again.final.fit.point.theta, loop.final.fit.point.theta)
    assert [item.reason for item in again.rounds] == [item.reason for item in loop.rounds]


def test_a_search_that_broke_off_ends_in_a_round_that_says_why(searched):
    roles, _, kept = searched
    loop = loop_of(kept[1].ended("it broke off"), roles)
    assert [item.reason for item in loop.rounds][1:] == ["it broke off"]
    assert loop.effects == ("coulomb_friction",)
    assert loop.rounds[-1].before is loop.final
    finished = kept[-1]
    broken = finished.ended("never said")
    assert broken.rounds == finished.rounds
    assert not finished.broken
    # Its effects had still to be looked at beside each other.
    assert broken.broken
    assert not loop_of(broken, roles).certain
    assert replace(finished, rounds=finished.rounds[:1]).finished is False


@pytest.mark.parametrize("another_first_effect", [False, True])
def test_what_stands_so_far_is_given_ahead_and_dropped_where_the_search_is_done_again(
    searched, monkeypatch, another_first_effect
):
    roles, loop, kept = searched
    events: list[object] = []

    def beam(progress, roles, numerics, follow, *_):
        events.append("beam")
        return follow(replace(progress), 2) if another_first_effect else progress

    def provisional(found):
        events.append(found)
        return lambda: events.append("drop")

    monkeypatch.setattr("bayesoleo.discovery._loop.best_of_beam", beam)
    again = close_loop(
        Assembly(damper()), roles, NUMERICS, effects=EFFECTS, seed=3,
        known=cloudpickle.loads(cloudpickle.dumps(kept[-1])), provisional=provisional,
    )  # fmt: skip
    given, *rest = events
    assert rest == (["beam", "drop"] if another_first_effect else ["beam"])
    # Structures are left to the caller, of the search that the result is of.
    assert again.structures is None
    assert (again is given) == (not another_first_effect)
    assert again.effects == loop.effects


def test_the_base_of_a_state_is_made_once_and_not_kept_for_all(searched):
    _, loop, _ = searched
    one, two = (entry.before for entry in loop.rounds[:2])
    base = one.base()
    assert two.base() is not base
    assert one.base() is base
    # States of their own, though of the same value; only the last two are kept.
    copies = [replace(two) for _ in range(2)]
    assert copies[0].base() is not copies[1].base()
    assert one.base() is not base
    np.testing.assert_array_equal(one.base().gram, base.gram)


def test_bases_go_with_their_states(searched):
    _, loop, _ = searched
    bases, state = _state._Bases(), replace(loop.first)
    bases.of(state)
    assert list(bases.kept) == [id(state)]
    del state
    assert not bases.kept
