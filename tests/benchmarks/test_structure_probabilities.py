"""Probabilities of structures on simulated campaigns whose truth is known."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import truth_effects
from scipy import stats
from truth_effects import NUMERICS, fitted
from truth_systems import Extra, Noise, Plan, make

from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare
from bayesoleo.discovery import StructurePosterior, StructurePrior
from bayesoleo.discovery._ranking import score_candidates
from bayesoleo.discovery._structure_search import structure_posterior
from bayesoleo.effects import find_effect

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "studies"))
import structure_draws
import structure_figures
import structure_mix
import structure_probabilities

FEW = ("coulomb_friction", "quadratic_stiffness", "cubic_stiffness", "sensor_gain")
NOISE = Noise(relative=0.005)
#: An input with ten times the relative noise of the outputs.
NOISY_INPUT = Noise(relative=0.001, relative_input=0.01)
_SLOW = pytest.param("two dofs", marks=pytest.mark.slow)
_KINDS = ["linear", _SLOW, "thermal", "force law", "oleo"]


def compared(made) -> StructurePosterior:
    state = fitted(made)
    base = state.base()
    scores, _ = score_candidates(base, state.assembly, [find_effect(name) for name in FEW], 1)
    errors = {(entry.run, entry.output): entry for entry in state.fit_errors.entries}
    return structure_posterior(base, state.assembly, scores, errors, NUMERICS)


@pytest.mark.parametrize("kind", _KINDS)
def test_noise_of_a_measured_input_is_no_effect(kind):
    plan = Plan(fitted=2, held_out=0, periods=5, per_period=64.3)
    found = compared(make(kind, 1, plan=plan, noise=NOISY_INPUT))
    # Where it was not counted, this was below a thousandth.
    assert found.nothing > 0.6


def test_noise_of_a_transient_input_is_no_effect():
    plan = Plan(fitted=2, held_out=0, transient=True, broadband=False)
    found = compared(make("force law", 1, plan=plan, noise=NOISY_INPUT))
    assert found.nothing > 0.6


@pytest.mark.parametrize("seed", [1, 2])
def test_rounding_that_repeats_in_every_period_is_no_effect(seed):
    """Steps of twelve standard deviations, with a whole number of samples in a period."""
    plan = Plan(fitted=2, held_out=0, periods=6, per_period=64.0)
    found = compared(make("force law", seed, plan=plan, noise=Noise(relative=5e-4, step=12.0)))
    # Where it was not counted, this was below a quarter.
    assert found.nothing > 0.6


ROW = {
    "what": "one",
    "truth": ["a @ x"],
    "nothing": 0.0,
    "outside": 0.1,
    "only_outside": 0.1,
    "effects": {"a @ x": 0.6, "b @ x": 0.3},
    "best": [[["a @ x"], False, 0.6]],
    "seconds": 1.0,
}
PLAIN = ROW | {"what": "nothing", "truth": [], "nothing": 0.97, "only_outside": 0.0, "effects": {}}


def test_under_the_prior_of_the_study_only_what_it_draws_has_a_probability():
    """Equal evidence: the shares of what is drawn for the kind remain."""
    cubic, drag = ["cubic_stiffness", "position"], ["quadratic_damping", "position"]
    evidence = [[[], False, 3.0], [[], True, 3.0], [[cubic], False, 3.0], [[drag], False, 9.0]]
    row = ROW | {"kind": "linear", "truth": ["cubic_stiffness @ position"], "evidence": evidence}
    said = structure_mix.statements_by_mix(row)
    shares = np.array([0.25 / 6, 0.25 / 5, 0.375 / 12])
    np.testing.assert_allclose([p for p, _ in said], shares / shares.sum())
    assert [true for _, true in said] == [False, False, True]


def test_names_of_one_effect_count_once():
    """Damping in one direction, and by direction beside that which the model has."""
    names = ["compression_damping", "extension_damping"]
    evidence = [[[], False, 3.0], *([[[name, "position"]], False, 3.0] for name in names)]
    evidence.append([[[name, "position"] for name in names], False, 50.0])
    row = ROW | {"kind": "linear", "truth": ["compression_damping @ position"]}
    said = structure_mix.statements_by_mix(row | {"evidence": evidence})
    shares = np.array([0.25 / 6, 0.375 / 12])
    np.testing.assert_allclose([p for p, _ in said], shares / shares.sum())
    assert [true for _, true in said] == [False, True]


def test_figures_of_a_few_statements():
    plain = PLAIN | {"best": [[[], False, 0.97]]}
    rows = [ROW, plain, {"failed": "no motion repeats"}]
    found = structure_figures.figures(rows)
    assert (found["structure_campaigns"], found["structure_failed"]) == (2, 1)
    assert found["statements_0.5_to_0.8"] == found["statements_0.95_to_1"] == 1
    assert found["calibration_error"] == pytest.approx(0.4)
    assert found["sure_and_wrong"] == 0.0
    # (0.4^2 + 0.3^2 + 0.1^2 + 0.03^2) / 2: the winners are right in both.
    assert found["brier"] == pytest.approx(0.13045)
    assert found["brier_winner"] == 0.0


@pytest.mark.parametrize(("size", "left_out"), [(0.1, True), (31.0, True), (0.5, False)])
def test_an_effect_that_did_not_come_to_its_size_is_left_out(size, left_out, monkeypatch):
    """It is not linear in its amplitude, so that what was asked for says little of what came."""
    made = structure_probabilities.Campaign(None, [], np.array([size]))
    monkeypatch.setattr(structure_probabilities, "campaign", lambda number, draw: made)
    if left_out:
        assert "amplitude" in structure_probabilities.run(4)["failed"]
    else:
        with pytest.raises(AttributeError, match="campaign"):  # it goes on, and there is none
            structure_probabilities.run(4)


@pytest.mark.parametrize("draw", list(structure_figures.TABLES))
def test_stored_table_says_how_it_was_made(draw):
    table = structure_figures.stored(draw)
    assert table["campaigns"] == len(table["rows"])
    assert table["seed"] == structure_probabilities.SEED
    assert f"--draw {draw}" in table["command"]


def test_the_readme_says_what_the_stored_tables_hold():
    """Also what speaks against the probabilities."""
    readme = Path(__file__).resolve().parents[2].joinpath("README.md").read_text(encoding="utf-8")
    for row in structure_figures.readme_rows():
        assert row in readme
    for draw in structure_figures.TABLES:
        campaigns = structure_figures.stored(draw)["campaigns"]
        assert f"{campaigns:,} ".replace(",", " ") in readme


def test_the_figure_has_a_panel_for_each_way_of_drawing():
    assert len(structure_figures.reliability_figure().axes) == len(structure_figures.TABLES)


#: Amplitude of an effect, in units of the independent simulator.
SMALL = 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("missing", "name", "amplitude"),
    [
        (truth_effects.CUBIC, "cubic_stiffness", lambda s: s.force / s.position**3),
        (truth_effects.FIRST_DRAG, "quadratic_damping", lambda s: s.force / s.velocity**2),
    ],
)
def test_what_an_effect_changes_is_what_the_independent_simulator_adds(missing, name, amplitude):
    """The simulators share no code; 0.2 % is what steps of the package's mesh leave."""
    kind = "linear" if missing.target == "position" else "two dofs"
    plan = Plan(fitted=2, held_out=0, periods=5, per_period=64.3)
    plain = make(kind, 3, plan=plan, noise=NOISE)
    extra = make(kind, 3, plan=plan, noise=NOISE, effect=lambda sizes: _scaled(missing, sizes))
    base = fitted(plain).base()
    assembly = prepare(plain.campaign, plain.model, Settings(jobs=1)).assembly
    scores, _ = score_candidates(base, assembly, [find_effect(name)], 1)
    (score,) = [score for score in scores if score.option.key == (name, missing.target)]
    effect = structure_draws.Lacking(score, np.array([SMALL * amplitude(plain.sizes)]))
    changes = structure_draws.Simulator.of(plain, plan).changes(effect, 1.0)
    for label, found in changes.items():
        for output, change in found.items():
            expected = extra.clean[label][output] - plain.clean[label][output]
            np.testing.assert_allclose(change, expected, atol=2e-3 * np.abs(expected).max())


def _scaled(missing, sizes) -> Extra:
    unit = missing.unit(sizes, {})
    return Extra(lambda *at: SMALL * unit.force(*at))


def test_effects_are_drawn_as_often_as_the_prior_says():
    """A chi-square test at one in ten thousand over the families, of 400 draws."""
    made = make("linear", 1, plan=Plan(fitted=2, held_out=0, periods=5, per_period=64.3))
    state = fitted(made)
    base = state.base()
    scores, _ = score_candidates(base, state.assembly, None, 1)
    options = {score.option.key: score.option for score in scores}
    families = {key: option.candidate.family for key, option in options.items()}
    inputs = set(state.assembly.model().inputs)
    weights = {
        key: weight
        for key, weight in StructurePrior().weights(families).items()
        if set(options[key].model.inputs) <= inputs
    }
    rng = np.random.default_rng(5)
    chosen = [structure_draws.keys_drawn(scores, inputs, 1, rng)[0] for _ in range(400)]
    names = sorted({families[key] for key in weights})
    counts = np.array([sum(families[key] == name for key in chosen) for name in names])
    share = np.array([sum(w for k, w in weights.items() if families[k] == n) for n in names])
    assert stats.chisquare(counts, 400 * share / share.sum()).pvalue > 1e-4


@pytest.mark.slow
@pytest.mark.statistical
def test_a_sample_of_the_study(monkeypatch):
    """Six campaigns make about three statements above 0.95. Of these, two would be wrong in one of
    four hundred samples at an error rate of 3 %."""
    for name in ("PLAN", "FEWER", "NOISE", "LEAST", "MOST"):  # the study sets its own
        monkeypatch.setattr(truth_effects, name, getattr(truth_effects, name))
    rows = [structure_probabilities.run(number) for number in range(6)]
    found = structure_figures.figures(rows)
    assert found["structure_campaigns"] >= 5
    assert found["sure_and_wrong"] * found["statements_0.95_to_1"] < 2
    assert found["log_score"] < 0.32  # twice that of the whole study
