"""Which errors an estimate assumes by itself: looked for cheaply, and not where priors decide."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
from fitted_states import NUMERICS
from small_campaigns import damper, damper_campaign, spring_damper_force, with_friction

from bayesoleo.discovery import _inference as inference, _signatures as signatures
from bayesoleo.discovery._assembly import Assembly, Roles, assign
from bayesoleo.discovery._catalogue_mean import CatalogueMean
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._inference import LOOKED_FOR, Inference, chosen_for
from bayesoleo.discovery._ranking import score_candidates
from bayesoleo.discovery._run_predictions import predict_held_out
from bayesoleo.discovery._scanned_columns import Scanned
from bayesoleo.discovery._signatures import more_than_noise_p, noise_of, signatures_of
from bayesoleo.discovery._state import State, fit_state
from bayesoleo.effects import find_effect
from bayesoleo.error_models._catalogue_evidence import Linearised

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


@pytest.mark.slow
@pytest.mark.parametrize("coloured", [0.0, 0.9])
def test_noise_alone_is_seldom_looked_at_again(tmp_path, coloured):
    # A third of 12 at most is expected; 9 or more happen less than once in two hundred times.
    assert looked_for(tmp_path, spring_damper_force, coloured=coloured) < 9


@pytest.mark.slow
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


@pytest.mark.slow
def test_errors_of_the_catalogue_are_not_chosen_where_priors_would_decide(tmp_path, monkeypatch):
    """The estimate under these errors leaves the signal to effects: it is not taken."""
    fit = fit_of(tmp_path, with_friction)
    assembly = Assembly(damper(), None)
    kept = chosen_for(Inference("auto"), fit, assembly, jobs=1)
    assert kept.error_model == "catalogue"
    monkeypatch.setattr(
        inference,
        "shifted",
        lambda problem, theta: CatalogueMean(
            0.0 * theta, Linearised(9.0, theta, np.eye(3)), theta, None
        ),
    )
    found = chosen_for(Inference("auto"), replace(fit), assembly, jobs=1)
    # What is left is alike from sample to sample: it does not count as noise.
    assert found.error_model == "power"
    assert "100% of the signal of force" in found.reason
    # More than noise is left there, and that is not denied.
    assert "although effects of the catalogue explain the residual better" in found.reason
    assert "no more than noise" not in found.reason
    monkeypatch.setattr(
        inference,
        "shifted",
        lambda problem, theta: CatalogueMean(
            theta, Linearised(9.0, theta, np.eye(3)), theta, None, settled=False
        ),
    )
    lost = chosen_for(Inference("auto"), replace(fit), assembly, jobs=1)
    assert lost.error_model == "power"
    assert "too far from linear about the estimate" in lost.reason
    # Nor is it said where effects are undecided and noise alone is left.
    monkeypatch.setattr(
        inference,
        "shifted",
        lambda problem, theta: CatalogueMean(
            0.0 * theta, Linearised(9.0, theta, np.eye(3)), theta, None
        ),
    )
    monkeypatch.setattr(inference, "linearised_of", lambda *_: Linearised(-9.0, np.zeros(3), None))
    undecided = chosen_for(Inference("auto"), replace(fit), assembly, undecided=["drag"], jobs=1)
    assert "although effects that the data do not tell apart are left: drag." in undecided.reason
    assert fit.problem.signatures is None


def test_power_errors_go_with_scatter_between_runs(tmp_path):
    """As `auto` may choose them where a user lets a parameter scatter."""
    both = Inference("power", ("damping",))
    campaign = damper_campaign(tmp_path, with_friction)
    model = both.declare(damper())
    fit = fit_model(model, assign(campaign.records).fitted, NUMERICS, check_mesh=False)
    density = both.density(fit)
    assert any("damping" in name for name in density.names)
    phi = density.coordinates(density.natural(np.zeros((1, density.dimension))))
    np.testing.assert_allclose(phi, 0.0, atol=1e-9)


EFFECTS = tuple(
    find_effect(name) for name in ("coulomb_friction", "end_stop_upper", "sensor_offset")
)


def scanned_by(state: State, effects=EFFECTS) -> Scanned:
    """What a score of some effects keeps."""
    kept: list[Scanned] = []
    score_candidates(state.base(), state.assembly, effects, 1, keep=kept.append)
    return kept[0]


@pytest.fixture(scope="module")
def left(tmp_path_factory):
    """A model that lacks friction, fitted."""
    campaign = damper_campaign(tmp_path_factory.mktemp("left"), with_friction)
    return fit_state(Assembly(damper(), None), assign(campaign.records), NUMERICS)


def not_again(*_, **__):
    raise AssertionError("computed again")


def test_what_a_score_computed_is_not_computed_again(left, monkeypatch):
    """The same choice and signatures as without scores, to the last bit: nothing is lost on the
    way."""
    fit, assembly = replace(left.fit), left.assembly
    apart = chosen_for(Inference("auto"), fit, assembly, effects=EFFECTS, jobs=1)
    alone = fit.problem.signatures
    scanned = scanned_by(left)
    monkeypatch.setattr(signatures, "columns_of", not_again)
    found = chosen_for(
        Inference("auto"), left.fit, assembly, effects=EFFECTS, scanned=scanned, jobs=1
    )
    assert found == apart
    assert found.error_model == "catalogue"
    together = left.fit.problem.signatures
    assert together.names == alone.names
    for one, other in zip(together.columns, alone.columns, strict=True):
        np.testing.assert_array_equal(one, other)


def test_columns_of_another_estimate_are_not_taken(left):
    """Nor those of other effects; and they are handed on once, and never pickled."""
    fit, assembly = left.fit, left.assembly
    other = replace(fit, point=replace(fit.point))
    assert scanned_by(left).take(other, assembly, EFFECTS) is None
    assert scanned_by(left).take(fit, replace(assembly), EFFECTS) is None
    assert scanned_by(left).take(fit, assembly, EFFECTS[:1]) is None
    scanned = scanned_by(left)
    assert scanned.take(fit, assembly, list(EFFECTS)) is not None
    assert scanned.take(fit, assembly, EFFECTS) is None
    assert pickle.loads(pickle.dumps(scanned_by(left))) is None


def test_large_columns_are_not_kept(left, monkeypatch):
    kept: list[Scanned] = []
    monkeypatch.setattr("bayesoleo.discovery._ranking.MOST_KEPT", 1000)
    score_candidates(left.base(), left.assembly, EFFECTS, 1, keep=kept.append)
    assert not kept


def test_a_run_that_was_not_fitted_has_the_curves_of_its_twin(left):
    """A fitted run under another label, held out: its motion, and so its curves, are the same."""
    fit = left.fit
    twin = replace(fit.records[0], label="twin", role="hold-out")
    held = predict_held_out(fit, Roles((), (twin,), "declared", "").held_out)
    effects = (*EFFECTS, find_effect("varies_by_run"))
    found = signatures_of(fit, left.assembly, noise_of(fit), effects=effects, held_out=held, jobs=1)
    # An unknown that each run has of its own acts in that run alone.
    own = np.array(["[" in name for name in found.names])
    assert own.any()
    first, second = found.curves[fit.records[0].label], found.curves["twin"]
    # Both motions are solved to some 1e-10 of their size, each by itself.
    scale = np.abs(first[:, ~own]).max()
    np.testing.assert_allclose(second[:, ~own], first[:, ~own], atol=1e-7 * scale)
    mine = np.array([name.endswith(f"[{fit.records[0].label}]") for name in found.names])
    its = np.array([name.endswith("[twin]") for name in found.names])
    np.testing.assert_allclose(second[:, its], first[:, mine], atol=1e-7 * scale)
    assert not np.any(first[:, its])
    assert all(not block[:, its].any() for block in found.columns)
