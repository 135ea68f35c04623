"""Contact: springs that act over part of the stroke only.

The point of contact is stated as the depth by which the estimated motion goes beyond it: a positive
length, whatever the zero of the position is.
"""

from __future__ import annotations

from bayesoleo.effects.effect import Effect
from bayesoleo.effects.force_effect import force_effect
from bayesoleo.effects.grids import range_grid
from bayesoleo.effects.parts import Amplitude, ShapeParameter

_DEPTH = ShapeParameter(
    "depth",
    "position",
    "h",
    "how far the motion goes beyond the point of contact",
    range_grid(1 / 64, 1 / 2),
)


def _stop(side: str, power: str, word: str) -> Effect:
    lower = side == "lower"
    beyond = (
        "positive(lowest_position + depth - position)"
        if lower
        else "positive(position - highest_position + depth)"
    )
    id_ = f"{word}_{side}"
    exponent = {"": "", "**(3/2)": "^{3/2}"}[power]
    unit = "force/position" if not power else "force/position**1.5"
    inside = r"q_\mathrm{min} + h - q" if lower else r"q - q_\mathrm{max} + h"
    sign = "-" if lower else ""
    return force_effect(
        id_,
        "contact",
        f"{sign}{id_}*{beyond}{power}",
        {id_: Amplitude(id_, unit, "k_h", "contact stiffness", 1)},
        shapes=(_DEPTH,),
        formula=rf"{sign} k_h \max({inside}, 0){exponent}",
        title=f"{'End stop' if not power else 'Hertzian contact'} at the {side} end",
        source="Verbeek (1993), section 4.3.3"
        if not power
        else "Hertz (1881), J. reine angew. Math. 92, 156-171",
    )


END_STOP_LOWER = _stop("lower", "", "end_stop")
END_STOP_UPPER = _stop("upper", "", "end_stop")
HERTZIAN_LOWER = _stop("lower", "**(3/2)", "hertzian_contact")
HERTZIAN_UPPER = _stop("upper", "**(3/2)", "hertzian_contact")

PLAY = force_effect(
    "play",
    "contact",
    "-play*max(min(position - (lowest_position + highest_position)/2, gap), -gap)",
    {
        "play": Amplitude(
            "play", "force/position", "k_g", "stiffness that acts beyond the gap only", 1
        )
    },
    shapes=(
        ShapeParameter(
            "gap", "position", "g", "half the gap about mid-stroke", range_grid(1 / 64, 1 / 4)
        ),
    ),
    formula=r"- k_g \operatorname{clip}(q - q_\mathrm{mid}, -g, g)",
    title="Play: no stiffness in a gap about mid-stroke",
    source="Nordin and Gutman (2002), Automatica 38(10), 1633-1649",
)

PRELOAD = force_effect(
    "preload",
    "contact",
    "preload*2/pi*atan((position - (lowest_position + highest_position)/2)/width)",
    {"preload": Amplitude("preload", "force", "F_p", "force that a preloaded spring holds", 1)},
    shapes=(
        ShapeParameter(
            "width",
            "position",
            "w",
            "displacement at which the preload is half taken up",
            range_grid(1 / 256, 1 / 8),
        ),
    ),
    formula=r"F_p \, \frac{2}{\pi} \arctan((q - q_\mathrm{mid}) / w)",
    title="Preload: a spring that is held between stops about mid-stroke",
    source="Den Hartog and Mikina (1932), Forced vibrations with non-linear spring constants,"
    " Trans. ASME 54, 157-164",
)

EFFECTS = (END_STOP_LOWER, END_STOP_UPPER, HERTZIAN_LOWER, HERTZIAN_UPPER, PLAY, PRELOAD)
