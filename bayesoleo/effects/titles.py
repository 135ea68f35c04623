"""What effects are called in sentences: by their titles, never by their ids."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from functools import cache

from bayesoleo.effects.catalogue import catalogue

#: Words with which a title begins as a sentence writes them.
PROPER = frozenset({"Coulomb", "Hertzian", "Dahl", "Bouc-Wen", "LuGre", "Stribeck"})
_NONPARAMETRIC = "Nonparametric: "


@cache
def catalogue_titles() -> dict[str, str]:
    """Titles of the catalogue's effects by id; shared, so leave it unchanged."""
    return {effect.id: effect.title for effect in catalogue()}


def in_sentence(title: str) -> str:
    """A title as a part of a sentence: no explanation in brackets or after a colon, and a small
    first letter but for names.

    Parameters
    ----------
    title : str

    Examples
    --------
    >>> in_sentence("Breakaway (Stribeck) friction")
    'breakaway friction'
    >>> in_sentence("Coulomb friction")
    'Coulomb friction'
    """
    text = title.removeprefix(_NONPARAMETRIC).split(":")[0]
    text = " ".join(re.sub(r"\([^)]*\)", "", text).split()) or title
    first = text.split()[0]
    kept = first in PROPER or first[1:] != first[1:].lower() or (len(first) == 1 and first != "A")
    return text if kept else text[0].lower() + text[1:]


def called(name: str, titles: Mapping[str, str]) -> str:
    """What ``effect`` or ``effect @ target`` is called in a sentence.

    Parameters
    ----------
    name : str
        An id, with a place or without one.
    titles : mapping of str to str
        Title by id, besides those of the catalogue; an id without one becomes words.
    """
    effect, _, place = name.partition(" @ ")
    title = titles.get(effect) or catalogue_titles().get(effect) or effect.replace("_", " ")
    return f"{in_sentence(title)} ({place})" if place else in_sentence(title)


def with_titles(text: str, titles: Mapping[str, str]) -> str:
    """A sentence with the ids of effects replaced by what they are called.

    Parameters
    ----------
    text : str
    titles : mapping of str to str
        Title by id; only these ids are replaced.
    """
    if not titles:
        return text
    ids = "|".join(map(re.escape, sorted(titles, key=len, reverse=True)))
    pattern = rf"(?<![\w.'-])({ids})(?: @ ([\w.]+(?:\[[^\]]*\])?))?(?![\w\[])"

    def words(found: re.Match[str]) -> str:
        return called(f"{found[1]} @ {found[2]}" if found[2] else found[1], titles)

    return re.sub(pattern, words, text)


def listed(names: Sequence[str], last: str = " and ") -> str:
    """``a, b and c``; names that hold a comma are kept apart by semicolons."""
    comma = "; " if any("," in name for name in names) else ", "
    return last.join(part for part in (comma.join(names[:-1]), *names[-1:]) if part)


def titles_for(ids: Iterable[str], known: Mapping[str, str]) -> dict[str, str]:
    """Title of each id; of ``effect @ target`` that of the effect.

    Parameters
    ----------
    ids : iterable of str
    known : mapping of str to str
        Titles besides those of the catalogue.
    """
    effects = dict.fromkeys(name.split(" @ ")[0] for name in ids)
    found = {name: known.get(name) or catalogue_titles().get(name) for name in effects}
    return {name: title for name, title in found.items() if title}
