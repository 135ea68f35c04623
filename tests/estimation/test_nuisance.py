"""Nuisance parameters: nothing at their null, and as much doubt as they should bring."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesoleo._workflow.estimating import estimate as estimate_campaign
from bayesoleo._workflow.model_files import from_document, to_document
from bayesoleo._workflow.settings import Settings
from bayesoleo.data import SimulatedRun, write_campaign
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._run_predictions import predict_held_out
from bayesoleo.errors import InputError
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._nuisance import Nuisance, declared_nuisance, uncertain_conditions
from bayesoleo.model import Model, Output, Parameter, driven_by
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Harmonics, Record
from bayesoleo.systems import system

AREA, STIFFNESS, NOISE = 2.0e-3, 900.0, 5.0
#: Label, mean displacement, declared pressure and its sd, true error in sds.
RUNS = (
    ("a", 0.05, 1.00e5, 4e3, 1.5),
    ("b", 0.10, 1.05e5, 8e3, -1.0),
    ("c", 0.02, 0.98e5, 2e3, 0.4),
    ("d", 0.08, 1.02e5, 6e3, -0.7),
)
QUICK = Numerics(jobs=1, backend="numpy", steps=16)


def spring() -> Model:
    """Linear in its one unknown; the pressure of a run pushes with a known area."""
    return Model(
        "spring",
        inputs={"displacement": "m"},
        conditions={"pressure": "Pa"},
        parameters={
            "stiffness": Parameter(800.0, "N/m", sd=400.0),
            "area": Parameter(AREA, "m**2", fixed=True),
        },
        outputs={"force": Output({"spring": "stiffness*displacement", "gas": "area*pressure"})},
    )


def records(seed: int = 3, offset: float = 0.0) -> list[Record]:
    rng = np.random.default_rng(seed)
    made = []
    for label, mean, pressure, sd, error in RUNS:
        motion = Harmonics(np.array([0, 1]), np.array([mean, 0.01 + 0j]), np.zeros(2))
        time = np.arange(150) / 50.0
        x = motion.evaluate(time, 1.0)
        force = STIFFNESS * x + AREA * (pressure + error * sd) + offset
        force += NOISE * rng.standard_normal(time.size)
        samples = {"displacement": x, "force": force}
        harmonics = {"displacement": motion, "force": motion}
        noise = {"displacement": 0.0, "force": NOISE}
        made.append(
            Record(
                label, "", "fit", "periodic", 1.0, 0.0, 3, time, samples, harmonics, noise,
                {"pressure": pressure}, {"pressure": sd},
            )
        )  # fmt: skip
    return made


def fitted(nuisance: Nuisance, runs: list[Record]):
    return fit_model(nuisance.extend(spring()), nuisance.complete(runs), QUICK, tolerance=1e-10)


def generalised_least_squares(runs, variance, by_run, shared):
    """Stiffness with the nuisances integrated out of the noise covariance; independent code."""
    x = np.concatenate([run.samples["displacement"] for run in runs])
    y = np.concatenate([run.samples["force"] - AREA * run.conditions["pressure"] for run in runs])
    sizes = [run.time.size for run in runs]
    V = variance * np.eye(x.size) + shared**2
    start = 0
    for size, sd in zip(sizes, by_run, strict=True):
        V[start : start + size, start : start + size] += sd**2
        start += size
    weighted = np.linalg.solve(V, np.column_stack([x, y]))
    precision = x @ weighted[:, 0] + 400.0**-2
    return (x @ weighted[:, 1] + 800.0 * 400.0**-2) / precision, precision**-0.5


@pytest.mark.parametrize("kinds", [("conditions",), ("offset",), ("conditions", "offset")])
def test_linear_gaussian_posterior_is_that_of_a_wider_noise(kinds):
    runs = records()
    nuisance = declared_nuisance(kinds, spring(), runs, {"force": 30.0})
    fit = fitted(nuisance, runs)
    by_run = [AREA * sd if "conditions" in kinds else 0.0 for _, _, _, sd, _ in RUNS]
    shared = 15.0 if "offset" in kinds else 0.0
    mean, sd = generalised_least_squares(runs, fit.point.variance[0], by_run, shared)
    # both solve the same linear equations
    assert fit.point["stiffness"] == pytest.approx(mean, rel=1e-9)
    assert fit.point.sd[fit.point.names.index("stiffness")] == pytest.approx(sd, rel=1e-9)
    alone = fitted(Nuisance(), runs)
    assert sd > 1.5 * alone.point.sd[0]


def test_a_wrong_condition_is_recovered_and_no_longer_biases():
    runs = records()
    fit = fitted(Nuisance(("pressure",)), runs)
    sd = dict(zip(fit.point.names, fit.point.sd, strict=True))
    for label, _, _, _, error in RUNS:
        name = f"pressure_error[{label}]"
        # errors are told from each other to a tenth of their prior, and stay within 4 of their own
        # standard deviations
        assert abs(fit.point[name] - error) < 4 * sd[name]
        assert sd[name] < 0.5
    assert abs(fit.point["stiffness"] - STIFFNESS) < 3 * sd["stiffness"]
    alone = fitted(Nuisance(), runs).point
    assert abs(alone["stiffness"] - STIFFNESS) > 6 * alone.sd[0]


def test_mbe_keeps_nuisances_at_their_null():
    """Its fixed point is the maximum of the likelihood, where nothing holds them."""
    runs = records()
    nuisance = declared_nuisance(["conditions", "offset"], spring(), runs, {"force": 30.0})
    fit = fitted(nuisance, runs)
    alone = fitted(Nuisance(), runs)
    assert fit.mbe["stiffness"] == pytest.approx(alone.mbe["stiffness"], rel=1e-12)
    assert {fit.mbe[name] for name in fit.mbe.names if name != "stiffness"} == {0.0}
    assert fit.mbe.names == fit.point.names
    assert fit.mbe.history.shape == (fit.mbe.iterations + 1, len(fit.point.names))


def test_held_out_run_takes_what_is_known_of_its_condition():
    """A prediction of the run with its declared pressure alone would be off by 24 N."""
    runs = records()
    nuisance = Nuisance(("pressure",))
    fit = fitted(nuisance, runs[1:])
    (held,) = predict_held_out(fit, nuisance.complete(runs[:1]))
    residual = runs[0].samples["force"] - held.y[0]
    prior, data = 1.0, runs[0].time.size * (AREA * 4e3) ** 2 / np.mean(residual**2)
    away = residual.mean() / (AREA * 4e3) + held.theta["pressure_error[a]"]
    # normal posterior mean of one error, given the shared stiffness
    assert held.theta["pressure_error[a]"] == pytest.approx(away * data / (data + prior), rel=1e-6)


@pytest.fixture(scope="module")
def oleo():
    """The thermo-mechanical oleo driven by displacement, with every nuisance."""
    model = driven_by(system("f16n2d2"), "displacement")
    motion = Harmonics(np.array([0, 1]), np.array([0.133, 0.034 + 0j]), np.zeros(2))
    time = np.arange(60) / 30.0
    x = motion.evaluate(time, 1.0)
    samples = {"displacement": x, "force": 9e3 + 0 * x, "pressure": 1e6 + 0 * x}
    known = {"initial_pressure": 4.9e5, "ambient_temperature": 293.0}
    sds = {"initial_pressure": 5e3, "ambient_temperature": 2.0}
    noise = {"displacement": 0.0, "force": 0.0, "pressure": 0.0}
    record = Record(
        "h", "", "fit", "periodic", 0.5, 0.0, 2, time, samples, {"displacement": motion}, noise,
        known, sds,
    )  # fmt: skip
    accuracy = {"displacement": 0.26e-3, "force": 90.0, "pressure": 2e4}
    nuisance = declared_nuisance(["conditions", "offset", "gain"], model, [record], accuracy)
    return model, record, nuisance


def answer(model: Model, record: Record, **values: float) -> np.ndarray:
    predictor = Predictor(model, [record], steps=64, backend="numpy", jobs=1)
    theta = predictor.layout.start(model)
    for name, value in values.items():
        theta[list(predictor.layout.parameters).index(name)] = value
    assert predictor.set_anchor(theta)[0].ok
    return predictor.predict(theta)[0].y


def test_null_is_the_old_model(oleo):
    model, record, nuisance = oleo
    extended = nuisance.extend(model)
    (complete,) = nuisance.complete([record])
    assert len(extended.estimated()) == len(model.estimated()) + 8
    np.testing.assert_allclose(
        answer(extended, complete), answer(model, record), rtol=1e-13, atol=1e-9
    )


def test_errors_mean_what_they_say(oleo):
    model, record, nuisance = oleo
    extended, (complete,) = nuisance.extend(model), nuisance.complete([record])
    old = answer(model, record)
    shifted = replace(record, conditions={**record.conditions, "initial_pressure": 4.95e5})
    np.testing.assert_allclose(
        answer(extended, complete, initial_pressure_error=1.0), answer(model, shifted), rtol=1e-12
    )
    # the pressure channel shows (1 + g) y + b
    shown = answer(extended, complete, sensor_gain_pressure=0.01, sensor_offset_pressure=500.0)
    np.testing.assert_allclose(shown[1], 1.01 * old[1] + 500.0, rtol=1e-12)
    np.testing.assert_allclose(shown[0], old[0], rtol=1e-12)
    # the displacement that was shown, 0.1 mm too much, is an input
    item = record.harmonics["displacement"]
    true = replace(item, coefficients=item.coefficients - np.array([1e-4, 0.0]))
    moved = answer(model, replace(record, harmonics={"displacement": true}))
    shown = answer(extended, complete, sensor_offset_displacement=1e-4)
    np.testing.assert_allclose(shown, moved, rtol=1e-12)


def test_offset_and_gain_share_the_accuracy(oleo):
    _, record, nuisance = oleo
    for channel, accuracy in {"displacement": 0.26e-3, "force": 90.0, "pressure": 2e4}.items():
        largest = np.abs(record.samples[channel]).max()
        at_largest = np.hypot(nuisance.offset[channel], nuisance.gain[channel] * largest)
        assert 2 * at_largest == pytest.approx(accuracy)


def test_model_with_nuisances_is_read_back(oleo):
    model, record, nuisance = oleo
    extended = nuisance.extend(model)
    again = from_document(to_document(extended))
    assert uncertain_conditions(again).conditions == nuisance.conditions
    problem = CampaignProblem(Predictor(again, nuisance.complete([record]), steps=8))
    assert problem.nuisances == {
        "orifice_damping",  # known to a tolerance
        "initial_pressure_error[h]", "ambient_temperature_error[h]",
        *(f"sensor_{k}_{c}" for k in ("offset", "gain") for c in nuisance.offset),
    }  # fmt: skip


def test_what_is_not_declared_is_asked_for():
    runs = records()
    with pytest.raises(InputError, match=r"unknown nuisance.*'ofset'.*did you mean offset"):
        declared_nuisance(["ofset"], spring(), runs, {})
    with pytest.raises(InputError, match=r"accuracy = … under \[channels.displacement\]"):
        declared_nuisance(["gain"], spring(), runs, {"force": None})
    silent = [replace(run, condition_sd={}) for run in runs]
    with pytest.raises(InputError, match=r"pressure = \{ value = …, unit = \"Pa\", sd = … \}"):
        declared_nuisance(["conditions"], spring(), silent, {})
    with pytest.raises(InputError, match=r"run d, key pressure: other runs declare"):
        declared_nuisance(["conditions"], spring(), [*runs[:3], silent[3]], {})


def test_one_word_in_the_settings(tmp_path):
    declared = {label: {"pressure": (pressure, "Pa", sd)} for label, _, pressure, sd, _ in RUNS}
    runs = [
        SimulatedRun(run.label, run.time, run.samples, 1.0, conditions=declared[run.label])
        for run in records()
    ]
    channels = {"displacement": ("x", "m"), "force": ("f", "N")}
    write_campaign(tmp_path / "springs", name="springs", channels=channels, runs=runs)
    options = {"jobs": 1, "steps": 16, "error_model": "independent"}
    free = Settings(nuisance=("conditions",), **options)
    points = [
        estimate_campaign(tmp_path / "springs", spring(), settings)["point"].to_dataset()
        for settings in (free, Settings(**options))
    ]
    assert points[0].sizes["parameter"] == 1 + len(RUNS)
    wide, narrow = (float(point["sd"].sel(parameter="stiffness")) for point in points)
    assert wide > 2 * narrow
