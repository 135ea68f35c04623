"""Derivatives at a motion that is known already: an extension that is absent moves nothing."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from synthetic_runs import run, stroke

from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._orbit import Status

BALANCE = "mass*ddot(q) + damping*dot(q) + stiffness*q + cubic*q**3 - x"


def oscillator(extra: str = "", **parameters: Parameter) -> Model:
    """A mass on a spring that hardens; what is not asked for is fixed."""
    fixed = {
        "mass": Parameter(1.0, fixed=True),
        "damping": Parameter(0.4, fixed=True),
        "stiffness": Parameter(30.0, fixed=True),
        "cubic": Parameter(20.0, fixed=True),
    }
    return Model(
        "oscillator",
        inputs={"x": "N"},
        dofs={"q": "m"},
        equations={"q": f"{BALANCE}{extra}"},
        outputs={"y": Output("q", "m")},
        parameters=fixed | parameters,
    )


#: A force at a place, of some width: its width is a shape and moves nothing where there is none.
EXTENDED = oscillator(
    " + bump*tanh((q - 0.01)/width)", bump=Parameter(0.0, sd=1.0), width=Parameter(0.1, fixed=True)
)


@pytest.fixture(scope="module")
def known() -> Predictor:
    free = oscillator(stiffness=Parameter(30.0, sd=1.0))
    record = run("one", {"x": stroke(0.0, 2.0)}, 0.8, {}, others=("y",))
    predictor = Predictor(free, [record], steps=64, backend="numpy", jobs=1)
    assert predictor.set_anchor(np.array([30.0])) == [Status.CONVERGED]
    return predictor


@pytest.mark.parametrize("scheme", ["radau3", "gauss2"])
def test_models_of_a_run_share_the_plan_of_its_samples(known, monkeypatch, scheme):
    """What is kept is what the scheme plans, bit by bit, and each model has its own copy."""
    rightly, planned = Collocation.plan, []

    def counted(method, phase, n, **options):
        planned.append(n)
        return rightly(method, phase, n, **options)

    monkeypatch.setattr(Collocation, "plan", counted)
    record = replace(known.records[0])  # nothing is kept of this one
    runs = [
        Predictor(model, [record], steps=steps, scheme=scheme, backend="numpy", jobs=1).runs[0]
        for model, steps in ((known.model, 64), (EXTENDED, 64), (EXTENDED, 80))
    ]
    assert planned == [64, 80]
    for one in runs:
        plan = rightly(one.scheme, record.phase, one.steps)
        for field in fields(plan):
            here, there = getattr(one.plan, field.name), getattr(plan, field.name)
            assert here.dtype == there.dtype
            np.testing.assert_array_equal(here, there)
            # Compiled code would be compiled once more for other arrays.
            assert here.flags.c_contiguous
            assert here.flags.writeable
    for field in fields(runs[0].plan):
        first, second = (getattr(one.plan, field.name) for one in runs[:2])
        assert not np.shares_memory(first, second)


def extension(known: Predictor, model: Model, **sets: list[float]):
    """The run under an extended model, and its constants with sets of some of them."""
    more = Predictor(model, known.records, steps=64, backend="numpy", jobs=1)
    p = np.repeat(more.runs[0].base_constants()[None], len(next(iter(sets.values()))), axis=0)
    for name, values in sets.items():
        p[:, more.runs[0].kernels.derived.constants.index(name)] = values
    return more.runs[0], p


def test_the_same_as_by_solving_for_every_set(known):
    widths = [0.02, 0.1, 0.5]
    run_, p = extension(known, EXTENDED, width=widths)
    found = run_.evaluate_on(known.runs[0], p)
    assert found is not None
    for k in range(len(widths)):
        other, _ = extension(known, EXTENDED, width=widths)
        solved = other.evaluate(p[k])
        np.testing.assert_allclose(found.y[k], solved.y[0], atol=1e-12)
        # Both linear problems are solved to round-off, at motions that differ by as much.
        np.testing.assert_allclose(found.y_p[k], solved.y_p[0], rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(run_.anchor.monodromy, other.anchor.monodromy, atol=1e-12)
    assert np.abs(found.y_p[0] - found.y_p[2]).max() > 1e-3 * np.abs(found.y_p).max()


@pytest.mark.parametrize(
    ("changed", "sets"),
    [
        ("the motion", {"bump": [0.0, 1e-3]}),
        ("how small changes move it", {"bump": [0.0, 0.0], "damping": [0.4, 0.4 + 1e-14]}),
    ],
)
def test_another_motion_is_not_taken_for_it(known, changed, sets):
    run_, p = extension(known, EXTENDED, **sets)
    assert run_.evaluate_on(known.runs[0], p) is None
    assert run_.anchor is None


def test_a_model_with_another_state_is_solved(known):
    lagging = Model(
        "with a lag",
        inputs=EXTENDED.inputs,
        dofs={"q": "m", "z": "m"},
        equations={**oscillator().equations, "z": "dot(z)/rate + z - q"},
        outputs=EXTENDED.outputs,
        parameters={**oscillator().parameters, "rate": Parameter(1.0, sd=1.0)},
    )
    run_, p = extension(known, lagging, rate=[1.0])
    assert run_.evaluate_on(known.runs[0], p) is None


def with_memory() -> Model:
    """The oscillator with a friction that remembers (Dahl's), of no force: an elastic slider."""
    own = {"slide": Parameter(0.0, sd=1.0), "rate": Parameter(50.0, fixed=True)}
    return Model(
        "oscillator with a slider",
        inputs={"x": "N"},
        dofs={"q": "m", "z": "1"},
        equations={
            "q": f"{BALANCE} + slide*z",
            "z": "dot(z) - rate*(dot(q) - abs(dot(q))*z)",
        },
        outputs={"y": Output("q", "m")},
        parameters=oscillator().parameters | own,
    )


def following(known: Predictor, model: Model, **sets: list[float]):
    run_, p = extension(known, model, **sets)
    run_.motions, run_.watched = known.runs[0].known_motions(), False
    return run_, p


def test_states_that_follow_a_motion_are_found_for_every_set(known):
    """Against central differences by solutions with a little of the force."""
    rates, small = [0.3, 20.0, 1000.0], 1e-4
    run_, p = following(known, with_memory(), rate=rates)
    found = run_.follow(p)
    assert found is not None
    assert (found.status == Status.CONVERGED.value).all()
    at = run_.kernels.derived.constants.index("slide")
    for k, row in enumerate(p):
        np.testing.assert_allclose(found.y[k], known.runs[0].predict(
            known.constants(np.array([[30.0]]), 0)).y[0], atol=1e-11)  # fmt: skip
        ends = []
        for force in (small, -small):
            other, _ = extension(known, with_memory(), rate=rates)
            moved = row.copy()
            moved[at] = force
            ends.append(other.evaluate(moved).y[0])
        expected = (ends[0] - ends[1]) / (2 * small)
        # Kinks of the memory move with the force: the difference is of first order in it.
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found.y_p[k, :, 0], expected, atol=2e-3 * scale)
    assert run_.anchor is not None
    np.testing.assert_array_equal(run_.anchor.p, p[0])


def test_guesses_of_several_sets_are_those_of_each(known):
    """Known motions are asked for once, at the nodes and at the points of the mesh."""
    model = with_memory()
    model = replace(model, dofs=model.dofs | {"z": Dof("1", guess="x*rate")})
    run_, p = following(known, model, rate=[0.3, 20.0, 1000.0])
    each = np.concatenate([run_.guess(row) for row in p])
    asked, motion = [], run_.motions["q"]

    def counted(phase):
        asked.append(phase.size)
        return motion(phase)

    run_.motions = {"q": counted}
    np.testing.assert_array_equal(run_._guesses(p), each)
    assert len(asked) == 2
    assert not np.array_equal(each[0], each[1])


def test_states_that_act_on_the_motion_do_not_follow_it(known):
    run_, p = following(known, with_memory(), slide=[0.0, 3.0])
    found = run_.follow(p)
    assert found is not None
    assert list(found.status) == [Status.CONVERGED.value, Status.NO_CONVERGENCE.value]
    assert np.isfinite(found.y[0]).all()
    assert np.isnan(found.y[1]).all()
    run_, p = following(known, with_memory(), slide=[3.0])
    assert run_.follow(p) is None
    assert run_.anchor is None


def test_a_motion_about_a_large_mean_is_not_taken_for_another(known):
    """An offset of the coordinate hides nothing of how the motion changes."""
    balance = BALANCE.replace("stiffness*q + cubic*q**3", "stiffness*(q - 300)")
    plain = replace(oscillator(), equations={"q": balance})
    record = known.records[0]
    far = Predictor(plain, [record], steps=64, backend="numpy", jobs=1).runs[0]
    p = far.base_constants()
    assert far.set_anchor(p) is Status.CONVERGED
    memory = "dot(z) - rate*(dot(q) - abs(dot(q))*z)"
    model = replace(
        with_memory(), equations={"q": f"{balance} + slide*z", "z": memory}
    )  # fmt: skip
    run_ = Predictor(model, [record], steps=64, backend="numpy", jobs=1).runs[0]
    run_.motions, run_.watched = far.known_motions(), False
    p = np.repeat(run_.base_constants()[None], 2, axis=0)
    p[1, run_.kernels.derived.constants.index("slide")] = 3.0
    found = run_.follow(p)
    assert found is not None
    assert list(found.status) == [Status.CONVERGED.value, Status.NO_CONVERGENCE.value]


def test_states_of_a_force_law_follow_what_drives_it():
    lag = Model(
        "a force that lags",
        inputs={"x": "m"},
        dofs={"z": "m"},
        equations={"z": "dot(z)/rate + z - x"},
        outputs={"y": Output("stiffness*x + share*z", "N")},
        parameters={
            "stiffness": Parameter(2.0, fixed=True),
            "share": Parameter(0.0, sd=1.0),
            "rate": Parameter(1.0, fixed=True),
        },
    )
    record = run("one", {"x": stroke(0.0, 2.0)}, 0.8, {}, others=("y",))
    run_ = Predictor(lag, [record], steps=64, backend="numpy", jobs=1).runs[0]
    p = np.repeat(run_.base_constants()[None], 2, axis=0)
    rates = p[:, run_.kernels.derived.constants.index("rate")] = 3.0, 12.0
    found = run_.follow(p)
    assert found is not None
    drive = record.harmonics["x"]
    for k, rate in enumerate(rates):
        turn = np.exp(2j * np.pi * np.outer(drive.orders, record.phase))
        slow = drive.coefficients / (1 + 2j * np.pi * record.frequency * drive.orders / rate)
        expected = (slow[:, None] * turn).real.sum(axis=0)
        np.testing.assert_allclose(found.y_p[k, 0, 0], expected, atol=1e-5)
