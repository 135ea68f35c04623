"""How tests ask whether an object shows itself."""

from __future__ import annotations

import pickle
from html import escape
from typing import Any


def check_shown(item: Any, *texts: str, picture: bool = True) -> None:
    """An object prints as text, shows a table with a small figure, and is the same when pickled."""
    text, page = repr(item), item._repr_html_()
    for wanted in texts:
        assert wanted in text
    assert escape(text.splitlines()[-1]) in page
    assert ("<img" in page) == picture
    assert len(page) < 200_000
    assert repr(pickle.loads(pickle.dumps(item))) == text
