"""Multiple shooting: chaotic records, the covariance, single shooting's failure, bad input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from chaotic_records import Chaos
from scipy.optimize import least_squares

from bayesoleo.errors import InputError
from bayesoleo.estimation._multiple_shooting import multiple_shooting
from bayesoleo.model import Model, Parameter
from bayesoleo.prediction._records import transient_record
from bayesoleo.solvers._orbit import Status
from bayesoleo.systems import system

SEEDS = 50


def z_scores(found, chaos: Chaos) -> np.ndarray:
    return (found.point.theta - chaos.theta) / np.sqrt(np.diag(found.point.covariance_likelihood))


@pytest.mark.statistical
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "samples", "channels"),
    [("lorenz", 401, "xyz"), ("lorenz", 401, "x"), ("rossler", 401, "xyz"), ("rossler", 401, "y")],
)
def test_parameters_come_back_within_their_standard_errors(name, samples, channels):
    """Every one of 50 seeds, started up to 20 % off, from all states or from one component.

    150 draws of a normal distribution pass four standard errors in one set of seeds of a hundred.
    They pass three in a third of all sets, and on which side a chaotic orbit ends, the processor's
    rounding decides. What holds for any is the mean square, one within four of its own standard
    errors. The three parameters are correlated, so that counts as 50 draws.
    """
    chaos = Chaos.of(name, samples)
    scores = []
    for seed in range(SEEDS):
        found = multiple_shooting(
            system(name), [chaos.record(seed, channels)], start=chaos.start(seed)
        )
        assert found.status.ok, seed
        scores.append(z_scores(found, chaos))
        assert found.trajectories[0].gap < 1e-9
        assert found.shift <= 0.1
    assert np.abs(scores).max() < 4.0
    assert abs(np.mean(np.square(scores)) - 1.0) < 4 * np.sqrt(2 / SEEDS)


@pytest.mark.slow
def test_single_shooting_fails_on_the_same_records():
    """The same code with one interval: the motion forgets its start, and the fit its way."""
    chaos = Chaos.of("lorenz", 401)
    reached = {0.0: 0, np.inf: 0}
    for interval in reached:
        for seed in range(3):
            found = multiple_shooting(
                system("lorenz"),
                [chaos.record(seed)],
                start=chaos.start(seed),
                steps=400,
                interval=interval,
            )
            good = found.status.ok and np.abs(z_scores(found, chaos)).max() < 5.0
            reached[interval] += bool(good)
    assert reached == {0.0: 3, np.inf: 0}


def test_one_fit_of_each_system_and_its_noise():
    for name, channels in (("lorenz", "x"), ("rossler", "xyz")):
        chaos = Chaos.of(name, 201)
        found = multiple_shooting(
            system(name), [chaos.record(3, channels)], start=chaos.start(3), backend="numpy"
        )
        assert found.status is Status.CONVERGED
        assert np.abs(z_scores(found, chaos)).max() < 3.0
        rows = ["xyz".index(c) for c in channels]
        noise = 0.05 * chaos.clean[rows].std(axis=1)
        # 201 samples give a variance to 10 %.
        np.testing.assert_allclose(found.point.variance, noise**2, rtol=0.4)
        first = found.trajectories[0]
        away = (first.states[0] - chaos.clean[:, 0]) / first.initial_sd
        assert np.abs(away).max() < 4.0


DECAY = Model(
    "decay",
    dofs={"q": "m"},
    parameters={
        "damping": Parameter(0.5, sd=0.3),
        "stiffness": Parameter(90.0, sd=30.0),
        "offset": Parameter(0.0, sd=0.1, by_run=True),
    },
    equations={"q": "ddot(q) + damping*dot(q) + stiffness*q"},
    outputs={"displacement": "q + offset"},
)


def decay(time, theta):
    """Two runs: ``(damping, stiffness, offsets, amplitudes and phases)``."""
    rate, offsets, parts = np.sqrt(theta[1] - theta[0] ** 2 / 4), theta[2:4], theta[4:]
    return np.concatenate(
        [
            np.exp(-theta[0] / 2 * time)
            * (parts[2 * r] * np.cos(rate * time) + parts[2 * r + 1] * np.sin(rate * time))
            + offsets[r]
            for r in range(2)
        ]
    )


def test_estimate_and_covariance_are_those_of_the_closed_form():
    """A linear oscillator's free decay in two runs: parameters, by-run ones, errors, noise."""
    time, rng = np.linspace(0.0, 3.0, 121), np.random.default_rng(5)
    truth = np.array([0.4, 100.0, 0.02, -0.03, 1.0, 0.2, -0.4, 0.7])
    y = decay(time, truth) + 0.02 * rng.standard_normal(2 * time.size)
    records = [
        transient_record(label, 5.0 + time, {"displacement": part})
        for label, part in zip("ab", np.split(y, 2), strict=True)
    ]
    found = multiple_shooting(DECAY, records, backend="numpy", tolerance=1e-9)
    assert found.status.ok
    assert found.point.names == ("damping", "stiffness", "offset[a]", "offset[b]")
    reference = least_squares(lambda t: decay(time, t) - y, truth, xtol=1e-14, ftol=1e-14)
    variance = 2 * reference.cost / (y.size - truth.size)
    covariance = variance * np.linalg.inv(reference.jac.T @ reference.jac)[:4, :4]
    sd = np.sqrt(np.diag(covariance))
    # What the mesh leaves is below a tenth of a standard deviation by its own choice; here far.
    assert np.abs((found.point.theta - reference.x[:4]) / sd).max() < 1e-3
    np.testing.assert_allclose(found.point.variance, variance, rtol=1e-5)
    np.testing.assert_allclose(np.sqrt(np.diag(found.point.covariance_likelihood)), sd, rtol=1e-3)
    assert found.trajectories[1].time[0] == 5.0
    assert found.doubt == ""
    assert "too coarse" in str(replace(found, shift=0.3))
    assert "moved a parameter by 0.3 of its standard deviations" in str(replace(found, shift=0.3))
    assert "nothing is known" in replace(found, shift=np.nan).doubt


def test_the_prior_pulls_the_mode_and_not_the_robust_estimate():
    time, rng = np.linspace(0.0, 1.0, 41), np.random.default_rng(2)
    y = np.exp(-0.2 * time) * np.cos(10 * time) + 0.05 * rng.standard_normal(time.size)
    records = [transient_record("a", time, {"displacement": y})]
    # The weaker the data against the prior, the slower MBE goes; it should still end in 50 steps.
    strict = DECAY.with_parameters(damping=Parameter(0.0, sd=0.2))
    points = {
        method: multiple_shooting(
            model.fixing("offset"), records, method, backend="numpy", steps=80, tolerance=1e-9
        ).point
        for method, model in (("mbe", strict), ("be", strict), ("gauss-newton", DECAY))
    }
    assert all(point.status.ok for point in points.values())
    robust, mode, plain = (points[m]["damping"] for m in ("mbe", "be", "gauss-newton"))
    assert robust == pytest.approx(plain, rel=1e-5)
    likelihood = points["mbe"].covariance_likelihood
    # The mode of a Gaussian times the prior of mean zero, both damping and stiffness counted.
    information = np.linalg.inv(likelihood)
    prior = np.diag([1 / 0.2**2, 1 / 30.0**2])
    target = information @ points["mbe"].theta + prior @ np.array([0.0, 90.0])
    expected = np.linalg.solve(information + prior, target)[0]
    assert mode == pytest.approx(expected, rel=0.02)
    assert abs(mode) < 0.95 * abs(robust)


def test_failures_are_a_status():
    chaos = Chaos.of("lorenz", 101)
    record = chaos.record(0)
    tired = multiple_shooting(system("lorenz"), [record], max_iterations=2, backend="numpy")
    assert tired.status is Status.NO_CONVERGENCE
    assert "did not converge" in tired.status.message
    unseen = Model(
        "unseen",
        dofs={"q": "m", "hidden": "m"},
        parameters={"rate": Parameter(1.0, sd=1.0)},
        equations={"q": "dot(q) + rate*q", "hidden": "dot(hidden) + hidden"},
        outputs={"x": "q"},
    )
    lost = multiple_shooting(unseen, [chaos.record(0, "x")], backend="numpy")
    assert lost.status is Status.SINGULAR
    walled = Model(
        "walled",
        dofs={"q": "m"},
        parameters={"rate": Parameter(1.0, sd=1.0)},
        equations={"q": "dot(q) + rate*q"},
        outputs={"x": "q"},
        admissible=["1 - q"],
    )
    outside = multiple_shooting(walled, [chaos.record(0, "x")], backend="numpy")
    assert outside.status is Status.INADMISSIBLE


def test_bad_input_is_named():
    chaos = Chaos.of("lorenz", 41)
    model, record = system("lorenz"), chaos.record(0)
    with pytest.raises(InputError, match=r"no such estimator.*use mbe, be, gauss-newton"):
        multiple_shooting(model, [record], "mve", backend="numpy")
    with pytest.raises(InputError, match=r"one finite number per unknown.*sigma, rho, beta"):
        multiple_shooting(model, [record], start=[1.0], backend="numpy")
    other = transient_record("r", chaos.time, {"w": chaos.clean[0]})
    with pytest.raises(InputError, match=r"no output of model 'rossler' was measured.*x, y, z"):
        multiple_shooting(system("rossler"), [other], backend="numpy")
    with pytest.raises(InputError, match=r"needs a one-step scheme.*use radau3"):
        multiple_shooting(model, [record], scheme="thesis", backend="numpy")
    with pytest.raises(InputError, match="run r: a transient needs equidistant times"):
        transient_record("r", chaos.time**2, {"x": chaos.clean[0]})
    with pytest.raises(InputError, match="run r, column x: a channel needs one finite number"):
        transient_record("r", chaos.time, {"x": chaos.clean[0, 1:]})
