"""Stiffness and damping effects.

Stiffness effects are forces that depend on position. Damping effects are forces that grow with
velocity, and changes of the damping that a model has.

References
----------
Verbeek (1993), eq. 6.1 (orifice damping) and section 6.4 (metering pin, rebound valve).
"""

from __future__ import annotations

from collections.abc import Callable

import sympy as sp

from bayesoleo.effects._effect import Effect, Names
from bayesoleo.effects._force_effect import single_force
from bayesoleo.effects._parts import Amplitude, ShapeParameter, values, velocity_grid
from bayesoleo.effects._places import damping_terms, force_places, is_quantity, moving_places
from bayesoleo.model._expressions import symbol
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Coordinate

_SOURCES = {
    1: "Hooke (1678), De potentia restitutiva",
    2: "Nayfeh and Mook (1979), Nonlinear Oscillations, section 4.1",
    3: "Duffing (1918), Erzwungene Schwingungen bei veraenderlicher Eigenfrequenz",
    5: "Nayfeh and Mook (1979), Nonlinear Oscillations, section 4.1",
}


def _power(order: int, word: str) -> Effect:
    id_ = f"{word}_stiffness"
    unit = "force/position" if order == 1 else f"force/position**{order}"
    exponent = "" if order == 1 else f"^{order}"
    return single_force(
        Amplitude(id_, unit, f"k_{order}", f"{word} stiffness"),
        "stiffness",
        f"{id_}*position**{order}",
        formula=f"k_{order} q{exponent}",
        title=f"{word.capitalize()} stiffness",
        source=_SOURCES[order],
    )


LINEAR = _power(1, "linear")
STIFFNESS_QUADRATIC = _power(2, "quadratic")
CUBIC = _power(3, "cubic")
QUINTIC = _power(5, "quintic")

STIFFNESS_EFFECTS = (LINEAR, STIFFNESS_QUADRATIC, CUBIC, QUINTIC)


VISCOUS = single_force(
    Amplitude("viscous_damping", "force/(position/s)", "c_1", "viscous damping"),
    "damping",
    "viscous_damping*velocity",
    formula=r"c_1 \dot q",
    title="Viscous damping",
    source="Den Hartog (1956), Mechanical Vibrations, section 2.1",
)

QUADRATIC = single_force(
    Amplitude("quadratic_damping", "force/(position/s)**2", "c_2", "quadratic damping"),
    "damping",
    "quadratic_damping*velocity*abs(velocity)",
    formula=r"c_2 \dot q |\dot q|",
    title="Quadratic damping (orifice)",
    source="Verbeek (1993), eq. 6.1",
)

# Smooth at rest: a power below one has an infinite slope there, which no Newton iteration survives.
POWER_LAW = single_force(
    Amplitude("power_law_damping", "force", "F_a", "damping force at the largest velocity"),
    "damping",
    "power_law_damping*velocity/largest_velocity"
    "*((velocity/largest_velocity)**2 + 1e-6)**((exponent - 1)/2)",
    shapes=(
        ShapeParameter(
            "exponent", "", "a", "exponent of the velocity", values(0.25, 0.5, 1.0, 1.5, 2.5)
        ),
    ),
    formula=r"F_a |\dot q / v_\mathrm{max}|^a \operatorname{sign} \dot q",
    title="Power-law damping",
    source="Symans and Constantinou (1998), ISET J. Earthquake Technology 35(4), 185-206",
)


def _scaling_effect(
    id: str,  # noqa: A002
    title: str,
    formula: str,
    amplitude: Amplitude,
    factor: Callable[[Model, Coordinate], sp.Expr],
    requires: tuple[str, ...] = (),
) -> Effect:
    """An effect that multiplies every damping term of a balance by ``1 + amplitude * factor``."""

    def places(model: Model) -> tuple[str, ...]:
        if not is_quantity(model, *requires):
            return ()
        found = moving_places(model)
        return tuple(name for name, place in found.items() if damping_terms(model, place))

    def change(model: Model, target: str, names: Names) -> Model:
        place = force_places(model)[target]
        scale = 1 + names[amplitude.name] * factor(model, place)
        for name, term in damping_terms(model, place).items():
            model = model.with_term(place.kind, place.target, name, term * scale)
        return model

    needs = f", of models that declare {', '.join(requires)}" if requires else ""
    return Effect(
        id=id,
        family="damping",
        title=title,
        formula=formula,
        amplitudes=(amplitude,),
        places=places,
        change=change,
        source="Verbeek (1993), section 6.4",
        applies_to="balances with a term that grows with velocity" + needs,
    )


def _in_sense(sense: int) -> Callable[[Model, Coordinate], sp.Expr]:
    """One while the velocity has this sign, else zero."""

    def factor(_: Model, place: Coordinate) -> sp.Expr:
        assert place.velocity is not None
        return sp.Heaviside(sense * place.velocity, sp.Rational(1, 2))

    return factor


DIRECTION_DEPENDENT = _scaling_effect(
    "direction_dependent_damping",
    "Damping different in extension",
    r"d(\dot q) \, (1 + \delta_- \,[\dot q < 0])",
    Amplitude(
        "direction_dependent_damping", "", r"\delta_-", "damping in extension over that stated, - 1"
    ),
    _in_sense(-1),
)

COMPRESSION = _scaling_effect(
    "compression_damping",
    "Damping different in compression",
    r"d(\dot q) \, (1 + \delta_+ \,[\dot q > 0])",
    Amplitude(
        "compression_damping", "", r"\delta_+", "damping in compression over that stated, - 1"
    ),
    _in_sense(1),
)

STROKE_DEPENDENT = _scaling_effect(
    "stroke_dependent_damping",
    "Damping that changes along the stroke (metering pin)",
    r"d(\dot q) \, (1 + \delta_q q)",
    Amplitude(
        "stroke_dependent_damping", "1/position", r"\delta_q", "relative change of damping a stroke"
    ),
    lambda model, place: place.position,
)

TEMPERATURE_DEPENDENT = _scaling_effect(
    "temperature_dependent_damping",
    "Damping that changes with temperature",
    r"d(\dot q) \, (1 + \delta_T (T/T_0 - 1))",
    Amplitude(
        "temperature_dependent_damping", "", r"\delta_T", "relative change of damping with T/T_0"
    ),
    lambda model, place: symbol("temperature_ratio") - 1,
    requires=("temperature", "temperature_ratio"),
)

EXTENSION_ONLY = single_force(
    Amplitude(
        "extension_damping", "force/(position/s)**2", "c_-", "quadratic damping in extension"
    ),
    "damping",
    "extension_damping*velocity*abs(velocity)*step(-velocity)",
    formula=r"c_- \dot q |\dot q| \,[\dot q < 0]",
    title="Quadratic damping in extension only",
    source="Verbeek (1993), section 6.4: rebound valve",
)

CUBIC_EXTENSION = single_force(
    Amplitude(
        "choked_rebound",
        "force/(position/s)**3",
        "c_{3-}",
        "cubic damping in extension",
        sign=1,
    ),
    "damping",
    "choked_rebound*velocity**3*step(-velocity)",
    formula=r"c_{3-} \dot q^3 \,[\dot q < 0]",
    title="Flow that chokes in extension",
    source="a term of third order where flow resists more than an orifice does; Milwitzky and Cook"
    " (1953), NACA Report 1154, for orifice and snubber",
)

CAVITATING = single_force(
    Amplitude(
        "cavitating_rebound",
        "force/(position/s)**2",
        r"c_\mathrm{cav}",
        "quadratic damping lost in extension beyond the onset",
        sign=1,
    ),
    "damping",
    "cavitating_rebound*positive(-velocity - onset)**2",
    shapes=(
        ShapeParameter(
            "onset",
            "position/s",
            r"v_\mathrm{cav}",
            "velocity of extension at which the oil cavitates",
            velocity_grid(1 / 16, 3 / 4),
        ),
    ),
    formula=r"c_\mathrm{cav} \max(-\dot q - v_\mathrm{cav}, 0)^2",
    title="Rebound damping that cavitation limits",
    source="the pressure behind the orifice cannot fall below that of vapour; Currey (1988),"
    " Aircraft Landing Gear Design, chapter 5",
)

EFFECTS = (
    VISCOUS,
    QUADRATIC,
    POWER_LAW,
    DIRECTION_DEPENDENT,
    COMPRESSION,
    STROKE_DEPENDENT,
    TEMPERATURE_DEPENDENT,
    EXTENSION_ONLY,
    CUBIC_EXTENSION,
    CAVITATING,
)
