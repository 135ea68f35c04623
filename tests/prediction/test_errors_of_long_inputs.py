"""Errors of the inputs of long transients, a few at a time, and what is kept of them."""

import numpy as np
import pytest

from bayesoleo.prediction._band_limited import Smoothed
from bayesoleo.prediction._run_errors import _Draws, _Known, _Lines


def test_lines_by_two_tables_are_cosines_and_their_derivatives():
    rng = np.random.default_rng(0)
    span, position = 7.0, np.sort(rng.random(50))
    omega = np.pi * np.arange(70) / span  # beyond several tables
    size, orders = rng.random(70), (0, 1, 2, 3)
    block = _Lines(omega, size, orders, position)
    time = span * position
    for first, last in ((0, 70), (33, 40)):
        chosen = slice(first, last)
        expected = [
            (size * omega**k)[chosen, None] * np.cos(np.outer(omega, time) + k * np.pi / 2)[chosen]
            for k in orders
        ]
        np.testing.assert_allclose(
            block.of(first, last), expected, rtol=0, atol=1e-11 * np.max(np.abs(expected))
        )


def test_a_part_of_known_changes_is_that_part():
    changes = np.arange(24.0).reshape(2, 4, 3)
    np.testing.assert_array_equal(_Known(changes).of(1, 3), changes[:, 1:3])


@pytest.mark.parametrize(("most", "kept"), [(0.0, 1), (1e12, 4)])
def test_draws_of_the_curves_asked_for_last_are_kept_as_far_as_there_is_room(most, kept):
    curves = [Smoothed(0.1, np.zeros((20, 3)), 1.0, 1e-3) for _ in range(4)]
    draws = _Draws(most)
    found = [draws.of(curve, 16) for curve in curves]
    assert len(draws.kept) == kept
    assert draws.of(curves[-1], 16)[3] is found[-1][3]


def test_the_first_of_many_draws_are_the_few():
    """So that what asks for many changes nothing for what asks for few."""
    curve = Smoothed(0.1, np.zeros((20, 3)), 1.0, 1e-3)
    few, draws = _Draws(1e12).of(curve, 16), _Draws(1e12)
    many = draws.of(curve, 40)
    assert (len(few), len(many)) == (16, 40)
    for one, other in zip(few, many, strict=False):
        np.testing.assert_array_equal(one.states, other.states)
    assert draws.of(curve, 16)[0] is many[0]
