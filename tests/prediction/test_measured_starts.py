"""Noise of a channel that a transient's start is read from."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.model._drive_and_start import with_estimated_starts
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import transient_record
from bayesoleo.prediction._run_errors import input_columns

TIME, NOISE, RATE, START = np.arange(300) * 0.1, 0.05, 0.2, 2.0


def decay(initial: str | None) -> Model:
    """A level that falls in proportion to itself."""
    return Model(
        "decay",
        dofs={"level": Dof("m", initial=initial)},
        equations={"level": {"change": "dot(level)", "outflow": "rate*level"}},
        outputs={"height": Output("level", "m")},
        parameters={"rate": Parameter(RATE, "1/s", relative_sd=0.5)},
    )


def errors(initial: str | None, seed: int) -> tuple[np.ndarray, float]:
    """Columns of one record, and by how much its start is off."""
    noise = NOISE * np.random.default_rng(seed).standard_normal(TIME.size)
    values = START * np.exp(-RATE * TIME) + noise
    predictor = Predictor(decay(initial), [transient_record("a", TIME, {"height": values})])
    theta = predictor.layout.start(predictor.model)
    (status,) = predictor.set_anchor(theta)
    assert status.ok
    run, p = predictor.runs[0], predictor.constants(theta[None], 0)[0]
    start = float(run.initial(p[None]).state[0, 0])
    return input_columns(run, p), start - START


def test_the_error_of_a_start_decays_with_the_motion():
    columns, _ = errors("height", 0)
    assert columns.shape[1] == 1
    change = columns[0, 0]
    np.testing.assert_allclose(change / change[0], np.exp(-RATE * TIME), rtol=1e-4)


def test_its_size_is_the_scatter_of_the_start():
    found = [errors("height", seed) for seed in range(60)]
    off = [error / np.linalg.norm(columns[0, :, 0]) for columns, error in found if columns.size]
    assert len(off) > 50  # of the others the record is smooth by chance
    # The root mean square of fifty is known to ten per cent; what a curve hides of the noise is
    # bias instead, which is not known as well.
    assert np.sqrt(np.mean(np.square(off))) == pytest.approx(1.0, abs=0.4)


@pytest.mark.parametrize("initial", [None, "2.0", "1.5 + 0.25*2"])
def test_a_start_that_is_estimated_or_known_has_no_error_of_a_channel(initial):
    noise = NOISE * np.random.default_rng(1).standard_normal(TIME.size)
    record = transient_record("a", TIME, {"height": START * np.exp(-RATE * TIME) + noise})
    predictor = Predictor(with_estimated_starts(decay(initial)), [record])
    theta = predictor.layout.start(predictor.model)
    (status,) = predictor.set_anchor(theta)
    assert status.ok
    p = predictor.constants(theta[None], 0)[0]
    assert input_columns(predictor.runs[0], p).shape[1] == 0


def test_of_two_starts_only_the_one_that_is_not_estimated_has_the_error_of_the_channel():
    """Both are read from one channel; the second is called like an estimated start."""
    model = Model(
        "two levels",
        dofs={"first": Dof("m", initial="height + start_shift"), "second": Dof("m")},
        equations={
            "first": {"change": "dot(first)", "outflow": "rate*first"},
            "second": {"change": "dot(second)", "outflow": "rate*second"},
        },
        outputs={"height": Output("second", "m"), "other": Output("first", "m")},
        parameters={
            "rate": Parameter(RATE, "1/s", relative_sd=0.5),
            "start_shift": Parameter(0.0, "m", fixed=True),
        },
    )
    noise = NOISE * np.random.default_rng(1).standard_normal((2, TIME.size))
    height, other = START * np.exp(-RATE * TIME) + noise
    record = transient_record("a", TIME, {"height": height, "other": other})
    predictor = Predictor(with_estimated_starts(model), [record])
    theta = predictor.layout.start(predictor.model)
    (status,) = predictor.set_anchor(theta)
    assert status.ok
    columns = input_columns(predictor.runs[0], predictor.constants(theta[None], 0)[0])
    assert columns.shape[1] == 1
    sizes = dict(zip(predictor.outputs, np.abs(columns[:, 0]).max(axis=1), strict=True))
    assert sizes["height"] == 0.0
    assert sizes["other"] > 0.0
