r"""Stiffness, damping and friction effects.

Stiffness effects are forces that depend on position. Damping effects are forces that grow with
velocity, and changes of the damping that a model has.

Friction follows a static law, or a dynamic law with an internal state. The sign of the velocity is
smooth, :math:`s(\dot q) = \frac{2}{\pi}\arctan(\dot q / v_0)`, as in Verbeek (1993), eq. 6.1: with
the model's own ``friction_slope`` = :math:`1/v_0` where it declares one, else with a scanned
:math:`v_0`. Where its tails leave more than noise, a search also tries other corners. The internal
state of a dynamic law follows the sliding surface. It is a number between about -1 and 1, so that
the amplitude is the sliding friction and the state's equation is regular at the null.

References
----------
Verbeek (1993), eq. 6.1 (orifice damping) and section 6.4 (metering pin, rebound valve).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import sympy as sp

from bayesoleo.effects._effect import Effect, Names
from bayesoleo.effects._forces import (
    InternalState,
    resisting_side,
    single_force,
    transition_velocity,
)
from bayesoleo.effects._parts import (
    Amplitude,
    Scan,
    ShapeParameter,
    range_grid,
    range_once,
    values,
    velocity_grid,
    velocity_once,
)
from bayesoleo.effects._places import (
    damping_terms,
    force_places,
    is_quantity,
    moving_places,
    positioned_places,
)
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


VISCOUS = replace(
    single_force(
        Amplitude("viscous_damping", "force/(position/s)", "c_1", "viscous damping"),
        "damping",
        "viscous_damping*velocity",
        formula=r"c_1 \dot q",
        title="Viscous damping",
        source="Den Hartog (1956), Mechanical Vibrations, section 2.1",
    ),
    side=resisting_side,
)

QUADRATIC = replace(
    single_force(
        Amplitude("quadratic_damping", "force/(position/s)**2", "c_2", "quadratic damping"),
        "damping",
        "quadratic_damping*velocity*abs(velocity)",
        formula=r"c_2 \dot q |\dot q|",
        title="Quadratic damping (orifice)",
        source="Verbeek (1993), eq. 6.1",
    ),
    side=resisting_side,
)

# Smooth at rest: a power below one has an infinite slope there, which no Newton iteration survives.
POWER_LAW = replace(
    single_force(
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
    ),
    side=resisting_side,
)


def _scaling_effect(
    id: str,  # noqa: A002
    title: str,
    formula: str,
    amplitude: Amplitude,
    factor: Callable[[Model, Coordinate], sp.Expr],
    requires: tuple[str, ...] = (),
    along: Callable[[Model], dict[str, Coordinate]] = moving_places,
) -> Effect:
    """An effect that multiplies every damping term of a balance by ``1 + amplitude * factor``."""

    def places(model: Model) -> tuple[str, ...]:
        if not is_quantity(model, *requires):
            return ()
        found = along(model)
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
    along=positioned_places,
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

DAMPING_EFFECTS = (
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


ARMSTRONG = "Armstrong-Helouvry, Dupont and Canudas de Wit (1994), Automatica 30(7), 1083-1138"


def _decay(grid: Scan) -> ShapeParameter:
    words = "velocity over which breakaway friction decays"
    return ShapeParameter("decay", "position/s", "v_s", words, grid)


COULOMB = replace(
    single_force(
        Amplitude("coulomb_friction", "force", "F_c", "Coulomb friction"),
        "friction",
        "coulomb_friction*direction",
        shapes=(transition_velocity("transition"),),
        over="transition",
        formula=r"F_c \, \frac{2}{\pi} \arctan(\dot q / v_0)",
        title="Coulomb friction",
        source="Verbeek (1993), eq. 6.1",
    ),
    side=resisting_side,
)

ASYMMETRIC = single_force(
    Amplitude(
        "asymmetric_friction", "force", r"\Delta F", "half the difference between directions"
    ),
    "friction",
    "asymmetric_friction*direction**2",
    formula=r"\Delta F \, s(\dot q)^2",
    title="Friction different in the two directions",
    source=ARMSTRONG,
)

STRIBECK = single_force(
    Amplitude("stribeck_friction", "force", "F_s", "breakaway friction beyond sliding friction", 1),
    "friction",
    "stribeck_friction*exp(-(velocity/decay)**2)*direction",
    shapes=(_decay(velocity_grid(1 / 128, 1 / 2)),),
    formula=r"F_s \, e^{-(\dot q / v_s)^2} s(\dot q)",
    title="Breakaway (Stribeck) friction",
    source=ARMSTRONG,
)

PRESSURE_DEPENDENT = single_force(
    Amplitude("pressure_dependent_friction", "force/Pa", r"\mu_p", "friction a pressure", 1),
    "friction",
    "pressure_dependent_friction*pressure*direction",
    formula=r"\mu_p \, p \, s(\dot q)",
    title="Friction that grows with pressure (seals)",
    source="Verbeek (1993), eq. 6.1: theta_9",
)

STROKE_DEPENDENT_FRICTION = single_force(
    Amplitude("stroke_dependent_friction", "force/position", r"\mu_q", "friction a stroke"),
    "friction",
    "stroke_dependent_friction*position*direction",
    formula=r"\mu_q \, q \, s(\dot q)",
    title="Friction that changes along the stroke",
    source=ARMSTRONG,
)

LOAD_DEPENDENT = single_force(
    Amplitude("load_dependent_friction", "", r"\mu_F", "coefficient of friction", 1),
    "friction",
    "load_dependent_friction*abs(spring_force)*direction",
    formula=r"\mu_F \, |F_\mathrm{spring}| \, s(\dot q)",
    title="Friction that grows with the load",
    source="Coulomb (1785), Theorie des machines simples",
    applies_to="balances with a spring",
)

FRICTION_EFFECTS = (
    COULOMB,
    ASYMMETRIC,
    STRIBECK,
    PRESSURE_DEPENDENT,
    STROKE_DEPENDENT_FRICTION,
    LOAD_DEPENDENT,
)


_RATE = ShapeParameter(
    "rate",
    "1/position",
    r"\rho",
    "reciprocal of the displacement over which friction builds up",
    range_grid(2.0, 2048.0, power=-1),
)


def _with_memory(
    amplitude: Amplitude, loss: str, described: str, *more_shapes: ShapeParameter, **more: Any
) -> Effect:
    """Friction in proportion to a state that builds up with the motion, less a loss."""
    state = InternalState(f"dot(memory) - rate*(velocity - {loss})", description=described)
    return single_force(
        amplitude,
        "friction",
        f"{amplitude.name}*memory",
        shapes=(_RATE, *more_shapes),
        states={"memory": state},
        **more,
    )


DAHL = _with_memory(
    Amplitude("dahl_friction", "force", "F_D", "sliding friction", 1),
    "abs(velocity)*memory",
    "friction over sliding friction",
    formula=r"F_D w, \quad \dot w = \rho (\dot q - |\dot q| w)",
    title="Dahl friction (memory)",
    source="Dahl (1968), Aerospace Corporation TOR-0158(3107-18)-1",
)

# The exponent is one: with a higher one the state's equation is singular where the state is zero.
BOUC_WEN = _with_memory(
    Amplitude("bouc_wen_friction", "force", "F_B", "yield force", 1),
    "(abs(velocity)*memory + velocity*abs(memory))/2",
    "hysteretic force over yield force",
    formula=r"F_B w, \quad \dot w = \rho (\dot q - \frac{1}{2} (|\dot q| w + \dot q |w|))",
    title="Bouc-Wen hysteresis (exponent one, equal coefficients)",
    source="Wen (1976), J. Eng. Mech. Div. ASCE 102(2), 249-263",
)

LUGRE = _with_memory(
    Amplitude("lugre_friction", "force", "F_L", "sliding friction", 1),
    "abs(velocity)*memory/(1 + exp(-(velocity/decay)**2)/2)",
    "friction over sliding friction",
    _decay(velocity_once(1 / 16)),
    formula=r"F_L w, \quad \dot w = \rho"
    r" \left(\dot q - \frac{|\dot q| w}{1 + \frac{1}{2} e^{-(\dot q / v_s)^2}}\right)",
    title="LuGre friction (memory and breakaway, half as much again)",
    source="Canudas de Wit et al. (1995), IEEE Trans. Automatic Control 40(3), 419-425",
)

# An ideal slider holds until its friction is reached, and the corner of its force is a jump of the
# state's equation. Here the corner is round over the last part of the rise, so that stiffness and
# friction are those of the ideal one: with a sixteenth, they came out 3 % off.
_CORNER = sp.Rational(1, 256)


def _slip(held: str) -> str:
    """Part of the motion that a slider yields to; ``held`` is its force over its friction."""
    below = 1 - _CORNER
    return f"(max({held} - {below}, 0) + min({held} + {below}, 0))/({_CORNER})"


# Without slip an element would remember any course for ever: a ten-thousandth of the memory is
# lost, so that a motion within it has one answer.
_LEAK = "memory/10000"

# Without a rise the slider is rigid, and no deflection tells its force: a rise of zero stands for a
# ten-thousandth of the gap. A rise of a hundredth of the gap changes by a part in 20,000. With
# neither this is Coulomb friction, which builds up over a hundred-thousandth of the stroke's range.
_RISE = "sqrt(rise**2 + (gap/10000)**2 + ((highest_position - lowest_position)/100000)**2)"
# The memory is scaled by all that can deflect, so that no gap is singular: without one it is an
# elastic slider, the Jenkins element.
_LARGEST = f"(gap + {_RISE})"
_BEHIND = f"((max(memory*{_LARGEST} - gap, 0) + min(memory*{_LARGEST} + gap, 0))/{_RISE})"
BACKLASH = single_force(
    Amplitude("backlash_friction", "force", "F_g", "sliding friction behind the gap", 1),
    "friction",
    f"backlash_friction*{_BEHIND}",
    shapes=(
        ShapeParameter("gap", "position", "g", "half the gap", range_grid(1 / 64, 1 / 4)),
        ShapeParameter(
            "rise",
            "position",
            r"\delta",
            "displacement over which friction builds up behind the gap",
            range_once(1 / 16),
        ),
    ),
    states={
        "memory": InternalState(
            f"dot(memory) - (velocity - abs(velocity)*({_slip(_BEHIND)} + {_LEAK}))/{_LARGEST}",
            description="deflection of the gap and the friction element over the largest",
        )
    },
    formula=r"F_g (w - \operatorname{clip}(w, -g, g))/\delta, \quad \dot w = \dot q \,[|F| < F_g]",
    title="Backlash: friction behind a gap, in series",
    source="Nordin and Gutman (2002), Automatica 38(10), 1633-1649, in series with a Jenkins"
    " element",
)

DYNAMIC_FRICTION_EFFECTS = (DAHL, BOUC_WEN, LUGRE, BACKLASH)
