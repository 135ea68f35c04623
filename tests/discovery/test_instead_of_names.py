"""A function without a name stands instead of names only if it predicts as well as they do."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from fitted_states import NUMERICS

from bayesoleo.discovery import _nonparametric_round as unnamed_round
from bayesoleo.discovery._round import Round
from bayesoleo.effects._nonparametric import FAMILY


@pytest.mark.parametrize("against", [False, True])
def test_a_curve_that_predicts_worse_does_not_stand_instead_of_names(monkeypatch, against):
    """Of a transient's remainder little counts as noise, and the fitted runs decide by a hair."""
    before = SimpleNamespace(at_floor=False, assembly=SimpleNamespace(steps=()))
    outcome = Round(before, (), {}, None, None, "no name", 60.0)
    score = SimpleNamespace(option=SimpleNamespace(key=("nonparametric_x", "force")))
    score.option.candidate = SimpleNamespace(
        effect="nonparametric_x", target="force", family=FAMILY
    )
    result = SimpleNamespace(share=0.96, contribution=None, score=score, inflation=40.0)
    answer = SimpleNamespace(
        refit=result, ranking=(), state=None, instead=True, search=SimpleNamespace(p_value=1e-9)
    )
    after = SimpleNamespace(at_floor=False)
    monkeypatch.setattr(unnamed_round, "closest", lambda *_: ())
    monkeypatch.setattr(unnamed_round, "confirmed", lambda *_: (after, "it explains much"))
    monkeypatch.setattr(unnamed_round, "contradicted", lambda *_: against)
    found, reason = unnamed_round._accepting(outcome, answer, None, NUMERICS, print)
    assert (found is outcome) == against
    assert ("predicts hold-out runs worse" in reason) == against


@pytest.mark.parametrize("fall", [-40.0, 0.0, 40.0, None])
def test_a_name_that_leaves_only_noise_gives_way_to_what_predicts_better(monkeypatch, fall):
    """Noise alone decides which of two models that explain all is the likelier."""
    steps = (SimpleNamespace(effect=SimpleNamespace(id="quadratic_damping")),)
    before = SimpleNamespace(at_floor=True, assembly=SimpleNamespace(steps=steps))
    outcome = Round(before, (), {}, None, None, "no name", 60.0)
    score = SimpleNamespace(option=SimpleNamespace(key=("nonparametric_x", "force")))
    score.option.candidate = SimpleNamespace(
        effect="nonparametric_x", target="force", family=FAMILY
    )
    result = SimpleNamespace(share=0.96, contribution=None, score=score, inflation=1.0)
    answer = SimpleNamespace(
        refit=result, ranking=(), state=None, instead=True, search=SimpleNamespace(p_value=1e-9)
    )
    entries = () if fall is None else (None,)  # no run is held out
    after = SimpleNamespace(at_floor=True, hold_errors=SimpleNamespace(entries=entries))
    monkeypatch.setattr(unnamed_round, "closest", lambda *_: ())
    monkeypatch.setattr(unnamed_round, "confirmed", lambda *_: (after, "it explains much"))
    monkeypatch.setattr(unnamed_round, "contradicted", lambda *_: False)
    monkeypatch.setattr(unnamed_round, "judged", lambda old, new: (old, new))
    monkeypatch.setattr(unnamed_round, "fall_on_hold_out", lambda *_: SimpleNamespace(value=fall))
    found, reason = unnamed_round._accepting(outcome, answer, None, NUMERICS, print)
    kept = fall is not None and fall <= 0.0
    assert (found is outcome) == kept
    assert ("predicts hold-out runs no better than quadratic_damping" in reason) == kept
