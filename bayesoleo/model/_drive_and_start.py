"""What drives a model, and where it starts: inputs by any channel, initial states of transients.

A rig may control the displacement although the equation of motion is written for a force. The
displacement is then the clean input, and the force is the response. If the controlled channel's
output map is a dof itself, the dof is replaced by the input with its exact derivatives. Otherwise -
an effect acts on the channel - the dof stays and the equation ``y(q, …) = x`` is added.

Where rates of the former input also appear (behind a lagging sensor ``F + tau dot(F) + tau^2 / 2
ddot(F)`` acts), the response ``F`` becomes a dof of that order.

A dof declares its start, its state at a run's first sample, with ``Dof(initial=...)``: an
expression over parameters (so that a start may be estimated, or depend on estimated ones),
conditions, channels as measured at the first sample, and the word ``equilibrium``, the value at
which nothing moves under the inputs of the first sample.

An undeclared start is estimated: it is the measured value, or equilibrium where no channel measures
it, plus an unknown of each transient run (``start_<dof>``), with a prior so weak that the data
decide. The thesis (Verbeek 1993, section 4.2) warns that "poor initial conditions ruin" a
transient; one unknown for each run costs less than that.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import sympy as sp

from bayesoleo.errors import ModelError
from bayesoleo.model._derivatives import derive
from bayesoleo.model._expressions import TIME, derivative_symbol, parse, split_derivative, symbol
from bayesoleo.model._kernels import Structured
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Dof, Output, Parameter
from bayesoleo.model._partial_derivatives import partial

#: An input has exact derivatives of any order; equations need at most this many.
MAXIMUM_DERIVATIVE = 6


def possible_drives(model: Model) -> tuple[str, ...]:
    """Channels that :func:`driven_by` accepts."""
    names = [*model.inputs]
    for channel in model.outputs:
        if _freed_input(model, channel) is not None:
            names.append(channel)
    return tuple(names)


def driven_by(model: Model, channel: str) -> Model:
    """Exchange an input against a measured output.

    Parameters
    ----------
    model : Model
        In its own drive.
    channel : str
        The channel that is to be the input. If it is one already, the model is returned unchanged.

    Returns
    -------
    Model
        With ``channel`` as an input and the former input as an output, under its own name.

    Raises
    ------
    ModelError
        If the exchange has no unique inverse; the message lists the channels that have one.
    """
    if channel in model.inputs:
        return model
    return _driven(Structured(model), channel).with_parameters(**model.parameters)


@lru_cache(maxsize=512)
def _driven(like: Structured, channel: str) -> Model:
    """The same of any model with these equations; parameters and their values stay as they are."""
    model = like.model
    found = _freed_input(model, channel) if channel in model.outputs else None
    if found is None:
        raise ModelError(
            f"model {model.name!r} cannot be driven by {channel!r}",
            hint=f"drive it by one of: {', '.join(possible_drives(model))}",
        )
    dof, freed = found
    if _lags(_orders(model.equation(dof), freed)):
        driven = _exchange_lagging(model, channel, dof, freed)
        measured = model.output(channel)
    else:
        answer = _solve_for_input(model, dof, freed)
        driven = _exchange(model, channel, dof, freed, answer)
        table = {symbol(freed): sp.Add(*answer.values())}
        measured = model.expand(model.output(channel).xreplace(table))
    inverse = _explicit_inverse(model, measured, dof, channel)
    if inverse is not None:
        return _replace_dof(driven, dof, inverse)
    equation = {"measured": measured, "drive": -symbol(channel)}
    # The dof stays close to what is measured: a far better first guess than a static value.
    stays = replace(
        driven.dofs[dof], guess=channel, initial="equilibrium", initial_rate=f"dot({channel})"
    )
    dofs = {**driven.dofs, dof: stays}
    return replace(driven, dofs=dofs, equations={**driven.equations, dof: equation})


def _freed_input(model: Model, channel: str) -> tuple[str, str] | None:
    """The dof that the channel observes and the input that its equation gives up for it."""
    expression = model.output(channel)
    for dof in model.dofs:
        if not expression.has(symbol(dof)):
            continue
        equation = model.equation(dof)
        for name in model.inputs:
            slope = partial(equation, symbol(name))
            linear = slope != 0 and not slope.has(symbol(name))
            if linear and not expression.has(TIME) and _appears_once(model, name, dof, channel):
                return dof, name
    return None


def _appears_once(model: Model, name: str, dof: str, channel: str) -> bool:
    """Whether an input enters the dof's equation only, and the channel itself.

    It may enter the equation with its rates, if linearly and not the channel as well.
    """
    own = _orders(model.equation(dof), name)
    others = [model.equation(other) for other in model.dofs if other != dof]
    others += [model.output(other) for other in model.outputs if other != channel]
    if any(_orders(expression, name) for expression in others):
        return False
    if _lags(own):
        equation = model.equation(dof)
        rates = [partial(equation, derivative_symbol(name, order)) for order in own if order]
        linear = not any(_orders(rate, name) for rate in rates)
        return linear and not _orders(model.output(channel), name)
    return own == {0}


def _lags(orders: set[int]) -> bool:
    """Whether these are derivatives of an input as a lag brings them, up to the second."""
    return orders in ({0, 1}, {0, 1, 2})


def _orders(expression: sp.Expr, name: str) -> set[int]:
    """Orders of the derivatives of a quantity that an expression contains."""
    found = (split_derivative(item) for item in expression.free_symbols)
    return {order for other, order in found if other == name}


def _solve_for_input(model: Model, dof: str, freed: str) -> dict[str, sp.Expr]:
    """The freed input as a sum of named terms: the equation solved for it."""
    item = symbol(freed)
    slope = partial(model.equation(dof), item)
    terms = {}
    for name, term in model.equations[dof].items():
        rest = term.xreplace({item: sp.Integer(0)}) if term.has(item) else term
        if rest != 0:
            terms[name] = -rest / slope
    return terms


def _exchange(
    model: Model, channel: str, dof: str, freed: str, answer: Mapping[str, sp.Expr]
) -> Model:
    """Swap the roles of the two channels; the dof still stands, with its equation given up."""
    unit = model.outputs[channel].unit
    inputs = {name: value for name, value in model.inputs.items() if name != freed} | {
        channel: unit
    }
    outputs = {freed: Output(dict(answer), model.inputs[freed])}
    outputs |= {name: output for name, output in model.outputs.items() if name != channel}
    equations = {**model.equations, dof: {"drive": symbol(dof) - symbol(channel)}}
    return replace(model, inputs=inputs, outputs=outputs, equations=equations)


def _exchange_lagging(model: Model, channel: str, dof: str, freed: str) -> Model:
    """The same where the freed input enters with its rates: the equation rules a new dof."""
    taken = {*model.dofs, *model.inputs, *model.parameters, *model.conditions, *model.definitions}
    state = f"{freed}_answer"
    while state in taken:
        state += "_"
    rates = {derivative_symbol(freed, order): derivative_symbol(state, order) for order in (1, 2)}
    table = {symbol(freed): symbol(state)} | rates
    terms = {name: term.xreplace(table) for name, term in model.equations[dof].items()}
    # The answer takes the state's rates only, so that where these do not count it is as exact
    # as without a state: interpolating the state itself would blur the jumps of dry friction.
    answer = {name: e.xreplace(rates) for name, e in _solve_for_input(model, dof, freed).items()}
    return _exchange(
        model.with_dof(state, Dof(model.inputs[freed]), terms), channel, dof, freed, answer
    )


def _explicit_inverse(model: Model, measured: sp.Expr, dof: str, channel: str) -> sp.Expr | None:
    """The dof as a function of the channel where the map is linear in the dof, else ``None``."""
    slope = sp.diff(measured, symbol(dof))
    rest = sp.expand(measured - slope * symbol(dof))
    moving = {*model.dofs, *model.inputs, TIME.name}
    involved = slope.free_symbols | rest.free_symbols
    if slope == 0 or any(split_derivative(item)[0] in moving for item in involved):
        return None
    return (symbol(channel) - rest) / slope


def _replace_dof(model: Model, dof: str, inverse: sp.Expr) -> Model:
    """Substitute a prescribed motion for a dof and its derivatives everywhere, and drop the dof."""
    (driver,) = (item for item in inverse.free_symbols if item.name in model.inputs)
    slope = sp.diff(inverse, driver)
    table = {symbol(dof): inverse}
    for order in range(1, MAXIMUM_DERIVATIVE):
        table[derivative_symbol(dof, order)] = slope * derivative_symbol(driver.name, order)

    def swap(expression: sp.Expr) -> sp.Expr:
        return expression.xreplace(table)

    return replace(
        model,
        dofs={name: item for name, item in model.dofs.items() if name != dof},
        equations={
            name: {term: swap(e) for term, e in terms.items()}
            for name, terms in model.equations.items()
            if name != dof
        },
        outputs={
            name: replace(
                output, terms={term: swap(e) for term, e in model.output_terms(name).items()}
            )
            for name, output in model.outputs.items()
        },
        definitions={name: swap(e) for name, e in model.definitions.items()},
        admissible=[swap(e) for e in model.admissible],
    )


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


def start_parameters(model: Model) -> frozenset[str]:
    """Parameters on which the starts of dofs depend, and nothing else: a periodic run has none of
    them."""
    declared = set(model.dofs) - set(undeclared_starts(model))
    begins = [start_of(model, name) for name in declared]
    starts = {item.name for one in begins for e in (one.value, one.rate) for item in e.free_symbols}
    alone = starts & set(model.parameters)
    if not alone:
        return frozenset()
    found = derive(model)
    rest = (*found.residual, *found.output, *found.admissible)
    return frozenset(alone - {item.name for e in rest for item in e.free_symbols})


def with_estimated_starts(model: Model, shown: Model | None = None) -> Model:
    """Give every dof whose start is not declared one that is estimated, run by run.

    Parameters
    ----------
    model : Model
    shown : Model, optional
        By whose outputs the probable start of its own dofs is found; by default the model's. An
        error of a sensor that an effect adds leaves a measured start nearly where it was: at rest,
        estimates of that effect would begin far from the motion.

    Returns
    -------
    Model
        With the parameters ``start_<dof>``, and ``start_rate_<dof>`` of dofs of second order: what
        is to be added to where the dof probably starts. Their null is zero. A dof whose rate no
        equation holds has no choice: it starts in equilibrium.
    """
    for name in undeclared_starts(model):
        by = shown if shown is not None and name in shown.dofs else model
        centre, dof = centre_of(by, name), model.dofs[name]
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
