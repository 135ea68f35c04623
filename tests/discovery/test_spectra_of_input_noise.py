"""Noise of a transient's measured input, by spectral line and along what draws have in common."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.discovery._spectral_data import INPUT_DRAWS, _along_draws

LINES = 300


def root_of(kind: str, rng: np.random.Generator) -> np.ndarray:
    """A root of the covariance of the errors, of noise of unit variance."""
    if kind == "none":
        return np.zeros((1, LINES))
    if kind == "few curves":
        return np.array([[20.0], [8.0]]) * np.linalg.qr(rng.standard_normal((LINES, 2)))[0].T
    if kind == "resonance":
        line = np.arange(LINES)
        return np.diag(5.0 / np.sqrt(1.0 + ((line - 80.0) / 10.0) ** 2))
    return np.sqrt(3.0) * np.eye(LINES)


def log_density(z: np.ndarray, covariance: np.ndarray) -> float:
    return float(-0.5 * (z @ np.linalg.solve(covariance, z) + np.linalg.slogdet(covariance)[1]))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["none", "few curves", "resonance", "white"])
def test_errors_by_draws_have_nearly_the_density_of_their_covariance(kind):
    """Whatever its rank, with noise on top; and far more than by the variances of lines alone where
    that is small."""
    rng = np.random.default_rng(3)
    variance = rng.uniform(0.5, 2.0, LINES)
    root = root_of(kind, rng) * np.sqrt(variance)
    exact, lost, by_lines = np.diag(variance) + root.T @ root, [], []
    for _ in range(10):
        draws = rng.standard_normal((INPUT_DRAWS, len(root))) @ root / np.sqrt(INPUT_DRAWS)
        kept, left = _along_draws(draws, variance)
        smooth = np.convolve(np.sum(left**2, axis=0), np.ones(15) / 15.0, "same")
        found = np.diag(variance + smooth) + kept.T @ kept
        apart = np.diag(variance + np.sum(draws**2, axis=0))
        for _ in range(20):
            z = rng.standard_normal(len(root)) @ root + np.sqrt(variance) * rng.standard_normal(
                LINES
            )
            lost.append(log_density(z, exact) - log_density(z, found))
            by_lines.append(log_density(z, exact) - log_density(z, apart))
    # A few dozen parameters of a covariance cost about half a unit each.
    assert np.mean(lost) < 20.0
    if kind == "few curves":
        assert np.mean(lost) < 5.0
        assert np.mean(by_lines) > 30.0
