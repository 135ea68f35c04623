"""The misfit of a vector depends on that vector alone, bit for bit."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from synthetic_runs import answered, harmonics, oleo_runs, run, stroke

from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.model import Model, Output, Parameter
from bayesoleo.model._drive_and_start import driven_by
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.solvers._orbit import Status, count
from bayesoleo.systems._oleo import mechanical_oleo, thermomechanical_oleo

STEPS = 64


@pytest.fixture(scope="module")
def model():
    return driven_by(thermomechanical_oleo(2), "displacement")


@pytest.fixture(scope="module")
def predictor(model):
    records = answered(model, oleo_runs(), noise=0.01, steps=STEPS)
    predictor = Predictor(model, records, steps=STEPS)
    statuses = predictor.set_anchor(predictor.layout.start(model))
    assert set(statuses) == {Status.CONVERGED}
    return predictor


@pytest.fixture(scope="module")
def vectors(model, predictor):
    start = predictor.layout.start(model)
    theta = start * (1 + 0.01 * np.random.default_rng(3).standard_normal((37, start.size)))
    volume = predictor.layout.names.index("initial_volume")
    theta[5, volume] *= 0.5  # the piston would leave the gas no volume
    theta[11] = np.nan
    return theta


@pytest.fixture(scope="module")
def whole(predictor, vectors):
    return predictor.sum_of_squares(vectors)


def test_failures_are_counted_and_have_no_sums(whole):
    squares, status = whole
    assert squares.shape == (37, 5, 2)
    assert count(status)["converged"] == 35
    assert Status(status[5]) is not Status.CONVERGED
    assert Status(status[11]) is Status.NOT_FINITE
    assert np.isnan(squares[[5, 11]]).all()
    assert np.isfinite(np.delete(squares, [5, 11], axis=0)).all()


@pytest.mark.parametrize("size", [1, 3, 16, 17, 36])
@pytest.mark.parametrize("jobs", [1, 2, 5])
def test_batch_split_and_threads_change_nothing(predictor, vectors, whole, size, jobs):
    predictor.jobs = jobs
    parts = [predictor.sum_of_squares(vectors[k : k + size]) for k in range(0, 37, size)]
    assert np.concatenate([squares for squares, _ in parts]).tobytes() == whole[0].tobytes()
    np.testing.assert_array_equal(np.concatenate([status for _, status in parts]), whole[1])


@pytest.mark.parametrize("jobs", [1, 2, 64])
def test_a_vector_without_a_solution_of_one_run_is_not_solved_in_those_after_it(predictor, jobs):
    other, asked = copy.copy(predictor), []
    other.jobs = jobs
    failing = {(1, 5): Status.SINGULAR, (3, 5): Status.NOT_FINITE, (0, 7): Status.INADMISSIBLE}

    def solve(r, lanes):
        asked.append((r, lanes))
        return np.array([failing.get((r, int(lane)), Status.CONVERGED) for lane in lanes])

    status = other.by_blocks(11, 4, solve)
    wanted = {5: Status.SINGULAR, 7: Status.INADMISSIBLE}
    assert status.tolist() == [int(wanted.get(lane, 0)) for lane in range(11)]
    assert max(lanes.size for _, lanes in asked) <= 4
    runs = {lane: {r for r, lanes in asked if lane in lanes} for lane in (4, 5, 7)}
    assert runs == {4: set(range(len(other.runs))), 5: {0, 1}, 7: {0}}


def test_row_position_changes_nothing(predictor, vectors, whole):
    order = np.random.default_rng(8).permutation(37)
    squares, status = predictor.sum_of_squares(vectors[order])
    assert squares.tobytes() == whole[0][order].tobytes()
    np.testing.assert_array_equal(status, whole[1][order])


def test_sums_are_those_of_the_predicted_outputs(predictor, vectors, whole):
    for r, one in enumerate(predictor.runs):
        samples = predictor.simulate(vectors[:4], r)
        expected = np.sum((one.measured - samples.y) ** 2, axis=2)
        # The same numbers summed in another order.
        np.testing.assert_allclose(whole[0][:4, r], expected, rtol=1e-12)


def test_outputs_at_some_samples_are_those_among_all_of_them(predictor, vectors):
    for r, one in enumerate(predictor.runs):
        chosen = np.array([0, 3, one.record.time.size - 1, 7])
        every, few = predictor.simulate(vectors, r), predictor.simulate_at(vectors, r, chosen)
        # The same formulas by another function of the compiler.
        np.testing.assert_allclose(few.y[:5], every.y[:5, :, chosen], rtol=1e-14)
        np.testing.assert_allclose(few.y[11:], every.y[11:, :, chosen], rtol=1e-14)
        # Where the piston would leave the gas no volume may be at another sample.
        np.testing.assert_array_equal(np.delete(few.status, 5), np.delete(every.status, 5))
        np.testing.assert_array_equal(few.jumped[:5], every.jumped[:5])


def test_chosen_samples_are_those_that_count(model):
    record = answered(model, oleo_runs()[:1], noise=0.01, steps=STEPS)[0]
    kept = np.arange(record.time.size) % 3 > 0
    problem = CampaignProblem(Predictor(model, [replace(record, kept=kept)], steps=STEPS))
    problem.freeze(problem.start)
    chosen, theta = np.array([1, 4, 10]), problem.start[None]
    measured = problem.kept(0, problem.predictor.runs[0].measured)
    expected = measured[:, chosen] - problem.residuals(theta, 0)[0][..., chosen]
    # A difference from measured values loses a digit.
    np.testing.assert_allclose(problem.outputs_at(theta, 0, chosen), expected, rtol=1e-12)


def test_back_ends_agree_to_round_off(model):
    records = oleo_runs()[1:3]
    squares = []
    for backend in ("numpy", "numba"):
        predictor = Predictor(model, records, steps=STEPS, backend=backend)
        theta = predictor.layout.start(model)
        predictor.set_anchor(theta)
        squares.append(predictor.sum_of_squares(theta[None] * 1.001)[0])
    # Round-off of 1e-15 in outputs, in sums of squares of the outputs themselves.
    np.testing.assert_allclose(squares[0], squares[1], rtol=1e-11)


def test_without_an_anchor_nothing_converges(model, predictor):
    fresh = Predictor(model, predictor.records[:1], steps=STEPS)
    squares, status = fresh.sum_of_squares(fresh.layout.start(model)[None])
    assert Status(status[0]) is Status.NO_CONVERGENCE
    assert np.isnan(squares).all()


@pytest.mark.parametrize(
    ("model", "channel", "signal"),
    [
        (driven_by(thermomechanical_oleo(2), "displacement"), "displacement", stroke(0.13, 0.03)),
        (thermomechanical_oleo(2), "force", harmonics([0, 1], [2500.0, 500.0])),
        (mechanical_oleo(2), "force", harmonics([0, 1], [2500.0, 500.0])),
    ],
)
def test_comparing_block_by_block_is_comparing_predictions(model, channel, signal):
    """First- and second-order dofs, with a last block that is not full."""
    others = tuple({"force", "displacement", "pressure"} - {channel})
    blank = [run("a", {channel: signal}, 0.5, others=others)]
    records = answered(model, blank, noise=0.01, steps=STEPS)
    predictor = Predictor(model, records, steps=STEPS, jobs=1)
    start = predictor.layout.start(model)
    predictor.set_anchor(start)
    theta = start * (1 + 0.003 * np.random.default_rng(1).standard_normal((5, start.size)))
    squares, status = predictor.sum_of_squares(theta)
    assert (status == Status.CONVERGED).all()
    for r, one in enumerate(predictor.runs):
        assert one._fused_outputs(by_phase=True) is not None
        found = one.predict(predictor.constants(theta, r))
        expected = np.sum((one.measured - found.y) ** 2, axis=2)
        np.testing.assert_allclose(squares[:, r], expected, rtol=1e-12)


def of_whole_arrays(one, p):
    """The prediction by way of the dofs' rows at all samples."""
    solution = one.solve(p)
    z = one._rows_at_samples(solution.x[..., None], p)[:, :, 0]
    return one._outputs(p, z, None, solution.status, derivatives=False)


@pytest.mark.parametrize(
    ("model", "channel", "signal"),
    [
        (driven_by(thermomechanical_oleo(2), "displacement"), "displacement", stroke(0.13, 0.03)),
        (mechanical_oleo(2), "force", harmonics([0, 1], [2500.0, 500.0])),
    ],
)
def test_outputs_block_by_block_are_those_of_whole_arrays(model, channel, signal):
    """To the last bit, with first- and second-order dofs, and where they are not admissible."""
    others = tuple({"force", "displacement", "pressure"} - {channel})
    records = answered(model, [run("a", {channel: signal}, 0.5, others=others)], steps=STEPS)
    predictor = Predictor(model, records, steps=STEPS, jobs=1)
    start = predictor.layout.start(model)
    predictor.set_anchor(start)
    theta = start * (1 + 0.003 * np.random.default_rng(1).standard_normal((5, start.size)))
    one = predictor.runs[0]
    p = predictor.constants(theta, 0)
    alike, found = of_whole_arrays(one, p), one.predict(p)
    assert found.y.tobytes() == alike.y.tobytes()
    assert (found.status == Status.CONVERGED).all()


def test_samples_that_break_a_condition_or_are_no_number_have_no_outputs(predictor, vectors):
    """Between the points of the mesh, where the solution itself does not show it."""
    one = predictor.runs[0]
    p = predictor.constants(vectors[:4], 0)
    x, status = one.solve(p).x, np.zeros(4, dtype=np.int64)
    x[1] *= -1.0  # of the temperature, which must be positive
    x[2] = np.inf
    status[3] = Status.NO_CONVERGENCE
    found = one._at_samples(p, x, None, status, derivatives=False)
    with np.errstate(invalid="ignore"):
        z = one._rows_at_samples(x[..., None], p)[:, :, 0]
        alike = one._outputs(p, z, None, status, derivatives=False)
    wanted = [Status.CONVERGED, Status.INADMISSIBLE, Status.NOT_FINITE, Status.NO_CONVERGENCE]
    assert [Status(value) for value in found.status] == wanted
    assert found.status.tolist() == alike.status.tolist()
    np.testing.assert_array_equal(found.y, alike.y)
    assert np.isnan(found.y[1:]).all()


def test_a_model_without_inputs_is_compared_too():
    """A mass hanging at rest, as far down as its weight and spring say."""
    hanging = Model(
        "hanging mass",
        dofs={"q": "m"},
        parameters={"weight": Parameter(3.0, "N", sd=1.0), "k": Parameter(2.0, "N/m", sd=1.0)},
        equations={"q": "ddot(q) + dot(q) + k*q - weight"},
        outputs={"displacement": Output("q", "m")},
    )
    blank = run("a", {}, 0.5, others=("displacement",))
    predictor = Predictor(hanging, [blank], steps=STEPS, jobs=1)
    predictor.set_anchor(np.array([3.0, 2.0]))
    squares, status = predictor.sum_of_squares(np.array([[3.0, 2.0], [3.3, 2.0]]))
    assert (status == Status.CONVERGED).all()
    samples = blank.samples["displacement"]
    expected = [np.sum((samples - rest) ** 2) for rest in (1.5, 1.65)]
    np.testing.assert_allclose(squares[:, 0, 0], expected, rtol=1e-12)
    # A solution that is no number has no outputs, where no condition says so first.
    one, still = predictor.runs[0], np.zeros(2, dtype=np.int64)
    p = predictor.constants(np.array([[3.0, 2.0], [3.3, 2.0]]), 0)
    x = one.solve(p).x
    x[1, 3] = np.inf
    found = one._at_samples(p, x, None, still, derivatives=False)
    assert [Status(value) for value in found.status] == [Status.CONVERGED, Status.NOT_FINITE]
    assert np.isnan(found.y[1]).all()


def test_a_predictor_sent_to_another_process_is_the_same(predictor, vectors, whole):
    sent = pickle.loads(pickle.dumps(predictor))
    squares, status = sent.sum_of_squares(vectors)
    assert squares.tobytes() == whole[0].tobytes()
    np.testing.assert_array_equal(status, whole[1])
    assert copy.copy(predictor).runs is predictor.runs


@pytest.mark.parametrize("backend", ["numpy", "numba"])
def test_a_broken_condition_is_told_where_another_one_is_no_number(backend):
    """By whole arrays, which have derivatives, as by blocks of samples."""
    model = Model(
        "spring",
        inputs={"x": "N"},
        dofs={"q": "m"},
        equations={"q": "ddot(q) + 0.4*dot(q) + 30*q - x"},
        outputs={"y": Output("q", "m")},
        parameters={"b": Parameter(1.0, sd=1.0)},
        admissible=("b - q", "sqrt(b - q) + 1"),
    )
    record = run("one", {"x": stroke(0.0, 2.0)}, 0.8, {}, others=("y",))
    one = Predictor(model, [record], steps=STEPS, backend=backend, jobs=1).runs[0]
    p = one.base_constants()[None]
    assert one.set_anchor(p[0]) is Status.CONVERGED
    x, x_p = one.anchor.x[None], np.moveaxis(one.anchor.x_p, 0, 2)[None]
    beyond = np.zeros_like(p)  # half of the motion
    for derivatives in (False, True):
        found = one._at_samples(beyond, x, x_p, np.zeros(1, dtype=np.int64), derivatives)
        assert list(found.status) == [Status.INADMISSIBLE.value]
        assert np.isnan(found.y).all()
