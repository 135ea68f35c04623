"""Periodic runs and transients of one model: each depends on what it has, and a cycle has no start.

An oscillator is simulated by SciPy: twice in its cycle under a sinusoidal force, twice as it swings
out freely.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bayesoleo._workflow import predicting
from bayesoleo.data import CampaignData, Channel, Run, reduce_campaign
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._ranking import estimated, score_candidates
from bayesoleo.discovery._refit import compare, refit
from bayesoleo.discovery._score_tests import corrected_p
from bayesoleo.discovery._state import fit_state
from bayesoleo.effects import find_effect
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.model._drive_and_start import start_parameters
from bayesoleo.prediction import _periodic_run as periodic_run
from bayesoleo.prediction._mesh_steps import steps_for
from bayesoleo.prediction._predictor import Layout, Predictor
from bayesoleo.prediction._run_errors import input_columns
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import Solution

DAMPING, STIFFNESS, NOISE = 0.8, 90.0, 1e-4
TIME = 0.01 * np.arange(1000)


def oscillator(**starts: str) -> Model:
    parameters = {
        "damping": Parameter(1.0, "1/s", relative_sd=0.5),
        "stiffness": Parameter(80.0, "1/s**2", relative_sd=0.5),
        "begin": Parameter(0.1, "m", sd=1.0),
    }
    if not starts:
        del parameters["begin"]
    return Model(
        "oscillator",
        dofs={"x": Dof("m", **starts)},
        inputs={"pull": "m/s**2"},
        parameters=parameters,
        equations={"x": "ddot(x) + damping*dot(x) + stiffness*x - pull"},
        outputs={"position": Output("x", "m")},
    )


def swings(label: str, kind: str, role: str, rng: np.random.Generator) -> Run:
    frequency = 1.0 if kind == "periodic" else None
    size = 5.0 if kind == "periodic" else 0.0

    def pull(t):
        return size * np.sin(2 * np.pi * t)

    span = (-40.0 if frequency else 0.0, TIME[-1])
    found = solve_ivp(
        lambda t, s: [s[1], pull(t) - DAMPING * s[1] - STIFFNESS * s[0]],
        span, [0.1, 0.0], rtol=1e-10, atol=1e-12, t_eval=TIME,
    )  # fmt: skip
    position = found.y[0] + NOISE * rng.standard_normal(TIME.size)
    return Run(
        label, f"{label}.csv", label, role, kind, frequency, TIME,
        {"pull": pull(TIME), "position": position},
    )  # fmt: skip


def mixed(**roles: str):
    """Runs by kind and role, such as ``cycle="fit"``."""
    rng = np.random.default_rng(5)
    kinds = {"cycle": "periodic", "slow": "periodic", "free": "transient", "last": "transient"}
    runs = tuple(swings(label, kinds[label], role, rng) for label, role in roles.items())
    channels = {
        "pull": Channel(name="pull", column="pull", unit="m/s**2", si_unit="m/s**2"),
        "position": Channel(name="position", column="position", unit="m", si_unit="m"),
    }
    made = CampaignData("mixed", "", "pull", ".", channels, runs, "")
    return reduce_campaign(made, jobs=1)


@pytest.fixture(scope="module")
def campaign():
    return mixed(cycle="fit", free="fit", slow="hold-out", last="hold-out")


def test_a_start_belongs_to_transients_alone(campaign):
    model = Assembly(oscillator(), "pull", starts=True).model()
    predictor = Predictor(model, campaign.records[:2], steps=64, backend="numpy", jobs=1)
    assert predictor.layout.names == (
        "damping", "stiffness", "start_x[free]", "start_rate_x[free]"
    )  # fmt: skip
    theta = np.array([DAMPING, STIFFNESS, 0.0, 0.0])
    cycle, free = predictor.evaluate(theta)
    assert cycle.status.ok
    assert free.status.ok
    assert not cycle.sensitivity[:, 2:].any()
    assert free.sensitivity[:, 2:].any(axis=(0, 2)).all()
    # As a campaign of periodic runs alone predicts it.
    alone = Predictor(oscillator(), campaign.records[:1], steps=64, backend="numpy", jobs=1)
    (same,) = alone.evaluate(theta[:2])
    np.testing.assert_array_equal(same.y, cycle.y)
    np.testing.assert_array_equal(same.sensitivity, cycle.sensitivity[:, :2])


def test_what_a_start_depends_on_is_told_from_what_moves():
    assert start_parameters(oscillator(initial="begin")) == {"begin"}
    assert start_parameters(oscillator(initial="begin*stiffness/80")) == {"begin"}
    assert start_parameters(oscillator(initial="0")) == frozenset()
    assert start_parameters(oscillator()) == frozenset()


def test_a_declared_start_common_to_all_runs_is_an_unknown_of_transients():
    layout = Layout.of(oscillator(initial="begin"), ["cycle", "free"], [True, False])
    assert layout.names == ("damping", "stiffness", "begin")
    assert [own.tolist() for own in layout.columns] == [[0, 1], [0, 1, 2]]


def test_both_kinds_together_are_estimated_without_false_unknowns(campaign):
    model = Assembly(oscillator(), "pull", starts=True).model()
    fit = fit_model(model, campaign.records[:2], Numerics(jobs=1, backend="numpy"))
    assert fit.point.status.ok
    assert set(fit.values) == {"damping", "stiffness", "start_x[free]", "start_rate_x[free]"}
    away = (fit.point.theta[:2] - [DAMPING, STIFFNESS]) / fit.point.sd[:2]
    assert np.abs(away).max() < 4.0


@pytest.mark.parametrize(
    "roles",
    [
        {"cycle": "fit", "slow": "fit", "free": "hold-out"},
        {"free": "fit", "last": "fit", "cycle": "hold-out"},
    ],
    ids=["cycles are fitted", "transients are fitted"],
)
def test_one_kind_predicts_the_other(roles):
    """What the fitted runs lack is the prediction's own."""
    reduced = mixed(**roles)
    assembly = Assembly(oscillator(), "pull", starts=True)
    state = fit_state(assembly, assign(reduced.records), Numerics(jobs=1, backend="numpy"))
    fitted = [label for label, role in roles.items() if role == "fit"]
    own = [name for name in state.fit.values if "[" in name]
    assert {name.split("[")[1][:-1] for name in own} == set(fitted) - {"cycle", "slow"}
    assert state.at_floor


def broad(label: str, role: str, count: int = 300, input_noise: float = 1e-3, seed: int = 5) -> Run:
    """A cycle of 1 000 samples with so many lines."""
    rng = np.random.default_rng(seed)
    order, lines = np.arange(501), np.zeros(501, dtype=complex)
    lines[1 : count + 1] = np.exp(2j * np.pi * rng.random(count))
    pull = np.tile(100.0 * np.fft.irfft(lines, 1000), 2)
    turn = 2j * np.pi * order * 0.1
    answer = np.fft.irfft(np.fft.rfft(pull[:1000]) / (turn**2 + DAMPING * turn + STIFFNESS), 1000)
    time = 0.01 * np.arange(2000)
    samples = {
        "pull": pull + input_noise * rng.standard_normal(2000),
        "position": np.tile(answer, 2) + NOISE * rng.standard_normal(2000),
    }
    return Run(label, f"{label}.csv", label, role, "periodic", 0.1, time, samples)


def test_the_steps_of_a_broadband_cycle_are_none_of_a_transient():
    """2 048 steps a cycle would cut those of a transient into sixteen each."""
    rng = np.random.default_rng(5)
    runs = (
        broad("broad", "fit"),
        swings("free", "transient", "fit", rng),
        swings("last", "transient", "hold-out", rng),
    )
    made = CampaignData("mixed", "", "pull", ".", mixed(free="fit").campaign.channels, runs, "")
    reduced = reduce_campaign(made, jobs=1)
    assembly = Assembly(oscillator(), "pull", starts=True)
    numerics = Numerics(jobs=1, backend="numpy")
    state = fit_state(assembly, assign(reduced.records), numerics)
    assert state.fit.steps >= 1024
    assert state.fit.fineness < state.fit.steps / 4
    assert [run.fineness for run in state.fit.predictor.runs[1:]] == [state.fit.fineness]
    (last,) = state.held_out
    assert last.predictor.fineness == state.fit.fineness
    assert state.at_floor


def test_a_cycle_is_solved_on_steps_of_its_own_after_a_fit_to_transients():
    rng = np.random.default_rng(5)
    runs = (swings("free", "transient", "fit", rng), broad("broad", "hold-out"))
    made = CampaignData("mixed", "", "pull", ".", mixed(free="fit").campaign.channels, runs, "")
    reduced = reduce_campaign(made, jobs=1)
    assembly = Assembly(oscillator(), "pull", starts=True)
    state = fit_state(assembly, assign(reduced.records), Numerics(jobs=1, backend="numpy"))
    (cycle,) = state.held_out
    assert state.fit.fineness < 1024 <= cycle.predictor.steps
    assert state.at_floor


@pytest.mark.parametrize(
    ("fitted", "steps", "others", "expected"),
    [
        ("cycle", 512, "free", 512),  # four times its first steps: a quarter of each
        ("free", 32, "cycle", 128),
        ("free", 256, "cycle", 256),
        ("cycle free", 256, "free", 256),
        ("cycle free", 256, "slow", 256),
    ],
)
def test_steps_of_other_runs(fitted, steps, others, expected):
    records = {r.label: r for r in mixed(cycle="fit", slow="fit", free="fit").records}
    known = [records[label] for label in fitted.split()]
    asked = [records[label] for label in others.split()]
    assert steps_for(oscillator(), known, steps, asked) == expected


def by_inputs(fit, base, changes):
    """Variance of changes in noise units by the errors of the inputs of periodic runs."""
    found = 0.0
    for r, (record, run) in enumerate(zip(fit.records, base.runs, strict=True)):
        if record.periodic:
            p = fit.predictor.constants(fit.point.theta[None], r)[0]
            columns = input_columns(fit.predictor.runs[r], p)[0] * run.scale
            found += float(np.sum((columns @ changes[r]) ** 2))
    # The residual bears out nearly all of that noise.
    return 0.9 * found


@pytest.mark.slow
def test_absent_effects_in_mixed_runs_count_the_noise_of_measured_inputs():
    """A transient among the runs must not hide what repeats in the others."""
    effects = [
        find_effect(name) for name in ("coulomb_friction", "cubic_stiffness", "quadratic_damping")
    ]
    small = []
    for seed in range(8):
        runs = (
            broad("one", "fit", 20, 1.0, seed),
            broad("two", "fit", 20, 1.0, seed + 100),
            swings("free", "transient", "fit", np.random.default_rng(seed)),
        )
        made = CampaignData("mixed", "", "pull", ".", mixed(free="fit").campaign.channels, runs, "")
        numerics = Numerics(jobs=1, backend="numpy")
        assembly = Assembly(oscillator(), "pull", starts=True)
        state = fit_state(assembly, assign(reduce_campaign(made, jobs=1).records), numerics)
        base = state.base()
        for score in score_candidates(base, state.assembly, effects, 1)[0]:
            result = refit(base, score, numerics)
            if np.isfinite(result.share):
                # The level of what is left exceeds its colour, and both hold the inputs' noise.
                changes = compare(base, result.fit)[1]
                white = sum(float(change @ change) for change in changes)
                assert result.noise.value >= result.noise.on_trial
                assert result.noise.on_trial >= by_inputs(state.fit, base, changes) / white
                small.append(corrected_p(estimated(score, result), 1.0))
    assert len(small) > 18
    # Of 24 at 5 % each at most five (chance 0.7 %), and one below a thousandth (two: 0.03 %).
    assert np.sum(np.array(small) < 0.05) <= 5
    assert np.sum(np.array(small) < 1e-3) <= 1


@pytest.mark.parametrize("watched", [True, False])
def test_a_step_that_is_only_compared_is_not_shot(watched, monkeypatch):
    """Where no path leads from the present motion, an estimate halves its step."""
    (record,) = mixed(cycle="fit").records
    predictor = Predictor(oscillator(), [record], steps=64, backend="numpy", jobs=1)
    theta, asked = np.array([DAMPING, STIFFNESS]), []
    assert predictor.set_anchor(theta) == [Status.CONVERGED]
    (run,) = predictor.runs
    run.watched = watched

    def lost(boundary, p, guess, exchange):
        status = np.array([Status.NO_CONVERGENCE.value])
        return Solution(np.repeat(guess, len(p), axis=0), status, np.zeros(1, dtype=np.int64))

    monkeypatch.setattr(periodic_run, "solve_from_guess", lost)
    monkeypatch.setattr(periodic_run, "solve_from_shot", lambda *_: asked.append(1))
    p = predictor.constants(theta[None], 0)[0]
    found = run.solve_from_guess(p)
    assert found.status[0] == Status.NO_CONVERGENCE.value
    assert bool(asked) is watched
    run.anchor, run.shots = None, 2
    before = len(asked)
    for _ in range(4):
        run.solve_from_guess(p)
    assert len(asked) == before + 2


@pytest.mark.parametrize(("lines", "steps"), [(20, 512), (300, 4096)])
def test_a_prediction_takes_as_many_steps_as_the_input_asks_for(lines, steps, monkeypatch):
    made = CampaignData(
        "mixed", "", "pull", ".", mixed(free="fit").campaign.channels,
        (broad("broad", "fit", lines),), "",
    )  # fmt: skip
    (record,) = reduce_campaign(made, jobs=1).records

    class AskedError(Exception):
        pass

    def refuse(*_, steps, **__):
        raise AskedError(steps)

    monkeypatch.setattr(predicting, "Predictor", refuse)
    rest = (None, None, 0.95, "radau2", "collocation")
    for given, expected in ((None, steps), (64, 64)):
        with pytest.raises(AskedError, match=f"^{expected}$"):
            predicting._one_run(oscillator(), record, *rest, given, 1)
