"""What a model of a gas spring must declare for each effect of the gas to be tried."""

from __future__ import annotations

from bayesoleo.effects.gas import as_gas_spring
from bayesoleo.effects.places import is_quantity
from bayesoleo.model import Model

_LAW = ("volume_ratio", "gas_pressure")
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
    """Effects of the gas that a model's names keep from being tried, and the names that it lacks.

    Parameters
    ----------
    model : Model
        As declared.

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
    # A model whose balances hold a first-order state besides the motion has a temperature already.
    warm = any(model.order(name) == 1 for name in model.dofs)
    wanted = _ANY | (_WARM if warm else _AT_AMBIENT)
    missing = {
        effect: tuple(name for name in names if not is_quantity(whole, name))
        for effect, names in wanted.items()
    }
    return {effect: names for effect, names in missing.items() if names}
