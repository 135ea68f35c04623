"""Exact transforms against plain linear algebra."""

import numpy as np
import pytest

from bayesoleo.data._fourier import (
    KEPT_SAMPLES,
    ChirpTransform,
    HarmonicBasis,
    basis_of,
    highest_order,
)


@pytest.mark.parametrize("step", [0.0301, -0.2, 1 / 37.3])
def test_chirp_is_the_sum_it_stands_for(step):
    rng = np.random.default_rng(1)
    values = rng.normal(size=(2, 50)) + 1j * rng.normal(size=(2, 50))
    table = np.exp(-2j * np.pi * step * np.outer(np.arange(50), np.arange(70)))
    np.testing.assert_allclose(ChirpTransform(50, 70, step)(values), values @ table, atol=1e-11)


@pytest.mark.parametrize(
    ("period", "samples"),
    [(37.3, 149), (40.0, 120), (37.9, 100), (12.5, 25), (20.02, 41), (41, 410)],
)
def test_fit_is_least_squares(period, samples):
    rng = np.random.default_rng(2)
    values = rng.normal(size=samples) + 5.0
    basis = HarmonicBasis(samples, 1 / period)
    phase = 2 * np.pi * np.outer(np.arange(samples) / period, basis.orders)
    design = np.hstack([np.cos(phase), np.sin(phase[:, 1:])])
    solution = np.linalg.lstsq(design, values, rcond=None)[0]
    # 1e-10 is the conjugate gradients' 1e-13 times the worst condition number here.
    np.testing.assert_allclose(basis.fit(values), design @ solution, atol=1e-10)
    expected = solution[: basis.highest + 1].astype(complex)
    expected[1:] -= 1j * solution[basis.highest + 1 :]
    np.testing.assert_allclose(basis.coefficients(values), expected, atol=1e-10)


def test_projection_is_idempotent_and_keeps_harmonics():
    rng = np.random.default_rng(3)
    basis = HarmonicBasis(4096, 1 / 1002.3)
    once = basis.fit(rng.normal(size=4096))
    np.testing.assert_allclose(basis.fit(once), once, atol=1e-10)


def test_highest_order_of_whole_and_fractional_periods():
    assert [highest_order(1 / period) for period in (1024, 1025, 1025.7, 8)] == [511, 512, 512, 3]


@pytest.mark.parametrize("off", [0.0, 2e-16, -1e-15, 1e-12])
@pytest.mark.parametrize(("period", "samples"), [(422, 2954), (1012, 6354), (96, 480), (704, 4518)])
def test_harmonics_that_a_whole_period_cannot_tell_apart_do_no_harm(period, samples, off):
    # Orders k and period - k are the same at the samples, so that there are many solutions; all
    # have the same fit, and that of a signal without noise is the signal.
    one = np.random.default_rng(4).normal(size=period)
    values = one[np.arange(samples) % period]
    basis = HarmonicBasis(samples, (1 + off) / period, period // 2 + 1)
    np.testing.assert_allclose(basis.fit(values), values, atol=1e-6)


def test_the_basis_of_a_run_is_made_once_and_that_of_a_long_record_is_not_kept():
    one, step = np.random.default_rng(5).normal(size=400), 1 / 37.3
    kept = basis_of(400, step)
    assert basis_of(400, step) is kept
    np.testing.assert_array_equal(kept.fit(one), HarmonicBasis(400, step).fit(one))
    for samples, other in ((401, step), (400, step * (1 + 1e-12))):
        assert basis_of(samples, other) is not kept
        assert (basis_of(samples, other).samples, basis_of(samples, other).step) == (samples, other)
    long = KEPT_SAMPLES + 1
    assert basis_of(long, step) is not basis_of(long, step)


def test_signals_together_are_averaged_as_each_alone():
    basis = HarmonicBasis(400, 1 / 37.3)
    signals = np.random.default_rng(6).normal(size=(3, 400)) * [[1.0], [1e6], [1e-6]]
    for one, together in zip(signals, basis.fit(signals), strict=True):
        # Transforms of several signals may differ from those of one in the last digits.
        np.testing.assert_allclose(together, basis.fit(one), rtol=0, atol=1e-12 * np.abs(one).max())
