"""One campaign estimated by every solver of periodic runs."""

import pickle

import numpy as np
import pytest

from bayesoleo import system
from bayesoleo._cli import options
from bayesoleo._workflow import settings
from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.simulating import to_simulated_run
from bayesoleo._workflow.task import check
from bayesoleo.data import load_campaign, reduce_campaign, write_campaign
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.errors import InputError, ModelError
from bayesoleo.model import Model, Parameter
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import transient_record
from bayesoleo.prediction._run_errors import motion_error
from bayesoleo.prediction._simulate import RunPlan, motion, record_of, simulate_run
from bayesoleo.prediction._transient_run import TransientRun
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._schemes import SOLVERS

SAMPLES = {"periods": 3.0, "samples_per_period": 200.0}
#: By name: the model, its runs, and where estimates start, over the truth.
CAMPAIGNS = {
    "duffing": (
        system("duffing"),
        (
            RunPlan("a", 1.1, {"force": motion(0.1, [3.0, 0.0, 0.5])}, **SAMPLES),
            RunPlan("b", 1.6, {"force": motion(0.0, [4.0])}, **SAMPLES),
        ),
        1.2,
    ),
    "end_stop": (
        system("end_stop").with_values({"stop_stiffness": 400.0}),
        (
            RunPlan("a", 1.0, {"force": motion(23.0, [20.0])}, **SAMPLES),
            RunPlan("b", 1.3, {"force": motion(23.0, [19.0])}, **SAMPLES),
        ),
        0.9,
    ),
}
NOISE = {"force": 1e-3, "displacement": 1e-3}


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory):
    """Folders of campaigns simulated by shooting, whose force is measured too."""
    folders = {}
    for name, (model, plans, _) in CAMPAIGNS.items():
        made = [
            simulate_run(model, plan, noise=NOISE, rng=np.random.default_rng(k), solver="shooting")
            for k, plan in enumerate(plans)
        ]
        folders[name] = write_campaign(
            tmp_path_factory.mktemp(name) / "campaign",
            name=name,
            channels={"force": ("f_N", "N"), "displacement": ("x_m", "m")},
            runs=[to_simulated_run(item, {}) for item in made],
        )
    return folders


@pytest.fixture(scope="module")
def fits(campaigns):
    """Fits by campaign and solver, each made once."""
    known = {}

    def fit(name, solver):
        if (name, solver) not in known:
            model, _, part = CAMPAIGNS[name]
            records = reduce_campaign(load_campaign(campaigns[name])).records
            start = part * np.array([model.parameters[n].value for n in model.estimated()])
            if solver == "library":  # takes seconds a motion: it begins three deviations away
                shot = fit(name, "shooting").point
                start = shot.theta + 3.0 * shot.sd
            # Of the equal steps the error is told by what it moves; the others choose their own.
            steps = None if solver == "collocation" else 128
            numerics = Numerics(solver=solver, steps=steps, jobs=1)
            known[name, solver] = fit_model(model, records, numerics, start=start)
        return known[name, solver]

    return fit


@pytest.mark.parametrize("name", CAMPAIGNS)
@pytest.mark.parametrize(
    "solver",
    ["collocation", "hybrid", "adaptive", pytest.param("library", marks=pytest.mark.slow)],
)
def test_every_solver_finds_the_same_estimate(fits, name, solver):
    shot, fit = fits(name, "shooting"), fits(name, solver)
    for found in (shot, fit):
        assert found.point.status is Status.CONVERGED
    # Equal steps may move an estimate by a tenth of its standard deviation; the others' errors are
    # those of a millionth of a swing, and an estimate ends a thousandth from its optimum. Steps of
    # a library change with the parameters: the objective scatters by 3e-4, which is 0.025.
    tolerance = {"collocation": 0.1, "library": 0.03}.get(solver, 0.005)
    assert np.abs((fit.point.theta - shot.point.theta) / shot.point.sd).max() < tolerance
    np.testing.assert_allclose(fit.point.sd, shot.point.sd, rtol=0.02)
    truth = np.array([fit.model.parameters[n].value for n in fit.model.estimated()])
    # Four standard deviations of up to three parameters.
    assert np.abs((fit.point.theta - truth) / fit.point.sd).max() < 4.0
    assert fit.motion_error < (1e-3 if solver == "collocation" else 1e-6)


def predictor_of(name, solver, **options):
    model, plans, _ = CAMPAIGNS[name]
    made = Predictor(
        model, [record_of(model, plans[0])], solver=solver, steps=128, jobs=1, **options
    )
    made.evaluate(made.layout.start(model))
    return made


@pytest.mark.parametrize("solver", ["shooting", "adaptive"])
def test_a_vector_depends_on_itself_and_the_anchor_alone(solver):
    """Whatever its neighbours are, and in another process as here."""
    predictor = predictor_of("end_stop", solver)
    theta = np.array([[380.0], [400.0], [430.0]])
    together, status = predictor.sum_of_squares(theta)
    alone = np.concatenate([predictor.sum_of_squares(row[None])[0] for row in theta[::-1]])[::-1]
    assert set(status) == {Status.CONVERGED}
    assert together.tobytes() == alone.tobytes()
    there = pickle.loads(pickle.dumps(predictor))
    assert there.solver == solver
    assert there.sum_of_squares(theta)[0].tobytes() == together.tobytes()


@pytest.mark.parametrize("solver", ["shooting", "hybrid", "adaptive"])
def test_sensitivities_are_differences_of_predictions(solver):
    predictor, step = predictor_of("end_stop", solver), 0.05
    theta = np.array([400.0])
    slope = predictor.predict(theta)[0].sensitivity[0, 0]
    ends = [predictor.predict(theta + sign * step)[0].y[0] for sign in (1, -1)]
    difference = (ends[0] - ends[1]) / (2 * step)
    # Motions err by 1e-8 of a swing of one, over twice the step.
    np.testing.assert_allclose(slope, difference, atol=1e-3 * np.abs(slope).max())


def test_a_run_simulated_by_shooting_knows_its_error():
    model, plans, _ = CAMPAIGNS["end_stop"]
    shot = simulate_run(model, plans[0], solver="shooting")
    equal = simulate_run(model, plans[0])
    assert shot.error < 1e-7 < equal.error
    np.testing.assert_allclose(
        shot.samples["displacement"], equal.samples["displacement"], atol=10 * equal.error
    )


def test_shooting_that_steps_over_something_is_told_by_the_error():
    """Where estimates solve, steps are not refined for what the integrator did not see."""
    model = Model(
        "lag",
        inputs={"u": "1"},
        dofs={"T": "1"},
        parameters={"tau": Parameter(1e-6, sd=1e-7)},
        equations={"T": "tau*dot(T) + T - tanh(50*u)"},
        outputs={"y": "T"},
    )
    record = record_of(model, RunPlan("a", 1.0, {"u": motion(0.0, [1.0])}))
    predictor = Predictor(model, [record], solver="shooting", steps=128, jobs=1)
    assert predictor.evaluate(np.array([1e-6]))[0].status is Status.CONVERGED
    found = motion_error(predictor.runs[0])
    assert found.error > 0.1
    assert found.better is not None


def test_failures_have_a_status():
    model, plans, _ = CAMPAIGNS["duffing"]
    for solver in SOLVERS[1:]:
        predictor = Predictor(
            model, [record_of(model, plans[0])], solver=solver, backend="numpy", steps=64, jobs=1
        )
        found = predictor.evaluate(np.zeros(3))[0]  # a free mass
        assert not found.status.ok
        assert np.isnan(found.y).all()
        assert predictor.runs[0].anchor is None


def test_transients_are_solved_by_collocation():
    model = system("linear_oscillator")
    time = np.linspace(0.0, 1.0, 101)
    record = transient_record("a", time, {"force": np.sin(time), "displacement": 0.0 * time})
    predictor = Predictor(model, [record], solver="shooting", backend="numpy", jobs=1)
    assert isinstance(predictor.runs[0], TransientRun)


def test_a_campaign_is_checked_by_the_solver_of_the_settings(campaigns):
    model = CAMPAIGNS["duffing"][0]
    by = [
        check(campaigns["duffing"], model, Settings(solver=solver, jobs=1))["start"]
        for solver in ("collocation", "shooting")
    ]
    assert len(by[0]) == len(by[1]) == 2
    for one, other in zip(*by, strict=True):
        assert one["ratio"] == pytest.approx(other["ratio"], rel=1e-4)


def test_what_cannot_be_solved_says_what_to_use():
    with pytest.raises(InputError, match=r"unknown solver.*shoting.*did you mean shooting"):
        Settings(solver="shoting")
    with pytest.raises(
        InputError, match=r"--solver: unknown solver.*one of: collocation, adaptive"
    ):
        options.settings(solver="euler")
    with pytest.raises(InputError, match=r"'thesis' needs equal steps.*use .*solver collocation"):
        Settings(solver="adaptive", scheme="thesis")
    assert settings.SOLVERS == SOLVERS
    model = system("linear_oscillator")
    jerk = Model(
        "jerk",
        inputs=model.inputs,
        dofs={"x": "m"},
        parameters={"tau": Parameter(0.1, sd=0.1)},
        equations={"x": "tau*dot(x) + x + 0.1*abs(x) - force"},
        outputs={"a": "ddot(x)"},
    )
    record = record_of(jerk, RunPlan("a", 1.0, {"force": motion(0.0, [1.0])}))
    predictor = Predictor(jerk, [record], solver="shooting", backend="numpy", jobs=1)
    with pytest.raises(ModelError, match=r"higher derivative of 'x'.*solver"):
        predictor.evaluate(np.array([0.1]))
