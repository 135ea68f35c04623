"""A quick search ends by the work that it has done, and a longer one goes on from there."""

from __future__ import annotations

from dataclasses import replace

import cloudpickle
import numpy as np
import pytest
from small_campaigns import damper, damper_campaign, with_friction

from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._loop import close_loop
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._work import ENDED, work_of
from bayesoleo.effects import find_effect

EFFECTS = tuple(map(find_effect, ("coulomb_friction", "quintic_stiffness", "constant_force")))
NUMERICS = Numerics(jobs=1)


@pytest.fixture(scope="module", params=[False, True], ids=["periodic", "transient"])
def searched(request, tmp_path_factory):
    """Roles of a campaign, its search to the end, and all that was kept of it."""
    folder = tmp_path_factory.mktemp("campaign")
    reduced = damper_campaign(folder, with_both, transient=request.param)
    roles, kept = assign(reduced.records), []
    return roles, closed(roles, keep=kept.append), kept


def with_both(x, v, t):
    """Friction and a constant force, of which the declared damper has neither."""
    return with_friction(x, v, t) + 4.0


def closed(roles, **more):
    return close_loop(Assembly(damper()), roles, NUMERICS, effects=EFFECTS, seed=3, **more)


@pytest.mark.slow
def test_each_round_adds_to_the_work(searched):
    _, loop, kept = searched
    work = [work_of(item) for item in kept]
    assert len(loop.effects) == 2
    assert work == sorted(work)
    assert work[0] < work[1]
    fit = kept[0].first.fit
    evaluations = fit.point.evaluations + fit.mbe.evaluations
    samples = sum(record.time.size for record in fit.records)
    assert work[0] == evaluations * samples * (1 + len(fit.problem.names))
    assert loop.complete


@pytest.mark.slow
def test_it_ends_after_the_round_in_which_the_work_was_done(searched):
    roles, loop, kept = searched
    found = closed(roles, most_work=work_of(kept[1]) - 1.0)
    assert len(found.rounds) == 2
    assert found.rounds[-1].reason == ENDED
    assert found.effects == loop.effects[:1]
    assert not found.complete
    assert not found.certain
    assert not found.final.at_floor
    # What the last round ranks tells what might be missing.
    assert found.rounds[-1].ranking
    # Of structures that nobody looked for there are no probabilities.
    assert found.structures is None
    assert loop.structures is not None


def test_a_first_round_is_always_looked_at(searched):
    roles, loop, _ = searched
    found = closed(roles, most_work=1.0)
    assert found.effects == loop.effects[:1]


@pytest.mark.slow
def test_a_search_that_ends_by_itself_is_complete_whatever_its_work(searched):
    roles, loop, kept = searched
    found = closed(roles, most_work=work_of(kept[-2]) - 1.0)
    assert found.rounds[-1].reason == loop.rounds[-1].reason
    assert found.complete
    assert found.effects == loop.effects


@pytest.mark.slow
def test_it_is_not_noticed_where_less_was_to_be_done(searched):
    roles, loop, kept = searched
    found = closed(roles, most_work=2.0 * work_of(kept[-1]))
    assert found.complete
    assert found.effects == loop.effects
    np.testing.assert_array_equal(found.final.fit.point.theta, loop.final.fit.point.theta)


@pytest.mark.slow
def test_without_the_limit_it_goes_on_to_the_same_end(searched):
    roles, loop, kept = searched
    reached = []
    closed(roles, most_work=work_of(kept[1]) - 1.0, keep=reached.append)
    known = cloudpickle.loads(cloudpickle.dumps(reached[-1]))
    assert not known.finished, "what was on trial is judged for the result alone"
    again = closed(roles, known=known)
    assert again.complete
    assert again.effects == loop.effects
    assert [item.reason for item in again.rounds] == [item.reason for item in loop.rounds]
    np.testing.assert_array_equal(again.final.fit.point.theta, loop.final.fit.point.theta)


def test_it_ends_as_quickly_when_it_is_resumed(searched):
    roles, _, kept = searched
    found = closed(roles, known=kept[1], most_work=work_of(kept[1]) - 1.0)
    assert [item.reason for item in found.rounds][1:] == [ENDED]


def test_an_effect_on_trial_waits_for_the_one_that_it_was_added_for(searched):
    """The pair was confirmed together; either alone was not."""
    roles, loop, kept = searched
    first = replace(kept[1].rounds[0], on_trial=True)
    found = closed(roles, known=replace(kept[1], rounds=(first,)), most_work=1.0)
    assert found.effects == loop.effects
    assert found.complete


@pytest.mark.slow
def test_most_effects_are_a_reason_of_their_own(searched):
    roles, loop, _ = searched
    found = closed(roles, most_work=1.0, max_effects=1)
    assert found.rounds[-1].reason.startswith("the largest allowed number of effects")
    assert found.complete
    assert found.effects == loop.effects[:1]
