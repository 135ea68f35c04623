"""Products of signatures, run by run, against the table of all signatures, by other algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fitted_states import NUMERICS
from small_campaigns import (
    damper,
    damper_campaign,
    oscillator_campaign,
    with_friction,
)
from test_coloured_transients import fitted

from bayesoleo.discovery import _signatures as signature_module
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._catalogue_mean import linearised_of
from bayesoleo.discovery._effects_beside_colour import gain_beside_colour
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._inference import Inference, chosen_for
from bayesoleo.discovery._signatures import (
    LEAST_BESIDE,
    FittedSignatures,
    noise_of,
    signatures_of,
)
from bayesoleo.discovery._spectral_data import SpectralData
from bayesoleo.effects import find_effect
from bayesoleo.error_models import CatalogueErrors, Frame
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.systems import system

EFFECTS = ("coulomb_friction", "cubic_stiffness", "sensor_offset", "varies_by_run")
#: Noise of an AR(1) process.
SLOW = 0.9


def _damper(folder, **options):
    campaign = damper_campaign(folder, with_friction, **options)
    return fit_model(damper(), assign(campaign.records).fitted, NUMERICS, check_mesh=False)


def _masked(folder):
    campaign = damper_campaign(folder, with_friction)
    records = list(assign(campaign.records).fitted)
    kept = np.ones(records[0].time.size, dtype=bool)
    kept[100:180] = False
    records[0] = replace(records[0], kept=kept)
    return fit_model(damper(), records, NUMERICS, check_mesh=False)


def _oscillator(folder):
    campaign = oscillator_campaign(folder, restoring=lambda x, v: 100.0 * x + v + 400.0 * x**2)
    return fit_model(system("duffing"), assign(campaign.records).fitted, NUMERICS, check_mesh=False)


KINDS = {
    "force law": _damper,
    "coloured noise": lambda folder: _damper(folder, coloured=SLOW),
    "samples left out": _masked,
    "oscillator": _oscillator,
    "transient, first order": lambda _: fitted("lag", "white", 0),
    "transient, slow noise": lambda _: fitted("oscillator", "slow", 0),
}


@pytest.fixture(scope="module", params=KINDS)
def found(request, tmp_path_factory):
    """A fit and the signatures of some effects at its estimate."""
    fit = KINDS[request.param](tmp_path_factory.mktemp("runs"))
    effects = tuple(find_effect(name) for name in EFFECTS)
    noise, assembly = noise_of(fit), Assembly(fit.model)
    signatures = FittedSignatures.of(fit, assembly, noise, effects=effects, jobs=1)
    assert noise.coloured == (request.param == "coloured noise")
    return fit, noise, signatures


def _rows(fit, noise, columns):
    """Signatures (s, k, n) of all runs in units of the noise, (k, all samples)."""
    return np.concatenate(
        [block[b] / noise.sigma[b] for block in columns for b in range(len(noise.sigma))], axis=1
    )


def _sensitivities(fit, noise):
    """What parameters change, likewise."""
    moved = fit.problem.evaluate(fit.point.theta).sensitivity
    ends = np.cumsum(fit.problem.counts, axis=0)
    starts = ends - fit.problem.counts
    parts = [
        moved[b][starts[r, b] : ends[r, b]].T / noise.sigma[b]
        for r in range(len(fit.records))
        for b in range(len(noise.sigma))
    ]
    return np.concatenate(parts, axis=1)


def test_an_effect_leaves_as_much_as_noise_beside_the_parameters(found):
    """Each at size one; one that parameters nearly imitate at a hundredth of itself at least."""
    fit, noise, signatures = found
    rows = _rows(fit, noise, signatures.signatures.columns)
    assert len(rows) == len(signatures.about.names) >= 3
    axes = np.linalg.qr(_sensitivities(fit, noise).T)[0]
    beside = rows - (rows @ axes) @ axes.T
    ends = np.cumsum([len(group.columns) for group in signatures.groups])
    for group, last in zip(signatures.groups, ends, strict=True):
        own = slice(last - len(group.columns), last)
        left, whole = (np.sqrt(np.sum(table[own] ** 2)) for table in (beside, rows))
        size = max(left, LEAST_BESIDE * whole) / np.sqrt(rows.shape[1])
        assert size == pytest.approx(group.root, rel=1e-6)


def test_signatures_that_are_alike_act_alone_as_one(found):
    """Kept ones differ beside the parameters, and each left out is like one that is kept."""
    fit, noise, signatures = found
    rows = _rows(fit, noise, signatures.signatures.columns)
    axes = np.linalg.qr(_sensitivities(fit, noise).T)[0]
    beside = rows - (rows @ axes) @ axes.T
    unit = beside / np.linalg.norm(beside, axis=1, keepdims=True)
    squared = np.square(unit @ unit.T)
    kept = signatures.about.single
    assert np.all(squared[np.ix_(kept, kept)][~np.eye(len(kept), dtype=bool)] <= 0.9 + 1e-9)
    single = np.flatnonzero([len(g.columns) == 1 for g in signatures.groups for _ in g.columns])
    assert np.all(squared[np.ix_(single, kept)].max(axis=1) > 0.9 - 1e-9)
    assert signatures.about.odds.sum() == pytest.approx(1.0)


def test_evidence_is_that_of_the_whole_table(found):
    fit, _, signatures = found
    theta, problem = fit.point.theta, fit.problem
    ours = linearised_of(problem, theta, signatures)
    problem.signatures = signatures.signatures
    errors = CatalogueErrors(Frame.of(problem))
    problem.signatures = None
    here, scale = problem.evaluate(theta), PriorScale.of(problem.priors, problem.names)
    pull, precision = scale.quadratic(theta)
    ends = np.cumsum(problem.counts, axis=0)
    moved, left = (
        [
            [make(b)[..., first:last] for b, (first, last) in enumerate(zip(a, z, strict=True))]
            for a, z in zip(ends - problem.counts, ends, strict=True)
        ]
        for make in (
            lambda b: (here.sensitivity[b] * scale.sd).T,
            lambda b: here.residual[b],
        )
    )
    whole = errors.linearised(moved, left, precision, pull)
    # Sums in another order; the evidence has squares of thousands of samples.
    assert ours.log_odds == pytest.approx(whole.log_odds, rel=1e-8, abs=1e-6)
    sd = np.sqrt(np.diag(whole.covariance))
    np.testing.assert_allclose(ours.shift / sd, whole.shift / sd, atol=1e-6)
    np.testing.assert_allclose(np.sqrt(np.diag(ours.covariance)), sd, rtol=1e-6)
    assert len(ours.groups) == len(whole.groups)


def test_no_table_of_all_signatures_is_made_for_a_choice_of_noise(tmp_path, monkeypatch):
    """Friction that is hardly there: effects are looked for, and none is better than noise."""
    fit = _damper(tmp_path, noise=0.5)
    monkeypatch.setattr("bayesoleo.discovery._inference._without_catalogue", lambda *_: None)
    monkeypatch.setattr("bayesoleo.discovery._inference.MORE_THAN_NOISE", np.inf)

    def table(_):
        raise AssertionError("made")

    monkeypatch.setattr(FittedSignatures, "signatures", property(table))
    effects = (find_effect("coulomb_friction"),)
    chosen = chosen_for(Inference("auto"), fit, Assembly(fit.model), effects=effects, jobs=1)
    assert chosen.error_model != "catalogue"
    assert fit.problem.signatures is None


def test_what_parameters_do_as_well_is_left_out(tmp_path):
    """A damping force beside a damping coefficient that is estimated."""
    fit = _damper(tmp_path)
    effects = (find_effect("coulomb_friction"), find_effect("viscous_damping"))
    signatures = FittedSignatures.of(
        fit, Assembly(fit.model), noise_of(fit), effects=effects, jobs=1
    )
    assert any("coulomb_friction" in name for name in signatures.about.names)
    assert not any("viscous_damping" in name for name in signatures.about.names)


def test_lines_of_an_unknown_of_one_run_need_no_zeros_in_another(found):
    """Of a by-run unknown each run has the columns of its own alone."""
    fit, _, _ = found
    rng, data = np.random.default_rng(0), SpectralData.of(fit)
    sizes = [record.time.size for record in fit.records]
    outputs, count = len(fit.predictor.outputs), len(sizes) + 1
    few = [rng.standard_normal((outputs, 2, n)) for n in sizes]
    acting = [np.array([0, r + 1]) for r in range(len(sizes))]
    every = [np.zeros((outputs, count, n)) for n in sizes]
    for whole, part, places in zip(every, few, acting, strict=True):
        whole[:, places] = part
    np.testing.assert_allclose(
        data.columns(few, acting, count), data.columns(every), rtol=1e-12, atol=1e-12
    )


def _zeros_in(labels, made):
    """Groups whose signatures are zero in some runs."""

    def groups(*arguments):
        return [
            replace(
                group,
                columns={
                    name: {
                        label: 0.0 * values if label in labels else values
                        for label, values in column.items()
                    }
                    for name, column in group.columns.items()
                },
            )
            for group in made(*arguments)
        ]

    return groups


@pytest.mark.parametrize("coloured", [0.0, SLOW])
@pytest.mark.parametrize("where", ["first run", "all runs"])
def test_runs_in_which_no_effect_acts(tmp_path, monkeypatch, coloured, where):
    """Signatures of zeros, or none: the remainder alone explains more than noise there."""
    fit = _damper(tmp_path, coloured=coloured)
    labels = [record.label for record in fit.records]
    made = signature_module._groups
    chosen = labels[:1] if where == "first run" else labels
    monkeypatch.setattr(signature_module, "_groups", _zeros_in(chosen, made))
    effects, noise = (find_effect("coulomb_friction"),), noise_of(fit)
    assembly, theta = Assembly(fit.model), fit.point.theta
    zeros = FittedSignatures.of(fit, assembly, noise, effects=effects, jobs=1)
    found = linearised_of(fit.problem, theta, zeros).log_odds
    assert np.isfinite(found)
    if where == "first run":
        monkeypatch.setattr(signature_module, "_groups", made)
        whole = FittedSignatures.of(fit, assembly, noise, effects=effects, jobs=1)
        assert found < linearised_of(fit.problem, theta, whole).log_odds
        return
    assert not zeros.about.names
    none = FittedSignatures.of(fit, assembly, noise, effects=(), jobs=1)
    assert found == pytest.approx(linearised_of(fit.problem, theta, none).log_odds, rel=1e-9)
    fit.problem.signatures = none.signatures
    errors = CatalogueErrors(Frame.of(fit.problem))
    fit.problem.signatures = None
    residual, status = fit.problem.residuals(theta[None], 0)
    assert not status[0]
    eta = np.zeros((1, len(errors.names)))
    eta[0, : len(noise.sigma)] = 2 * np.log(noise.sigma)
    assert np.isfinite(errors.of_run(0, residual, eta)).all()


def test_tiny_signatures_have_the_evidence_of_others(tmp_path, monkeypatch):
    """In units in which their squares are next to no numbers."""
    fit = _damper(tmp_path)
    made = signature_module._groups

    def tiny(*arguments):
        return [
            replace(
                group,
                columns={
                    name: {label: 1e-156 * values for label, values in column.items()}
                    for name, column in group.columns.items()
                },
            )
            for group in made(*arguments)
        ]

    odds = []
    for groups in (made, tiny):
        monkeypatch.setattr(signature_module, "_groups", groups)
        effects = (find_effect("coulomb_friction"),)
        signatures = FittedSignatures.of(
            fit, Assembly(fit.model), noise_of(fit), effects=effects, jobs=1
        )
        odds.append(linearised_of(fit.problem, fit.point.theta, signatures).log_odds)
    # Squares of 1e-156 have ten digits left of what is no longer a normal number.
    assert odds[1] == pytest.approx(odds[0], rel=1e-6)


def test_no_effect_gains_where_there_is_none():
    fit = fitted("lag", "slow", 0)
    signatures = signatures_of(fit, Assembly(fit.model), noise_of(fit), effects=(), jobs=1)
    assert gain_beside_colour(fit, signatures) == -np.inf
