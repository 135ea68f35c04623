"""What the data cannot show is not scored: its computed size is round-off."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import fitted, options
from small_campaigns import MASS, oscillator_campaign

from bayesoleo.discovery._score_basis import Base, Block, RunBase, coefficients, squared_distance
from bayesoleo.discovery._score_tests import SPANNED, UNRESOLVED, _evaluate, score_all
from bayesoleo.model import Model, Output, Parameter

SAMPLES = 400


def base_with(J, rng):
    run = RunBase.of(
        np.ones(SAMPLES),
        rng.standard_normal(SAMPLES),
        J,
        np.zeros((0, SAMPLES)),
        np.zeros(SAMPLES, dtype=np.int64),
    )
    gram, _, gradient = run.products(J)
    return Base(None, [run], gram, gradient, 1.0, 100.0, 1.0)


def score_of(base, direction):
    option = SimpleNamespace(candidate=SimpleNamespace(sign={}))
    return _evaluate(base, option, {}, Block(("a",), [direction[None, None]]))


# Products of directions hold half the digits of a number, some eight.
@pytest.mark.parametrize("digits", range(8))
def test_what_the_model_spans_scores_nothing_however_alike_its_parameters(digits):
    rng = np.random.default_rng(digits)
    for _ in range(20):
        J = rng.standard_normal((4, SAMPLES))
        J[1] = J[0] + 10.0**-digits * J[1]
        J[2] *= 10.0**digits
        base = base_with(J, rng)
        assert score_of(base, rng.standard_normal(4) @ J) is None
        # The direction in which the parameters differ is the hardest.
        assert score_of(base, J[1] - J[0]) is None


@pytest.mark.parametrize("digits", [0, 3, 6])
def test_what_is_new_scores_as_least_squares_says(digits):
    rng = np.random.default_rng(10 + digits)
    J = rng.standard_normal((3, SAMPLES))
    J[1] = J[0] + 10.0**-digits * J[1]
    base, new = base_with(J, rng), rng.standard_normal(SAMPLES)
    e = base.runs[0].residual
    q, _ = np.linalg.qr(np.stack([J[0], (J[1] - J[0]) * 10.0**digits, J[2]]).T)
    rest = new - q @ (q.T @ new)
    found = score_of(base, new)
    assert found.fall == pytest.approx((rest @ e) ** 2 / (rest @ rest), rel=1e-3)


def test_coefficients_do_not_depend_on_units():
    rng = np.random.default_rng(3)
    J, C = rng.standard_normal((3, 50)), rng.standard_normal((2, 50))
    units = np.array([1e-9, 1.0, 1e9])
    plain = coefficients(J @ J.T, J @ C.T)
    scaled = coefficients(np.outer(units, units) * (J @ J.T), units[:, None] * (J @ C.T))
    assert scaled * units[:, None] == pytest.approx(plain, rel=1e-9)
    assert plain == pytest.approx(np.linalg.lstsq(J.T, C.T, rcond=None)[0], rel=1e-9)


def oscillator(output):
    """A linear spring, whose place of rest no derivative of its motion shows."""
    return Model(
        "oscillator",
        inputs={"force": "N"},
        dofs={"position": "m"},
        parameters={
            "mass": Parameter(MASS, "kg", fixed=True),
            "damping": Parameter(0.8, "N*s/m", relative_sd=0.5),
            "stiffness": Parameter(100.0, "N/m", relative_sd=0.3),
        },
        equations={
            "position": {
                "inertia": "mass*ddot(position)",
                "damper": "damping*dot(position)",
                "spring": "stiffness*position",
                "drive": "-force",
            }
        },
        outputs={"displacement": Output(output, "m")},
    )


@pytest.fixture(scope="module")
def linear_oscillator(tmp_path_factory):
    """Measured as a displacement from its mean, which its acceleration over ``100/s^2`` stands in
    for as well as any output."""
    return oscillator_campaign(
        tmp_path_factory.mktemp("linear"), restoring=lambda x, v: 100.0 * x + 0.8 * v
    )


def test_an_offset_that_no_output_contains_scores_nothing(linear_oscillator):
    state = fitted(linear_oscillator, oscillator("-ddot(position)/100"))
    hidden = ("constant_force", "force_offset_by_run")
    scores, failed = score_all(state.base(), options(state, [*hidden, "cubic_stiffness"]), 1)
    assert [score.option.candidate.effect for score in scores] == ["cubic_stiffness"]
    assert failed == {f"{name} at position": UNRESOLVED for name in hidden}


def test_the_same_offset_scores_where_an_output_contains_it(linear_oscillator):
    state = fitted(linear_oscillator, oscillator("position"))
    names = ("constant_force", "linear_stiffness")
    scores, failed = score_all(state.base(), options(state, names), 1)
    (score,) = scores
    assert score.option.candidate.effect == "constant_force"
    # A newton moves the spring by 1/k, which is a mean over all samples.
    noise = state.fit_errors.entries[0].average.sigma
    assert abs(score.expected[0]) < 100.0 * 6 * noise
    assert set(failed.values()) <= {SPANNED}


@pytest.mark.parametrize("decades", [0, 5, 10])
def test_units_do_not_matter_to_a_distance(decades):
    """A stiffness of the gas beside one of a stop: parameters ten decades apart."""
    rng = np.random.default_rng(0)
    J = rng.standard_normal((3, 50))
    J[0] += 2 * J[1] + J[2]
    unit = np.array([1.0, 10.0**decades, 10.0**-decades])
    covariance = np.linalg.inv(J @ J.T) / np.outer(unit, unit)
    value = np.array([0.3, -0.2, 0.1])
    assert squared_distance(value / unit, covariance) == pytest.approx(
        float(np.sum((value @ J) ** 2)), rel=1e-9
    )
