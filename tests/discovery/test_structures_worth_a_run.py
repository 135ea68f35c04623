"""A run is proposed to tell structures apart only where one of them may be true."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from bayesoleo.discovery import _open_questions as questions
from bayesoleo.discovery._open_questions import proposals_entry
from bayesoleo.discovery._structures import Structure, StructurePosterior, StructurePrior
from bayesoleo.errors import ModelError

DRAG, STOP = ("drag", "x"), ("stop", "x")


def asked(monkeypatch, drag, stop):
    """The questions where something outside the catalogue has the rest of the probability."""
    table = {(): 1.0 - drag - stop, (DRAG,): drag, (STOP,): stop}
    structures = StructurePosterior(
        tuple(Structure(effects, not effects, p, 0.0, True) for effects, p in table.items()),
        StructurePrior(),
    )

    def refused(*_):
        raise ModelError("not solved here", hint="none")

    monkeypatch.setattr(questions, "structure_fits", refused)
    assembly = SimpleNamespace(corner="", with_corner=lambda corner: None)
    first = SimpleNamespace(base=lambda: None, assembly=assembly)
    loop = SimpleNamespace(
        certain=False, rounds=[SimpleNamespace(ranking=[])], first=first, final=first
    )
    monkeypatch.setattr(questions, "scored_later", lambda _: [])
    policy = SimpleNamespace(proposal_rivals=4)
    plan = SimpleNamespace(numerics=SimpleNamespace(policy=policy, jobs=1), callback=lambda _: None)
    return questions._of_structures(loop, structures, plan)


@pytest.mark.parametrize(("drag", "stop", "worth"), [(0.01, 0.007, False), (0.04, 0.03, True)])
def test_no_run_is_proposed_for_structures_of_which_none_is_likely(monkeypatch, drag, stop, worth):
    assert len(asked(monkeypatch, drag, stop)) == worth


def test_a_question_holds_what_its_structures_have_together(monkeypatch):
    (question,) = asked(monkeypatch, 0.3, 0.2)
    assert question.probability == pytest.approx(0.5)
    assert proposals_entry(question, "m")["probability"] == pytest.approx(0.5)
