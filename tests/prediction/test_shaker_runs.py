"""Force-driven runs over the whole of the thesis's plan are solved from both kinds of guess."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_runs import harmonics, run, stroke

from bayesoleo.model._drive_and_start import driven_by
from bayesoleo.model._kernels import kernels
from bayesoleo.prediction._periodic_run import RunPredictor
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import solve_from_guess
from bayesoleo.systems._oleo import thermomechanical_oleo

#: Label, static position and amplitude in mm, frequency in Hz (Verbeek 1993, table 5.1), with full
#: and lost amplitudes taken as 125 mm and those that overlap the stop reduced to stay above it.
TABLE = [
    ("a", 133, 125, 0.04),
    ("b", 133, 125, 0.1),
    ("c", 179, 75, 0.2),
    ("d", 219, 32, 0.5),
    ("e", 229, 20, 1.0),
    ("f", 249, 8, 2.0),
    ("g", 133, 78, 0.2),
    ("h", 133, 34, 0.5),
    ("i", 133, 21, 1.0),
    ("j", 133, 10, 2.0),
    ("k", 82, 80, 0.2),
    ("l", 39, 35, 0.5),
    ("m", 23, 22, 1.0),
    ("n", 14, 10, 2.0),
]


@pytest.fixture(scope="module")
def records():
    """The force that each prescribed motion needs, in 40 harmonics; friction of slope 3400 s/m."""
    prescribed = driven_by(thermomechanical_oleo(1), "displacement")
    phase = np.arange(1024) / 1024
    made = []
    for label, mean, amplitude, frequency in TABLE:
        motion = stroke(1e-3 * mean, 1e-3 * amplitude)
        record = run(label, {"displacement": motion}, frequency, others=("force",))
        fine = replace(
            record,
            time=phase / frequency,
            samples={"force": np.zeros(1024)} | {"displacement": phase},
        )
        predictor = Predictor(prescribed, [fine], backend="numpy", jobs=1)
        theta = predictor.layout.start(prescribed)
        assert predictor.set_anchor(theta) == [Status.CONVERGED]
        spectrum = np.fft.rfft(predictor.predict(theta)[0].y[0]) / 1024
        force = harmonics(np.arange(41), np.where(np.arange(41) > 0, 2, 1) * spectrum[:41])
        made.append(replace(record, harmonics={"displacement": motion, "force": force}))
    return made


@pytest.mark.parametrize("scheme", ["radau3", "thesis"])
@pytest.mark.parametrize(
    "steps",
    [256, pytest.param(400, marks=pytest.mark.slow), pytest.param(800, marks=pytest.mark.slow)],
)
def test_all_runs_converge_to_one_motion_from_both_guesses(records, scheme, steps):
    model = thermomechanical_oleo(1)
    compiled = kernels(model)
    failed, apart = [], []
    for record in records:
        predictor = RunPredictor(model, compiled, record, steps, scheme)
        p = predictor.base_constants()
        cold = RunPredictor(
            model,
            compiled,
            replace(record, harmonics={"force": record.harmonics["force"]}),
            steps,
            scheme,
        )
        answers = []
        for item in (predictor, cold):
            solution = solve_from_guess(item.boundary, p[None], item.guess(p))
            if solution.status[0] != Status.CONVERGED:
                failed.append((record.label, "measured" if item is predictor else "static"))
            answers.append(solution.x[0, :, 0])
        apart.append(np.abs(answers[0] - answers[1]).max())
    assert not failed
    # Newton leaves 1e-14 of a stroke of 0.1 m; the closure's condition lifts it.
    assert max(apart) < 1e-9
