"""The error of a prediction against its noise: one where nothing is missing."""

from __future__ import annotations

import numpy as np
import pytest
from fitted_states import NUMERICS
from small_campaigns import (
    CUBIC,
    DAMPER_RUNS,
    DAMPING,
    STIFFNESS,
    damper,
    damper_campaign,
    spring_damper_force,
)

from bayesoleo.discovery._fit_and_hold_out_error import error_table
from bayesoleo.discovery._run_predictions import Prediction
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.solvers._orbit import Status

TRUTH = {"damping": DAMPING, "stiffness": STIFFNESS, "cubic": CUBIC}
#: More runs than usual, so that the pooled ratio is known well.
RUNS = tuple(
    (f"{label}{k}", frequency, amplitude, role)
    for k in range(3)
    for label, frequency, amplitude, role in DAMPER_RUNS
)


def predicted(reduced, truth=TRUTH) -> list[Prediction]:
    """Every run at known parameters."""
    found = []
    for record in reduced.records:
        predictor = Predictor(damper(), [record], backend="numpy", jobs=1)
        theta = np.array(list(truth.values()))
        y = predictor.predict(theta)[0].y
        found.append(Prediction(record, y, truth, 0, Status.CONVERGED, predictor))
    return found


def table(reduced, truth=TRUTH):
    roles = {record.label: record.role for record in reduced.records}
    return error_table(predicted(reduced, truth), roles, jobs=NUMERICS.jobs)


def scatter(errors) -> float:
    """Standard deviation of the mean squared ratio: F of M and N - M degrees of freedom by run."""
    variances = [
        2 / e.average.number + 2 / (e.average.samples - e.average.number) for e in errors.entries
    ]
    return float(np.sqrt(sum(variances)) / len(variances))


def mean_square(errors) -> float:
    return float(np.mean([entry.ratio**2 for entry in errors.entries]))


@pytest.mark.slow
@pytest.mark.parametrize("per_period", [100.0, 100.37, 41.7])
def test_pure_noise_has_ratio_one(tmp_path, per_period):
    reduced = damper_campaign(tmp_path, spring_damper_force, runs=RUNS, per_period=per_period)
    errors = table(reduced)
    assert mean_square(errors) == pytest.approx(1.0, abs=4 * scatter(errors))
    for entry in errors.entries:
        assert entry.rms == pytest.approx(0.5, rel=0.15)
        assert entry.average.sigma == pytest.approx(0.5, rel=0.15)


def test_the_noise_of_the_input_is_counted(tmp_path):
    reduced = damper_campaign(tmp_path, spring_damper_force, runs=RUNS, noise=0.1, input_noise=3e-4)
    errors = table(reduced)
    # Few harmonics carry it, so that their own scatter has few degrees of freedom.
    degrees = 4 * len(errors.entries)
    assert mean_square(errors) == pytest.approx(1.0, abs=4 * np.sqrt(2 / degrees))
    for entry in errors.entries:
        assert entry.input_noise > 0
        assert entry.noise == pytest.approx(np.hypot(entry.spectrum.noise, entry.input_noise))
    without = np.mean([(e.repeating / e.average.noise) ** 2 for e in errors.entries])
    assert without > 1.5


def test_what_is_missing_shows(tmp_path):
    reduced = damper_campaign(tmp_path, spring_damper_force)
    errors = table(reduced, TRUTH | {"cubic": 0.0})
    assert errors.worst_ratio() > 5
    entry = errors.at("force", "c")
    x = reduced.record("c").harmonics["displacement"]
    phase = np.arange(2000) / 2000
    rms = np.sqrt(np.mean((CUBIC * x.evaluate(phase, 0.5) ** 3) ** 2))
    assert entry.repeating == pytest.approx(rms, rel=0.05)
    assert entry.rms == pytest.approx(np.hypot(rms, 0.5), rel=0.05)


def test_pooling_is_the_root_mean_square_over_runs(tmp_path):
    errors = table(damper_campaign(tmp_path))
    assert errors.outputs == ("force",)
    for role in ("fit", "hold-out"):
        chosen = [e for e in errors.entries if e.role == role]
        pooled = errors.pooled(role, "force")
        assert pooled == errors.by_role()[role]["force"]
        for key, values in {
            "rms": [e.rms for e in chosen],
            "repeating": [e.repeating for e in chosen],
            "ratio_to_noise": [e.ratio for e in chosen],
        }.items():
            assert pooled[key] == pytest.approx(np.sqrt(np.mean(np.square(values))))
    ratios = [errors.pooled(role, "force")["ratio_to_noise"] for role in ("fit", "hold-out")]
    assert errors.worst_ratio() == max(ratios)
    assert errors.worst_ratio("hold-out") == ratios[1]
    by_run = errors.by_run()["force"]
    assert {label: row["role"] for label, row in by_run.items()} == {
        label: role for label, _, _, role in DAMPER_RUNS
    }
    for row in by_run.values():
        assert row["ratio_to_noise"] == pytest.approx(row["repeating"] / row["noise"])
