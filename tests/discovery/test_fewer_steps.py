"""Comparisons and densities take fewer steps than an estimate, where these change nothing."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from fitted_states import NUMERICS

from bayesoleo.discovery import _fit
from bayesoleo.discovery._fewest_steps import SAMPLED, for_comparison, for_sampling
from bayesoleo.discovery._fit import COMPARED, ModelFit, fit_model
from bayesoleo.error_models import Stretch
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.model._priors import Transforms
from bayesoleo.prediction._mesh_steps import WHOLE, coarsest_steps, whole_steps
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Harmonics, Record, transient_record

NOISE = {"free": 1e-3, "broad": 5e-2}


def with_memory(drive: str = "") -> Model:
    """An oscillator with a force that remembers the last reversals: their corners ask for many
    steps."""
    return Model(
        "memory",
        inputs={"u": ""} if drive else {},
        dofs={"y": Dof("", initial="0" if drive else "1", initial_rate="0"), "z": Dof("")},
        parameters={
            "d": Parameter(0.1, "1/s", relative_sd=1.0),
            "k": Parameter(35.0, "1/s**2", relative_sd=0.5),
            "f": Parameter(0.5, "1/s**2", relative_sd=1.0),
        },
        equations={
            "y": {"all": f"ddot(y) + d*dot(y) + k*y + f*z {drive}"},
            "z": {"memory": "dot(z) - 30*(dot(y) - abs(dot(y))*z)"},
        },
        outputs={"out": Output("y", "")},
    )


def free() -> tuple[Model, Record]:
    model = with_memory()
    model = replace(model, dofs={**model.dofs, "z": Dof("", initial="0")})
    time = 5e-3 * np.arange(3000)
    empty = transient_record("free", time, {"out": np.zeros(time.size)})
    return model, simulated(model, empty)


def broadband() -> tuple[Model, Record]:
    """Of which only few harmonics are large: the steps that all of them ask for are not needed."""
    model, time = with_memory("- 40*u"), np.arange(4096) / 4096 * 10.0
    orders = np.arange(1, 256)
    phase = np.random.default_rng(2).uniform(0.0, 2 * np.pi, orders.size)
    sizes = np.exp(1j * phase) / (1.0 + (orders / 8.0) ** 4)
    drive = Harmonics(orders, sizes, np.full(orders.size, 1e-12))
    samples = {"u": drive.evaluate(time, 0.1), "out": np.zeros(time.size)}
    kinds, noise = {"u": drive}, {"u": 1e-9, "out": NOISE["broad"]}
    record = Record("broad", "", "fit", "periodic", 0.1, 0.0, 1, time, samples, kinds, noise)
    return model, simulated(model, record)


def simulated(model: Model, record: Record) -> Record:
    """The record as the model's nominal values make it, with noise."""
    predictor = Predictor(model, [record], steps=4 * whole_steps(model, [record]), jobs=1)
    theta = predictor.layout.start(model)
    assert predictor.set_anchor(theta)[0].ok
    out = predictor.simulate(theta[None], 0).y[0, 0]
    noise = NOISE[record.label] * np.random.default_rng(5).standard_normal(out.size)
    return replace(record, samples={**record.samples, "out": out + noise})


@pytest.fixture(scope="module", params=[free, broadband])
def fit(request) -> ModelFit:
    model, record = request.param()
    return fit_model(model, [record], NUMERICS)


def test_fewer_steps_show_no_difference(fit: ModelFit) -> None:
    found = for_comparison(fit)
    assert coarsest_steps(fit.records, fit.steps) <= found.steps < fit.steps
    assert found.predictor.runs[0].steps <= 0.6 * fit.predictor.runs[0].steps
    change = found.predictions[0].y - fit.predictions[0].y
    left = fit.predictor.runs[0].measured - fit.predictions[0].y
    squares = np.sum(change**2) + abs(np.sum(2.0 * left * change))
    assert squares < 1.1 * fit.policy.unseen * fit.point.variance[0]


def test_a_candidate_is_estimated_alike_on_fewer_steps(fit: ModelFit) -> None:
    base = for_comparison(fit)
    start = fit.point.theta * 1.2
    found = fit_model(
        fit.model, fit.records, replace(fit.numerics, steps=base.steps), start=start,
        tolerance=1e-4, resolution=COMPARED, share=base.predictor, check_mesh=False, damped=True,
    )  # fmt: skip
    assert found.point.status.ok
    assert found.steps >= base.steps
    # Steps may change twice the log likelihood by one, which half a standard deviation does.
    away = np.abs(found.point.theta - fit.point.theta) / fit.point.sd
    assert away.max() < COMPARED + 1.0


def test_a_posterior_stays_where_it_is_on_fewer_steps(fit: ModelFit) -> None:
    found = for_sampling(fit)
    # By a kink in each swing of a broadband motion all steps are needed.
    assert found.steps == (fit.steps if fit.all_periodic else fit.steps // 2)
    np.testing.assert_array_equal(found.point.theta, fit.point.theta)
    again = fit_model(
        fit.model, fit.records, replace(fit.numerics, steps=found.steps),
        start=fit.point.theta, share=found.predictor, check_mesh=False,
    )  # fmt: skip
    if again.steps == found.steps:
        away = np.abs(again.point.theta - fit.point.theta) / fit.point.sd
        assert away.max() < 2.0 * SAMPLED * fit.policy.mesh_shift
    # Of two vectors a sampler compares the likelihoods.
    draws = fit.point.theta + fit.point.sd * np.random.default_rng(0).standard_normal((8, 3))
    fine, coarse = (
        one.problem.misfit(draws).sum_of_squares.sum(axis=(1, 2)) / fit.point.variance[0]
        for one in (fit, found)
    )
    assert np.ptp(fine - coarse) < 0.1 + 0.01 * np.ptp(fine)


def test_a_wider_posterior_is_sampled_on_fewer_steps(fit: ModelFit) -> None:
    """Where samples count less, parameters may move by more: in units of the wider deviations they
    stay where they are."""
    steps, tells = [], (1.0, 0.1, 1e-3, 1e-6)
    for told in tells:
        found = for_sampling(fit, told * fit.problem.counts)
        steps.append(found.steps)
        if found.steps < fit.steps:
            moved = fit_model(
                fit.model, fit.records, replace(fit.numerics, steps=found.steps),
                start=fit.point.theta, share=found.predictor, check_mesh=False,
            )  # fmt: skip
            away = np.abs(moved.point.theta - fit.point.theta) / fit.point.sd * np.sqrt(told)
            assert away.max() < 2.0 * SAMPLED * fit.policy.mesh_shift
    assert steps[0] == for_sampling(fit).steps
    assert steps == sorted(steps, reverse=True)
    assert steps[-1] < steps[0]
    with np.errstate(all="raise"):  # one sample counts at least
        assert for_sampling(fit, 0.0 * fit.problem.counts).steps <= steps[-2]


def test_what_an_error_model_was_told_is_known_on_fewer_steps(fit: ModelFit) -> None:
    """A fit that was moved to the mode under such errors tells its problem no second time."""
    problem = copy(fit.problem)
    problem.effective = np.full((1, 1), 50.0)
    wide = 4.0 * fit.point.covariance
    transforms = Transforms.of(problem.priors)
    problem.stretch = Stretch.of(transforms, fit.point.theta, fit.point.covariance, wide)
    found = for_sampling(replace(fit, problem=problem))
    assert found.steps <= fit.steps
    assert found.problem.effective is problem.effective
    assert found.problem.stretch is problem.stretch


def test_steps_that_were_asked_for_are_sampled_on(fit: ModelFit) -> None:
    asked = replace(fit, numerics=replace(fit.numerics, steps=fit.steps))
    assert for_sampling(asked) is asked


def test_an_estimate_from_a_start_ends_where_all_steps_lead(
    fit: ModelFit, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever fewer steps are taken on the way; it is told where it began."""
    start, iterations = fit.point.theta * 1.05, []
    for look in (True, False):
        monkeypatch.setattr(_fit, "_has_fewer_steps", lambda _, yes=look: yes)
        found = fit_model(fit.model, fit.records, NUMERICS, start=start, damped=True)
        assert found.steps >= fit.steps
        np.testing.assert_array_equal(found.mbe.start, start)
        away = np.abs(found.point.theta - fit.point.theta) / fit.point.sd
        assert away.max() < 2.0 * fit.policy.mesh_shift
        iterations.append(found.mbe.iterations)
    assert iterations[0] < 5


def test_steps_are_whole_where_nobody_compares() -> None:
    model, record = free()
    assert whole_steps(model, [record]) == WHOLE
    model, record = broadband()
    assert whole_steps(model, [record]) == 1024
    assert coarsest_steps([record], 4096) == 512
    assert coarsest_steps([record], 128) == 128
