"""When the progress of a search is kept."""

import pytest

from bayesoleo.discovery._kept_progress import Kept


def test_progress_is_kept_once_and_not_before_it_is_time():
    """Later progress holds what was left before; what is kept is not kept again."""
    seen = []
    with Kept(seen.append) as kept:
        kept.later("estimate")
        kept.later("first round")
        assert seen == []
        kept.now()
        kept.now()
        assert seen == ["first round"]
        kept.later("second round")
    assert seen == ["first round", "second round"]


def test_what_is_left_is_kept_where_a_search_breaks_off():
    """A result of what was reached is made of it."""
    seen = []

    def search():
        with Kept(seen.append) as kept:
            kept.later("estimate")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        search()
    assert seen == ["estimate"]


def test_what_cannot_be_kept_is_not_tried_again():
    """On leaving it would hide the reason."""
    calls = []

    def fails(known):
        calls.append(known)
        raise OSError("full")

    def search():
        with Kept(fails) as kept:
            kept.later("estimate")
            kept.now()

    with pytest.raises(OSError, match="full"):
        search()
    assert calls == ["estimate"]


def test_a_process_that_nobody_waits_for_keeps_at_once():
    seen = []
    with Kept(seen.append, at_once=True) as kept:
        kept.later("estimate")
        assert seen == ["estimate"]
        kept.later("first round")
        kept.now()
    assert seen == ["estimate", "first round"]
