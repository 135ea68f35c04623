"""Which errors an estimate assumes by itself: looked for cheaply, and not where priors decide."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitted_states import NUMERICS
from small_campaigns import damper, damper_campaign, spring_damper_force, with_friction

from bayesoleo.discovery import _inference as inference
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._inference import LOOKED_FOR, Inference, chosen_for
from bayesoleo.discovery._signatures import more_than_noise_p, noise_of
from bayesoleo.error_models._catalogue_discrepancy import Linearised

SEEDS = 12


def fit_of(folder, force, **options):
    campaign = damper_campaign(folder, force, **options)
    return fit_model(damper(), assign(campaign.records).fitted, NUMERICS, check_mesh=False)


def looked_for(tmp_path, force, **options):
    """How often effects are looked for in a residual."""
    found = 0
    for seed in range(SEEDS):
        fit = fit_of(tmp_path / str(seed), force, seed=seed, **options)
        found += more_than_noise_p(fit, noise_of(fit)) <= LOOKED_FOR
    return found


@pytest.mark.parametrize("coloured", [0.0, 0.9])
def test_noise_alone_is_seldom_looked_at_again(tmp_path, coloured):
    # A third of 12 at most is expected; 9 or more happen less than once in two hundred times.
    assert looked_for(tmp_path, spring_damper_force, coloured=coloured) < 9


def test_an_effect_at_its_detection_limit_is_looked_for(tmp_path):
    """Friction that changes the outputs by five standard deviations beside the parameters."""
    noise = 0.5
    whole = fit_of(tmp_path / "whole", with_friction, noise=1e-9)
    left = [
        run.measured - p.y for run, p in zip(whole.predictor.runs, whole.predictions, strict=True)
    ]
    part = 5.0 * noise / np.sqrt(sum(np.sum(one**2) for one in left))

    def small(x, v, t):
        plain = spring_damper_force(x, v, t)
        return plain + part * (with_friction(x, v, t) - plain)

    # Where one in twenty is missed, three or more of 12 are once in fifty times.
    assert looked_for(tmp_path, small, noise=noise) > SEEDS - 3


def test_errors_of_the_catalogue_are_not_chosen_where_priors_would_decide(tmp_path, monkeypatch):
    """The estimate under these errors leaves the signal to effects: it is not taken."""
    fit = fit_of(tmp_path, with_friction)
    assembly = Assembly(damper(), None)
    kept = chosen_for(Inference("auto"), fit, assembly, jobs=1)
    assert kept.error_model == "catalogue"
    monkeypatch.setattr(
        inference,
        "_shifted",
        lambda problem, theta: (0.0 * theta, Linearised(9.0, theta, np.eye(3)), theta),
    )
    found = chosen_for(Inference("auto"), replace(fit), assembly, jobs=1)
    assert found.error_model == "independent"
    assert "100% of the signal of force" in found.reason
    assert fit.problem.signatures is None
