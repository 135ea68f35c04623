"""Estimates say on which of a model's answers they rest: multipliers, jumps, doubled periods."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy.integrate import solve_ivp

from bayesoleo._storage.result_files import read_tree, write_tree
from bayesoleo.estimation import estimate
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.model import Model, Parameter
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Harmonics, Record
from bayesoleo.prediction._simulate import RunPlan, motion, record_of
from bayesoleo.prediction._stability import Stability
from bayesoleo.systems import system


def settled(model: Model, plan: RunPlan, force, state, noise: float, orders: int = 0) -> Record:
    """A record of what an integrator of SciPy's settles to, with the true mass of 1 kg.

    With the measured harmonics up to an order, as reduction finds them.
    """
    record = record_of(model, plan)
    c, k, k3 = (model.parameters[n].value for n in ("damping", "stiffness", "cubic_spring"))
    begin = 100 / plan.frequency
    way = solve_ivp(
        lambda t, s: [s[1], force(t) - c * s[1] - k * s[0] - k3 * s[0] ** 3],
        (0.0, begin + record.time[-1]),
        state,
        t_eval=begin + record.time,
        method="DOP853",
        rtol=1e-8,
        atol=1e-10,
    )
    y = way.y[0] + noise * np.random.default_rng(0).standard_normal(record.time.size)
    turns = np.exp(2j * np.pi * np.outer(np.arange(orders + 1), record.phase))
    rows = np.concatenate([turns.real, -turns.imag[1:]])
    found = np.linalg.lstsq(rows.T, y, rcond=None)[0]
    coefficients = found[: orders + 1] + 1j * np.append(0.0, found[orders + 1 :])
    known = dict(record.harmonics)
    if orders:
        known["displacement"] = Harmonics(np.arange(orders + 1), coefficients, np.zeros(orders + 1))
    return replace(record, samples={**record.samples, "displacement": y}, harmonics=known)


def fitted(model: Model, record: Record, steps: int = 64):
    predictor = Predictor(model, [record], steps=steps, backend="numpy", jobs=1)
    return estimate(CampaignProblem(predictor))


def test_multipliers_of_a_linear_estimate_are_its_closed_form(tmp_path):
    model = system("duffing").with_values({"cubic_spring": 0.0}).fixing("cubic_spring")
    plan = RunPlan("a", 2.5, {"force": motion(0.0, [6.0])}, periods=1)
    record = settled(model, plan, lambda t: 6 * np.cos(5 * np.pi * t), (0, 0), 1e-4)
    point = fitted(model, record)
    roots = np.roots([1.0, point["damping"], point["stiffness"]])
    assert point.stability is not None
    found = np.sort_complex(point.stability.multipliers[0])
    np.testing.assert_allclose(found, np.sort_complex(np.exp(roots / 2.5)), rtol=1e-7)
    assert point.branch_jumps == 0
    assert point.notes == []
    data = point.to_dataset()
    assert data["stable"].sel(run="a") == 1
    parts = data["floquet"].sel(run="a")
    again = parts.sel(part="real") + 1j * parts.sel(part="imaginary")
    np.testing.assert_array_equal(again, point.stability.multipliers[0])
    assert data.attrs["branch_jumps"] == 0
    write_tree(xr.DataTree.from_dict({"point": data}), tmp_path / "results.nc")
    assert read_tree(tmp_path / "results.nc")["point"]["stable"].item() == 1


def duffing(stiffness: float) -> Model:
    """Only the stiffness is unknown."""
    declared = system("duffing").fixing("damping", "cubic_spring")
    return declared.with_values({"stiffness": stiffness})


def test_an_estimate_that_falls_off_its_branch_says_so():
    """The record is on the large answer, the start on the small one, which has no use for it."""
    plan = RunPlan("a", 2.5, {"force": motion(0.0, [6.0])}, periods=1)
    force = lambda t: 6 * np.cos(5 * np.pi * t)  # noqa: E731
    record = settled(duffing(150.0), plan, force, (0.15, 0.0), 1e-3)
    lost = fitted(duffing(100.0), record)
    assert lost.branch_jumps > 0
    assert "the periodic solution of run a (" in str(lost)
    assert "A nonlinear model then has other answers to this input" in str(lost)
    assert lost.to_dataset()["branch_jumps"].sel(run="a") == lost.branch_jumps
    # Started on the measured motion, as records of a campaign are, it comes home without one.
    home = fitted(duffing(100.0), settled(duffing(150.0), plan, force, (0.15, 0.0), 1e-3, 6))
    assert home["stiffness"] == pytest.approx(150.0, abs=4 * home.sd[0])
    assert home.branch_jumps == 0


#: Between two wells, where more force doubles the period of the motion in one of them.
WELLS = system("duffing").with_parameters(
    damping=Parameter(0.3, sd=0.2), stiffness=Parameter(-1.0, sd=0.3),
    cubic_spring=Parameter(1.0, sd=0.3),
)  # fmt: skip
RATE = 1.2 / (2 * np.pi)


def test_a_record_of_two_input_periods_is_fitted_at_half_the_frequency():
    def force(t):
        return 0.28 * np.cos(1.2 * t)

    half = RunPlan("a", RATE / 2, {"force": motion(0.0, [0.0, 0.28])}, periods=2)
    found = fitted(WELLS, settled(WELLS, half, force, (1.0, 0.0), 5e-3, 12), 128)
    truth = np.array([0.3, -1.0, 1.0])
    assert np.abs((found.theta - truth) / found.sd).max() < 4.0
    assert found.notes == []
    assert found.stability is not None
    assert found.stability.unstable[0] == 0

    # At the input's own frequency the solution is unstable at the truth, and the fit is pushed
    # to the edge of that region, many standard deviations away.
    whole = RunPlan("a", RATE, {"force": motion(0.0, [0.28])}, periods=4)
    record = settled(WELLS, whole, force, (1.0, 0.0), 5e-3, 6)
    wrong = fitted(WELLS, record)
    assert np.abs((wrong.theta - truth) / wrong.sd).max() > 5.0
    assert any("close to where its period doubles" in note for note in wrong.notes)
    problem = CampaignProblem(Predictor(WELLS, [record], steps=64, backend="numpy", jobs=1))
    there = Stability.of(("a",), problem.evaluate(truth).monodromy, np.zeros(1, dtype=np.int64))
    assert "is unstable and its period doubles" in there.notes()[0]
