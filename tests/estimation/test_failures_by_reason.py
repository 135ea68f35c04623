"""What cannot be evaluated is a status, counted by its reason, in every result."""

import json
from dataclasses import replace

import numpy as np
import pytest

from bayesoleo import system
from bayesoleo.estimation import estimate, multistart, to_dataset
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.model import Parameter, driven_by
from bayesoleo.posterior import LogDensity
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._simulate import RunPlan, motion, record_of, simulate_run
from bayesoleo.solvers._orbit import Status, added, counted

#: Reached in the record, m, of a stroke that ends at ``TRUTH``: beyond that the gas law has no
#: pressure.
REACHED, TRUTH = 0.90, 0.93
#: From here every trial of the estimators ends 0.02 m or more inside or outside the region, so that
#: no rounding of another processor's decides which ones fail.
FAR = 1.1


def problem(start: float) -> CampaignProblem:
    """The gas spring of the end stop under a motion close to its end; the end is to be found.

    A fifth of the prior, ``start ± 0.1``, lies where the motion would go beyond the end.
    """
    model = driven_by(system("end_stop"), "displacement")
    end = Parameter(start, "m", sd=0.1)
    stop = replace(model.parameters["stop_stiffness"], fixed=True, prior=None)
    model = replace(
        model, parameters=model.parameters | {"full_stroke": end, "stop_stiffness": stop}
    )
    plan = RunPlan("deep", 1.0, {"displacement": motion(0.5, [REACHED - 0.5])}, periods=2.0)
    made = simulate_run(
        model, plan, {"full_stroke": TRUTH}, noise={"force": 0.5}, rng=np.random.default_rng(5)
    )
    record = replace(record_of(model, plan), samples=dict(made.samples))
    return CampaignProblem(Predictor(model, [record], steps=64, backend="numpy", jobs=1))


@pytest.mark.parametrize("method", ["be", "levenberg-marquardt"])
def test_an_estimate_counts_the_trials_that_left_the_admissible_region(method):
    """From far away the first steps go too far; they are shortened, and the end is found."""
    point = estimate(problem(FAR), method, tolerance=1e-7)
    assert point.status is Status.CONVERGED
    assert point["full_stroke"] == pytest.approx(TRUTH, abs=5 * point.sd[0])
    assert set(point.failures) == {"inadmissible"}
    assert 0 < point.failures["inadmissible"] < point.evaluations
    number = point.failures["inadmissible"]
    assert f"trials that failed: {number} inadmissible" in str(point)
    assert json.loads(to_dataset(point).attrs["failures"]) == {"inadmissible": number}


def test_an_optimiser_that_stops_at_the_edge_of_the_region_has_not_converged():
    """Its line search meets vectors without a value, and SciPy calls where it stops a success."""
    point = estimate(problem(FAR), "scipy:L-BFGS-B", tolerance=1e-7)
    assert point.failures["inadmissible"] > 0
    assert abs(point["full_stroke"] - TRUTH) > 0.02  # BE's standard deviation is far below a mm
    assert point.status is Status.NO_CONVERGENCE


def test_nothing_failed_nothing_said():
    point = estimate(problem(0.95), "be")
    assert point.failures == {}
    assert "failed" not in str(point)
    assert to_dataset(point, mbe=point).attrs["failures"] == "{}"


def test_methods_tried_in_turn_add_up():
    first = estimate(problem(FAR), "be", max_iterations=1)
    assert first.status is Status.NO_CONVERGENCE
    second = estimate(problem(FAR), "levenberg-marquardt")
    both = estimate(problem(FAR), ["be", "levenberg-marquardt"], max_iterations=None)
    assert both.failures == estimate(problem(FAR), "be").failures
    assert added([first.failures, second.failures]) == {
        "inadmissible": first.failures["inadmissible"] + second.failures["inadmissible"]
    }


def test_a_start_outside_is_a_failed_estimate():
    point = estimate(problem(0.85), "mbe")
    assert point.status is Status.INADMISSIBLE
    assert point.failures == {"inadmissible": 1}
    modes = multistart(problem(0.85), 12, np.random.default_rng(0))
    assert modes.status["inadmissible"] >= 4  # of 26, two a start, about two thirds of them outside
    assert len(modes) == 1


def test_the_density_is_zero_where_the_prior_leaves_the_region():
    """As often as the prior says."""
    target = problem(1.0)
    target.freeze(np.array([TRUTH]))
    density = LogDensity(target)
    ends = 1.0 + 0.1 * np.random.default_rng(2).standard_normal(2000)
    value, by_run = density(density.coordinates(np.column_stack([ends, np.full(2000, -1.4)])))
    outside = ends <= REACHED
    assert np.array_equal(np.isneginf(value), outside)
    assert np.array_equal(np.isneginf(by_run[:, 0]), outside)
    assert density.failures == {"inadmissible": outside.sum()}


def test_counts_are_words():
    assert counted({"inadmissible": 3, "no_convergence": 1, "singular": 0}) == (
        "3 inadmissible, 1 no convergence"
    )
    assert counted({}) == ""
    assert added([{"a": 1}, {}, {"a": 2, "b": 1}]) == {"a": 3, "b": 1}
