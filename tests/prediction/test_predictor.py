"""What a predictor asks of records, and where parameters that vary by run go."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_runs import answered, oleo_runs, run, stroke

from bayesoleo.errors import CampaignError, ModelError
from bayesoleo.model import Condition, Model, Output, Parameter
from bayesoleo.model._drive_and_start import driven_by
from bayesoleo.prediction._periodic_run import RunPredictor
from bayesoleo.prediction._predictor import Layout, Predictor
from bayesoleo.solvers._orbit import Status
from bayesoleo.systems._oleo import thermomechanical_oleo


def force_law() -> Model:
    return Model(
        "force law",
        inputs={"x": "m"},
        outputs={"y": Output("c*dot(x) + k*x*tilt + offset", "N")},
        parameters={
            "c": Parameter(2.0, sd=1.0),
            "offset": Parameter(0.5, sd=1.0, by_run=True),
            "k": Parameter(3.0, sd=1.0),
            "known": Parameter(9.0, fixed=True),
        },
        conditions={"tilt": Condition("")},
    )


def records(**options):
    return [
        run(label, {"x": stroke(0.0, size)}, 0.5, {"tilt": tilt}, others=("y",), **options)
        for label, size, tilt in (("one", 1.0, 1.0), ("two", 2.0, 4.0))
    ]


def test_by_run_parameters_have_a_place_for_every_run():
    layout = Layout.of(force_law(), ["one", "two", "three"])
    assert layout.names == ("c", "offset[one]", "offset[two]", "offset[three]", "k")
    assert layout.active == (("c", "offset", "k"),) * 3
    np.testing.assert_array_equal(layout.columns, [[0, 1, 4], [0, 2, 4], [0, 3, 4]])
    np.testing.assert_array_equal(layout.start(force_law()), [2.0, 0.5, 0.5, 0.5, 3.0])
    assert [prior.mean for prior in layout.priors(force_law())] == [2.0, 0.5, 0.5, 0.5, 3.0]


def test_a_parameter_without_prior_is_named():
    model = force_law().with_parameters(c=Parameter(2.0))
    with pytest.raises(ModelError, match="parameter 'c' has no prior"):
        Layout.of(model, ["one"]).priors(model)


@pytest.mark.parametrize("backend", ["numpy", "numba"])
def test_a_model_without_dofs_predicts_and_differentiates(backend):
    predictor = Predictor(force_law(), records(), backend=backend)
    theta = np.array([2.0, 0.1, -0.2, 3.0])
    assert predictor.set_anchor(theta) == [Status.CONVERGED] * 2
    for r, (prediction, record) in enumerate(zip(predictor.predict(theta), records(), strict=True)):
        x = record.harmonics["x"].evaluate(record.phase, 0.5)
        v = record.harmonics["x"].evaluate(record.phase, 0.5, 1)
        tilt = record.conditions["tilt"]
        np.testing.assert_allclose(prediction.y[0], 2 * v + 3 * tilt * x + theta[1 + r], atol=1e-12)
        own = np.zeros((4, x.size))
        own[0], own[1 + r], own[3] = v, 1.0, tilt * x
        np.testing.assert_allclose(prediction.sensitivity[0], own, atol=1e-12)
        assert prediction.status is Status.CONVERGED
    squares, status = predictor.sum_of_squares(theta[None])
    assert status.tolist() == [0]
    expected = [np.sum(p.y[0] ** 2) for p in predictor.predict(theta)]
    np.testing.assert_allclose(squares[0, :, 0], expected, rtol=1e-13)


def test_no_run_and_no_vector_are_nothing_not_an_error():
    predictor = Predictor(force_law(), records(), backend="numpy")
    squares, status = predictor.sum_of_squares(np.empty((0, 4)))
    assert squares.shape == (0, 2, 1)
    assert status.shape == (0,)


def test_a_missing_condition_is_named_with_what_to_write():
    bare = [replace(record, conditions={}) for record in records()]
    with pytest.raises(
        CampaignError, match=r"run one: .* needs condition 'tilt'.*\[runs.conditions\]"
    ):
        Predictor(force_law(), bare, backend="numpy")


def test_a_default_condition_is_used_where_a_run_states_none():
    model = replace(force_law(), conditions={"tilt": Condition("", 4.0)})
    stated, bare = records()[1], replace(records()[1], conditions={})
    theta = np.array([2.0, 0.1, 3.0])
    predictions = [
        Predictor(model, [record], backend="numpy").predict(theta)[0].y for record in (stated, bare)
    ]
    np.testing.assert_array_equal(*predictions)


@pytest.mark.parametrize("missing", ["x", "y"])
def test_a_missing_channel_is_named(missing):
    poor = [
        replace(r, samples={k: v for k, v in r.samples.items() if k != missing}) for r in records()
    ]
    with pytest.raises(CampaignError, match=f"needs channel '{missing}', which the campaign lacks"):
        Predictor(force_law(), poor, backend="numpy")


def test_an_anchor_far_away_is_reached_along_a_path():
    """Vectors 40 % from the anchor end at the solution that a fresh start finds."""
    model = driven_by(thermomechanical_oleo(2), "displacement").fixing("orifice_damping")
    made = answered(model, oleo_runs()[:2], steps=64, backend="numpy")
    predictor = Predictor(model, made, steps=64, backend="numpy")
    start = predictor.layout.start(model)
    predictor.set_anchor(start)
    moved = ("initial_volume", "friction_per_pressure", "solubility")
    far = start * np.where(np.isin(predictor.layout.names, moved), 1.4, 1.0)
    squares, status = predictor.sum_of_squares(far[None])
    fresh = Predictor(model, made, steps=64, backend="numpy")
    fresh.set_anchor(far)
    expected, _ = fresh.sum_of_squares(far[None])
    assert status.tolist() == [0]
    # Two ways to the same solution, which Newton leaves at round-off.
    np.testing.assert_allclose(squares, expected, rtol=1e-9)


def test_a_prediction_made_from_the_data_fits_them():
    model = driven_by(thermomechanical_oleo(2), "displacement")
    made = answered(model, oleo_runs(), steps=64, backend="numpy")
    predictor = Predictor(model, made, steps=64, backend="numpy")
    theta = predictor.layout.start(model)
    predictor.set_anchor(theta)
    squares, _ = predictor.sum_of_squares(theta[None])
    scale = np.stack([[np.sum(row**2) for row in run.measured] for run in predictor.runs])
    assert (squares[0] < 1e-24 * scale).all()


@pytest.mark.parametrize("jobs", [1, 3])
def test_a_vector_that_one_run_does_not_solve_leaves_all_where_they_were(monkeypatch, jobs):
    """In one thread nothing more is solved once a run has failed, and that run is asked first."""
    model = driven_by(thermomechanical_oleo(), "displacement")
    predictor = Predictor(model, oleo_runs(), steps=64, backend="numpy", jobs=jobs)
    theta = predictor.layout.start(model)
    first = predictor.evaluate(theta)
    anchors, asked = [item.anchor for item in predictor.runs], []
    solve = RunPredictor.evaluate

    def evaluate(one, p):
        asked.append(one.record.label)
        found, lost = solve(one, p), one.record.label == "h"
        return replace(found, status=np.array([Status.NO_CONVERGENCE.value])) if lost else found

    with monkeypatch.context() as patch:
        patch.setattr(RunPredictor, "evaluate", evaluate)
        for expected in (["b", "d", "h"], ["h"]) if jobs == 1 else (["b", "d", "h", "i", "n"],):
            asked.clear()
            found = predictor.evaluate(1.01 * theta)
            assert sorted(asked) == expected
            assert {item.status for item in found} == {Status.NO_CONVERGENCE}
            assert all(np.isnan(item.y).all() for item in found)
            assert all(np.isnan(item.sensitivity).all() for item in found)
            assert [item.anchor for item in predictor.runs] == anchors
    for again, once in zip(predictor.evaluate(theta), first, strict=True):
        np.testing.assert_allclose(again.y, once.y, rtol=1e-9)
