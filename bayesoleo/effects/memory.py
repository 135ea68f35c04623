r"""Friction with memory: a state that follows the sliding surface.

The states are numbers between about -1 and 1, so that the amplitude is the sliding friction and
the null leaves their equations regular.
"""

from __future__ import annotations

from bayesoleo.effects.force_effect import InternalState, force_effect
from bayesoleo.effects.grids import range_grid, velocity_once
from bayesoleo.effects.parts import Amplitude, ShapeParameter

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

EFFECTS = (DAHL, BOUC_WEN, LUGRE)
