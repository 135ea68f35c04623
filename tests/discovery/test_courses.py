"""Courses of further terms are inputs of a model: their derivatives, and what is computed once."""

import numpy as np
import pytest

from bayesoleo.discovery._nonparametric_quantities import _Course, _Remembered

PERIOD, PHASE = 2.0, np.linspace(0.1, 0.9, 50)


def courses():
    """Two courses, and the phases for which they were asked."""
    asked = []

    def values(phase):
        asked.append(phase)
        return np.array([np.sin(2 * np.pi * phase), np.cos(4 * np.pi * phase)])

    remembered = _Remembered(values)
    return [_Course(remembered, k, 1 / PERIOD) for k in range(3)], asked


@pytest.mark.parametrize("order", [0, 1, 2])
def test_derivatives_are_those_of_the_course(order):
    items, _ = courses()
    for item, angle, start in zip(items, (2 * np.pi, 4 * np.pi), (0.0, np.pi / 2), strict=False):
        # Every derivative of a sine is a quarter of a turn ahead of the one before.
        turn = angle * PHASE + start + order * np.pi / 2
        found = item.evaluate(PHASE, 1 / PERIOD, order)
        # Round-off over the square of a step of 1e-6.
        exact, error = (angle / PERIOD) ** order * np.sin(turn), (1e-12, 1e-8, 1e-3)[order]
        np.testing.assert_allclose(found, exact, atol=error)


def test_all_courses_are_computed_at_once():
    items, asked = courses()
    for item in items:
        item.evaluate(PHASE, 1 / PERIOD, 1)
    assert len(asked) == 2  # on either side
    remembered = items[0].courses
    assert remembered.derivative(PHASE, 1) is remembered.derivative(PHASE, 1)
    items[0].evaluate(PHASE.copy(), 1 / PERIOD, 1)
    assert len(asked) == 2  # phases are known by their values
    items[0].evaluate(PHASE + 0.01, 1 / PERIOD, 1)
    assert len(asked) == 4


def test_there_are_no_more_courses_than_there_are():
    items, _ = courses()
    assert not items[2].evaluate(PHASE, 1 / PERIOD, 1).any()
