"""Effects of the gas law: solubility, compliance, volume, pressure and exponent.

A model has a gas spring that these effects recognise if it declares, under these names,

========================= ============================================================
``volume_ratio``          definition: gas volume over ``initial_volume``
``free_volume_ratio``     definition: the same, corrected for dissolved gas
``temperature_ratio``     definition: gas temperature over ``ambient_temperature``, or 1
``gas_pressure``          definition: absolute pressure, Pa
``initial_volume``        parameter, m³
``initial_pressure``      condition or parameter: absolute, Pa, at volume ratio one
``ambient_temperature``   condition or parameter, K
``ambient_pressure``      parameter or condition, Pa (for the thermal effects; optional)
========================= ============================================================

as the oleos of :mod:`bayesoleo.systems` do, each definition in terms of those before it. An effect
requires the names that it changes or uses. Where the second and the third are not declared,
``volume_ratio`` and ``gas_pressure`` define them (:func:`as_gas_spring`). :func:`undeclared` lists
the names that a model lacks.

References
----------
Verbeek (1993), eqs. 6.1-6.4 and section 7.3 (the five causes behind "solubility").
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import sympy as sp

from bayesoleo.effects._effect import BY_RUN, Effect, Names, error_of, free_name
from bayesoleo.effects._parts import Amplitude
from bayesoleo.effects._places import is_quantity
from bayesoleo.model._expressions import split_derivative, symbol, total_derivative
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Dof

_LAW = ("volume_ratio", "gas_pressure")

Change = Callable[[Model, str, Names], Model]


def has_gas(model: Model, *more: str) -> bool:
    """Whether a model declares a gas spring, and further names."""
    return all(name in model.definitions for name in _LAW) and is_quantity(model, *more)


def as_gas_spring(model: Model) -> Model:
    """The same model with the names of a gas spring that follow from its declarations.

    The free volume is the volume if the pressure depends on the volume. The temperature is that of
    the ambient if the model declares none.
    """
    if not has_gas(model):
        return model
    volume, free, ratio = map(symbol, ("volume_ratio", "free_volume_ratio", "temperature_ratio"))
    pressure = model.definitions["gas_pressure"]
    if not is_quantity(model, free.name) and pressure.has(volume):
        pressure = pressure.xreplace({volume: free})
        model = model.with_definition(free.name, volume)
    if not is_quantity(model, ratio.name) and not is_quantity(model, "temperature"):
        pressure = ratio * pressure
        model = model.with_definition(ratio.name, sp.Integer(1))
    return model.with_definition("gas_pressure", pressure)


def of_gas(change: Change) -> Change:
    """A change of a gas spring that first declares its missing names."""
    return lambda model, target, names: change(as_gas_spring(model), target, names)


def _where(target: str, *more: str) -> Callable[[Model], Sequence[str]]:
    return lambda model: (target,) if has_gas(as_gas_spring(model), *more) else ()


# -- solubility ------------------------------------------------------------------------------------


def _undissolved(model: Model) -> Sequence[str]:
    """Models whose free volume is the whole volume."""
    model = as_gas_spring(model)
    if not has_gas(model, "free_volume_ratio", "temperature_ratio"):
        return ()
    whole = model.expand(symbol("free_volume_ratio")) == model.expand(symbol("volume_ratio"))
    return ("free_volume_ratio",) if whole else ()


def _dissolve(model: Model, target: str, names: Names) -> Model:
    r"""With :math:`\sigma = \theta_7 T_0` and n = 1 this is Verbeek (1993), eq. 6.4:

    p = p0 (1/T0 + theta7) T / (v + theta7 T) = p0 (T/T0) / ((v + sigma T/T0) / (1 + sigma)).
    """
    sigma = names["gas_solubility"]
    body = symbol("volume_ratio") + sigma * symbol("temperature_ratio")
    return model.with_definition(target, body / (1 + sigma))


SOLUBILITY = Effect(
    id="gas_solubility",
    family="gas",
    title="Gas that dissolves as pressure rises",
    formula=r"p = p_0 \frac{T}{T_0} \left(\frac{v + \sigma T/T_0}{1 + \sigma}\right)^{-n},"
    r" \quad \sigma = -\frac{dn}{dp} \frac{R T_0}{V_0}",
    amplitudes=(
        Amplitude("gas_solubility", "", r"\sigma", "dissolved over free gas, by pressure", 1),
    ),
    places=_undissolved,
    change=of_gas(_dissolve),
    source="Verbeek (1993), eq. 6.4",
    applies_to="gas springs without solubility",
)


# -- volume that follows pressure ------------------------------------------------------------------


def volume_ratio_rate(model: Model) -> sp.Expr:
    """Rate of the gas volume over ``initial_volume``, including the volume that pressure adds."""
    return total_derivative(model.expand(symbol("volume_ratio")), (*model.dofs, *model.inputs))


def _with_its_work(before: Model, after: Model) -> Model:
    """Correct the power on the gas for the added rate of its volume."""
    if "gas_power" not in after.definitions:
        return after
    power, old = before.definitions["gas_power"], volume_ratio_rate(before)
    rates = [item for item in old.free_symbols if split_derivative(item)[1] == 1]
    a_volume = next((sp.diff(power, r) / sp.diff(old, r) for r in rates if power.has(r)), None)
    if a_volume is None:
        return after
    more = a_volume * (volume_ratio_rate(after) - old)
    return after.with_definition("gas_power", power + more)


def _compliant(
    id: str,  # noqa: A002
    title: str,
    formula: str,
    latex: str,
    description: str,
    weight: Callable[[Model], sp.Expr],
) -> Effect:
    """Gas volume that grows with pressure.

    Pressure depends on volume and volume on pressure, so the added volume is a dof of its own, with
    an algebraic equation ``u = c w (p - p0) / V0`` that is regular at the null ``c = 0``.
    """

    def change(model: Model, target: str, names: Names) -> Model:
        dof = free_name(f"{id}_ratio", model)
        added = symbol(dof)
        compliance = names[id] * weight(model)
        pressure = symbol("gas_pressure") - symbol("initial_pressure")
        wider = model.definitions[target] + added
        unit = Dof("", 0.0, "added gas volume over initial volume")
        follow = -compliance * pressure / symbol("initial_volume")
        extended = model.with_dof(dof, unit, {"volume": added, "pressure": follow})
        return _with_its_work(model, extended.with_definition(target, wider))

    return Effect(
        id=id,
        family="gas",
        title=title,
        formula=formula,
        amplitudes=(Amplitude(id, "m**3/Pa", latex, description, 1),),
        places=_where("volume_ratio", "initial_volume", "initial_pressure"),
        change=of_gas(change),
        source="Verbeek (1993), section 7.3",
        applies_to="gas springs",
    )


def _volume(model: Model) -> sp.Expr:
    """The volume of the gas law: the free volume, or the volume where that is not declared."""
    free = "free_volume_ratio"
    return symbol(free if is_quantity(model, free) else "volume_ratio")


OIL_COMPRESSIBILITY = _compliant(
    "oil_compressibility",
    "Oil that gives under pressure",
    r"v = 1 - \frac{A_p q - c_o (p - p_0)}{V_0}",
    "c_o",
    "oil volume lost a pressure",
    lambda model: sp.Integer(1),
)

CYLINDER_EXPANSION = _compliant(
    "cylinder_expansion",
    "Cylinder that widens around the gas",
    r"v = (1 - A_p q / V_0) \left(1 + c_c \frac{p - p_0}{V_0}\right)",
    "c_c",
    "volume of the whole gas space gained a pressure",
    _volume,
)


# -- volume, pressure, exponent --------------------------------------------------------------------


EXTRA_VOLUME = error_of(
    "initial_volume",
    "m**3",
    Amplitude("extra_volume", "m**3", "V_e", "volume beyond the initial volume"),
    family="gas",
    title="More gas volume than stated (gauge, lines)",
    formula=r"V_0 + V_e",
    source="Verbeek (1993), section 7.3",
    applies_to="gas springs",
)

PRESSURE_ERROR = error_of(
    "initial_pressure",
    "Pa",
    Amplitude("initial_pressure_error", "", r"\epsilon", "relative error of p_0"),
    relative=True,
    family="gas",
    title="Error of the initial pressure, the same in all runs",
    formula=r"p_0 (1 + \epsilon)",
    source="Verbeek (1993), eq. 6.2: theta_5",
    applies_to="gas springs",
)

PRESSURE_ERROR_BY_RUN = error_of(
    "initial_pressure",
    "Pa",
    Amplitude("initial_pressure_by_run", "", r"\epsilon_r", "relative error of p_0", by_run=True),
    relative=True,
    family="gas",
    title="Error of the initial pressure by run (leakage, drift)",
    formula=r"p_0 (1 + \epsilon_r)",
    source=BY_RUN,
    applies_to="gas springs",
)


def _steepen(model: Model, target: str, names: Names) -> Model:
    factor = _volume(model) ** (-names["gas_exponent_error"])
    return model.with_definition(target, model.definitions[target] * factor)


EXPONENT = Effect(
    id="gas_exponent_error",
    family="gas",
    title="Another exponent of the gas law",
    formula=r"p \, v^{-\delta n}",
    amplitudes=(
        Amplitude("gas_exponent_error", "", r"\delta n", "exponent beyond that of the model"),
    ),
    places=_where("gas_pressure"),
    change=of_gas(_steepen),
    source="Verbeek (1993), eq. 6.2",
    applies_to="gas springs",
)

EFFECTS = (
    SOLUBILITY,
    OIL_COMPRESSIBILITY,
    CYLINDER_EXPANSION,
    EXTRA_VOLUME,
    PRESSURE_ERROR,
    PRESSURE_ERROR_BY_RUN,
    EXPONENT,
)


_VOLUME = (*_LAW, "initial_volume", "initial_pressure")
_ANY = {
    "oil_compressibility": _VOLUME,
    "cylinder_expansion": _VOLUME,
    "initial_pressure_error": ("initial_pressure",),
    "initial_pressure_by_run": ("initial_pressure",),
    "gas_exponent_error": _LAW,
}
_AT_AMBIENT = {"heat_exchange": (*_VOLUME, "ambient_temperature")}
_WARM = {
    "wall_heat_capacity": (*_LAW, "temperature", "heat_loss", "ambient_temperature"),
    "oil_heat_capacity": (*_LAW, "temperature", "heat_loss", "ambient_temperature"),
    "absolute_pressure_work": (*_LAW, "initial_volume", "gas_power", "ambient_pressure"),
}


def undeclared(model: Model) -> dict[str, tuple[str, ...]]:
    """Gas effects that cannot be tried because a model lacks names, with the missing names.

    Parameters
    ----------
    model : Model
        The model as declared.

    Returns
    -------
    dict of str to tuple of str
        Missing names by effect; empty for a model that declares no gas at all.

    Examples
    --------
    >>> from bayesoleo.systems import system
    >>> undeclared(system("f16n2d2"))
    {}
    """
    if not any(is_quantity(model, name) for name in _LAW):
        return {}
    whole = as_gas_spring(model)
    # A first-order state besides the motion counts as a temperature.
    warm = any(item.kind == "equation" and item.velocity is None for item in model.coordinates())
    wanted = _ANY | (_WARM if warm else _AT_AMBIENT)
    missing = {
        effect: tuple(name for name in names if not is_quantity(whole, name))
        for effect, names in wanted.items()
    }
    return {effect: names for effect, names in missing.items() if names}
