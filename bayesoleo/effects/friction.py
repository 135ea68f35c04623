r"""Dry friction without memory.

The sign of the velocity is smooth, :math:`s(\dot q) = \frac{2}{\pi}\arctan(\dot q / v_0)`, as in
Verbeek (1993), eq. 6.1: with the model's own ``friction_slope`` = :math:`1/v_0` where it declares
one, else with a scanned :math:`v_0`.
"""

from __future__ import annotations

from bayesoleo.effects.force_effect import force_effect
from bayesoleo.effects.grids import velocity_grid
from bayesoleo.effects.parts import Amplitude, ShapeParameter

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
