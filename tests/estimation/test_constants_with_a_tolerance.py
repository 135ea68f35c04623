"""Constants known to a tolerance: unknowns whose prior is a measurement, in every estimator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_campaigns import damper, damper_campaign

from bayesoleo.errors import InputError, ModelError
from bayesoleo.estimation import (
    FunctionProblem,
    between_runs,
    data_against_prior,
    estimate,
    estimate_each,
    estimate_many,
    linearised_intervals,
    profile,
    sampling_distribution,
)
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.model import Normal, Parameter, Uniform
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.systems import system

GAIN, OFFSET, TOLERANCE, NOISE = 2.0, 0.5, 0.2, 0.05
X = np.linspace(0.5, 1.5, 40)


def line(seed: int = 1, offset: float = OFFSET, **options) -> FunctionProblem:
    """A line whose offset is known to a tolerance; linear, so that closed forms hold."""
    noise = NOISE * np.random.default_rng(seed).standard_normal(X.size)
    return FunctionProblem(
        lambda x, t: t[0] * x + t[1],
        X,
        GAIN * X + offset + noise,
        [Normal(1.0, 1e4), Normal(0.3, TOLERANCE)],
        names=["gain", "offset"],
        nuisances=["offset"],
        **options,
    )


@pytest.mark.parametrize("method", ["mbe", "levenberg-marquardt", "gauss-newton"])
def test_a_method_that_forgets_priors_holds_them_and_carries_their_uncertainty(method):
    point = estimate(line(), method, tolerance=1e-12)
    held = X @ (line().data[0] - 0.3) / (X @ X)
    assert point["gain"] == pytest.approx(held, rel=1e-9)
    assert point["offset"] == 0.3
    assert point.known == ("offset",)
    assert any("known to a tolerance" in note and "offset" in note for note in point.notes)
    # An offset wrong by d moves the gain by -sum(x)/sum(x^2) d.
    shift = -X.sum() / (X @ X)
    conditional = point.variance[0] / (X @ X)
    expected = np.array([[conditional + (shift * TOLERANCE) ** 2, shift * TOLERANCE**2],
                         [shift * TOLERANCE**2, TOLERANCE**2]])  # fmt: skip
    np.testing.assert_allclose(point.covariance, expected, rtol=1e-5)
    assert point.covariance_likelihood[0, 0] == pytest.approx(conditional, rel=1e-6)
    assert point.undetermined == ()


def test_the_bayesian_estimator_weighs_tolerance_and_data():
    problem = line()
    point = estimate(problem, "be", tolerance=1e-12)
    A = np.column_stack([X, np.ones_like(X)]) / np.sqrt(point.variance[0])
    y = problem.data[0] / np.sqrt(point.variance[0])
    rows = np.vstack([A, [0.0, 1 / TOLERANCE]])
    mean = np.linalg.lstsq(rows, np.append(y, 0.3 / TOLERANCE), rcond=None)[0]
    np.testing.assert_allclose(point.theta, mean, rtol=1e-6)
    np.testing.assert_allclose(point.covariance, np.linalg.inv(rows.T @ rows), rtol=1e-6)
    assert point.known == ()


def test_intervals_take_the_tolerance_for_a_measurement():
    """Over experiments in which the offset is measured anew, the estimate scatters as the posterior
    is wide."""
    point = estimate(line(), "be", tolerance=1e-12)
    both = [linearised_intervals(line(), point, form) for form in ("posterior", "propagated")]
    widths = [table["sd"].sel(parameter=["gain", "offset"]).values for table in both]
    # But for the data's small curvature by the variance both are [A + w^-1]^-1.
    np.testing.assert_allclose(widths[0], widths[1], rtol=1e-2)
    np.testing.assert_allclose(widths[0], point.sd, rtol=1e-2)


def test_a_profile_is_that_of_the_posterior():
    point = estimate(line(), "be", tolerance=1e-12)
    (low,), (high,) = (profile(line(), point, ["gain"])[key].values for key in ("low", "high"))
    # Of a linear model with the variance profiled: within a few per cent of the normal interval.
    assert (high - low) / (2 * 1.96 * point.sd[0]) == pytest.approx(1.0, rel=0.1)
    with pytest.raises(InputError, match=r"forgets what is known of offset.*kind='posterior'"):
        profile(line(), estimate(line()), ["gain"])


def test_replications_hold_them_at_the_truth_and_say_so():
    truth = np.array([GAIN, 0.3])
    options = {"variance": [NOISE**2], "replications": 400, "seed": 3}
    shown = sampling_distribution(line(), truth, **options)
    assert list(shown["sd"]["parameter"].values) == ["gain"]
    assert shown.data.attrs["held"] == "offset"
    assert "held at the truth" in str(shown)
    # The scatter of a standard deviation from 400 draws is 3.5 %.
    assert float(shown["sd"][0]) == pytest.approx(NOISE / np.sqrt(X @ X), rel=0.15)
    found = estimate_many(line(), line().data[0][None], "mbe")
    alone = estimate(line(), "mbe", tolerance=1e-6)
    np.testing.assert_allclose(found.theta[0], alone.theta, rtol=1e-6)


def test_runs_are_compared_given_the_constant_that_they_share():
    each = estimate_each({str(seed): line(seed) for seed in range(6)})
    assert each.attrs["held"] == "offset"
    assert float(each["sd"].sel(run="0", parameter="gain")) > 3 * NOISE / np.sqrt(X @ X)
    found = between_runs(each)
    assert found.names == ("gain",)
    assert "parameter offset, held: a constant known to a tolerance" in found.left_out
    assert found.p_value[0] > 0.01


def test_what_was_held_is_listed_as_not_asked():
    found = data_against_prior(estimate(line()), line().priors)
    assert "offset was held, known to its tolerance only" in found.attrs["statement"]


def test_an_unknown_nuisance_is_refused():
    with pytest.raises(InputError, match=r"key nuisances: there is no such unknown.*use a"):
        FunctionProblem(lambda x, t: t[0] + x, X, X, [Normal(0, 1)], ["a"], nuisances=["b"])


def test_with_nothing_else_to_estimate_mbe_stays_and_the_mode_moves():
    problem = FunctionProblem(
        lambda x, t: t[0] + 0 * x, X, X, [Normal(0.8, 0.1)], ["level"], nuisances=["level"]
    )
    assert estimate(problem).theta == [0.8]
    assert 0.8 < estimate(problem, "be")["level"] < 1.0


def test_in_a_model_they_are_unknowns_and_fixing_holds_exactly():
    model = system("f16n2d2")
    assert model.uncertain() == ("orifice_damping",)
    assert "orifice_damping" in model.estimated()
    assert "mass" not in model.estimated()
    held = model.fixing("orifice_damping")
    assert "orifice_damping" not in held.estimated()
    assert held.uncertain() == ()
    assert model.parameters["orifice_damping"].measured
    assert not model.freeing("orifice_damping").parameters["orifice_damping"].measured


def test_a_tolerance_must_hold_the_value():
    with pytest.raises(ModelError, match="exclude the start"):
        Parameter(2.0, "N/m", fixed=True, prior=Uniform(0.0, 1.0))
    assert replace(Parameter(0.5, fixed=True, prior=Uniform(0.0, 1.0)), value=0.7).toleranced


def test_data_sets_of_a_campaign_are_fitted_together_beside_what_is_held(tmp_path):
    """As one by one: the constant keeps its value, the others follow the data."""
    reduced = damper_campaign(tmp_path)
    model = damper()
    known = replace(model.parameters["stiffness"], value=950.0, fixed=True)
    predictor = Predictor(model.with_parameters(stiffness=known), reduced.records, steps=32)
    problem = CampaignProblem(predictor)
    rng = np.random.default_rng(4)
    (force,) = problem.data
    data = force + 0.1 * rng.standard_normal((3, force.size))
    found = estimate_many(problem, data)
    assert found.names == problem.names
    assert found.together.all()
    assert (found["stiffness"] == 950.0).all()
    for row, theta in zip(data, found.theta, strict=True):
        alone = estimate(problem.with_data([row]), "mbe", tolerance=1e-6)
        np.testing.assert_allclose(theta, alone.theta, rtol=1e-5)
