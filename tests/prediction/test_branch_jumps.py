"""A solution that leaves its branch between neighbouring parameters is told, and no other is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._other_starts import promising
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._problem import Held
from bayesoleo.posterior import LogDensity
from bayesoleo.prediction._branches import follow_branch
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._simulate import RunPlan, motion, record_of
from bayesoleo.prediction._stability import Stability, count_unstable, swings
from bayesoleo.prediction._starts import Anchor
from bayesoleo.systems import system

#: Between the folds of the declared Duffing system under 6 N, which are at 2.37 and 5.27 Hz.
PLAN = RunPlan("sweep", 2.5, {"force": motion(0.0, [6.0])}, periods=1)
STEPS = 64


@pytest.fixture(scope="module")
def fold() -> float:
    """Stiffness at which the small answer meets the unstable one and vanishes."""
    branch = follow_branch(system("duffing"), PLAN, "stiffness", (20.0, 400.0), steps=STEPS)
    (found,) = branch.branch.of_kind("fold")
    return found.value


def predictor(stiffness: float, model: str = "duffing") -> tuple[Predictor, np.ndarray]:
    """Anchored at a stiffness; with the vector of its unknowns."""
    record = record_of(system(model), PLAN)
    measured = {**record.samples, "displacement": np.zeros(record.time.size)}
    made = Predictor(
        system(model), [replace(record, samples=measured)], steps=STEPS, backend="numpy", jobs=1
    )
    theta = made.layout.start(made.model)
    theta[made.layout.names.index("stiffness")] = stiffness
    assert made.set_anchor(theta)[0].ok
    return made, theta


def at(theta: np.ndarray, names: tuple[str, ...], **values: float) -> np.ndarray:
    moved = theta.copy()
    for name, value in values.items():
        moved[names.index(name)] = value
    return moved


def test_a_step_over_the_fold_is_reported_and_a_walk_up_to_it_is_not(fold):
    made, theta = predictor(100.0)
    for value in (90.0, 110.0, 120.0, 0.999 * fold):
        answer = made.evaluate(at(theta, made.layout.names, stiffness=value))[0]
        assert answer.status.ok
        assert not answer.jumped
    small = np.ptp(answer.y)
    beyond = made.evaluate(at(theta, made.layout.names, stiffness=1.02 * fold))[0]
    assert beyond.status.ok
    assert beyond.jumped
    assert np.ptp(beyond.y) > 1.8 * small
    # Back over the fold the motion stays on the large branch: that is no jump.
    back = made.evaluate(at(theta, made.layout.names, stiffness=0.999 * fold))[0]
    assert not back.jumped
    assert np.ptp(back.y) > 1.8 * small
    assert made.runs[0].jumps == 1


@pytest.mark.slow
def test_lanes_of_a_batch_are_told_apart(fold):
    """Lanes over parameters far and near: those on another branch than continuation, no others."""
    made, theta = predictor(110.0)
    rng = np.random.default_rng(4)
    vectors = theta * np.exp(rng.uniform(-0.7, 0.7, (50, theta.size)))
    found = made.simulate(vectors, 0)
    good = found.status == 0
    assert good.sum() > 20
    assert found.jumped is not None
    assert not found.jumped[~good].any()
    truth = np.zeros(good.size, dtype=bool)
    for lane in np.flatnonzero(good):
        end = walked(predictor(110.0)[0], theta, vectors[lane])
        truth[lane] = end is None or np.abs(end - found.y[lane, 0]).max() > 1e-6
    np.testing.assert_array_equal(found.jumped[good], truth[good])
    assert 0 < truth.sum() < 30
    assert made.runs[0].jumps == truth.sum()
    made.sum_of_squares(vectors)
    assert made.runs[0].jumps == 2 * truth.sum()


def test_nobody_looks_for_jumps_that_are_not_asked_for(monkeypatch):
    """Far from the anchor the walk that looks for one takes longer than the solution."""
    made, theta = predictor(110.0)
    vectors = theta * np.exp(np.random.default_rng(4).uniform(-0.7, 0.7, (50, theta.size)))
    problem = CampaignProblem(made)
    expected = problem.misfit(vectors)
    counted = problem.branch_jumps.sum()
    assert counted > 0
    held = Held(problem, theta, [])
    with monkeypatch.context() as patched:
        patched.setattr(Anchor, "leads_to", None)
        with LogDensity(held).unwatched():
            found = problem.misfit(vectors)
    np.testing.assert_array_equal(found.sum_of_squares, expected.sum_of_squares)
    assert problem.branch_jumps.sum() == counted
    problem.misfit(vectors)
    assert problem.branch_jumps.sum() == 2 * counted


@pytest.mark.parametrize("compared", [False, True])
def test_an_estimate_that_is_only_compared_looks_for_no_jumps(monkeypatch, compared):
    """Its optimum is the same; an estimate that stands for itself looks for them."""
    made, theta = predictor(110.0)
    measured = {**made.records[0].samples, "displacement": made.simulate(theta[None], 0).y[0, 0]}
    record = replace(made.records[0], samples=measured)
    looked, left_by = [], Anchor.left_by

    def counted(*given):
        looked.append(given)
        return left_by(*given)

    monkeypatch.setattr(Anchor, "left_by", counted)
    numerics = Numerics(jobs=1, backend="numpy", steps=STEPS)
    start = at(theta, made.layout.names, stiffness=114.0)
    fit = fit_model(made.model, [record], numerics, start=start, check_mesh=not compared)
    assert bool(looked) is not compared
    # The data are exact: both end there, to the tolerance of an estimate.
    np.testing.assert_allclose(fit.point.theta, theta, rtol=1e-4)


def test_draws_of_the_priors_are_no_jumps_of_an_estimate():
    """They lie on all branches, and only say where an estimate is to begin."""
    made, _ = predictor(110.0)
    problem = CampaignProblem(made)
    rng = np.random.default_rng(4)
    vectors = problem.start * np.exp(rng.uniform(-0.7, 0.7, (50, problem.start.size)))
    problem.misfit(vectors)
    counted = problem.branch_jumps.sum()
    assert counted > 0  # another measure of the same draws
    assert len(promising(problem, problem.start, SearchPolicy())) > 0
    assert problem.branch_jumps.sum() == counted


def walked(made: Predictor, theta: np.ndarray, end: np.ndarray) -> np.ndarray | None:
    """Displacement after fifty small steps; None where the branch ends on the way."""
    for part in np.linspace(0.02, 1.0, 50):
        run = made.runs[0]
        p = made.constants((theta + part * (end - theta))[None], 0)
        if made.simulate((theta + part * (end - theta))[None], 0).status[0] != 0:
            return None
        before = made.runs[0].anchor
        run.set_anchor(p[0])
        if np.abs(run.anchor.x - before.x).max() > 0.5 * np.ptp(before.x[:, 0]) + 1.0:
            return None
    return made.simulate(end[None], 0).y[0, 0]


def test_a_linear_system_has_one_branch():
    made, theta = predictor(100.0, "linear_oscillator")
    vectors = theta * np.exp(np.random.default_rng(1).uniform(-2, 2, (50, theta.size)))
    found = made.simulate(vectors, 0)
    assert (found.status == 0).all()
    assert found.jumped is not None
    assert not found.jumped.any()


def test_multipliers_of_the_linear_oscillator_come_with_derivatives():
    """``exp(lambda T)`` with the roots of ``m lambda**2 + c lambda + k``."""
    made, theta = predictor(100.0, "linear_oscillator")
    answer = made.evaluate(theta)[0]
    found = Stability.of(["sweep"], [answer.monodromy], np.zeros(1, dtype=np.int64))
    expected = np.exp(np.roots([1.0, 0.5, 100.0]) / 2.5)
    # Radau IIA of order five with 64 steps in 0.6 of a turn of the free motion.
    found_ones = np.sort_complex(found.multipliers[0])
    np.testing.assert_allclose(found_ones, np.sort_complex(expected), rtol=1e-8)
    assert found.unstable.tolist() == [0]
    assert found.notes() == []


def test_notes_say_what_would_happen_instead():
    table = np.array(
        [
            [0.5, 0.1],
            [-1.7, 0.2],
            [1.4, 0.3],
            [1.1 + 0.5j, 1.1 - 0.5j],
            [np.nan, np.nan],
            [-0.97, 0.1],
        ]
    )
    jumps = np.array([0, 0, 2, 0, 0, 0])
    found = Stability(tuple("abcdef"), table, jumps)
    assert found.unstable.tolist() == [0, 1, 1, 2, -1, 0]
    doubled, left, second, close, jumped = found.notes()
    assert "run b (-1.7) is unstable and its period doubles" in doubled
    assert "run f (-0.97) is close" in close
    assert "run c (1.4)" in left
    assert "another answer" in left
    assert "run d (1.1 ± 0.5i)" in second
    assert "second frequency" in second
    assert "run c (2)" in jumped
    assert found.branch_jumps == 2


def test_jumps_and_changes_of_stability_are_told_apart():
    """A linear model has one answer to an input, which may be unstable."""
    table = np.full((3, 1), 0.5 + 0j)
    found = Stability(tuple("abc"), table, np.array([0, 2, 5]), np.array([0, 2, 1]))
    jumped, changed = found.notes()
    assert "run c (4) went to another branch" in jumped
    assert "several answers" in jumped
    assert "runs b (2), c (1) changed its stability" in changed
    assert "several answers" not in changed
    assert "a linear one" in changed
    both = found.together(found.with_jumps(np.array([1, 0, 0]), np.array([1, 0, 0])))
    assert both.only_changed.tolist() == [0, 2, 1, 1, 0, 0]
    assert both.branch_jumps == 8


def test_a_linear_model_changes_its_stability_only():
    made, theta = predictor(110.0, "linear_oscillator")
    unstable = at(theta, made.layout.names, damping=-theta[made.layout.names.index("damping")])
    problem = CampaignProblem(made)
    for vector in (theta, unstable, theta):
        problem.evaluate(vector)
    problem.misfit(unstable[None])
    assert problem.branch_jumps.tolist() == problem.stability_changes.tolist() == [2]


def test_what_is_not_known_is_not_unstable():
    assert count_unstable(np.empty((3, 0), dtype=complex)).tolist() == [-1, -1, -1]
    assert count_unstable(np.array([[1.0 + 1e-12, 0.5]], dtype=complex)).tolist() == [0]
    assert np.isinf(swings(np.array([[3.0, 1.0], [3.0 + 1e-12, 2.0]]), 2)).tolist() == [True, False]


def test_a_problem_that_was_evaluated_elsewhere_is_on_its_branch_again():
    """Beyond a fold the way back from elsewhere leads to the other branch."""
    made, theta = predictor(95.0)
    problem = CampaignProblem(made)
    problem.freeze(theta)
    residual = problem.evaluate(theta).residual[0].copy()
    before = problem.misfit(theta[None]).sum_of_squares
    moved = theta.copy()
    moved[problem.names.index("stiffness")] *= np.exp(0.3)
    with problem.undisturbed():
        problem.evaluate(moved)
    np.testing.assert_array_equal(problem.misfit(theta[None]).sum_of_squares, before)
    np.testing.assert_array_equal(problem.evaluate(theta).residual[0], residual)
    assert not problem.branch_jumps.any()
    # Without it, the misfit is that of the other branch.
    problem.evaluate(moved)
    problem.evaluate(theta)
    assert problem.misfit(theta[None]).sum_of_squares.sum() > 2 * before.sum()
