"""What is said of a search that follows another first effect."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from bayesoleo.discovery import _alternatives as beam
from bayesoleo.discovery._round import Progress

TRIED, ROLES = "play was removed again", "run b is held out"


def ended(*effects: str, notes: tuple[str, ...] = ()) -> Progress:
    """A finished search with these effects, as far as notes ask for it."""
    assembly = SimpleNamespace(added=tuple((effect, "stroke") for effect in effects))
    return Progress(None, SimpleNamespace(assembly=assembly, at_floor=False), (), notes)


@pytest.mark.parametrize("notes", [(TRIED,), (ROLES, TRIED)])
def test_what_befell_one_search_is_not_said_of_another(monkeypatch, notes):
    """The note on the roles holds for both."""
    monkeypatch.setattr(beam, "confirmed", lambda *_: (SimpleNamespace(), "it explains more"))
    opening = SimpleNamespace(before=None, ranking=(), failed={}, tests=1.0, accepted=None)
    progress = Progress(None, ended("play").state, (opening,), notes)
    first = SimpleNamespace(refit=SimpleNamespace())
    roles = SimpleNamespace(description=ROLES)
    found = beam._followed(progress, first, roles, None, lambda other, _: other, 4, print)
    assert found.notes == tuple(note for note in notes if note == ROLES)


def test_a_model_that_leaves_more_is_not_said_to_leave_less():
    """Causes go before what merely varies from run to run, at a small price."""
    told = [
        beam._with_notes(ended("offset"), ended("play"), gap, print).notes[-1]
        for gap in (12.0, -3.0)
    ]
    assert "instead of offset the model has play" in told[0]
    assert told[0].endswith("falls by 12")
    assert told[1].endswith("rises by 3 only, and they name causes")
