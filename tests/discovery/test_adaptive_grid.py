"""A density on few places has the quantiles that it has on many."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import log_expit

from bayesoleo.discovery._adaptive_grid import MOST, on_a_grid

CHANCES = np.array([0.05, 0.25, 0.5, 0.75, 0.95])
LOW, HIGH = -8.0, 8.0


def flat(place):
    return np.where((place >= LOW) & (place <= HIGH), 0.0, -np.inf)


def wide(place):
    return -0.5 * (place / 3.0) ** 2


#: Logarithms of likelihoods, with what linearisation might expect: mean and deviation.
SHAPES = {
    "normal": (lambda x: -0.5 * ((x - 1.0) / 0.4) ** 2, 1.0, 0.4),
    "much narrower than expected": (lambda x: -0.5 * ((x - 1.0) / 0.05) ** 2, 1.0, 2.0),
    "much wider than expected": (lambda x: -0.5 * ((x - 1.0) / 2.0) ** 2, 1.0, 0.05),
    "cliff": (lambda x: 30.0 * log_expit(25.0 * (1.7 - x)), -1.0, 0.5),
    "slope and cliff": (lambda x: 1.5 * x + 300.0 * log_expit(25.0 * (2.2 - x)), 1.0, 0.5),
    "plateau": (lambda x: -4.0 * np.exp(-np.exp(0.7 * (x + 1.0))), 1.0, 0.3),
    "nothing known": (lambda x: 0.0 * x, 0.0, 1.0),
}


def sides(mean: float, sd: float) -> list[list[float]]:
    outer = [LOW, -4.0, 0.0, 4.0, HIGH]
    up = [mean + 1.25 * sd, mean + 3.0 * sd]
    down = [mean - 1.25 * sd, mean - 3.0 * sd]
    up = [p for p in up if p < HIGH]
    down = [p for p in down if p > LOW]
    return [
        [*down, *(p for p in outer[::-1] if p < min([mean, *down]))],
        [*up, *(p for p in outer if p > max([mean, *up]))],
    ]


def exact(shape, prior) -> np.ndarray:
    fine = np.linspace(LOW, HIGH, 200_001)
    log = shape(fine) + prior(fine)
    density = np.exp(log - log.max())
    return np.interp(CHANCES, np.cumsum(density) / density.sum(), fine)


@pytest.mark.parametrize("prior", [flat, wide])
@pytest.mark.parametrize("name", SHAPES)
def test_quantiles_are_those_of_the_density(name, prior):
    shape, mean, sd = SHAPES[name]
    count = 0

    def log_evidence(place: float) -> float:
        nonlocal count
        count += 1
        return float(shape(np.array(place)))

    found = on_a_grid(prior, log_evidence, mean, sides(mean, sd))
    assert found is not None
    assert count <= MOST
    assert (found.unknown, found.modes) == (0.0, 1)
    fine = np.linspace(LOW, HIGH, 200_001)
    log = shape(fine) + prior(fine)
    below = np.cumsum(np.exp(log - log.max()))
    # An interval of 90 % then holds 86 % at least; cells are halved until this is so.
    parts = np.interp(np.quantile(found.values, CHANCES), fine, below / below[-1])
    np.testing.assert_allclose(parts, CHANCES, atol=0.02)


def test_where_nothing_could_be_solved_the_neighbours_speak():
    """A force as steep as a step: beyond some steepness all are alike, and no solver gets there."""
    found = on_a_grid(
        flat,
        lambda place: float(-4.0 * np.exp(-2.0 * (place + 3.0))) if place < 5.0 else np.nan,
        -1.0,
        sides(-1.0, 0.5),
    )
    assert found is not None
    wanted = exact(lambda x: -4.0 * np.exp(-2.0 * (x + 3.0)), flat)
    np.testing.assert_allclose(np.quantile(found.values, CHANCES), wanted, atol=0.2)
    # How much of it is not known is said: the places from five to eight.
    assert found.unknown == pytest.approx(3.0 / 11.0, abs=0.05)


def test_a_hole_is_bridged():
    def log(place: float) -> float:
        return np.nan if 0.2 < place < 0.5 else -0.5 * place**2

    found = on_a_grid(flat, log, 0.0, sides(0.0, 1.0))
    assert found is not None
    wanted = exact(lambda x: -0.5 * x**2, flat)
    np.testing.assert_allclose(np.quantile(found.values, CHANCES), wanted, atol=0.1)


def test_two_peaks_are_counted():
    def log(place: float) -> float:
        return float(np.logaddexp(-2.0 * (place - 2.0) ** 2, -2.0 * (place + 2.0) ** 2))

    found = on_a_grid(flat, log, 2.0, [[1.0, 0.0, -1.5, -2.5, LOW], [3.0, 4.0, HIGH]])
    assert found is not None
    assert found.modes == 2


def test_nothing_is_said_where_nothing_could_be_solved():
    found = on_a_grid(flat, lambda p: 0.0 if p == 0.0 else np.nan, 0.0, sides(0.0, 1.0))
    assert found is None
