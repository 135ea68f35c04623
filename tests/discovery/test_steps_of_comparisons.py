"""Candidates are compared on long steps where that decides nothing, and on short ones elsewhere."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from broadband_transients import COUNT, KINDS, oscillator, record

from bayesoleo.discovery import _fit
from bayesoleo.discovery._fewest_steps import for_comparison
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._mesh_error import (
    can_be_coarser,
    changed_squares,
    mesh_shift,
    squares_of_change,
    visible,
)
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._run_predictions import predict_held_out
from bayesoleo.discovery._score_basis import sensitivities_of
from bayesoleo.prediction._mesh_steps import COARSEST, WHOLE
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import transient_record
from bayesoleo.prediction._transient_run import TransientRun
from bayesoleo.solvers._orbit import Status

NUMERICS = Numerics(jobs=1)


@pytest.fixture(scope="module", params=list(KINDS))
def fitted(request):
    model, truth = KINDS[request.param]
    data = record(model, truth)
    return request.param, truth, fit_model(model, [data], NUMERICS)


def squares(fit):
    """Sum of squares at an estimate, in variances of what is left: as found, and on a fine mesh."""
    predictor = Predictor(fit.model, fit.records, steps=8 * WHOLE, jobs=1, share=fit.predictor)
    theta, measured = fit.problem.full(fit.point.theta[None])[0], predictor.runs[0].measured
    predictor.set_anchor(theta)
    fine = predictor.simulate(theta[None], 0).y[0]
    return [float(np.sum((measured - y) ** 2)) for y in (fit.predictions[0].y, fine)] / (
        fit.point.variance[0]
    )


@pytest.mark.slow
def test_an_estimate_is_that_of_the_equations(fitted):
    _, truth, fit = fitted
    assert not fit.shift > fit.policy.mesh_shift
    assert np.all(np.abs(fit.point.theta[: len(truth)] - truth) < 4 * fit.point.sd[: len(truth)])


@pytest.mark.slow
def test_no_decision_depends_on_the_steps_of_a_comparison(fitted):
    _, _, fit = fitted
    base = for_comparison(fit)
    assert base.steps <= fit.steps
    # Twice the logarithm of equal odds, 6, is the least difference that anything is decided on.
    found, fine = squares(base)
    assert abs(found - fine) < 4.0


def test_a_change_along_what_is_left_counts(fitted):
    """Of two changes of one size, that along the residual changes the sum of squares more."""
    _, _, fit = fitted
    measured, here = fit.predictor.runs[0].measured, fit.predictions[0]
    left, sd = measured - here.y, np.sqrt(fit.point.variance[0])
    along = 0.5 * sd * left / np.linalg.norm(left)
    across = np.roll(along, 1, axis=1)
    across -= left * np.sum(across * left) / np.sum(left**2)
    across *= np.linalg.norm(along) / np.linalg.norm(across)

    def seen(change):
        return squares_of_change(fit.problem, [here], [here.y + change], fit.point)

    # Both changes are half a standard deviation: d.d is 1/4. Across the residual of this mesh, that
    # of the other one is shorter along d by d itself, so that |2 r.d| is twice d.d.
    assert seen(across) == pytest.approx(3 * 0.25, rel=1e-6)
    # The residual is sqrt(N) = 77 standard deviations long; d.d takes a quarter off twice that.
    assert seen(along) == pytest.approx(np.sqrt(left.size) - 0.25, rel=1e-3)
    assert seen(0.0 * along) == 0.0


def by_finer_steps(predictor, theta, y, variance):
    """``d.d`` and ``|2 r.d|`` of twice as many steps than a prediction's, over the variance."""
    finer = Predictor(predictor.model, predictor.records, steps=2 * predictor.steps, jobs=1)
    finer.set_anchor(theta)
    other, measured = finer.simulate(theta[None], 0).y[0], predictor.runs[0].measured
    change = other - y
    return np.sum(change**2) / variance, abs(np.sum(2 * (measured - other) * change)) / variance


def with_limit(fit, unseen):
    """A fit under another policy."""
    policy = replace(fit.policy, unseen=unseen)
    return replace(fit, numerics=replace(fit.numerics, policy=policy))


@pytest.mark.parametrize("fitted", ["oscillator", "lag"], indirect=True)
def test_a_mesh_is_refused_by_what_it_changes_along_the_residual(fitted):
    """Alone: the squares of the change are below the limit."""
    _, _, fit = fitted
    chosen = for_comparison(with_limit(fit, np.inf))
    assert chosen.steps == COARSEST
    y, variance = chosen.predictions[0].y, fit.point.variance[0]
    change, measured = fit.predictions[0].y - y, fit.predictor.runs[0].measured
    squares = np.sum(change**2) / variance
    along = abs(np.sum(2 * (measured - fit.predictions[0].y) * change)) / variance
    # A limit between both: a mesh of which only the change counted would do.
    limits = [squares + part * along for part in (0.5, 1.01)]
    found = [for_comparison(with_limit(fit, unseen)).steps for unseen in limits]
    assert found[0] > COARSEST
    assert found[1] == COARSEST


@pytest.mark.parametrize("fitted", ["oscillator", "lag"], indirect=True)
def test_an_estimate_and_a_hold_out_run_are_refined_along_the_residual(fitted):
    name, truth, fit = fitted
    free = replace(fit.numerics, policy=replace(fit.policy, unseen=np.inf, mesh_shift=np.inf))
    coarse = fit_model(fit.model, fit.records, free)
    assert coarse.steps == COARSEST
    theta = coarse.problem.full(coarse.point.theta[None])[0]
    pair = by_finer_steps(
        coarse.predictor, theta, coarse.predictions[0].y, coarse.point.variance[0]
    )
    *_, seen = mesh_shift(coarse.problem, coarse.point, coarse.predictions, free.policy)
    # The finest solution of a motion is not that of half the steps: both are near.
    assert seen == pytest.approx(sum(pair), rel=0.5)
    between = replace(free.policy, unseen=pair[0] + 0.3 * (seen - pair[0]))
    assert fit_model(fit.model, fit.records, replace(free, policy=between)).steps > COARSEST
    other = replace(record(KINDS[name][0], truth, seed=3), label="other")
    (held,) = predict_held_out(coarse, [other])
    left = np.mean((held.predictor.runs[0].measured - held.y) ** 2)
    squares, along = by_finer_steps(held.predictor, held.vector, held.y, left)
    (finer,) = predict_held_out(with_limit(coarse, squares + 0.5 * along), [other])
    assert finer.predictor.steps > held.predictor.steps


def test_a_candidate_is_refined_where_its_steps_show(fitted):
    """Twice as many steps, and all of them, change little of what it leaves, whatever it began
    with."""
    _, _, fit = fitted
    coarse = replace(NUMERICS, steps=COARSEST)
    found = fit_model(
        fit.model, fit.records, coarse, start=fit.point.theta, check_mesh=False, tolerance=1e-4
    )
    own, fine = squares(found)
    assert abs(own - fine) < 4.0
    worst = np.max(np.abs(found.point.theta - fit.point.theta) / fit.point.sd)
    assert worst < 1.0


@pytest.mark.slow
def test_an_end_stop_in_few_samples_counts_in_full():
    model, truth = KINDS["stop"]
    data = record(model, truth)
    without = fit_model(oscillator(), [data], NUMERICS)
    assert np.mean(data.samples["out"] > 0.21) < 0.05
    falls = []
    for steps, limit in ((COARSEST, 1.0), (8 * WHOLE, np.inf)):
        numerics = replace(NUMERICS, steps=steps, policy=replace(NUMERICS.policy, unseen=limit))
        start = np.array([*without.point.theta, 5e5])
        one = fit_model(
            model, [data], numerics, start=start, check_mesh=False, damped=True,
            share=without.predictor,
        )  # fmt: skip
        falls.append(float(np.log(without.point.variance[0] / one.point.variance[0])) * COUNT)
    assert falls[1] > 100.0
    assert abs(falls[0] - falls[1]) < 0.02 * falls[1] + 6.0


@pytest.mark.slow
@pytest.mark.parametrize("fitted", ["lag", "friction"], indirect=True)
def test_a_hold_out_run_has_steps_of_its_own(fitted):
    name, truth, fit = fitted
    rough = record(KINDS[name][0], truth, seed=3)
    rough = replace(rough, label="other")
    (found,) = predict_held_out(fit, [rough])
    theta = found.vector
    fine = Predictor(fit.model, [rough], steps=8 * WHOLE, jobs=1, share=found.predictor)
    fine.set_anchor(theta)
    change = np.mean((fine.simulate(theta[None], 0).y[0] - found.y) ** 2, axis=1)
    left = np.mean((fine.runs[0].measured - found.y) ** 2, axis=1)
    assert found.status.ok
    assert visible(fine.runs[0].measured, change, left) < 4.0


def failing(monkeypatch, fails):
    """Let the motion not be found where a function of the steps and the number of the call says."""
    solve = Predictor.solved_anew
    seen = []

    def solved_anew(self, theta):
        seen.append(self.steps)
        found = solve(self, theta)
        if fails(self.steps, seen.count(self.steps)):
            lost = np.array([Status.NO_CONVERGENCE.value])
            return [replace(one, status=lost) for one in found]
        return found

    monkeypatch.setattr(Predictor, "solved_anew", solved_anew)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fitted", "coarse"), [("lag", True), ("friction", False)], indirect=["fitted"]
)
def test_a_hold_out_run_whose_finer_steps_are_not_solved(fitted, coarse, monkeypatch):
    """On long steps nothing is known of them, and it goes on; on short ones it ends."""
    name, truth, fit = fitted
    other = replace(record(KINDS[name][0], truth, seed=3), label="other")
    if coarse:
        numerics = replace(fit.numerics, policy=replace(fit.policy, unseen=np.inf))
        fit = fit_model(fit.model, fit.records, numerics)
    assert (fit.steps < WHOLE) == coarse
    failing(monkeypatch, lambda steps, call: steps == 2 * fit.steps and call == 1)
    (found,) = predict_held_out(fit, [other])
    assert found.status.ok
    assert found.predictor.steps > fit.steps if coarse else found.predictor.steps == fit.steps


@pytest.mark.parametrize("fitted", ["friction"], indirect=True)
def test_a_scan_begins_with_the_first_shape_that_is_solved(fitted, monkeypatch):
    _, _, fit = fitted
    model = fit.model.fixing("r")
    shapes = [{"r": value} for value in (20.0, 30.0, 45.0)]
    every = sensitivities_of(fit, model, shapes)
    solve, asked = TransientRun.set_anchor, []

    def set_anchor(self, p, *args, **more):
        asked.append(float(p[self.kernels.derived.constants.index("r")]))
        if asked[-1] in lost:
            return Status.NO_CONVERGENCE
        return solve(self, p, *args, **more)

    monkeypatch.setattr(TransientRun, "set_anchor", set_anchor)
    lost = {20.0}
    found = sensitivities_of(fit, model, shapes)
    assert asked == [20.0, 30.0]
    for one, expected in zip(found, every, strict=True):
        # The same equations from another start, solved to some 1e-9 of their size.
        size = np.abs(expected.by_run[0]).max()
        assert size > 0.0
        np.testing.assert_allclose(one.by_run[0], expected.by_run[0], atol=1e-6 * size)
    lost = {20.0, 30.0, 45.0}
    assert sensitivities_of(fit, model, shapes) is Status.NO_CONVERGENCE


def test_steps_of_short_records_are_joined_for_comparisons_only():
    model, truth = KINDS["oscillator"]
    whole = record(model, truth)
    cut = {name: values[:300] for name, values in whole.samples.items()}
    short = transient_record("short", whole.time[:300], cut)
    fit = fit_model(model, [short], NUMERICS)
    assert fit.steps >= WHOLE
    assert not can_be_coarser(fit.problem)
    base = for_comparison(fit)
    assert COARSEST <= base.steps <= WHOLE
    found, fine = squares(base)
    assert abs(found - fine) < 4.0


def test_what_has_settled_does_not_show():
    measured = np.random.default_rng(0).standard_normal((1, 100))
    assert visible(measured, np.array([1e-12]), np.array([1e-30])) == 0.0
    assert visible(measured, np.array([1e-6]), np.array([1e-4])) == pytest.approx(1.0)


def test_masked_samples_change_nothing():
    """A few masked spikes make the variance of a record so large that no change would show."""
    rng = np.random.default_rng(3)
    measured = rng.standard_normal((2, 500))
    here, other = (measured + 0.1 * rng.standard_normal((2, 500)) for _ in range(2))
    weight, variance = np.ones(500), np.array([0.5, 2.0])
    weight[::100] = 0.0
    counts = weight > 0
    expected = changed_squares(
        measured[:, counts], here[:, counts], other[:, counts], variance, weight[counts]
    )
    measured[:, ~counts], other[:, ~counts] = 1e9, -1e3
    assert expected[0] > 0
    assert changed_squares(measured, here, other, variance, weight) == expected
    assert changed_squares(measured, here, other, variance, np.zeros(500)) == (0.0, 0.0)


def test_an_estimate_is_lost_where_no_solution_was_found_and_not_where_iterations_ended():
    def ended(status, **failures):
        return SimpleNamespace(status=status, failures=failures)

    fine = ended(Status.CONVERGED)
    assert not _fit._lost(fine, fine)
    assert not _fit._lost(fine, ended(Status.NO_CONVERGENCE))
    assert _fit._lost(fine, ended(Status.NO_CONVERGENCE, not_finite=1))
    # No failure is counted where derivatives are not finite.
    assert _fit._lost(fine, ended(Status.NOT_FINITE))


def test_iterations_that_run_out_are_not_repeated_from_the_start_on_finer_steps(monkeypatch):
    """More iterations were what such an estimate lacked, and the steps still do."""
    model, truth = KINDS["oscillator"]
    data, begin = record(model, truth), np.array([60.0, 280.0])
    starts, real = [], _fit.estimate

    def counted(problem, method, *, start=None, **options):
        starts.append((problem.predictor.steps, None if start is None else start.copy()))
        return real(problem, method, start=start, **options)

    monkeypatch.setattr(_fit, "estimate", counted)
    found = fit_model(
        model, [data], replace(NUMERICS, steps=COARSEST), start=begin,
        max_iterations=1, check_mesh=False,
    )  # fmt: skip
    assert not found.point.status.ok
    assert [steps for steps, _ in starts[:1]] == [COARSEST]
    # On finer steps, if any, the estimate goes on from where it was.
    assert not any(np.array_equal(start, begin) for _, start in starts[1:])
