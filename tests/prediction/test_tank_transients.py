"""A tank that empties by a root of its level: where it rests, and many vectors at once."""

import numpy as np
import pytest

from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction import _transient_run as transient
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import transient_record
from bayesoleo.solvers._orbit import Status

STEP, COUNT = 0.5, 60
TANK = Model(
    "tank",
    inputs={"flow": "m/s"},
    dofs={"level": Dof("m", guess="3.0", initial="equilibrium")},
    parameters={"outflow": Parameter(1.0, "m**0.5/s", sd=1.0)},
    equations={"level": "dot(level) + outflow*sqrt(positive(level)) - flow"},
    outputs={"seen": Output("level", "m")},
)


def predictor(flow: float) -> Predictor:
    time = STEP * np.arange(COUNT)
    samples = {"flow": flow * (1 + 0.3 * np.sin(0.3 * time)), "seen": np.zeros(COUNT)}
    return Predictor(TANK, [transient_record("run", time, samples)], backend="numpy")


@pytest.mark.parametrize("flow", [0.05, 0.5, 1.0, 4.0])
def test_rest_is_found_from_far_above(flow):
    """Newton's first step from the guess would lead below the bottom, where nothing changes."""
    made = predictor(flow)
    (status,) = made.set_anchor(np.ones(1))
    assert status is Status.CONVERGED
    assert made.simulate(np.ones((1, 1)), 0).y[0, 0, 0] == pytest.approx(flow**2, rel=1e-6)


@pytest.mark.parametrize("derivatives", [False, True])
def test_vectors_in_groups_are_the_same_to_the_last_bit(derivatives, monkeypatch):
    made = predictor(1.0)
    made.set_anchor(np.ones(1))
    run, p = made.runs[0], np.linspace(0.9, 1.1, 7)[:, None]
    together = run.predict(p, derivatives=derivatives)
    monkeypatch.setattr(transient, "MOST_BYTES", 1.0)
    assert run._together(derivatives) == 1
    apart = run.predict(p, derivatives=derivatives)
    np.testing.assert_array_equal(apart.y, together.y)
    np.testing.assert_array_equal(apart.status, together.status)
    if derivatives:
        np.testing.assert_array_equal(apart.y_p, together.y_p)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_run_that_begins_like_another_has_the_solution_of_its_own_start(factor):
    """Also where no integrator is asked for the first motion."""
    known = predictor(1.0)
    known.set_anchor(np.ones(1))
    alone, begun = predictor(factor), predictor(factor)
    begun.runs[0].start_like(known.runs[0])
    for made in (alone, begun):
        (status,) = made.set_anchor(np.ones(1))
        assert status is Status.CONVERGED
    assert begun.runs[0].chosen is known.runs[0].chosen
    own, other = (made.simulate(np.ones((1, 1)), 0).y[0, 0] for made in (alone, begun))
    # Two meshes: what either leaves of the solution.
    np.testing.assert_allclose(other, own, rtol=1e-5, atol=1e-5 * np.abs(own).max())


def test_solutions_ask_for_no_slopes_of_where_they_rest(monkeypatch):
    """States and statuses without derivatives are those with them, failures included."""
    made = predictor(1.0)
    made.set_anchor(np.ones(1))
    run, p = made.runs[0], np.array([[0.9], [1.1], [np.nan], [0.0]])
    start, (state, status) = run.initial(p), run.initial.states(p)
    np.testing.assert_array_equal(state, start.state)
    np.testing.assert_array_equal(status, start.status)
    assert (status == Status.CONVERGED.value).sum() == 2
    expected = run.predict(p[:2])
    monkeypatch.setattr(type(run.initial), "_equilibrium", None)
    np.testing.assert_array_equal(run.predict(p[:2]).y, expected.y)
