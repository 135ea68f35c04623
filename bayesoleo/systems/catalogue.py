"""The systems that come with the package, by name."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from functools import partial

from bayesoleo.errors import InputError
from bayesoleo.model import Model
from bayesoleo.systems import autonomous, mechanical, oleo

_SYSTEMS: dict[str, Callable[[], Model]] = {
    "gas_spring": mechanical.gas_spring,
    "viscous_damper": mechanical.viscous_damper,
    "linear_oscillator": mechanical.linear_oscillator,
    "duffing": mechanical.duffing,
    "end_stop": mechanical.end_stop,
    "f16n1d1": partial(oleo.mechanical_oleo, 1),
    "f16n1d2": partial(oleo.mechanical_oleo, 2),
    "f16n2d1": partial(oleo.thermomechanical_oleo, 1),
    "f16n2d2": partial(oleo.thermomechanical_oleo, 2),
    "f16n1d1_thesis": partial(oleo.mechanical_oleo_thesis, 1),
    "f16n1d2_thesis": partial(oleo.mechanical_oleo_thesis, 2),
    "f16n2d1_thesis": partial(oleo.thermomechanical_oleo_thesis, 1),
    "f16n2d2_thesis": partial(oleo.thermomechanical_oleo_thesis, 2),
    "f16n2d1_thesis_printed": partial(oleo.thermomechanical_oleo_thesis, 1, printed=True),
    "f16n2d2_thesis_printed": partial(oleo.thermomechanical_oleo_thesis, 2, printed=True),
    "van_der_pol": autonomous.van_der_pol,
    "lorenz": autonomous.lorenz,
    "rossler": autonomous.rossler,
}


def systems() -> tuple[str, ...]:
    """Names of the built-in systems."""
    return tuple(_SYSTEMS)


def system(name: str) -> Model:
    """A built-in system by its name.

    Raises
    ------
    InputError
        If there is none; the message names the closest.
    """
    if name not in _SYSTEMS:
        close = difflib.get_close_matches(name.lower(), _SYSTEMS, 3)
        hint = f"did you mean {' or '.join(close)}?" if close else f"known: {', '.join(_SYSTEMS)}"
        raise InputError("unknown system", value=name, hint=f"{hint} (or write file.py:object)")
    return _SYSTEMS[name]()
