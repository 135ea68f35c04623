"""The effects that come with the package, and every candidate they make of a model."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Iterable
from functools import cache
from typing import Any

from bayesoleo.effects import (
    compliance,
    contact,
    damping,
    force,
    friction,
    gas,
    memory,
    run_to_run,
    sensor,
    stiffness,
    thermal,
)
from bayesoleo.effects.effect import Candidate, Effect
from bayesoleo.effects.parts import Amplitude, Constant, Scales, ShapeParameter
from bayesoleo.errors import InputError
from bayesoleo.model import Model

_MODULES = (
    damping,
    friction,
    memory,
    stiffness,
    contact,
    force,
    gas,
    thermal,
    compliance,
    sensor,
    run_to_run,
)


@cache
def catalogue() -> tuple[Effect, ...]:
    """Every built-in effect, by family."""
    return tuple(effect for module in _MODULES for effect in module.EFFECTS)


def find_effect(id: str) -> Effect:  # noqa: A002 - the word that users of a catalogue know
    """The built-in effect of a canonical id.

    Raises
    ------
    InputError
        If there is none; the message names the closest ids.
    """
    known = {effect.id: effect for effect in catalogue()}
    if id not in known:
        close = difflib.get_close_matches(id, known, 3)
        hint = f"did you mean {' or '.join(close)}?" if close else f"known: {', '.join(known)}"
        raise InputError("unknown effect", value=id, hint=hint)
    return known[id]


def candidates(
    model: Model,
    scales: Scales,
    effects: Iterable[Effect] | None = None,
    exclude: Collection[str] = (),
) -> list[Candidate]:
    """Every effect at every place of a model where it applies, matters and is not in yet.

    Parameters
    ----------
    model : Model
        In its own drive.
    scales : Scales
        Sizes of the estimated motion.
    effects : iterable of Effect, optional
        Instead of the catalogue; add to it with ``[*catalogue(), my_effect]``.
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
    """Whether anything depends on the new amplitudes: a constant offset of a velocity does not."""
    model = candidate.model
    expressions = [*model.definitions.values()]
    expressions += [term for terms in model.equations.values() for term in terms.values()]
    expressions += [term for name in model.outputs for term in model.output_terms(name).values()]
    felt = set[str]().union(*({item.name for item in e.free_symbols} for e in expressions))
    return felt.issuperset(candidate.parameters)


def describe(effect: Effect) -> dict[str, Any]:
    """What a listing says of an effect, ready for JSON.

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
