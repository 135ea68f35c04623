"""Simulated runs: what goes in comes out again, however they are sampled."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from bayesoleo.errors import InputError
from bayesoleo.estimation import estimate
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.model import Condition, Dof, Model, Output, Parameter, driven_by
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._simulate import RunPlan, motion, simulate_run
from bayesoleo.systems._oleo import thermomechanical_oleo

OSCILLATOR = Model(
    "oscillator",
    inputs={"force": "N"},
    dofs={"position": "m"},
    parameters={
        "mass": Parameter(1.0, "kg", fixed=True),
        "damping": Parameter(2.0, "N*s/m", relative_sd=0.5),
        "stiffness": Parameter(100.0, "N/m", relative_sd=0.5),
        "cubic": Parameter(4000.0, "N/m**3", relative_sd=0.5),
    },
    equations={
        "position": "mass*ddot(position) + damping*dot(position) + stiffness*position"
        " + cubic*position**3 - force"
    },
    outputs={"displacement": Output("position", "m")},
)
OLEO = driven_by(thermomechanical_oleo(2), "displacement")
STROKE = motion(0.133, [0.034, 0.0003, 0.0002], [0.2, 1.0])


def force_plan(**options):
    return RunPlan("one", 1.3, {"force": motion(1.0, [5.0, 0.0, 0.3], [0.4])}, **options)


def record_of(plan, simulation):
    """The record that a perfect reduction would make."""
    turned = {
        name: motion(
            item.coefficients[0].real,
            np.abs(item.coefficients[1:]),
            np.angle(item.coefficients[1:]) + 2 * np.pi * item.orders[1:] * plan.phase,
        )
        for name, item in plan.inputs.items()
    }
    return Record(
        simulation.label,
        simulation.group,
        simulation.role,
        "periodic",
        simulation.frequency,
        0.0,
        int(plan.periods),
        simulation.time,
        simulation.samples,
        turned,
        {},
        simulation.conditions,
    )


def test_a_motion_is_its_cosines():
    phase = np.linspace(0.0, 2.0, 41)
    expected = 0.5 + 2 * np.cos(2 * np.pi * phase + 0.3) + 0.1 * np.cos(6 * np.pi * phase)
    item = motion(0.5, [2.0, 0.0, 0.1], [0.3])
    np.testing.assert_allclose(item.evaluate(phase, 3.0), expected, atol=1e-14)


@pytest.mark.slow
@settings(deadline=None, max_examples=10)
@given(phase=st.floats(-2.0, 2.0), per_period=st.floats(40.0, 90.0))
def test_a_refit_returns_the_parameters(phase, per_period):
    truth = {"damping": 1.7, "stiffness": 93.0, "cubic": 4600.0}
    plan = force_plan(phase=phase, samples_per_period=per_period, periods=3.4)
    simulation = simulate_run(OSCILLATOR, plan, truth, steps=128)
    predictor = Predictor(OSCILLATOR, [record_of(plan, simulation)], steps=128, backend="numpy")
    point = estimate(CampaignProblem(predictor))
    # Both sides have the mesh's error, so that nothing is left but rounding; its standard deviation
    # is what the status, which is no convergence, measures steps by.
    np.testing.assert_allclose(point.theta, list(truth.values()), rtol=1e-9)


def test_twice_the_samples_contain_the_same_ones():
    few = simulate_run(OLEO, RunPlan("h", 0.5, {"displacement": STROKE}, samples_per_period=101.3))
    many = simulate_run(OLEO, RunPlan("h", 0.5, {"displacement": STROKE}, samples_per_period=202.6))
    for name, x in few.samples.items():
        # a phase is rounded to 1e-16 of a cycle, which a friction jump of 1e5 N a cycle shows
        np.testing.assert_allclose(many.samples[name][::2], x, rtol=1e-9)


def test_a_later_start_is_a_shift():
    whole = simulate_run(OSCILLATOR, force_plan(samples_per_period=80))
    later = simulate_run(OSCILLATOR, force_plan(samples_per_period=80, phase=0.25))
    for name, x in whole.samples.items():
        np.testing.assert_allclose(later.samples[name][:-20], x[20:], atol=1e-7 * np.ptp(x))


def test_the_mesh_is_fine_enough_for_a_rig():
    plan = RunPlan("h", 0.5, {"displacement": STROKE})
    coarse, fine = simulate_run(OLEO, plan), simulate_run(OLEO, plan, steps=4096)
    # a hundredth of the noise of a campaign, 20 N and 0.05 bar
    assert np.abs(coarse.samples["force"] - fine.samples["force"]).max() < 0.2
    assert np.abs(coarse.samples["pressure"] - fine.samples["pressure"]).max() < 50


def test_noise_and_quantisation():
    plan = force_plan(periods=50, samples_per_period=100)
    clean = simulate_run(OSCILLATOR, plan)
    noise, step = {"force": 0.2, "displacement": 0.0}, {"displacement": 0.001}
    first, second = (
        simulate_run(OSCILLATOR, plan, noise=noise, quantisation=step, rng=np.random.default_rng(3))
        for _ in range(2)
    )
    error = first.samples["force"] - clean.samples["force"]
    assert np.std(error) == pytest.approx(0.2, rel=4 / np.sqrt(2 * 5000))  # four standard errors
    rounded = first.samples["displacement"]
    np.testing.assert_allclose(rounded / 0.001, np.round(rounded / 0.001), atol=1e-9)
    assert np.abs(rounded - clean.samples["displacement"]).max() <= 0.0005 * (1 + 1e-9)
    for name, x in first.samples.items():
        np.testing.assert_array_equal(x, second.samples[name])


def test_a_model_without_dofs():
    law = Model(
        "spring",
        inputs={"displacement": "m"},
        parameters={"stiffness": Parameter(3.0, "N/m")},
        outputs={"force": Output("stiffness*displacement + offset", "N")},
        conditions={"offset": Condition("N")},
    )
    plan = RunPlan("one", 2.0, {"displacement": STROKE}, {"offset": 5.0}, role="hold-out")
    made = simulate_run(law, plan)
    expected = 3 * made.samples["displacement"] + 5
    np.testing.assert_allclose(made.samples["force"], expected, rtol=1e-14)
    assert (made.role, made.frequency, made.time.size) == ("hold-out", 2.0, 2000)
    with pytest.raises(InputError, match=r"run one: no condition 'offset'; give conditions="):
        simulate_run(law, RunPlan("one", 2.0, {"displacement": STROKE}))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"values": {"mas": 1.0}}, "key mas: no such parameter; parameters there are: mass, "),
        ({"noise": {"pressure": 1.0}}, "noise of no channel; channels there are: force, displace"),
        ({"noise": {"force": -1.0}}, "key force: noise .got -1.0.; write a positive number"),
        ({"noise": {"force": 1.0}}, "noise needs a generator; pass rng="),
        ({"quantisation": {"force": 0.0}}, "key force: quantisation .got 0.0."),
    ],
)
def test_bad_input_says_what_to_write(options, message):
    with pytest.raises(InputError, match=message):
        simulate_run(OSCILLATOR, force_plan(), **options)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RunPlan("one", 0.0, {}), r"run one, key frequency: .*got 0.0.*positive"),
        (lambda: RunPlan("one", 1.0, {}, periods=0.001), "run one: fewer than two samples"),
        (lambda: RunPlan("one", 1.0, {}, phase=np.nan), "key phase"),
        (lambda: motion(0.0, [1.0], [0.0, 1.0]), "more phases than amplitudes"),
        (lambda: motion(0.0, [np.inf]), "a motion needs finite numbers"),
        (lambda: simulate_run(OSCILLATOR, RunPlan("one", 1.0, {})), "needs the input 'force'"),
    ],
)
def test_a_plan_that_is_none(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_a_motion_beyond_the_gas_volume_is_an_error():
    plan = RunPlan("far", 0.5, {"displacement": motion(0.2, [0.1])})
    with pytest.raises(InputError, match=r"run far: model 'f16n2d2': no periodic answer"):
        simulate_run(OLEO, plan)


def test_a_simulation_knows_the_error_of_its_motion():
    """Of a harmonic too fast for the steps it is large, and by many steps it is the difference."""
    fast = force_plan(samples_per_period=333.3)
    fast = replace(fast, inputs={"force": motion(0.0, [1.0, *[0.0] * 98, 500.0])})
    coarse = simulate_run(OSCILLATOR, fast, steps=128)
    fine = simulate_run(OSCILLATOR, fast, steps=4096)
    true = np.abs(coarse.samples["displacement"] - fine.samples["displacement"]).max()
    assert fine.error < 1e-5
    assert coarse.error > true / np.ptp(fine.samples["displacement"])
    assert coarse.error > 0.01


LAGGING = {
    # Dahl (1968): the friction follows the motion within a length of 1/rate.
    "dahl": ("dot(z) - rate*(dot(q) - abs(dot(q))*z)", "rub*z"),
    # Bouc and Wen with the exponent two.
    "bouc_wen": ("dot(z) - rate*dot(q) + rate*(abs(dot(q))*abs(z)*z + dot(q)*z**2)/2", "rub*z"),
}


def lagging(name: str) -> Model:
    """An oscillator with friction that remembers the motion."""
    memory, force = LAGGING[name]
    return Model(
        name,
        inputs={"force": "N"},
        dofs={"q": Dof("m"), "z": Dof("")},
        parameters={
            "m": Parameter(1.2, "kg", fixed=True),
            "c": Parameter(12.0, "N*s/m", sd=6.0),
            "k": Parameter(2e4, "N/m", sd=6e3),
            "rub": Parameter(3.0, "N", sd=2.0),
            "rate": Parameter(4e3, "1/m", sd=2e3),
        },
        equations={"q": f"m*ddot(q) + c*dot(q) + k*q + {force} - force", "z": memory},
        outputs={"displacement": Output("q", "m")},
    )


@pytest.mark.parametrize("frequency", [5.0, 18.0])
@pytest.mark.parametrize("solver", ["collocation", "adaptive", "hybrid"])
@pytest.mark.parametrize("name", LAGGING)
def test_a_state_that_stands_still_at_rest_is_solved_by_every_solver(name, solver, frequency):
    """At rest, where guesses of an unknown motion begin, nothing determines the memory."""
    plan = RunPlan("a", frequency, {"force": motion(0.0, [20.0])})
    found, shot = (
        simulate_run(lagging(name), plan, steps=512, solver=one).samples["displacement"]
        for one in (solver, "shooting")
    )
    # What 512 equal steps leave at the kinks of each reversal.
    np.testing.assert_allclose(found, shot, atol=1e-4 * np.abs(shot).max())


@pytest.mark.parametrize("mean", [0.0, 1.0])
@pytest.mark.parametrize("solver", ["collocation", "adaptive"])
def test_a_free_mass_has_no_motion_that_can_be_found(solver, mean):
    """Any position does, or none."""
    free = Model(
        "free mass",
        inputs={"force": "N"},
        dofs={"q": Dof("m")},
        parameters={"m": Parameter(1.2, "kg", sd=0.1)},
        equations={"q": "m*ddot(q) - force"},
        outputs={"displacement": Output("q", "m")},
    )
    plan = RunPlan("a", 5.0, {"force": motion(mean, [20.0])})
    with pytest.raises(InputError, match="no periodic answer to this motion was found"):
        simulate_run(free, plan, steps=128, solver=solver)


@pytest.mark.parametrize("solver", ["collocation", "adaptive"])
def test_what_cannot_be_shot_is_singular_still(solver):
    """An output that needs a derivative beyond the equation's cannot be integrated."""
    adrift = Model(
        "adrift",
        inputs={"force": "N"},
        dofs={"q": Dof("m")},
        parameters={"c": Parameter(1.2, "N*s/m", sd=0.1)},
        equations={"q": "c*dot(q) + c*abs(dot(q))/9 - force"},
        outputs={"acceleration": Output("ddot(q)", "m/s**2")},
    )
    plan = RunPlan("a", 5.0, {"force": motion(0.0, [20.0])})
    with pytest.raises(InputError, match="no periodic answer to this motion was found"):
        simulate_run(adrift, plan, steps=128, solver=solver)
