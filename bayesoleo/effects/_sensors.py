"""Sensor effects (offset, gain, lag, drift, saturation), and run-to-run parameters.

A channel shows :math:`m` where the model says :math:`y`. For an output the effect changes the
expression. For an input, which *is* the measured value, the true quantity of the model is computed
from it.

A run-to-run effect lets a parameter vary that the model holds constant over the runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import sympy as sp

from bayesoleo.effects._effect import BY_RUN, Effect, Names, either_side, free_name
from bayesoleo.effects._nonparametric import COEFFICIENT
from bayesoleo.effects._parts import (
    HIGHEST_LINE,
    Amplitude,
    Constant,
    Scales,
    Scan,
    ShapeParameter,
    geometric,
    period_grid,
)
from bayesoleo.effects._places import is_quantity, substitute
from bayesoleo.model._drive_and_start import MAXIMUM_DERIVATIVE, possible_drives
from bayesoleo.model._expressions import (
    TIME,
    WITHIN,
    derivative_symbol,
    extreme,
    split_derivative,
    symbol,
    total_derivative,
    with_symbols_as,
)
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Dof
from bayesoleo.model._partial_derivatives import partial


def _shared(model: Model) -> Sequence[str]:
    """Estimated parameters that all runs share, but for constants known to a tolerance: these are
    the same in all runs. A curve's coefficients mean nothing alone."""
    free = {n: item for n, item in model.parameters.items() if not item.fixed}
    shared = {n: item for n, item in free.items() if not item.by_run}
    return tuple(n for n, item in shared.items() if not item.description.startswith(COEFFICIENT))


def _vary(model: Model, target: str, names: Names) -> Model:
    shared = symbol(target)
    return substitute(model, {shared: shared + names["varies_by_run"]})


# The deviations and the shared value are determined up to a constant only; the priors of the
# deviations, centred on zero, decide it.
VARIES = Effect(
    id="varies_by_run",
    family="run-to-run",
    title="A parameter that differs from run to run",
    formula=r"\theta + \delta_r",
    amplitudes=(
        Amplitude(
            "varies_by_run",
            "parameter",
            r"\delta_r",
            "deviation from the shared value",
            by_run=True,
        ),
    ),
    places=_shared,
    change=_vary,
    source=BY_RUN,
    applies_to="estimated parameters",
    own_name_per_target=True,
)

RUN_TO_RUN_EFFECTS = (VARIES,)


_DERIVATIVES = 4
# Of a motion that lags by a thirtieth of its period 2 % are missing without the second order in the
# lag, 0.2 % without the third.
_SERIES = 3
VOCABULARY = "JCGM 200:2012, International vocabulary of metrology"


def _channels(model: Model) -> Sequence[str]:
    return (*(name for name in model.inputs if WITHIN not in name), *model.outputs)


def _correct_input(
    model: Model, channel: str, true: Callable[[sp.Expr, sp.Expr], sp.Expr]
) -> Model:
    """Replace an input and its derivatives by ``true(x, dx/dt)`` and the derivatives of that."""
    table = {}
    for order in range(MAXIMUM_DERIVATIVE):
        now, next_ = (derivative_symbol(channel, order + more) for more in (0, 1))
        shown = true(now, next_)
        # A constant offset leaves derivatives alone.
        table[now] = shown if order == 0 else shown - true(sp.Integer(0), sp.Integer(0))
    return substitute(model, table)


def _offset(model: Model, channel: str, names: Names) -> Model:
    ((name, offset),) = names.items()
    if channel in model.inputs:
        return _correct_input(model, channel, lambda x, rate: x - offset)
    return model.with_term("output", channel, name, offset)


def _gain(model: Model, channel: str, names: Names) -> Model:
    gain = names["sensor_gain"]
    if channel in model.inputs:
        return _correct_input(model, channel, lambda x, rate: x / (1 + gain))
    whole = sp.Add(*model.output_terms(channel).values())
    return model.with_term("output", channel, "sensor_gain", gain * whole)


def _gauges(model: Model) -> Sequence[str]:
    """Outputs that show a pressure above the declared ambient one."""
    ambient = symbol("ambient_pressure")
    if not is_quantity(model, ambient.name):
        return ()
    shown = {name: model.expand(model.output(name)) for name in model.outputs}
    return tuple(name for name, expression in shown.items() if sp.diff(expression, ambient) == -1)


def _absolute_gain(model: Model, channel: str, names: Names) -> Model:
    """The sensor amplifies the absolute pressure, of whose reading the ambient one is taken off."""
    whole = sp.Add(*model.output_terms(channel).values()) + symbol("ambient_pressure")
    return model.with_term(
        "output", channel, "absolute_pressure_gain", names["absolute_pressure_gain"] * whole
    )


def _lag(model: Model, channel: str, names: Names) -> Model:
    lag = names["sensor_lag"]
    if channel in model.inputs:
        orders = range(MAXIMUM_DERIVATIVE - 1)
        table = {derivative_symbol(channel, k): _later(channel, k, lag, 2) for k in orders}
        return substitute(model, table)
    shown = model.output(channel)
    return model.with_term("output", channel, "sensor_lag", _before(model, shown, lag) - shown)


def _before(model: Model, expression: sp.Expr, lag: sp.Expr) -> sp.Expr:
    """An expression as it was ``lag`` ago.

    What it depends on is taken back along its series, not the expression along its own: a motion is
    smooth where the dry friction that follows it switches within the lag.
    """
    moving = _moving(model)
    earlier = {TIME: TIME - lag}
    for item in expression.free_symbols:
        name, order = split_derivative(item)
        if name in moving:
            # A dof has the derivatives that its equations determine, an input those above noise.
            highest = model.order(name) if name in model.dofs else _DERIVATIVES
            known = max(highest - order, 1)
            earlier[item] = _later(name, order, -lag, known)
            if highest == 1 and order == 0:
                earlier[item] += lag**2 / 2 * _acceleration(model, name)
    return with_symbols_as(expression, earlier)


def _acceleration(model: Model, dof: str) -> sp.Expr:
    """Second derivative of a dof of first order, by its equation; zero where that does not say."""
    balance = model.expand(sp.Add(*model.equations[dof].values()))
    rate = derivative_symbol(dof, 1)
    storage = partial(balance, rate)
    if storage == 0 or storage.has(rate):
        return sp.Integer(0)
    held = sp.Dummy("rate", real=True)
    change = total_derivative(balance.xreplace({rate: held}), _moving(model)).xreplace({held: rate})
    return -change / storage if _exists(model, change) else sp.Integer(0)


def _moving(model: Model) -> tuple[str, ...]:
    return (*model.dofs, *model.inputs)


def _later(name: str, order: int, ahead: sp.Expr, known: int) -> sp.Expr:
    """A derivative as it will be, by a series in the ``known`` derivatives above it."""
    terms = range(min(known, _SERIES) + 1)
    return sp.Add(
        *(ahead**k / math.factorial(k) * derivative_symbol(name, order + k) for k in terms)
    )


def _follow(model: Model, channel: str, names: Names) -> Model:
    """A part of what the sensor shows follows its input: tau ds/dt + s = y."""
    shown, dof = model.output(channel), free_name(f"{channel}_reading", model)
    late = symbol(dof)
    equation = {
        "storage": names["time_constant"] * derivative_symbol(dof, 1),
        "reading": late,
        "input": -shown,
    }
    state = Dof(
        model.outputs[channel].unit, 0.0, "what the sensor shows of the channel", "equilibrium"
    )
    term = names["first_order_lag"] * (late - shown)
    model = model.with_dof(dof, state, equation)
    return model.with_term("output", channel, "first_order_lag", term)


def _rate(model: Model, channel: str) -> sp.Expr:
    return total_derivative(model.output(channel), _moving(model))


def _exists(model: Model, rate: sp.Expr) -> bool:
    """Whether dofs have the derivatives in it: an output that shows an acceleration has no rate."""
    found = map(split_derivative, rate.free_symbols)
    return all(name not in model.dofs or order <= model.order(name) for name, order in found)


def _laggable(model: Model) -> Sequence[str]:
    """Channels whose rate exists."""
    return tuple(
        name
        for name in _channels(model)
        if name in model.inputs or _exists(model, _rate(model, name))
    )


def _drift(model: Model, channel: str, names: Names) -> Model:
    return model.with_term("output", channel, "sensor_drift", names["sensor_drift"] * TIME)


def _driftable(model: Model) -> Sequence[str]:
    """Outputs that can not be an input: a periodic state cannot follow what drifts."""
    return tuple(name for name in model.outputs if name not in possible_drives(model))


def _sensor(
    id: str,  # noqa: A002
    title: str,
    formula: str,
    unit: str,
    latex: str,
    places: Callable[[Model], Sequence[str]],
    change: Callable[[Model, str, Names], Model],
    term: str,
    side: Callable[[Model, str], int] = either_side,
) -> Effect:
    return Effect(
        id=id,
        family="sensor",
        title=title,
        formula=formula,
        amplitudes=(Amplitude(id, unit, latex, title[0].lower() + title[1:]),),
        places=places,
        change=change,
        source=f"{VOCABULARY}, {term}",
        applies_to="outputs" if id == "sensor_drift" else "every channel",
        own_name_per_target=True,
        side=side,
    )


OFFSET = _sensor(
    "sensor_offset",
    "Offset of a sensor",
    "m = y + b",
    "channel",
    "b",
    _channels,
    _offset,
    "4.20: instrumental bias",
)
# A sensor that is set to zero before each run, or drifts between runs.
OFFSET_BY_RUN = replace(
    OFFSET,
    id="sensor_offset_by_run",
    title="Offset of a sensor, different in every run",
    formula="m = y + b_r",
    amplitudes=(
        Amplitude(
            "sensor_offset_by_run", "channel", "b_r", "offset of the sensor in the run", by_run=True
        ),
    ),
    source=BY_RUN,
)
GAIN = _sensor(
    "sensor_gain",
    "Gain error of a sensor",
    "m = (1 + g) y",
    "",
    "g",
    _channels,
    _gain,
    "4.12: sensitivity",
)
LAG = _sensor(
    "sensor_lag",
    "Lag of a sensor, channels misaligned in time (a short delay)",
    r"m(t) = y(x(t - \tau)), x(t - \tau) \approx x - \tau \dot x + \frac{1}{2} \tau^2 \ddot x",
    "s",
    r"\tau",
    _laggable,
    _lag,
    "4.23: step response time",
    # A channel that leads is one beside which the others lag.
    lambda model, channel: 1,
)
# The time constant is a shape: at the null of a time constant a long lag looks like a short delay.
# A part below zero would be a sensor that leads: what relaxes in the process, such as a gas that
# loses heat, looks like that.
FIRST_ORDER_LAG = Effect(
    id="first_order_lag",
    family="sensor",
    title="First-order lag of a sensor (of any length)",
    formula=r"m = y + a (w - y), \quad \tau \dot w + w = y",
    amplitudes=(
        Amplitude("first_order_lag", "", "a", "part that lags; one where the whole sensor does", 1),
    ),
    places=lambda model: tuple(model.outputs),
    change=_follow,
    shapes=(
        ShapeParameter(
            "time_constant", "s", r"\tau", "time constant of the lag", period_grid(1 / 16, 1 / 2)
        ),
    ),
    source=f"{VOCABULARY}, 4.23: step response time",
    applies_to="outputs",
    own_name_per_target=True,
)
ABSOLUTE_GAIN = replace(
    _sensor(
        "absolute_pressure_gain",
        "Gain error of a gauge that senses the absolute pressure",
        "m + p_a = (1 + g) (y + p_a)",
        "",
        "g",
        _gauges,
        _absolute_gain,
        "4.12: sensitivity",
    ),
    applies_to="outputs that show a pressure above ``ambient_pressure``",
)
DRIFT = _sensor(
    "sensor_drift",
    "Drift of a sensor, or of a force",
    "m = y + d t",
    "channel/s",
    "d",
    _driftable,
    _drift,
    "4.21: instrumental drift",
)


def _hum(model: Model, channel: str, names: Names) -> Model:
    turn = 2 * sp.pi * names["frequency"] * TIME
    shown = names["cosine"] * sp.cos(turn) + names["sine"] * sp.sin(turn)
    return model.with_term("output", channel, "sensor_hum", shown)


# In a force law a force that hums is the same.
HUM = Effect(
    id="sensor_hum",
    family="sensor",
    title="Hum of a sensor, at a frequency of its own",
    formula=r"m = y + a_r \cos 2 \pi f_h t + b_r \sin 2 \pi f_h t",
    amplitudes=tuple(
        Amplitude(part, "channel", f"{letter}_r", f"{part} part of a hum, by run", by_run=True)
        for part, letter in (("cosine", "a"), ("sine", "b"))
    ),
    places=lambda model: tuple(model.outputs),
    change=_hum,
    shapes=(ShapeParameter("frequency", "Hz", "f_h", "frequency of a hum", HIGHEST_LINE),),
    source="Fisher (1929), Proc. R. Soc. A 125, 54-59, for the line that it starts from",
    applies_to="outputs, in transient runs with a line that no input has",
    own_name_per_target=True,
    kind="transient",
    shown=lambda scales: scales.dominant_frequency is not None,
)


# -- saturation ------------------------------------------------------------------------------------


def _extreme(end: int) -> Callable[[Model, str, Scales], float]:
    return lambda model, target, scales: _range(target, scales)[end]


def _range(channel: str, scales: Scales) -> tuple[float, float]:
    return scales.output_range.get(channel, (-1.0, 1.0))


def _depth_grid(model: Model, channel: str, scales: Scales) -> tuple[float, ...]:
    """From a level just inside the highest value measured to one a quarter of the range inside."""
    low, high = _range(channel, scales)
    return geometric((high - low) / 256, (high - low) / 4)


_DEPTH = Scan(_depth_grid, "1/256 to 1/4 of the range measured")


def _saturation(side: str) -> Effect:
    """Beyond a level only a part of what is to be measured is shown; of a clipped channel none.

    The level is stated as its depth inside the extreme value measured, so that it is positive.
    """
    upper = side == "upper"
    id_ = f"sensor_saturation_{side}"

    def saturate(model: Model, channel: str, names: Names) -> Model:
        whole = sp.Add(*model.output_terms(channel).values())
        inside = names["extreme"] - names["depth"] if upper else names["extreme"] + names["depth"]
        beyond = extreme(sp.Max if upper else sp.Min, whole - inside, sp.Integer(0))
        return model.with_term("output", channel, id_, -names[id_] * beyond)

    beyond_level = (
        r"- s \, \max(y - m_\mathrm{max} + h, 0)"
        if upper
        else r"+ s \, \max(m_\mathrm{min} + h - y, 0)"
    )
    word = "highest" if upper else "lowest"
    return Effect(
        id=id_,
        family="sensor",
        title=f"Sensor that saturates at its {side} end",
        formula=f"m = y {beyond_level}",
        amplitudes=(
            Amplitude(id_, "", "s", "part that is not shown; one where the channel is clipped", 1),
        ),
        places=lambda model: tuple(model.outputs),
        change=saturate,
        source=f"{VOCABULARY}, 4.7: measuring interval",
        shapes=(
            ShapeParameter(
                "depth", "channel", "h", f"distance from the {word} value measured", _DEPTH
            ),
        ),
        constants=(
            Constant("extreme", "channel", f"{word} value measured", _extreme(1 if upper else 0)),
        ),
        applies_to="outputs",
        own_name_per_target=True,
    )


EFFECTS = (
    OFFSET,
    OFFSET_BY_RUN,
    GAIN,
    ABSOLUTE_GAIN,
    LAG,
    FIRST_ORDER_LAG,
    DRIFT,
    HUM,
    _saturation("upper"),
    _saturation("lower"),
)
