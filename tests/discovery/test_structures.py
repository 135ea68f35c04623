"""Probabilities of structures on campaigns whose truth is known, and the evidence they rest on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from discovery.fitted_states import NUMERICS, fitted
from scipy import stats
from scipy.special import logsumexp
from small_campaigns import (
    CUBIC,
    DAMPING,
    STIFFNESS,
    damper,
    damper_campaign,
    spring_damper_force,
)

from bayesoleo.discovery import StructurePosterior, StructurePrior
from bayesoleo.discovery._nonparametric_quantities import Forced, Motions, quantities_of
from bayesoleo.discovery._parameter_mixture import Mixture, part_of
from bayesoleo.discovery._ranking import score_candidates
from bayesoleo.discovery._spectral_data import EstimatedModel, scan_prior
from bayesoleo.discovery._state import State
from bayesoleo.discovery._structure_columns import (
    Group,
    Likelihood,
    Reduced,
    fewer,
)
from bayesoleo.discovery._structure_comparison import (
    LEAST_SEEN,
    LIKELY_SIDE,
    Comparison,
    grids_of,
    visible,
)
from bayesoleo.discovery._structure_search import (
    Evidence,
    Ground,
    _columns,
    _curves,
    _named_as,
    extended,
    structure_posterior,
)
from bayesoleo.discovery._structures import AveragedParameter
from bayesoleo.effects import find_effect
from bayesoleo.effects._nonparametric import balance_places

FEW = ("coulomb_friction", "quadratic_damping", "preload", "quadratic_stiffness", "sensor_gain")
FRICTION = ("coulomb_friction", "force")


def with_soft_friction(x, v, t):
    """Friction that changes its direction over a twentieth of the largest velocity."""
    return spring_damper_force(x, v, t) + 5.0 * 2 / np.pi * np.arctan(v / 0.004)


def compared(state: State, names=FEW, prior: StructurePrior | None = None) -> StructurePosterior:
    base = state.base()
    effects = [find_effect(name) for name in names]
    scores, _ = score_candidates(base, state.assembly, effects, 1)
    errors = {(entry.run, entry.output): entry for entry in state.fit_errors.entries}
    return structure_posterior(
        base, state.assembly, scores, errors, NUMERICS, prior=prior or StructurePrior()
    )


@pytest.fixture(scope="module")
def rubbing(tmp_path_factory) -> State:
    return fitted(damper_campaign(tmp_path_factory.mktemp("rubbing")), damper())


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> State:
    folder = tmp_path_factory.mktemp("plain")
    return fitted(damper_campaign(folder, spring_damper_force), damper())


def test_probabilities_are_of_all_structures(rubbing):
    found = compared(rubbing)
    assert sum(item.probability for item in found.structures) == pytest.approx(1.0)
    falling = [item.probability for item in found.structures]
    assert falling == sorted(falling, reverse=True)
    assert set(found.effects) <= {(name, target) for name, target in found.effects}


def test_what_is_missing_is_probable(rubbing):
    found = compared(rubbing)
    assert found.effects[FRICTION] > 0.95
    assert found.nothing < 1e-6
    assert found.structures[0].effects == (FRICTION,)
    assert found.structures[0].estimated


def test_nothing_is_probable_where_nothing_is_missing(plain):
    found = compared(plain)
    # The prior of nothing is 0.45: data that show nothing raise it.
    assert found.nothing > 0.6
    assert max(found.effects.values()) < 0.2


def test_without_the_true_effect_something_outside_is_probable(rubbing):
    found = compared(rubbing, ("quadratic_stiffness", "sensor_gain"))
    assert found.outside > 0.9


def with_two_effects(x, v, t):
    return with_soft_friction(x, v, t) + 2e4 * x**2


PAIR = (FRICTION, ("quadratic_stiffness", "force"))


@pytest.fixture(scope="module")
def two(tmp_path_factory) -> State:
    return fitted(damper_campaign(tmp_path_factory.mktemp("two"), with_two_effects), damper())


def evidence_with(state: State, names=FEW) -> tuple[Evidence, list[EstimatedModel]]:
    """Evidence about the declared model, and estimates of the pair's parts and of the pair, from
    one of them and from the declared model."""
    base = state.base()
    scores, _ = score_candidates(base, state.assembly, [find_effect(n) for n in names], 1)
    errors = {(entry.run, entry.output): entry for entry in state.fit_errors.entries}
    evidence = Evidence(Comparison.of(base, errors, scores, StructurePrior()))
    declared = EstimatedModel(base.fit, {})
    evidence.add(declared)
    by_key = {score.option.key: score for score in scores}
    ground = Ground(base, state.assembly, by_key, NUMERICS)

    def estimate(effects, near):
        return extended(ground, (effects, near))

    single = [estimate((key,), declared) for key in PAIR]
    return evidence, [*single, estimate(PAIR, single[0]), estimate(PAIR, declared)]


def test_two_effects_are_found_where_none_was_tried_as_a_pair(two, monkeypatch):
    """Each is compared beside the other, for what is left of a probable set is estimated too."""
    monkeypatch.setattr("bayesoleo.discovery._structure_comparison.IN_PAIRS", 1)
    found = compared(two)
    assert set(found.structures[0].effects) == set(PAIR)
    assert found.structures[0].estimated
    # The rest is of laws that resemble one of the two, or both.
    assert all(found.effects[key] > 0.8 for key in PAIR), found.effects


def test_curves_that_are_solved_together_are_those_solved_alone(plain):
    """Also where one of them is no number: it is left out, and the other is not."""
    base, assembly = plain.base(), plain.assembly
    motions = Motions(base.fit, assembly, quantities_of(assembly.native))
    curves = [courses for _, courses in _curves(motions, dict(motions.axes({})), assembly.native)]
    (target,) = balance_places(assembly.native)
    forced = Forced(base.fit, assembly, target)

    def bad(r, phase):
        return curves[0](r, phase) * np.nan

    alone = [_columns(base, forced, [courses])[0] for courses in curves[:2]]
    together = _columns(base, forced, curves[:2])
    assert len(together) == 2
    assert not np.allclose(*together)
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_array_equal(one, other)
    one, none = _columns(base, forced, [curves[1], bad])
    assert none is None
    np.testing.assert_array_equal(one, alone[1])


def test_effects_are_compared_alike_whatever_is_looked_at_with_them(two, monkeypatch):
    evidence, (one, *_) = evidence_with(two)
    evidence.add(one)
    monkeypatch.setattr("bayesoleo.discovery._structure_comparison.CHUNK", 1)
    alone = Evidence(evidence.comparison)
    for anchor in (EstimatedModel(two.base().fit, {}), one):
        alone.add(anchor)
    assert alone.found.keys() == evidence.found.keys()
    # Round-off of logarithms that are hundreds.
    for key, value in evidence.found.items():
        assert alone.found[key] == pytest.approx(value, abs=1e-6), key


def test_parts_of_a_probable_pair_are_estimated_each(two):
    evidence, (one, _, both, _) = evidence_with(two)
    evidence.add(both)
    assert set(evidence.parts(np.log(0.1))) == {(key,) for key in PAIR}
    evidence.add(one)
    assert evidence.parts(np.log(0.1)) == [(PAIR[1],)]


def test_an_estimate_does_not_depend_on_where_it_starts(two):
    """The mode is one: from the estimate of a part, or from the declared model."""
    evidence, (one, _, both, other) = evidence_with(two)
    evidence.add(one)
    assert evidence.nearest(PAIR, both) is one
    nothing_compared = Evidence(evidence.comparison)
    assert nothing_compared.nearest(PAIR, both) is both
    assert nothing_compared.without_outside() == []
    for name, value in both.fit.values.items():
        # Estimates for comparison end where steps are small parts of a standard deviation.
        sd = float(
            np.sqrt(both.fit.point.covariance.diagonal()[both.fit.problem.names.index(name)])
        )
        assert other.fit.values[name] == pytest.approx(value, abs=0.2 * sd)
    assert both.fit.values["quadratic_stiffness"] == pytest.approx(2e4, rel=0.05)


def test_a_law_like_an_effect_has_one_evidence_about_both_estimates(two):
    """About an estimate without the effect, by its column, and about one with it."""
    evidence, (one, other, both, _) = evidence_with(two)
    evidence.add(one)
    key, part = PAIR[1], frozenset({PAIR[0]})
    about_part = evidence._similar[part][key]
    evidence.add(other)
    evidence.add(both)
    # Sizes are on a coarser grid where the effect is estimated: half a unit of log evidence.
    assert evidence._similar[part][key] == pytest.approx(about_part, abs=0.7)
    like, alone = evidence.evidence_of((part, True)), evidence.found[part, True]
    assert like > alone  # what differs a little from the effect beside friction is likelier


def test_odds_of_two_structures_follow_their_prior(plain):
    """The evidence does not depend on the prior of structures."""
    odds = []
    for prior in (StructurePrior(), StructurePrior(nothing=0.2, catalogue=0.4, outside=0.4)):
        found = compared(plain, prior=prior)
        odds.append(found.nothing / found.only_outside * prior.outside / prior.nothing)
    assert odds[0] == pytest.approx(odds[1], rel=1e-9)


def test_evidence_about_an_estimate_is_that_of_importance_sampling(tmp_path):
    """The model is nonlinear in no parameter but the shape of friction, which is well known here.

    Where friction switches at once, its shape is only bounded on one side and the two differ by
    some two units.
    """
    rubbing = fitted(damper_campaign(tmp_path, with_soft_friction), damper())
    base = rubbing.base()
    scores, _ = score_candidates(base, rubbing.assembly, [find_effect(FRICTION[0])], 1)
    errors = {(entry.run, entry.output): entry for entry in rubbing.fit_errors.entries}
    evidence = Evidence(Comparison.of(base, errors, scores, StructurePrior()))
    evidence.add(EstimatedModel(base.fit, {}))
    (score,) = scores
    ground = Ground(base, rubbing.assembly, {FRICTION: score}, NUMERICS)
    anchor = extended(ground, ((FRICTION,), EstimatedModel(base.fit, {})))
    evidence.add(anchor)
    found = evidence.found[frozenset({FRICTION}), False]
    assert found == pytest.approx(_sampled(evidence.comparison, anchor), abs=0.3)


def _sampled(comparison: Comparison, anchor) -> float:
    """Log evidence by importance sampling of the model itself, sizes of the effect included."""
    rng, fit, data = np.random.default_rng(4), anchor.fit, comparison.data
    names, theta = list(fit.problem.names), fit.point.theta
    likelihood = Likelihood(comparison.variance.size, comparison.freedom)
    _, sizes = grids_of(comparison, data.signal(fit))
    columns = data.columns([p.sensitivity for p in fit.predictions])
    amplitude = names.index("coulomb_friction")
    unit = comparison.unit(columns[[amplitude]])[0]
    # Sizes are those of what the other unknowns cannot make of its change.
    white = columns / np.sqrt(comparison.variance)
    others = np.delete(white, amplitude, axis=0)
    rest = white[amplitude] - others.T @ np.linalg.lstsq(others.T, white[amplitude])[0]
    unit *= np.linalg.norm(white[amplitude]) / np.linalg.norm(rest)
    # Shapes are positive: they are drawn in their logarithm.
    scale = np.array([theta[k] if n in anchor.shapes else 1.0 for k, n in enumerate(names)])
    root = np.linalg.cholesky(1.44 * fit.point.covariance / np.outer(scale, scale))
    white = rng.standard_t(8, (400, theta.size))
    moved = white @ root.T
    shape = np.array([name in anchor.shapes for name in names])
    draws = np.where(shape, theta * np.exp(np.minimum(moved, 5.0)), theta + moved)
    proposal = stats.t.logpdf(white, 8).sum(axis=1) - np.log(np.diag(root)).sum()
    logs = np.full(len(draws), -np.inf)
    for n, draw in enumerate(draws):
        predictions = fit.predictor.predict(fit.problem.full(draw[None])[0])
        residual = data.columns(
            [
                (run.measured - p.y)[:, None]
                for run, p in zip(fit.predictor.runs, predictions, strict=True)
            ]
        )[0]
        square = np.sum(residual**2 / comparison.variance)
        logs[n] = likelihood(square, np.log(comparison.variance).sum())
        for k, name in enumerate(names):
            if k == amplitude:
                # At the mean of the grid that the package uses for its own effects.
                normal = fewer(sizes) * unit / np.sqrt(3.0)
                each = stats.norm.logpdf(draw[k], scale=normal) + np.log((draw[k] / normal) ** 2)
                logs[n] += logsumexp(each) - np.log(each.size)
                logs[n] += np.log(2 * (LIKELY_SIDE if draw[k] > 0 else 1 - LIKELY_SIDE))
            elif name in anchor.shapes:
                centre, width = scan_prior(anchor.shapes[name])
                logs[n] += stats.norm.logpdf(np.log(draw[k]), centre, width)
            else:
                logs[n] += fit.problem.priors[k].log_density(draw[None, k])[0]
    return float(logsumexp(logs - proposal) - np.log(len(draws)))


@pytest.mark.parametrize("own", [0.3, 1e-9])
def test_columns_have_unit_size_in_what_the_model_cannot_make(own):
    """One column is what an unknown does but for this part; the other shares nothing with it."""
    samples = 50
    basis = np.linalg.qr(np.random.default_rng(2).standard_normal((samples, 3)))[0].T
    like = np.sqrt(1.0 - own) * basis[0] + np.sqrt(own) * basis[1]
    rows = np.sqrt(samples) * np.array([basis[0], like, basis[2]])
    unknown = 1e8 * rows[:1]  # hardly any prior
    every = np.concatenate([np.zeros((1, samples)), unknown, rows[1:]])
    reduced = Reduced.of((every @ every.T)[None], np.zeros(1), 1, np.zeros(1))
    factors = visible(reduced, [Group((0,)), Group((1,))], samples)
    part = max(own, LEAST_SEEN)
    np.testing.assert_allclose(factors, [part**-0.5, 1.0], rtol=1e-4)
    seen = np.diagonal(reduced.scaled(factors).gram[0]) / samples
    np.testing.assert_allclose(seen, [own / part, 1.0], rtol=1e-4, atol=1e-6)


def test_where_nothing_is_missing_averages_are_those_of_the_fit(plain):
    sure = StructurePrior(nothing=0.999, catalogue=0.0005, outside=0.0005)
    found = compared(plain, prior=sure).parameters
    sd = np.sqrt(np.diag(plain.fit.point.covariance))
    assert set(found) == set(plain.fit.problem.names)
    for name, estimate, own in zip(plain.fit.problem.names, plain.fit.point.theta, sd, strict=True):
        shown = found[name]
        assert abs(shown.mean - estimate) < 0.5 * own
        # Noise is weighted by its spectrum here and is white there.
        assert shown.high - shown.low == pytest.approx(2 * 1.645 * own, rel=0.1)


def test_an_average_over_two_structures_contains_both():
    """Two normal densities of equal weight, ten standard deviations apart."""

    def mixed(*parts: tuple[float, float, float]) -> AveragedParameter:
        return Mixture.of([part_of(*part, False) for part in parts]).summary()

    found = mixed((0.5, -5.0, 1.0), (0.5, 5.0, 1.0))
    assert found.mean == pytest.approx(0.0)
    assert found.sd == pytest.approx(np.sqrt(26.0))
    far = mixed((0.97, 0.0, 1.0), (0.03, 1000.0, 1.0))
    assert far.low < far.median < far.high < far.mean
    # Five per cent of the mixture are ten of the lower part, whose quantile is -1.2816.
    assert (found.low, found.high) == pytest.approx((-6.2816, 6.2816), abs=1e-4)
    alone = mixed((0.5, 3.0, 2.0))
    assert (alone.low, alone.high) == pytest.approx((3 - 2 * 1.64485, 3 + 2 * 1.64485), abs=1e-4)


def test_averages_cover_where_effects_cannot_be_told_apart(tmp_path):
    """A stop whose spring hardens or not: the estimate of the declared model is far off."""

    def stopped(x, v, t):
        return spring_damper_force(x, v, t) + 1500.0 * np.maximum(x - 0.006, 0.0)

    state = fitted(damper_campaign(tmp_path, stopped), damper())
    found = compared(state, ("end_stop_upper", "hertzian_contact_upper", "quadratic_stiffness"))
    assert found.nothing < 0.01
    truth, off = {"damping": DAMPING, "stiffness": STIFFNESS, "cubic": CUBIC}, []
    sd = np.sqrt(np.diag(state.fit.point.covariance))
    for name, estimate, own in zip(state.fit.problem.names, state.fit.point.theta, sd, strict=True):
        shown = found.parameters[name]
        off.append(abs(estimate - truth[name]) / own)
        # Three standard deviations: three parameters of one seed are no test of coverage.
        assert abs(shown.mean - truth[name]) < 3 * shown.sd
    assert max(off) > 4


def test_estimates_know_parameters_that_a_second_place_renames(two):
    """Beside an effect that makes a second place for it, an effect is called after its place."""
    evidence, _ = evidence_with(two)
    score = next(s for s in evidence.comparison.scores if s.option.key == FRICTION)
    candidate = score.option.candidate
    after = {name: f"{name}_force" for name in (*candidate.parameters, *candidate.shapes)}
    renamed = replace(
        candidate,
        parameters=tuple(after[name] for name in candidate.parameters),
        shapes={after[name]: values for name, values in candidate.shapes.items()},
    )
    found = _named_as(score, replace(score.option, candidate=renamed))
    assert found.names == tuple(after[name] for name in score.names)
    assert found.shapes == {after[name]: value for name, value in score.shapes.items()}
    # What another effect has brought already is not there a second time.
    bare = _named_as(score, replace(score.option, candidate=replace(renamed, shapes={})))
    assert bare.shapes == {}


@pytest.mark.parametrize("first", [0, 1])
def test_one_law_of_two_names_has_the_first_whatever_round_off_says(plain, first):
    """Both explain the same but for the last digits, which are other ones on other machines."""
    names = ["compression_damping", "direction_dependent_damping"]
    ordered = [names[first], names[1 - first]]
    effects = [find_effect(name) for name in ordered]
    scores, reasons = score_candidates(plain.base(), plain.assembly, effects, 1)
    assert [score.option.key[0] for score in scores] == ordered[:1]
    assert reasons[f"{ordered[1]} at force"] == f"the same as {ordered[0]} in other words"
