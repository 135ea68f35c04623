r"""Friction effects: static laws, and dynamic laws with an internal state.

The sign of the velocity is smooth, :math:`s(\dot q) = \frac{2}{\pi}\arctan(\dot q / v_0)`, as in
Verbeek (1993), eq. 6.1: with the model's own ``friction_slope`` = :math:`1/v_0` where it declares
one, else with a scanned :math:`v_0`.

The internal state of a dynamic law follows the sliding surface. It is a number between about -1 and
1, so that the amplitude is the sliding friction and the state's equation is regular at the null.
"""

from __future__ import annotations

from typing import Any

from bayesoleo.effects._effect import Effect
from bayesoleo.effects._force_effect import InternalState, single_force, transition_velocity
from bayesoleo.effects._parts import (
    Amplitude,
    Scan,
    ShapeParameter,
    range_grid,
    range_once,
    velocity_grid,
    velocity_once,
)

ARMSTRONG = "Armstrong-Helouvry, Dupont and Canudas de Wit (1994), Automatica 30(7), 1083-1138"


def _decay(grid: Scan) -> ShapeParameter:
    words = "velocity over which breakaway friction decays"
    return ShapeParameter("decay", "position/s", "v_s", words, grid)


COULOMB = single_force(
    Amplitude("coulomb_friction", "force", "F_c", "Coulomb friction"),
    "friction",
    "coulomb_friction*2/pi*atan(velocity/transition)",
    shapes=(transition_velocity("transition"),),
    formula=r"F_c \, \frac{2}{\pi} \arctan(\dot q / v_0)",
    title="Coulomb friction",
    source="Verbeek (1993), eq. 6.1",
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

STROKE_DEPENDENT = single_force(
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

EFFECTS = (COULOMB, ASYMMETRIC, STRIBECK, PRESSURE_DEPENDENT, STROKE_DEPENDENT, LOAD_DEPENDENT)


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

# The slider gives a little more than its friction while it slides, by one over _CORNER, lest the
# corner between sticking and sliding be a jump. Within the gap an element would remember any course
# for ever: a thousandth of the memory is lost, so that a motion inside the gap has one answer.
_CORNER = 16
_SPRING = "((max(memory - 1, 0) + min(memory + 1, 0))*gap/rise)"
_SLIDING = f"{_CORNER}*(max({_SPRING} - 1, 0) + min({_SPRING} + 1, 0))"
BACKLASH = single_force(
    Amplitude("backlash_friction", "force", "F_g", "sliding friction behind the gap", 1),
    "friction",
    f"backlash_friction*{_SPRING}*{_CORNER}/{_CORNER + 1}",
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
            f"dot(memory) - (velocity - abs(velocity)*({_SLIDING} + memory/1000))/gap",
            description="deflection of the gap and the friction element over half the gap",
        )
    },
    formula=r"F_g (w - \operatorname{clip}(w, -g, g))/\delta, \quad \dot w = \dot q \,[|F| < F_g]",
    title="Backlash: friction behind a gap, in series",
    source="Nordin and Gutman (2002), Automatica 38(10), 1633-1649, in series with Dahl (1968)",
)

DYNAMIC_FRICTION_EFFECTS = (DAHL, BOUC_WEN, LUGRE, BACKLASH)
