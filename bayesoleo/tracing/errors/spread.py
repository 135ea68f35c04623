"""Whether what the unknowns' posterior does to a run is what its linearisation says."""

from __future__ import annotations

from typing import cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.data.local_average import local_means
from bayesoleo.solvers.status import Status
from bayesoleo.tracing.errors.holdout import Prediction
from bayesoleo.tracing.fitting.masked import weights
from bayesoleo.tracing.policy import SearchPolicy


def curved(prediction: Prediction, root: Array, averaged: Array, policy: SearchPolicy) -> Array:
    """Mean square change over draws of the unknowns, over the linearised one, by output.

    Parameters
    ----------
    prediction : Prediction
        Of a run without unknowns of its own.
    root : ndarray, shape (l, l)
        ``R`` with ``R R'`` the covariance of its unknowns.
    averaged : ndarray, shape (ny, l, N)
        Sensitivities.
    policy : SearchPolicy

    Returns
    -------
    ndarray, shape (ny,)
        One where nothing moves, or too few draws can be solved.
    """
    outputs = averaged.shape[0]
    linear = np.array([float(np.sum((root.T @ J) ** 2)) for J in averaged]) / averaged.shape[2]
    record = prediction.record
    left = np.stack([record.samples[o] for o in prediction.predictor.outputs]) - prediction.y
    size = np.mean((left * weights(record)) ** 2, axis=1)
    if not np.any(linear > policy.curvature_matters * size):
        return np.ones(outputs)
    draws = _inside(prediction, root, policy.curvature_draws)
    found = prediction.predictor.simulate(draws, 0)
    good = found.status == Status.CONVERGED.value
    if good.sum() < policy.curvature_draws // 2:
        return np.ones(outputs)
    changes = (found.y[good] - prediction.y) * weights(record)
    if not record.periodic:
        changes = local_means(changes)
    squares = np.mean(changes**2, axis=2)
    squares = np.minimum(squares, policy.farthest_draw**2 * np.mean(squares, axis=0))
    return np.where(linear > 0, np.mean(squares, axis=0) / np.maximum(linear, 1e-300), 1.0)


def _inside(prediction: Prediction, root: Array, count: int) -> Array:
    """Vectors of all unknowns drawn about the estimate, within their priors' supports."""
    rng = np.random.default_rng(0)
    # Opposite pairs: the mean of the changes is then that of the curvature alone.
    half = rng.standard_normal((count // 2, root.shape[1])) @ root.T
    draws = prediction.vector + np.concatenate([half, -half])
    predictor = prediction.predictor
    for k, prior in enumerate(predictor.layout.priors(predictor.model)):
        low, high = prior.support
        room = 1e-3 * prior.sd
        draws[:, k] = np.clip(draws[:, k], low + room, high - room)
    return cast(Array, draws)
