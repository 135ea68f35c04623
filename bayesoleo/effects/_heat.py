"""Thermal effects: heat of the gas into the wall and into the oil.

Beyond the names of a gas spring, a model with heat exchange declares the dof ``temperature`` (of
the gas, K) and the definitions ``heat_loss`` and ``gas_power`` (W), which its equation contains.
Wall and oil add one dof each: their temperature above the ambient.

References
----------
Verbeek (1993), eq. 6.4 and sections 6.4.2 and 7.3.
"""

from __future__ import annotations

from collections.abc import Sequence

import sympy as sp

from bayesoleo.effects._effect import Effect, Names, free_name
from bayesoleo.effects._gas import as_gas_spring, has_gas, of_gas, volume_ratio_rate
from bayesoleo.effects._parts import (
    Amplitude,
    Constant,
    Scales,
    Scan,
    ShapeParameter,
    geometric,
    period_grid,
    values,
)
from bayesoleo.effects._places import is_quantity
from bayesoleo.model._expressions import derivative_symbol, symbol
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Dof

SPECIFIC_HEAT_NITROGEN = 743.0  # J/(kg K), at constant volume
GAS_CONSTANT_NITROGEN = 296.8  # J/(kg K)

# Values where neither model nor runs state a number: a gas spring of a litre.
_STANDARD = {"initial_pressure": 1e6, "initial_volume": 1e-3, "ambient_temperature": 293.15}
_THERMAL = ("temperature", "heat_loss", "gas_power", "heat_capacity")


def _power(model: Model, pressure: sp.Expr) -> sp.Expr:
    """Power of a pressure on the shrinking gas, ``-p dV/dt``."""
    return -pressure * symbol("initial_volume") * volume_ratio_rate(model)


# -- heat exchange of a polytropic gas -------------------------------------------------------------


def _polytropic(model: Model) -> Sequence[str]:
    needed = ("initial_volume", "initial_pressure", "ambient_temperature")
    model = as_gas_spring(model)
    if not has_gas(model, "temperature_ratio", *needed) or any(
        is_quantity(model, name) for name in _THERMAL
    ):
        return ()
    isothermal = model.expand(symbol("temperature_ratio")) == 1
    return ("temperature_ratio",) if isothermal else ()


def _nominal_capacity(model: Model, scales: Scales) -> float:
    """Heat capacity of the gas at nominal values, J/K. Conditions have their mean over the runs."""
    nominal = {item.name: value for item, value in model.nominal().items()}
    stated = {**_STANDARD, **scales.conditions, **nominal}
    gas = stated["initial_pressure"] * stated["initial_volume"] / stated["ambient_temperature"]
    return gas * SPECIFIC_HEAT_NITROGEN / GAS_CONSTANT_NITROGEN


def _conduction_grid(model: Model, target: str, scales: Scales) -> tuple[float, ...]:
    """Conductions whose time constants cover the range that the runs can show."""
    capacity = _nominal_capacity(model, scales)
    slow, fast = 3 * scales.longest_period, scales.shortest_period / 30
    return geometric(capacity / slow, capacity / fast)


#: Time constants of the gas from a thirtieth of the shortest period to three of the longest.
_CONDUCTION = Scan(
    _conduction_grid, "time constants 1/30 of the shortest period to 3 times the longest"
)
#: From a wall that hardly shrinks to one that shrinks with the gas.
_SWEPT = values(0.25, 0.5, 1.0)


def _exchange_heat(model: Model, target: str, names: Names) -> Model:
    """Write p = p0 (T/T0) v^-n, and heat the gas by a fraction kappa of the work done on it.

    With kappa = 0 the gas stays at ambient temperature and the polytrope is unchanged.
    """
    temperature, ambient = symbol("temperature"), symbol("ambient_temperature")
    gas = symbol("initial_pressure") * symbol("initial_volume") / ambient
    pressure = symbol("gas_pressure")
    if is_quantity(model, "ambient_pressure"):
        pressure = pressure - symbol("ambient_pressure")  # as in eq. 6.4
    # The piston sweeps a part of the conducting wall; the rest stays in contact with the gas.
    exposed = 1 - names["swept"] * (1 - symbol("volume_ratio"))
    loss = names["conduction"] * exposed * (temperature - ambient)
    extended = model.with_dof(
        "temperature",
        Dof("K", ambient, "gas temperature"),
        {
            "storage": symbol("heat_capacity") * derivative_symbol("temperature", 1),
            "conduction": symbol("heat_loss"),
            "compression": -names["heat_exchange"] * symbol("gas_power"),
        },
    )
    capacity = gas * names["specific_heat"] / names["gas_constant"]
    for name, body in {
        target: temperature / ambient,
        "heat_capacity": capacity,
        "gas_power": _power(model, pressure),
        "heat_loss": loss,
    }.items():
        extended = extended.with_definition(name, body)
    return extended


HEAT_EXCHANGE = Effect(
    id="heat_exchange",
    family="thermal",
    title="Gas that warms when compressed and loses heat",
    formula=r"p = p_0 \frac{T}{T_0} v^{-n}, \quad"
    r" C \dot T + G (1 - s (1 - v)) (T - T_0) = \kappa (p - p_a) A_p \dot q",
    amplitudes=(
        Amplitude("heat_exchange", "", r"\kappa", "fraction of the work that heats the gas", 1),
    ),
    places=_polytropic,
    change=of_gas(_exchange_heat),
    shapes=(
        ShapeParameter("conduction", "W/K", "G", "heat conduction to the ambient", _CONDUCTION),
        ShapeParameter(
            "swept", "", "s", "part of the conducting wall that the piston sweeps", _SWEPT
        ),
    ),
    constants=(
        Constant(
            "specific_heat",
            "J/(kg*K)",
            "of nitrogen, at constant volume",
            lambda model, target, scales: SPECIFIC_HEAT_NITROGEN,
        ),
        Constant(
            "gas_constant",
            "J/(kg*K)",
            "of nitrogen",
            lambda model, target, scales: GAS_CONSTANT_NITROGEN,
        ),
    ),
    source="Verbeek (1993), eq. 6.4, where the piston sweeps all of the wall (s = 1); a time"
    " constant of the gas's own (s = 0) as of accumulators: Pourmovahed and Otis (1990), J. Dyn."
    " Sys. Meas. Control 112(1), 116-121",
    applies_to="gas springs at constant temperature ratio",
)


# -- wall and oil ----------------------------------------------------------------------------------


def _with_heat_loss(model: Model) -> Sequence[str]:
    if not has_gas(model, "temperature", "heat_loss", "ambient_temperature"):
        return ()
    relative = model.definitions["heat_loss"].has(symbol("ambient_temperature"))
    return ("heat_loss",) if relative else ()


def _warm_wall(model: Model, target: str, names: Names) -> Model:
    """The gas loses heat to a wall at T0 + u: tau du/dt + u = r * heat_loss.

    With tau = r C this is the wall's energy balance, times r: regular at r = 0, where u = 0. (An
    infinite capacity instead would leave du/dt = 0, which no periodic solver can invert.)
    """
    ambient = symbol("ambient_temperature")
    dof = free_name("wall_excess", model)
    excess = symbol(dof)
    loss = model.definitions[target].xreplace({ambient: ambient + excess})
    equation = {
        "storage": names["time_constant"] * derivative_symbol(dof, 1),
        "to_ambient": excess,
        "from_gas": -names["resistance"] * symbol(target),
    }
    described = Dof("K", 0.0, "wall temperature above ambient")
    return model.with_dof(dof, described, equation).with_definition(target, loss)


def _warm_oil(model: Model, target: str, names: Names) -> Model:
    """A further path of heat, into oil that stores it: tau du/dt + u = T - T0."""
    above = symbol("temperature") - symbol("ambient_temperature")
    dof = free_name("oil_excess", model)
    excess = symbol(dof)
    equation = {
        "storage": names["time_constant"] * derivative_symbol(dof, 1),
        "oil": excess,
        "gas": -above,
    }
    loss = model.definitions[target] + names["conduction"] * (above - excess)
    described = Dof("K", 0.0, "oil temperature above ambient")
    return model.with_dof(dof, described, equation).with_definition(target, loss)


_STORAGE_TIME = ShapeParameter(
    "time_constant", "s", r"\tau", "resistance times heat capacity", period_grid(1 / 8, 4.0)
)

WALL = Effect(
    id="wall_heat_capacity",
    family="thermal",
    title="Cylinder wall that stores heat",
    formula=r"\dot Q = G v (T - T_w), \quad \tau \dot T_w + T_w - T_0 = r \dot Q,"
    r" \quad \tau = r C_w",
    amplitudes=(Amplitude("resistance", "K/W", "r", "thermal resistance, wall to ambient", 1),),
    places=_with_heat_loss,
    change=_warm_wall,
    shapes=(_STORAGE_TIME,),
    source="Verbeek (1993), sections 6.4.2 and 7.3",
    applies_to="gas springs with heat exchange",
)

OIL = Effect(
    id="oil_heat_capacity",
    family="thermal",
    title="Oil that stores heat",
    formula=r"\dot Q + G_o (T - T_o), \quad \tau \dot T_o + T_o = T, \quad \tau = C_o / G_o",
    amplitudes=(Amplitude("conduction", "W/K", "G_o", "heat conduction into the oil", 1),),
    places=_with_heat_loss,
    change=_warm_oil,
    shapes=(_STORAGE_TIME,),
    source="Verbeek (1993), sections 6.4.2 and 7.3",
    applies_to="gas springs with heat exchange",
)


# -- work ------------------------------------------------------------------------------------------


def _with_gauge_work(model: Model) -> Sequence[str]:
    needed = ("gas_power", "ambient_pressure", "initial_volume")
    return ("gas_power",) if has_gas(model, *needed) else ()


def _count_ambient_work(model: Model, target: str, names: Names) -> Model:
    more = _power(model, names["absolute_pressure_work"] * symbol("ambient_pressure"))
    return model.with_definition(target, model.definitions[target] + more)


ABSOLUTE_WORK = Effect(
    id="absolute_pressure_work",
    family="thermal",
    title="Work on the gas by absolute instead of gauge pressure",
    formula=r"(p - p_a + \lambda p_a) A_p \dot q",
    amplitudes=(
        Amplitude(
            "absolute_pressure_work", "", r"\lambda", "1 where absolute pressure does the work", 1
        ),
    ),
    places=_with_gauge_work,
    change=_count_ambient_work,
    source="first law; cf. Verbeek (1993), eq. 6.4, which takes gauge pressure",
    applies_to="gas springs with heat exchange and an ambient pressure",
)

EFFECTS = (HEAT_EXCHANGE, WALL, OIL, ABSOLUTE_WORK)
