"""What is removed before an estimate is removed before its predictions are judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_campaigns import damper, damper_campaign, spring_damper_force

import bayesoleo as bo
from bayesoleo.errors import CampaignError
from bayesoleo.model import Output

NOISE, TONE = 0.1, 0.6


def with_tone(x, v, t):
    return spring_damper_force(x, v, t) + TONE * np.sin(2 * np.pi * 17.3 * t)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tone")
    damper_campaign(folder, with_tone, noise=NOISE)
    return bo.load_campaign(folder, progress=False)


@pytest.fixture(scope="module")
def fit(campaign):
    return bo.Problem(campaign, damper()).fit()


def test_a_tone_is_removed_before_a_prediction_is_judged(fit, campaign):
    found = fit.predict(campaign)
    np.testing.assert_allclose(found.data["rms"], NOISE, rtol=0.15)
    np.testing.assert_allclose(found.data["coverage"], 0.95, atol=0.03)
    assert "tone that is no harmonic of the drive" in str(found)
    assert "it was removed" in str(found)


def test_it_stays_where_that_is_asked_for(fit, campaign):
    found = fit.predict(campaign, disturbances=())
    assert (found.data["rms"] > 3 * NOISE).all()
    assert "removed" not in str(found)


def test_an_output_that_nobody_measured_is_named(fit, campaign):
    other = replace(damper(), outputs={"torque": Output("1.0*displacement", "N*m")})
    with pytest.raises(CampaignError, match="needs channel 'torque', which the campaign lacks"):
        fit.predict(campaign, model=other)
