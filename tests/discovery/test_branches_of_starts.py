"""Starts that are looked for elsewhere leave the density on the branch of the estimate."""

from __future__ import annotations

import numpy as np
from test_noise_of_inputs import resonant

from bayesoleo.discovery import _inference as inference
from bayesoleo.discovery._inference import Inference, mixture_at


def test_starts_elsewhere_leave_the_solvers_where_the_estimate_is(tmp_path, monkeypatch):
    """From where they end, the density at the estimate may be solved on another branch."""
    fit = resonant(tmp_path, 0, noise=0.0)
    density, theta = Inference("independent").density(fit), fit.point.theta
    seen, whole = [], inference.laplace_mixture

    def anchors():
        return np.array([run.anchor.p for run in fit.predictor.runs])

    def astray(problem, *_):
        problem.evaluate(3.0 * theta)
        return []

    def astray_too(density, starts):
        seen.append(anchors())
        found = whole(density, starts)
        density.problem.evaluate(2.0 * theta)
        return found

    def frozen(theta):
        seen.append(anchors())

    before = anchors()
    monkeypatch.setattr(inference, "multistart", astray)
    monkeypatch.setattr(inference, "laplace_mixture", astray_too)
    monkeypatch.setattr(fit.problem, "freeze", frozen)
    mixture_at(density, theta, starts=1)
    assert len(seen) == 2
    for found in seen:
        np.testing.assert_array_equal(found, before)
