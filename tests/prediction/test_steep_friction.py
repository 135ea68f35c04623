"""Friction too steep for Newton's method from a static guess starts from an integrated motion."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.model import Model, Parameter
from bayesoleo.prediction._orbits import periodic_orbit
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._simulate import RunPlan, motion, record_of
from bayesoleo.solvers._orbit import Status

MODEL = Model(
    "friction oscillator",
    inputs={"force": "N"},
    dofs={"q": "m"},
    parameters={
        "mass": Parameter(1.0, "kg", sd=1.0),
        "damping": Parameter(0.05, "N*s/m", fixed=True),
        "stiffness": Parameter(1.5, "N/m", fixed=True),
        "friction": Parameter(0.4, "N", fixed=True),
        "slope": Parameter(3400.0, "s/m", fixed=True),
    },
    equations={
        "q": "mass*ddot(q) + damping*dot(q) + stiffness*q + friction*atan(slope*dot(q)) - force"
    },
    outputs={"displacement": "q"},
)
#: A mass at which nothing else than an integrated motion is near enough.
LIGHT = 0.01
PLAN = RunPlan("a", 0.2, {"force": motion(0.0, [2.0])})


@pytest.mark.slow
def test_every_mass_is_solved_and_agrees_with_shooting() -> None:
    masses, phases = {"mass": np.logspace(0, -3, 13)}, np.arange(101) / 101
    # Equal steps see the sticking of a light mass as coarse as they are: a part of 1/512 each. The
    # estimate is linear and on the safe side.
    mesh = periodic_orbit(MODEL, PLAN, masses, steps=512, tolerance=5.0 / 512, jobs=1)
    shot = periodic_orbit(MODEL, PLAN, masses, "shooting", jobs=1)
    np.testing.assert_array_equal(mesh.status, Status.CONVERGED)
    np.testing.assert_array_equal(shot.status, Status.CONVERGED)
    found, known = (o.outputs(phases)["displacement"] for o in (mesh, shot))
    size = np.ptp(known, axis=1, keepdims=True)
    assert np.max(np.abs(found - known) / size) < 1.0 / 512


@pytest.mark.parametrize("backend", ["numba", "numpy"])
def test_anchor_is_set_where_the_static_guess_fails(backend: str) -> None:
    predictor = Predictor(MODEL, [record_of(MODEL, PLAN)], backend=backend, jobs=1)
    assert predictor.set_anchor(np.array([LIGHT])) == [Status.CONVERGED]
