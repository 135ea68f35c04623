"""The error of a run's motion on its frozen mesh, periodic or transient, by what is exact."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import expm
from synthetic_runs import exact_signal

from bayesoleo.model import Dof, Model, Parameter
from bayesoleo.model._kernels import kernels
from bayesoleo.prediction._periodic_run import RunPredictor
from bayesoleo.prediction._run_errors import motion_error, outputs_of
from bayesoleo.prediction._simulate import RunPlan, motion, record_of
from bayesoleo.prediction._transient_run import TransientRun

K, C = 100.0, 0.5
MODEL = Model(
    "oscillator",
    inputs={"u": "N"},
    dofs={"q": Dof("m", initial="0")},
    parameters={"c": Parameter(C, sd=0.1), "k": Parameter(K, sd=1.0)},
    equations={"q": "ddot(q) + c*dot(q) + k*q - u"},
    outputs={"y": "q"},
)
PLAN = RunPlan("a", 1.0, {"u": motion(0.5, [1.0, 0.0, 3.0])}, periods=1.0, samples_per_period=801.0)


def settled(time: np.ndarray) -> np.ndarray:
    """Exact states ``(2, N)`` of the periodic motion."""
    item = PLAN.inputs["u"]
    rate = 2j * np.pi * item.orders
    answer = item.coefficients / (K + C * rate + rate**2)
    turns = np.exp(np.outer(time, rate))
    return np.stack([(turns @ answer).real, (turns @ (rate * answer)).real])


def from_rest(time: np.ndarray) -> np.ndarray:
    """Exact position of the motion from rest."""
    system = np.array([[0.0, 1.0], [-K, -C]])
    away = -settled(np.zeros(1))[:, 0]
    return settled(time)[0] + np.array([(expm(system * t) @ away)[0] for t in time])


@pytest.mark.parametrize("scheme", ["radau3", "thesis"])
@pytest.mark.parametrize("steps", [32, 128])
def test_of_a_periodic_run_it_is_the_true_one(scheme, steps):
    run = RunPredictor(
        MODEL, kernels(MODEL, backend="numpy"), record_of(MODEL, PLAN), steps, scheme
    )
    assert np.isnan(motion_error(run).error)  # not anchored
    assert run.set_anchor(run.base_constants()).ok
    found, phase = motion_error(run), np.linspace(0.0, 1.0, 2001)
    exact = settled(phase)
    plan, step = run.scheme.plan(phase, steps), run.boundary.step(steps)
    rows = run.scheme.sample(run.anchor.x[None, :, :, None], plan, step)[0, :2, 0]
    error = (np.abs(rows - exact).max(axis=1) / np.ptp(exact, axis=1)).max()
    # Against steps half as long, which leave a part of it, and at eight places in each only.
    assert found.error == pytest.approx(error, rel=0.5)
    better = outputs_of(run, found)[0]
    before = run.predict(run.base_constants()[None]).y[0, 0]
    true = settled(run.record.phase)[0]
    assert np.abs(better - true).max() < 0.3 * np.abs(before - true).max()


def test_of_a_transient_it_is_the_true_one():
    base = record_of(MODEL, replace(PLAN, periods=3.0))
    time = np.linspace(0.0, 2.0, 1601)
    samples = {"u": PLAN.inputs["u"].evaluate(time, 1.0), "y": np.zeros(time.size)}
    record = replace(
        base, kind="transient", time=time, samples=samples, harmonics={}, periods=0,
        smoothed={"u": exact_signal(samples["u"], time[1])},
    )  # fmt: skip
    run = TransientRun(MODEL, kernels(MODEL, backend="numpy"), record, 128, "radau3")
    assert run.set_anchor(run.base_constants()).ok
    found = motion_error(run, 1e-9)
    exact = from_rest(time)
    y = run.predict(run.base_constants()[None]).y[0, 0]
    error = np.abs(y - exact).max() / np.ptp(exact)
    # Velocities may err more than positions; samples see the input through a spline, whose own
    # error is 1e-9 here.
    assert error < 3 * found.error
    assert found.error < 1e-5
