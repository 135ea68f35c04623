"""Replications of a campaign: a batch through the solver is what each data set gives alone."""

from __future__ import annotations

import numpy as np
import pytest
from small_campaigns import damper, damper_campaign, spring_damper_force

from bayesoleo.errors import InputError
from bayesoleo.estimation import estimate, estimate_many
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction._predictor import Predictor


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    reduced = damper_campaign(tmp_path_factory.mktemp("damper"), spring_damper_force)
    return reduced.records[:2]


@pytest.fixture(scope="module", params=["force law", "oscillator"])
def problem(request, records):
    if request.param == "force law":
        return CampaignProblem(Predictor(damper(offsets=True), records, backend="numpy", jobs=1))
    return oscillator_problem(records)


def oscillator_problem(records):
    """The same spring and damper, driven the other way: the displacement is solved for."""
    model = Model(
        "oscillator",
        inputs={"force": "N"},
        dofs={"x": Dof("m")},
        parameters={
            "damping": Parameter(190.0, "N*s/m", sd=50.0),
            "stiffness": Parameter(950.0, "N/m", sd=300.0),
        },
        equations={"x": {"damping": "damping*dot(x)", "spring": "stiffness*x", "drive": "-force"}},
        outputs={"displacement": Output("x", "m")},
    )
    return CampaignProblem(Predictor(model, records, steps=32, backend="numpy", jobs=1))


def test_each_estimate_is_that_of_its_data_alone(problem):
    sd = np.std(problem.data[0])
    data = problem.data[0] + np.random.default_rng(3).normal(
        0, 0.02 * sd, (3, problem.data[0].size)
    )
    problem.freeze(estimate(problem).theta)
    found = estimate_many(problem, data, tolerance=1e-8)
    assert found.ok.all()
    assert found.together.all()
    for theta, covariance, y in zip(found.theta, found.covariance, data, strict=True):
        point = estimate(problem.with_data([y]), tolerance=1e-8)
        # of a standard deviation: solves agree to the solver's tolerance
        assert np.max(np.abs(theta - point.theta) / point.sd) < 1e-4
        np.testing.assert_allclose(covariance, point.covariance_likelihood, rtol=1e-4)


def test_other_data_leave_the_problem_as_it_was(problem):
    before = problem.evaluate(problem.start).residual[0]
    other = problem.with_data([problem.data[0] + 1.0])
    np.testing.assert_allclose(other.evaluate(problem.start).residual[0], before + 1.0, atol=1e-9)
    # the solver starts from where it stands, so only its tolerance agrees
    np.testing.assert_allclose(problem.evaluate(problem.start).residual[0], before, atol=1e-12)
    misfit = other.misfit(problem.start[None]).sum_of_squares.sum()
    assert misfit == pytest.approx(np.sum((before + 1.0) ** 2), rel=1e-9)


def test_data_must_fit(problem):
    with pytest.raises(InputError, match="as many as the problem's"):
        problem.with_data([np.ones(3)])
