"""Initial states of transients: the state of a model at a run's first sample.

A dof declares its start with ``Dof(initial=...)``: an expression over parameters (so that a start
may be estimated, or depend on estimated ones), conditions, channels as measured at the first
sample, and the word ``equilibrium``, the value at which nothing moves under the inputs of the first
sample.

An undeclared start is estimated: it is the measured value, or equilibrium where no channel measures
it, plus an unknown of each transient run (``start_<dof>``), with a prior so weak that the data
decide. The thesis (Verbeek 1993, section 4.2) warns that "poor initial conditions ruin" a
transient; one unknown for each run costs less than that.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import sympy as sp

from bayesoleo.errors import ModelError
from bayesoleo.model._expressions import derivative_symbol, parse, symbol
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Dof, Parameter

#: The value at which nothing moves, in an initial expression.
EQUILIBRIUM = "equilibrium"
#: How names of estimated starts begin.
START, START_RATE = "start_", "start_rate_"
#: Standard deviation of the prior of an estimated start over the dof's typical size.
WIDTH = 1.0


@dataclass(frozen=True)
class Start:
    """The start of one dof.

    Parameters
    ----------
    value, rate : sympy.Expr
        Over parameters, conditions, channels with their derivatives, and :data:`EQUILIBRIUM`
        (``value`` only). ``rate`` is of use for a dof of second order.
    """

    value: sp.Expr
    rate: sp.Expr

    @property
    def from_rest(self) -> bool:
        """Whether the equilibrium has to be known."""
        return bool(self.value.has(symbol(EQUILIBRIUM)))


def start_of(model: Model, dof: str) -> Start:
    """Parse how a dof starts; what is not declared is at its centre, see :func:`centre_of`.

    Raises
    ------
    ModelError
        If an expression uses a name that has no value at the start.
    """
    declared = model.dofs[dof]
    centre = centre_of(model, dof)
    value = centre.value if declared.initial is None else _parsed(model, dof, declared.initial)
    rate = sp.Integer(0) if declared.initial is not None else centre.rate
    if declared.initial_rate is not None:
        rate = _parsed(model, dof, declared.initial_rate)
    if rate.has(symbol(EQUILIBRIUM)):
        raise ModelError(
            f"model {model.name!r}, initial_rate of {dof!r}: nothing moves in equilibrium",
            value=declared.initial_rate,
            hint="write initial_rate=0, or leave it out",
        )
    return Start(value, rate)


def centre_of(model: Model, dof: str) -> Start:
    """The probable start of a dof: as measured if a channel is the dof itself, else at rest."""
    for channel in model.outputs:
        if model.output(channel) == symbol(dof):
            return Start(symbol(channel), derivative_symbol(channel, 1))
    return Start(symbol(EQUILIBRIUM), sp.Integer(0))


def _parsed(model: Model, dof: str, text: str | float | sp.Expr) -> sp.Expr:
    channels = (*model.inputs, *model.outputs)
    names = (*model.parameters, *model.conditions, *channels, EQUILIBRIUM)
    where = f"model {model.name!r}, initial value of {dof!r}"
    return parse(text, {name: symbol(name) for name in names}, channels, where)


def with_starts(model: Model, swap: Callable[[sp.Expr], sp.Expr]) -> dict[str, Dof]:
    """The dofs with their declared starts rewritten, as effects rewrite equations."""
    changed = dict(model.dofs)
    for name, dof in model.dofs.items():
        if dof.initial is not None:
            changed[name] = replace(changed[name], initial=swap(_parsed(model, name, dof.initial)))
        if dof.initial_rate is not None:
            rate = swap(_parsed(model, name, dof.initial_rate))
            changed[name] = replace(changed[name], initial_rate=rate)
    return changed


def undeclared_starts(model: Model) -> tuple[str, ...]:
    """Dofs whose start is to be estimated."""
    return tuple(
        name for name, dof in model.dofs.items() if dof.initial is None and dof.initial_rate is None
    )


def with_estimated_starts(model: Model) -> Model:
    """Give every dof whose start is not declared one that is estimated, run by run.

    Returns
    -------
    Model
        With the parameters ``start_<dof>``, and ``start_rate_<dof>`` of dofs of second order: what
        is to be added to where the dof probably starts. Their null is zero. A dof whose rate no
        equation holds has no choice: it starts in equilibrium.
    """
    for name in undeclared_starts(model):
        centre, dof = centre_of(model, name), model.dofs[name]
        if not _has_rate(model, name):
            model = replace(model, dofs={**model.dofs, name: replace(dof, initial=EQUILIBRIUM)})
            continue
        new = {START + name: _estimated(model, name, dof.unit, "start")}
        value = centre.value + symbol(START + name)
        rate: sp.Expr = centre.rate
        if model.order(name) == 2:
            unit = f"{dof.unit}/s" if dof.unit else "1/s"
            new[START_RATE + name] = _estimated(model, name, unit, "start velocity")
            rate = rate + symbol(START_RATE + name)
        started = replace(dof, initial=value, initial_rate=rate)
        model = replace(
            model,
            dofs={**model.dofs, name: started},
            parameters={**model.parameters, **new},
        )
    return model


def _has_rate(model: Model, name: str) -> bool:
    found = {item for dof in model.dofs for item in model.equation(dof).free_symbols}
    return any(derivative_symbol(name, order) in found for order in (1, 2))


def _estimated(model: Model, name: str, unit: str, what: str) -> Parameter:
    return Parameter(
        0.0,
        unit,
        sd=WIDTH * _typical_size(model, name),
        by_run=True,
        description=f"{what} of {name}, beyond what is measured or at rest",
    )


def _typical_size(model: Model, name: str) -> float:
    """Size of the declared guess at nominal values; one in the SI unit where that says nothing."""
    guess = model.dofs[name].guess
    known = (*model.parameters, *model.conditions, *model.inputs)
    where = f"model {model.name!r}, guess of {name!r}"
    parsed = parse(guess, {item: symbol(item) for item in known}, model.inputs, where)
    number = parsed.subs(model.nominal())
    return abs(float(number)) if number.is_number and abs(float(number)) > 0 else 1.0
