"""Derivatives at a motion that is known already: an extension that is absent moves nothing."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_runs import run, stroke

from bayesoleo.model import Model, Output, Parameter
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.solvers._orbit import Status


def oscillator(extra: str = "", **parameters: Parameter) -> Model:
    """A mass on a spring that hardens; what is not asked for is fixed."""
    fixed = {
        "mass": Parameter(1.0, fixed=True),
        "damping": Parameter(0.4, fixed=True),
        "stiffness": Parameter(30.0, fixed=True),
        "cubic": Parameter(20.0, fixed=True),
    }
    balance = "mass*ddot(q) + damping*dot(q) + stiffness*q + cubic*q**3 - x"
    return Model(
        "oscillator",
        inputs={"x": "N"},
        dofs={"q": "m"},
        equations={"q": f"{balance}{extra}"},
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
