r"""Friction effects: static laws, and dynamic laws with an internal state.

Dry friction without memory.

The sign of the velocity is smooth, :math:`s(\dot q) = \frac{2}{\pi}\arctan(\dot q / v_0)`, as in
Verbeek (1993), eq. 6.1: with the model's own ``friction_slope`` = :math:`1/v_0` where it declares
one, else with a scanned :math:`v_0`.

Friction with memory: a state that follows the sliding surface.

The states are numbers between about -1 and 1, so that the amplitude is the sliding friction and
the null leaves their equations regular.
"""

from __future__ import annotations

from bayesoleo.effects._force_effect import InternalState, force_effect
from bayesoleo.effects._parts import (
    Amplitude,
    ShapeParameter,
    range_grid,
    velocity_grid,
    velocity_once,
)

ARMSTRONG = "Armstrong-Helouvry, Dupont and Canudas de Wit (1994), Automatica 30(7), 1083-1138"

COULOMB = force_effect(
    "coulomb_friction",
    "friction",
    "coulomb_friction*2/pi*atan(velocity/transition)",
    {"coulomb_friction": Amplitude("coulomb_friction", "force", "F_c", "Coulomb friction")},
    shapes=(
        ShapeParameter(
            "transition",
            "position/s",
            "v_0",
            "velocity at which friction has half its final size",
            velocity_grid(1 / 512, 1 / 4),
        ),
    ),
    formula=r"F_c \, \frac{2}{\pi} \arctan(\dot q / v_0)",
    title="Coulomb friction",
    source="Verbeek (1993), eq. 6.1",
)

ASYMMETRIC = force_effect(
    "asymmetric_friction",
    "friction",
    "asymmetric_friction*direction**2",
    {
        "asymmetric_friction": Amplitude(
            "asymmetric_friction", "force", r"\Delta F", "half the difference between directions"
        )
    },
    formula=r"\Delta F \, s(\dot q)^2",
    title="Friction different in the two directions",
    source=ARMSTRONG,
)

STRIBECK = force_effect(
    "stribeck_friction",
    "friction",
    "stribeck_friction*exp(-(velocity/decay)**2)*direction",
    {
        "stribeck_friction": Amplitude(
            "stribeck_friction", "force", "F_s", "breakaway friction beyond sliding friction", 1
        )
    },
    shapes=(
        ShapeParameter(
            "decay",
            "position/s",
            "v_s",
            "velocity over which breakaway friction decays",
            velocity_grid(1 / 128, 1 / 2),
        ),
    ),
    formula=r"F_s \, e^{-(\dot q / v_s)^2} s(\dot q)",
    title="Breakaway (Stribeck) friction",
    source=ARMSTRONG,
)

PRESSURE_DEPENDENT = force_effect(
    "pressure_dependent_friction",
    "friction",
    "pressure_dependent_friction*pressure*direction",
    {
        "pressure_dependent_friction": Amplitude(
            "pressure_dependent_friction", "force/Pa", r"\mu_p", "friction a pressure", 1
        )
    },
    formula=r"\mu_p \, p \, s(\dot q)",
    title="Friction that grows with pressure (seals)",
    source="Verbeek (1993), eq. 6.1: theta_9",
)

STROKE_DEPENDENT = force_effect(
    "stroke_dependent_friction",
    "friction",
    "stroke_dependent_friction*position*direction",
    {
        "stroke_dependent_friction": Amplitude(
            "stroke_dependent_friction", "force/position", r"\mu_q", "friction a stroke"
        )
    },
    formula=r"\mu_q \, q \, s(\dot q)",
    title="Friction that changes along the stroke",
    source=ARMSTRONG,
)

LOAD_DEPENDENT = force_effect(
    "load_dependent_friction",
    "friction",
    "load_dependent_friction*abs(spring_force)*direction",
    {
        "load_dependent_friction": Amplitude(
            "load_dependent_friction", "", r"\mu_F", "coefficient of friction", 1
        )
    },
    formula=r"\mu_F \, |F_\mathrm{spring}| \, s(\dot q)",
    title="Friction that grows with the load",
    source="Coulomb (1785), Theorie des machines simples",
    applies_to="balances with a spring",
)

EFFECTS = (COULOMB, ASYMMETRIC, STRIBECK, PRESSURE_DEPENDENT, STROKE_DEPENDENT, LOAD_DEPENDENT)


_STIFFNESS = ShapeParameter(
    "rate",
    "1/position",
    r"\rho",
    "reciprocal of the displacement over which friction builds up",
    range_grid(2.0, 2048.0, power=-1),
)

DAHL = force_effect(
    "dahl_friction",
    "friction",
    "dahl_friction*memory",
    {"dahl_friction": Amplitude("dahl_friction", "force", "F_D", "sliding friction", 1)},
    shapes=(_STIFFNESS,),
    states={
        "memory": InternalState(
            "dot(memory) - rate*(velocity - abs(velocity)*memory)",
            description="friction over sliding friction",
        )
    },
    formula=r"F_D w, \quad \dot w = \rho (\dot q - |\dot q| w)",
    title="Dahl friction (memory)",
    source="Dahl (1968), Aerospace Corporation TOR-0158(3107-18)-1",
)

# With exponent one: a higher one leaves the state's equation singular where the state is zero.
BOUC_WEN = force_effect(
    "bouc_wen_friction",
    "friction",
    "bouc_wen_friction*memory",
    {"bouc_wen_friction": Amplitude("bouc_wen_friction", "force", "F_B", "yield force", 1)},
    shapes=(_STIFFNESS,),
    states={
        "memory": InternalState(
            "dot(memory) - rate*(velocity - (abs(velocity)*memory + velocity*abs(memory))/2)",
            description="hysteretic force over yield force",
        )
    },
    formula=r"F_B w, \quad \dot w = \rho (\dot q - \frac{1}{2} (|\dot q| w + \dot q |w|))",
    title="Bouc-Wen hysteresis (exponent one, equal coefficients)",
    source="Wen (1976), J. Eng. Mech. Div. ASCE 102(2), 249-263",
)

LUGRE = force_effect(
    "lugre_friction",
    "friction",
    "lugre_friction*memory",
    {"lugre_friction": Amplitude("lugre_friction", "force", "F_L", "sliding friction", 1)},
    shapes=(
        _STIFFNESS,
        ShapeParameter(
            "decay",
            "position/s",
            "v_s",
            "velocity over which breakaway friction decays",
            velocity_once(1 / 16),
        ),
    ),
    states={
        "memory": InternalState(
            "dot(memory) - rate*(velocity - abs(velocity)*memory"
            "/(1 + exp(-(velocity/decay)**2)/2))",
            description="friction over sliding friction",
        )
    },
    formula=r"F_L w, \quad \dot w = \rho"
    r" \left(\dot q - \frac{|\dot q| w}{1 + \frac{1}{2} e^{-(\dot q / v_s)^2}}\right)",
    title="LuGre friction (memory and breakaway, half as much again)",
    source="Canudas de Wit et al. (1995), IEEE Trans. Automatic Control 40(3), 419-425",
)

DYNAMIC_FRICTION_EFFECTS = (DAHL, BOUC_WEN, LUGRE)
