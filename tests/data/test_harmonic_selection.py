"""Harmonics that stand above the noise, and few that do not."""

import numpy as np
import pytest

from bayesoleo.data import HarmonicBasis, significant_harmonics
from bayesoleo.data._harmonics import coefficient_variances, within_bandwidth


def signal(basis, true, rng):
    coefficients = np.zeros(basis.highest + 1, dtype=complex)
    coefficients[true] = np.exp(2j * np.pi * rng.random(len(true)))
    return basis.evaluate(coefficients)


@pytest.mark.parametrize(("period", "periods"), [(302.3, 4), (119.3, 20), (250.0, 2)])
def test_all_true_harmonics_and_few_false_ones(period, periods):
    rng = np.random.default_rng(1)
    basis = HarmonicBasis(int(period * periods), 1 / period)
    true = [1, 2, 3, 5, 7, 9, 11, 40]
    false = 0
    for _ in range(100):
        values = signal(basis, true, rng) + 0.5 * rng.normal(size=basis.samples)
        orders = significant_harmonics(basis, values).orders
        assert set(true) | {0} <= set(orders.tolist())
        false += orders.size - len(true) - 1
    # Expected 0.8 in 100 records of eight true harmonics at a rate of 1e-3; Poisson, one in 10 000.
    assert false <= 6


def test_noise_alone_leaves_the_mean():
    rng = np.random.default_rng(2)
    basis = HarmonicBasis(1209, 1 / 302.3)
    sizes = [significant_harmonics(basis, rng.normal(size=1209)).orders.size for _ in range(200)]
    assert np.mean(np.array(sizes) > 1) < 0.02


def test_variances_are_those_of_the_coefficients():
    rng = np.random.default_rng(3)
    basis = HarmonicBasis(808, 1 / 201.9)
    noise = rng.normal(size=(300, 808))
    # Noise that is red: the local spectrum has to follow it.
    noise = noise + 0.9 * np.roll(noise, 1, axis=1)
    coefficients = basis.coefficients(noise)
    claimed = np.mean(
        [coefficient_variances(basis, row - basis.fit(row))[0] for row in noise], axis=0
    )
    seen = 0.5 * (coefficients.real.var(axis=0) + coefficients.imag.var(axis=0))
    assert coefficients[:, 0].real.var() == pytest.approx(claimed[0], rel=0.3)
    # 600 numbers each give 6 % a coefficient; their mean over orders is much closer.
    assert np.mean(seen[1:80] / claimed[1:80]) == pytest.approx(1.0, abs=0.04)


def test_harmonics_evaluate_to_the_signal():
    rng = np.random.default_rng(4)
    basis = HarmonicBasis(808, 1 / 201.9)
    values = 3.0 + signal(basis, [1, 4], rng)
    harmonics = significant_harmonics(basis, values + 1e-6 * rng.normal(size=808))
    assert harmonics.orders.tolist() == [0, 1, 4]
    phase = np.arange(808) / 201.9
    np.testing.assert_allclose(harmonics.evaluate(phase, 1.0), values, atol=1e-6)


@pytest.mark.parametrize(("quantum", "noise"), [(1e-2, 0.0), (1e-2, 1e-4), (1e-1, 0.0)])
def test_rounding_that_repeats_is_not_differentiated(quantum, noise):
    """An encoder's steps fall on the same phases in every period: significant, and no motion."""
    rng = np.random.default_rng(5)
    phase = np.arange(8000) / 1000
    values = np.sin(2 * np.pi * phase) + 0.2 * np.sin(6 * np.pi * phase + 1)
    bend = -4 * np.pi**2 * (np.sin(2 * np.pi * phase) + 1.8 * np.sin(6 * np.pi * phase + 1))
    noisy = np.round((values + noise * rng.standard_normal(8000)) / quantum) * quantum
    harmonics = significant_harmonics(HarmonicBasis(8000, 1e-3), noisy)
    found = harmonics.for_derivative(2).evaluate(phase, 1.0, 2)
    # All significant harmonics would make hundreds of times the true acceleration.
    assert np.std(found - bend) < 0.06 * np.std(bend)
    assert harmonics.for_derivative(0).orders.size == harmonics.orders.size


def test_noise_that_averages_out_limits_nothing():
    """Where periods scatter by as much as stands between harmonics, significance has decided."""
    rng = np.random.default_rng(6)
    phase = np.arange(8000) / 1000
    values = np.sin(2 * np.pi * phase) + 0.002 * np.sin(2 * np.pi * 31 * phase)
    noisy = np.round((values + 0.01 * rng.standard_normal(8000)) / 1e-3) * 1e-3
    harmonics = significant_harmonics(HarmonicBasis(8000, 1e-3), noisy)
    assert harmonics.for_derivative(2) is harmonics
    assert harmonics.orders[-1] == 31


def test_a_multisine_that_fills_the_band_is_kept():
    rng = np.random.default_rng(7)
    basis = HarmonicBasis(4000, 1e-3)
    values = signal(basis, list(range(1, 480)), rng)
    harmonics = significant_harmonics(basis, values + 1e-6 * rng.standard_normal(4000))
    assert harmonics.for_derivative(2).orders[-1] == 479


def test_a_declared_bandwidth_counts_for_the_value_too():
    rng = np.random.default_rng(8)
    basis = HarmonicBasis(4000, 1e-3)
    values = signal(basis, [1, 5, 40], rng) + 1e-6 * rng.standard_normal(4000)
    item = significant_harmonics(basis, values)
    for order in range(3):
        # 2 Hz each: 30 Hz is the fifteenth.
        limited = within_bandwidth(item, 2.0, 30.0).for_derivative(order)
        assert limited.orders.tolist() == [0, 1, 5]
    assert within_bandwidth(item, 2.0, np.inf).for_derivative(2).orders[-1] == 40
    assert within_bandwidth(item, 2.0, None) is item
