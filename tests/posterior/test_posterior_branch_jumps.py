"""Solutions that left their branch are counted through segments, restarts and the stored groups."""

from __future__ import annotations

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from kill_target import run
from posterior_targets import Gaussian

from bayesoleo.discovery._summary import _sampler_notes
from bayesoleo.model._priors import Normal
from bayesoleo.posterior import LogDensity, to_datasets


class Jumping(Gaussian):
    """Says of every row beyond two that its solution left the branch."""

    def __init__(self) -> None:
        super().__init__(np.ones(2))
        self.branch_jumps = 0

    def __call__(self, phi):
        self.branch_jumps += int(np.sum(phi[:, 0] > 2.0))
        return super().__call__(phi)


def test_jumps_are_counted_and_outlive_a_restart(tmp_path):
    target = Jumping()
    # The search for other modes looks far beyond what is sampled: its jumps say nothing of that.
    first = run(target, tmp_path, climbs=0)
    assert first.branch_jumps == target.branch_jumps > 0
    # Of a normal density 2.3 % lie beyond two; proposals that are refused count too.
    assert 0.01 < first.jumped_part < 0.1
    again = Jumping()
    resumed = run(again, tmp_path, climbs=0)
    assert resumed.branch_jumps == first.branch_jumps
    assert resumed.jumped_part == first.jumped_part
    assert again.branch_jumps == 0
    groups = to_datasets(first, (Normal(0, 1), Normal(0, 1)))
    assert groups["sample_stats"].attrs["branch_jumps"] == first.branch_jumps


@pytest.mark.parametrize(("part", "told"), [(0.0, False), (1e-4, False), (0.03, True)])
def test_jumps_are_told_where_they_may_move_an_interval(part, told):
    """One of thousands of solutions mixes no answers."""
    samples = SimpleNamespace(warning="", branch_jumps=25, evaluations=17513, jumped_part=part)
    notes = _sampler_notes(samples)
    assert len(notes) == told
    if told:
        assert "may be 3 % of the draws: the posterior may mix several answers" in notes[0]


class Watching(Gaussian):
    """Keeps whether each row was watched."""

    def __init__(self) -> None:
        super().__init__(np.ones(2))
        self.watched, self.rows = True, {True: 0, False: 0}

    @contextmanager
    def unwatched(self):
        self.watched = False
        yield
        self.watched = True

    def __call__(self, phi):
        self.rows[self.watched] += len(phi)
        return super().__call__(phi)


def test_only_the_search_for_modes_is_not_watched():
    without, target = Watching(), Watching()
    run(without, None, climbs=0)
    assert without.rows[False] == 0
    run(target, None, climbs=4)
    assert target.rows[True] == without.rows[True]
    assert target.rows[False] > 0


def test_a_density_that_counts_none_has_none():
    assert run(Gaussian(np.ones(2)), None).branch_jumps == 0


class Solved:
    """A problem whose runs have solutions, some of which jumped."""

    names, outputs, runs = ("x",), ("y",), ("a", "b")
    priors, counts = (Normal(0.0, 1.0),), np.ones((2, 1), dtype=np.int64)
    branch_jumps = np.array([2, 1])


def test_the_log_density_takes_the_count_from_its_problem():
    assert LogDensity(Solved()).branch_jumps == 3
