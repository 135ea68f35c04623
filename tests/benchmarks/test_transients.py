"""The benchmark of transients compares solutions of one problem."""

from __future__ import annotations

from transients import error_of, exact, ours, vectors


def test_the_package_solves_the_transient_that_the_peer_is_given():
    p = vectors(2)
    solve, of = ours()
    # The default tolerance of a motion is 1e-8 of its size; its sensitivities lose a digit.
    assert error_of(of(solve(p), 0), exact(p[0])) < 1e-7
