"""Settings given as keywords of a step."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

from bayesoleo.errors import InputError
from bayesoleo.workflow.settings import Settings

#: Settings that may still be changed when the posterior is sampled, and in a search.
SAMPLING = ("seed", "jobs", "quick", "effective_size", "scheduler")
SEARCHING = ("seed", "jobs", "quick", "scheduler", "max_effects", "effects", "without")


def changed(
    settings: Settings, keywords: Mapping[str, Any], allowed: Sequence[str] | None = None
) -> Settings:
    """Settings with some of them changed.

    Parameters
    ----------
    settings : Settings
    keywords : mapping of str to object
        New values.
    allowed : sequence of str, optional
        Names that may be changed; by default all.

    Raises
    ------
    InputError
        If there is no such setting, or it belongs to an earlier step.
    """
    known = [item.name for item in fields(Settings)]
    for name, value in keywords.items():
        if name not in known:
            near = difflib.get_close_matches(name, allowed or known, 1)
            hint = f"did you mean {near[0]}?" if near else f"use {', '.join(allowed or known)}"
            raise InputError("there is no such setting", key=name, value=value, hint=hint)
        if allowed is not None and name not in allowed:
            raise InputError(
                "cannot be changed at this step", key=name, value=value,
                hint=f"give it to the problem: bo.Problem(…, {name}={value!r})",
            )  # fmt: skip
    given: dict[str, Any] = {}
    for name, value in keywords.items():
        given[name] = tuple(value) if isinstance(value, list) else value
    return replace(settings, **given)
