"""The fits that say how small an error can be follow laws."""

from __future__ import annotations

import numpy as np
import pytest
from measured_limits import (
    FINE,
    KNOTS,
    PUBLISHED,
    STEP,
    band_force,
    moved,
    of_position,
    rms,
    sharp_swing,
    simple,
    stretched,
    swung,
)
from scipy.signal import lfilter


def test_a_mass_with_viscous_friction_follows_the_closed_form():
    mass, viscous, force = 95.0, 200.0, 12.0
    time = STEP * np.arange(3000)
    found = moved(np.full(time.size, force), mass, KNOTS, viscous * KNOTS, np.zeros(3), 0.2)
    rate = viscous / mass
    expected = 0.2 + force / viscous * (time - (1 - np.exp(-rate * time)) / rate)
    # Implicit steps of a third of a millisecond are of first order: their error is at most half
    # a step times the velocity, 1e-5 m.
    assert np.abs(found - expected).max() < 0.5 * STEP / 3 * force / viscous


def test_a_force_of_position_holds_the_slide_where_it_balances():
    elastic, place = np.array([300.0, -20.0, 4000.0]), 0.05
    balance = np.full(20_000, np.polyval([*elastic[::-1], 0.0], place))
    found = moved(balance, 10.0, KNOTS, 100.0 * KNOTS, elastic, 0.0)
    # After twenty seconds the motion has died away, by steps of any length.
    assert found[-1] == pytest.approx(place, abs=1e-9)


def test_a_slide_rests_within_its_coulomb_friction():
    mass, viscous, coulomb, _ = PUBLISHED
    values = np.array([mass, viscous, coulomb, coulomb, 0.0])
    resting, moving = (
        simple(values, np.full(2000, size * coulomb), 0.1)[-1] for size in (0.5, 1.5)
    )
    # The friction rises over 2 mm/s instead of jumping: half of it is reached at 1 mm/s.
    assert resting == pytest.approx(0.1 + 2.0 * 1e-3, rel=0.02)
    assert moving > 0.1 + 2.0 * 0.02


def test_what_a_position_shows_is_not_left():
    draw = np.random.default_rng(0)
    position = lfilter([1e-6], [1.0, -1.8, 0.9], draw.standard_normal(60_000))
    force = np.zeros_like(position)
    force[1:-1] = 95.0 * np.diff(position, 2) / STEP**2
    noise = draw.standard_normal(position.size)
    assert of_position(position, force)[2] < 0.02 * rms(force)
    # White noise: 96 % of its power is above 20 Hz of 500. Some two hundred segments make
    # the coherence, and with it the power that is explained, too large by about a hundredth.
    left = of_position(position, force + noise)[2]
    assert left == pytest.approx(np.sqrt(0.96), rel=0.03)


def test_a_slider_returns_work_only_below_its_limit():
    motion = np.sin(2 * np.pi * np.arange(1024) / 1024)
    assert stretched(motion, 0.25).max() == 0.25
    # The area of the loop of an elastic slider: four times limit times what is slipped. Each of its
    # four corners falls between two of the 1024 samples, which are up to 0.006 apart.
    area = -np.trapezoid(stretched(motion, 0.25) * np.gradient(motion), dx=1.0)
    assert abs(area) == pytest.approx(4 * 0.25 * (1 - 0.25), rel=5e-3)
    assert abs(stretched(0.2 * motion, 0.25)).max() < 0.25 + 1e-12


def test_backlash_lets_the_force_rest_at_a_reversal():
    motion = np.sin(2 * np.pi * np.arange(1024) / 1024)
    values = np.array([2.0, 3.0, 0.05, 0.0, 0.2, 0.0])
    without, with_gap = (band_force(values, motion, np.zeros(1024), gap) for gap in (False, True))
    assert (without.max(), without.min()) == (2.0, pytest.approx(-3.0))
    assert (with_gap.max(), with_gap.min()) == (pytest.approx(2.0), pytest.approx(-3.0))
    assert np.count_nonzero(with_gap == 0) > 50
    assert np.count_nonzero(without == 0) == 0


@pytest.mark.slow
def test_a_small_swing_with_viscous_damping_follows_the_closed_form():
    stiffness, viscous, begin = 64.0, 0.3, 1e-3
    time = 1e-3 * np.arange(4000)
    found = swung(time, np.array([begin, 0.0]), stiffness, FINE, viscous * FINE)
    rate, turn = viscous / 2, np.sqrt(stiffness - viscous**2 / 4)
    expected = np.exp(-rate * time) * (np.cos(turn * time) + rate / turn * np.sin(turn * time))
    # The sine of an angle of a thousandth differs from it by 2e-7 of it.
    np.testing.assert_allclose(found, begin * expected, atol=2e-5 * begin)


@pytest.mark.slow
def test_a_swing_loses_what_coulomb_friction_takes():
    stiffness, coulomb = 64.0, 0.2
    time = 1e-3 * np.arange(4000)
    force = sharp_swing(np.array([0.0, coulomb, 0.0, 0.0]))
    found = swung(time, np.array([0.5, 0.0]), stiffness, FINE, force)
    turns = np.abs(found[1:-1][np.diff(np.sign(np.diff(found))) != 0])
    lost = stiffness * np.diff(np.cos(turns))
    taken = coulomb * (turns[:-1] + turns[1:])
    # The friction turns over 0.05 rad/s of 4, which takes up to a fiftieth of its work.
    np.testing.assert_allclose(lost, taken, rtol=0.03)
