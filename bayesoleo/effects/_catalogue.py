"""The catalogue of built-in effects, their candidates in a model, and their titles.

Sentences for readers use the titles of effects, not their ids.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cache
from typing import Any

from bayesoleo.effects import (
    _damping_and_friction,
    _end_stop,
    _forces,
    _gas,
    _heat,
    _sensors,
    _terms,
)
from bayesoleo.effects._effect import Candidate, Effect
from bayesoleo.effects._parts import Amplitude, Constant, Scales, ShapeParameter
from bayesoleo.errors import InputError, choose
from bayesoleo.model._model import Model

#: The effects of each file, by family.
_EFFECTS = (
    _damping_and_friction.DAMPING_EFFECTS,
    _damping_and_friction.FRICTION_EFFECTS,
    _damping_and_friction.DYNAMIC_FRICTION_EFFECTS,
    _damping_and_friction.STIFFNESS_EFFECTS,
    _end_stop.CONTACT_EFFECTS,
    _terms.EFFECTS,
    _forces.EFFECTS,
    _gas.EFFECTS,
    _heat.EFFECTS,
    _end_stop.COMPLIANCE_EFFECTS,
    _sensors.EFFECTS,
    _sensors.RUN_TO_RUN_EFFECTS,
)


@cache
def catalogue() -> tuple[Effect, ...]:
    """Every built-in effect, by family."""
    return tuple(effect for effects in _EFFECTS for effect in effects)


def find_effect(id: str) -> Effect:  # noqa: A002 - the word that users of a catalogue know
    """The built-in effect of a canonical id.

    Raises
    ------
    InputError
        If there is none; the message names the closest ids.
    """
    known = {effect.id: effect for effect in catalogue()}
    if id not in known:
        raise InputError("unknown effect", value=id, hint=choose(id, known, 3))
    return known[id]


def candidates(
    model: Model,
    scales: Scales,
    effects: Iterable[Effect] | None = None,
    exclude: Collection[str] = (),
) -> list[Candidate]:
    """Every effect at every place of a model where it applies, matters and is not present.

    Parameters
    ----------
    model : Model
        The model in its own drive.
    scales : Scales
        Sizes of the estimated motion.
    effects : iterable of Effect, optional
        Effects in place of the catalogue; extend it with ``[*catalogue(), my_effect]``.
    exclude : collection of str
        Ids of effects to leave out; ``"effect at target"`` leaves out one place.

    Returns
    -------
    list of Candidate
        In the order of the effects, then of their places.
    """
    chosen = catalogue() if effects is None else tuple(effects)
    found = (
        effect.extend(model, target, scales)
        for effect in chosen
        if effect.id not in exclude and effect.fits(scales)
        for target in effect.places(model)
        if f"{effect.id} at {target}" not in exclude and not effect.is_in(model, target)
    )
    return [candidate for candidate in found if _is_felt(candidate)]


def _is_felt(candidate: Candidate) -> bool:
    """Whether the model depends on the new amplitudes, unlike a velocity on a constant offset."""
    model = candidate.model
    expressions = [*model.definitions.values()]
    expressions += [term for terms in model.equations.values() for term in terms.values()]
    expressions += [term for name in model.outputs for term in model.output_terms(name).values()]
    felt = set[str]().union(*({item.name for item in e.free_symbols} for e in expressions))
    return felt.issuperset(candidate.parameters)


def describe(effect: Effect) -> dict[str, Any]:
    """The description of an effect for listings, ready for JSON.

    Returns
    -------
    dict
        ``id``, ``family``, ``title``, ``formula`` (LaTeX), ``parameters`` (name to ``unit``,
        ``latex``, ``description``, ``kind``; of amplitudes ``sign`` and ``null``, of shapes
        ``scan``), ``source``, ``applies_to``. Units are in words of the place: ``force``,
        ``position``, ``channel``, ``parameter``.
    """
    parameters: dict[str, dict[str, Any]] = {}
    for item in effect.amplitudes:
        by_run = "amplitude by run" if item.by_run else "amplitude"
        parameters[item.name] = _entry(item, item.latex, by_run) | {"sign": item.sign, "null": 0.0}
    for shape in effect.shapes:
        scan = getattr(shape.grid, "text", "")
        parameters[shape.name] = _entry(shape, shape.latex, "shape") | {"scan": scan}
    for constant in effect.constants:
        parameters[constant.name] = _entry(constant, "", "constant")
    return {
        "id": effect.id,
        "family": effect.family,
        "title": effect.title,
        "formula": effect.formula,
        "parameters": parameters,
        "source": effect.source,
        "applies_to": effect.applies_to,
    }


def _entry(item: Amplitude | ShapeParameter | Constant, latex: str, kind: str) -> dict[str, Any]:
    return {"unit": item.unit, "latex": latex, "description": item.description, "kind": kind}


#: Proper names, which keep their capital where a title is part of a sentence.
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
    """The name of ``effect`` or ``effect @ target`` in a sentence.

    Parameters
    ----------
    name : str
        An id, with a place or without one.
    titles : mapping of str to str
        Titles by id, in addition to the catalogue; an id without a title becomes words.
    """
    effect, _, place = name.partition(" @ ")
    title = titles.get(effect) or catalogue_titles().get(effect) or effect.replace("_", " ")
    own = f" ({parameter_called(place, titles)})" if place else ""
    return f"{in_sentence(title)}{own}"


def parameter_called(label: str, titles: Mapping[str, str]) -> str:
    """A parameter that an effect brought, by the effect's title: ``breakaway friction, decay``.

    Parameters
    ----------
    label : str
        Of a parameter, or a place; those that do not begin with the id of an effect stay.
    titles : mapping of str to str
        Titles by id, in addition to the catalogue. Ids of one word may be words of a model.
    """
    ids = [one for one in {**catalogue_titles(), **titles} if "_" in one]
    own = [one for one in ids if re.match(rf"{re.escape(one)}(?![^_\[])", label)]
    if not own:
        return label
    effect = max(own, key=len)
    rest = label.removeprefix(effect).replace("_", " ").strip()
    comma = "," if rest and not rest.startswith("[") else ""
    return f"{called(effect, titles)}{comma} {rest}".strip()


def with_titles(text: str, titles: Mapping[str, str]) -> str:
    """A sentence with the ids of effects replaced by their titles.

    Parameters
    ----------
    text : str
    titles : mapping of str to str
        Title by id; only these ids are replaced.
    """
    if not titles:
        return text
    ids = "|".join(map(re.escape, sorted(titles, key=len, reverse=True)))
    pattern = rf"(?<![\w.'-])({ids})(?: @ ([\w.]+(?:[/-][\w.]+)*(?:\[[^\]]*\])?))?(?![\w\[])"

    def words(found: re.Match[str]) -> str:
        return called(f"{found[1]} @ {found[2]}" if found[2] else found[1], titles)

    return re.sub(pattern, words, text)


def listed(names: Sequence[str], last: str = " and ") -> str:
    """``a, b and c``; names that contain a comma are separated by semicolons."""
    comma = "; " if any("," in name for name in names) else ", "
    return last.join(part for part in (comma.join(names[:-1]), *names[-1:]) if part)


def titles_for(ids: Iterable[str], known: Mapping[str, str]) -> dict[str, str]:
    """Title of each id; of ``effect @ target`` that of the effect.

    Parameters
    ----------
    ids : iterable of str
    known : mapping of str to str
        Titles in addition to the catalogue.
    """
    effects = dict.fromkeys(name.split(" @ ")[0] for name in ids)
    found = {name: known.get(name) or catalogue_titles().get(name) for name in effects}
    return {name: title for name, title in found.items() if title}
