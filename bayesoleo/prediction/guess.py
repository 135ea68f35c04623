"""A first guess of a periodic motion: measured where a dof is measured, declared otherwise."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import cast

import numpy as np
import sympy as sp

from bayesoleo._types import Array
from bayesoleo.model import Model
from bayesoleo.model.derive import Derived
from bayesoleo.model.expressions import (
    derivative_symbol,
    parse,
    split_derivative,
    symbol,
    total_derivative,
)
from bayesoleo.prediction.inputs import harmonics_of
from bayesoleo.prediction.records import Record

#: Known motion of a dof: its values and derivatives, shape (rows, N), at phases in cycles.
Motion = Callable[[Array], Array]
#: Rows of channels at fixed phases, by channel and derivative: they depend on no parameter.
KnownRows = dict[tuple[str, int], Array]


def guess_rows(
    model: Model,
    derived: Derived,
    record: Record,
    constants: Mapping[str, float],
    phase: Array,
    motions: Mapping[str, Motion] | None = None,
    known_rows: KnownRows | None = None,
) -> Array:
    """Values and derivatives of every dof, shape (nz, N): known motions before guesses.

    With ``known_rows``, of the same record and phases, channels are evaluated once only.
    """
    rows: list[Array] = []
    for dof, order in zip(derived.dofs, derived.orders, strict=True):
        if motions is not None and dof in motions:
            known = motions[dof](phase)
            if known.shape[0] == order + 1:
                rows.extend(known)
                continue
        expression = _measured(model, dof, record) or _declared(model, dof)
        for _ in range(order + 1):
            rows.append(_evaluate(expression, record, constants, phase, known_rows))
            expression = total_derivative(expression, list(record.harmonics))
    return np.stack(rows) if rows else np.empty((0, phase.size))


def _measured(model: Model, dof: str, record: Record) -> sp.Expr | None:
    """The channel that measures a dof directly, if there is one."""
    for channel in model.outputs:
        if model.output(channel) == symbol(dof) and channel in record.harmonics:
            return symbol(channel)
    return None


def _declared(model: Model, dof: str) -> sp.Expr:
    known = {name: symbol(name) for name in (*model.parameters, *model.conditions, *model.inputs)}
    return parse(
        model.dofs[dof].guess, known, model.inputs, f"model {model.name!r}, guess of {dof!r}"
    )


def _evaluate(
    expression: sp.Expr,
    record: Record,
    constants: Mapping[str, float],
    phase: Array,
    known_rows: KnownRows | None,
) -> Array:
    function, items = _compiled(expression)
    found: KnownRows = {} if known_rows is None else known_rows
    columns = []
    for item in items:
        channel, order = split_derivative(item)
        if channel in record.harmonics:
            assert item == derivative_symbol(channel, order)
            if (channel, order) not in found:
                item = harmonics_of(record, channel).for_derivative(order)
                found[channel, order] = item.evaluate(phase, record.frequency, order)
            columns.append(found[channel, order])
        else:
            columns.append(np.asarray(constants[channel]))
    return cast(Array, np.zeros(phase.size) + np.asarray(function(*columns), dtype=float))


@lru_cache(maxsize=256)
def _compiled(expression: sp.Expr) -> tuple[Callable[..., Array], tuple[sp.Symbol, ...]]:
    """A guess as a function of its symbols: the same for every run, and slow to make."""
    items = tuple(sorted(expression.free_symbols, key=str))
    return sp.lambdify(items, expression, "numpy"), items
