"""A system driven by either channel, with or without something in series, is the same system."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from synthetic_runs import CONDITIONS, harmonics, oleo_runs, run, stroke

from bayesoleo.effects import Scales, find_effect
from bayesoleo.model import Model, Output, Parameter
from bayesoleo.model._drive_and_start import driven_by
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.solvers._orbit import Status
from bayesoleo.systems._oleo import mechanical_oleo, thermomechanical_oleo


def predicted(model, records, steps=64, **options):
    predictor = Predictor(model, records, steps=steps, backend="numpy", **options)
    theta = predictor.layout.start(model)
    assert set(predictor.set_anchor(theta)) == {Status.CONVERGED}
    return predictor, predictor.predict(theta)


def test_displacement_to_force_and_back():
    """The force that a prescribed motion needs, as harmonics, brings about that motion."""
    base = thermomechanical_oleo(2)
    # A gentle friction slope: its arctangent must fit into the harmonics that carry the force.
    base = base.with_values({"friction_slope": 40.0, "friction_base": 500.0})
    records = oleo_runs()[3:4]
    record = records[0]
    n = 512
    phase = np.arange(n) / n
    fine = replace(
        record,
        time=phase / record.frequency,
        samples={name: np.zeros(n) for name in record.samples},
    )
    prescribed = driven_by(base, "displacement")
    _, answer = predicted(prescribed, [fine], 256)
    force = answer[0].y[list(prescribed.outputs).index("force")]
    spectrum = np.fft.rfft(force) / n
    orders = np.arange(200)
    channel = harmonics(orders, np.where(orders > 0, 2, 1) * spectrum[:200])
    back = replace(
        record,
        harmonics={"force": channel},
        samples={**record.samples, "force": channel.evaluate(record.phase, record.frequency)},
    )
    _, motion = predicted(base, [back], 512)
    displacement = motion[0].y[list(base.outputs).index("displacement")]
    exact = record.harmonics["displacement"].evaluate(record.phase, record.frequency)
    # Amplitude 21 mm; what is lost is the force's harmonics above 200 and the mesh's error.
    np.testing.assert_allclose(displacement, exact, atol=2e-9)
    pressure = list(prescribed.outputs).index("pressure")
    at_samples = np.interp(
        record.phase % 1,
        np.append(phase, 1.0),
        np.append(answer[0].y[pressure], answer[0].y[pressure][0]),
    )
    # Linear interpolation between 512 points of a wave of some 1e5 Pa: (2 pi/512)**2/8 of it.
    assert np.abs(motion[0].y[list(base.outputs).index("pressure")] - at_samples).max() < 20.0


def compliant(value: float) -> Model:
    base = mechanical_oleo(2).with_parameters(compliance=Parameter(value, "m/N", sd=1e-8))
    displacement = replace(base.outputs["displacement"], terms="stroke + compliance*force")
    return replace(base, outputs={**base.outputs, "displacement": displacement})


def test_without_compliance_the_added_equation_changes_nothing():
    records = oleo_runs()
    plain, expected = predicted(driven_by(mechanical_oleo(2), "displacement"), records, 256)
    model = driven_by(compliant(0.0), "displacement")
    assert model.dofs, "the dof stays"
    predictor, found = predicted(model, records, 256)
    assert predictor.outputs == plain.outputs == ("force", "pressure")
    for one, other in zip(expected, found, strict=True):
        # The stroke equals the displacement where its equation holds. Between those points it errs
        # by (2 pi/256)**4/24 of the gas's change; its velocity, through steep friction, by a
        # thousand times that.
        scale = np.abs(one.y).max(axis=1)
        assert (np.abs(other.y - one.y).max(axis=1) < [3e-6, 5e-9] * scale).all()
        theta = predictor.layout.start(model)[: one.sensitivity.shape[1], None]
        change = theta * (other.sensitivity[:, : len(theta)] - one.sensitivity)
        assert (np.abs(change).max(axis=(1, 2)) < [1e-6, 1e-7] * scale).all()
        compliance = other.sensitivity[:, predictor.layout.names.index("compliance")]
        assert np.isfinite(compliance).all(), "the null is not singular"


def test_compliance_against_integration():
    """Compliance turns the algebraic drive into a differential equation of its own: solve that."""
    value = 1.5e-7
    record = oleo_runs()[2]
    model = driven_by(compliant(value), "displacement")
    _, found = predicted(model, [record], 512)
    force = found[0].y[list(model.outputs).index("force")]
    p = {name: item.value for name, item in compliant(value).parameters.items()}
    drive, f = record.harmonics["displacement"], record.frequency

    def balance(q, v):
        ratio = 1 - p["piston_area"] * q / p["initial_volume"]
        gas = CONDITIONS["initial_pressure"] * ratio ** -p["gas_exponent"]
        friction = (p["friction_base"] + p["friction_per_pressure"] * gas) * np.arctan(
            p["friction_slope"] * v
        )
        return (
            p["mass"] * p["gravity"]
            + p["orifice_damping"] * v * abs(v)
            + p["piston_area"] * (gas - p["ambient_pressure"])
            + friction
        )

    def rates(t, y):
        q, v = y
        pull = (drive.evaluate(np.array([f * t]), f)[0] - q) / value
        return [v, (pull - balance(q, v)) / p["mass"]]

    # 25 kg on 6.7 MN/m rings at 82 Hz; friction damps it within a fraction of a period of 2 s.
    start = [drive.evaluate(np.array([0.0]), f)[0] - value * balance(0.133, 0.0), 0.0]
    end = 2 / f
    late = (record.time > 1 / f) & (record.time < end)
    solution = solve_ivp(
        rates, (0, end), start, method="LSODA", t_eval=record.time[late], rtol=1e-10, atol=1e-13
    )
    exact = (drive.evaluate(f * solution.t, f) - solution.y[0]) / value
    scale = np.ptp(exact)
    # The ringing after each reversal of friction is coarse in 512 steps of 4 ms: its period is 12
    # ms.
    error = np.sqrt(np.mean((force[late] - exact) ** 2)) / scale
    assert error < 2e-3


@pytest.mark.parametrize("lag", [0.0, 1e-4, 0.01])
def test_a_force_that_was_measured_late_answers_a_motion(lag):
    """By the series of what acts, ``F + tau F' + tau^2 F'' / 2``, solved for the force measured."""
    base = Model(
        "spring",
        inputs={"force": "N"},
        dofs={"y": "m"},
        parameters={"stiffness": Parameter(50.0, "N/m", sd=5.0)},
        equations={"y": "2*ddot(y) + stiffness*y - force"},
        outputs={"position": Output("y", "m")},
    )
    late = find_effect("sensor_lag").extend(base, "force", Scales({}, {}, {}, 1.0, 1.0)).model
    model = driven_by(late.with_values({"sensor_lag_force": lag}), "position")
    moved = harmonics([1, 3], [1.0, 0.2j])
    record = run("driven", {"position": moved}, 2.0, conditions={}, others=("force",))
    _, found = predicted(model, [record], 256)
    omega = 2j * np.pi * 2.0 * moved.orders
    acts = (2.0 * omega**2 + 50.0) * moved.coefficients
    shown = harmonics(moved.orders, acts / (1 + lag * omega + (lag * omega) ** 2 / 2))
    exact = shown.evaluate(record.phase, record.frequency)
    # Of third order, with 85 steps for the third harmonic.
    np.testing.assert_allclose(found[0].y[0], exact, atol=2e-5 * np.abs(exact).max())


def test_every_derivative_of_an_input_reaches_the_equation():
    """A force law with inertia of the prescribed motion needs the second derivative, exactly."""
    model = Model(
        "derivatives",
        inputs={"x": "m"},
        outputs={
            "y": Output("a*x + b*dot(x) + c*ddot(x) + d*dddot(x)", "N"),
        },
        parameters={name: Parameter(1.0, sd=1.0) for name in "abcd"},
    )
    frequency = 0.7
    channel = stroke(0.1, 0.05)
    record = run("r", {"x": channel}, frequency, conditions={}, others=("y",))
    predictor, answer = predicted(model, [record])
    assert predictor.runs[0].kernels.derived.inputs == (("x", 0), ("x", 1), ("x", 2), ("x", 3))
    rate = 2j * np.pi * frequency * channel.orders
    phases = np.exp(2j * np.pi * np.outer(record.phase, channel.orders))
    for k in range(4):
        exact = (phases @ (channel.coefficients * rate**k)).real
        np.testing.assert_allclose(
            answer[0].sensitivity[0, k], exact, atol=1e-12 * np.abs(exact).max()
        )
    np.testing.assert_allclose(answer[0].y[0], answer[0].sensitivity[0].sum(axis=0), rtol=1e-12)


def test_time_in_an_output_is_seconds_since_the_first_sample():
    model = Model(
        "drift",
        inputs={"x": "m"},
        outputs={"y": Output("gain*x + drift*time", "V")},
        parameters={"gain": Parameter(2.0, sd=1.0), "drift": Parameter(0.3, sd=1.0)},
    )
    record = run("r", {"x": stroke(0.0, 1.0)}, 0.5, conditions={}, others=("y",))
    _, answer = predicted(model, [record])
    x = record.samples["x"]
    np.testing.assert_allclose(answer[0].y[0], 2.0 * x + 0.3 * record.time, atol=1e-13)


@pytest.mark.parametrize("frequency", [0.1, 2.0])
def test_sensitivities_at_samples_are_differences_of_predictions(frequency):
    model = driven_by(thermomechanical_oleo(2), "displacement")
    record = run("r", {"displacement": stroke(0.13, 0.03)}, frequency, others=("force", "pressure"))
    predictor, answer = predicted(model, [record])
    theta = predictor.layout.start(model)
    for k, value in enumerate(theta):
        step = 1e-5 * abs(value)
        ends = []
        for sign in (1, -1):
            moved = theta.copy()
            moved[k] += sign * step
            ends.append(predictor.simulate(moved[None], 0).y[0])
        difference = (ends[0] - ends[1]) / (2 * step)
        # Outputs of 1e6 Pa and 1e3 N are good to 1e-15: differences over 1e-5 to 1e-9 of the
        # output.
        limit = 1e-9 * np.abs(answer[0].y).max(axis=1) / abs(value) + 1e-7 * np.abs(difference).max(
            axis=1
        )
        assert (np.abs(answer[0].sensitivity[:, k] - difference).max(axis=1) < limit).all()
