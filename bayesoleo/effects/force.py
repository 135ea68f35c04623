"""Forces that follow no motion, and inertia."""

from __future__ import annotations

from collections.abc import Sequence

from bayesoleo.effects.effect import Amplitude, Effect, Names
from bayesoleo.effects.force_effect import force_effect
from bayesoleo.effects.places import is_quantity, substitute
from bayesoleo.model import Model
from bayesoleo.model.expressions import symbol

#: Name under which a model may declare the acceleration of gravity.
GRAVITY = "gravity"

CONSTANT = force_effect(
    "constant_force",
    "force",
    "constant_force",
    {"constant_force": Amplitude("constant_force", "force", "F_0", "constant force")},
    formula="F_0",
    title="Constant force (preload, weight)",
)

OFFSET_BY_RUN = force_effect(
    "force_offset_by_run",
    "force",
    "force_offset_by_run",
    {
        "force_offset_by_run": Amplitude(
            "force_offset_by_run", "force", "F_{0,r}", "constant force of the run", by_run=True
        )
    },
    formula="F_{0,r}",
    title="Constant force, different in every run",
)

MASS = force_effect(
    "mass_error",
    "force",
    "mass_error*acceleration",
    {"mass_error": Amplitude("mass_error", "force/(position/s**2)", r"\Delta m", "added mass")},
    formula=r"\Delta m \, \ddot q",
    title="Mass error (inertia)",
)


def _declares_gravity(model: Model) -> Sequence[str]:
    """Models that name it and use it."""
    return (GRAVITY,) if is_quantity(model, GRAVITY) else ()


def _heavier(model: Model, target: str, names: Names) -> Model:
    return substitute(model, {symbol(target): symbol(target) + names["gravity_error"]})


GRAVITY_ERROR = Effect(
    id="gravity_error",
    family="force",
    title="Gravity error (a rig that is not upright)",
    formula=r"g + \Delta g",
    amplitudes=(
        Amplitude("gravity_error", "parameter", r"\Delta g", "acceleration beyond that stated"),
    ),
    places=_declares_gravity,
    change=_heavier,
    applies_to=f"models that declare {GRAVITY}",
)

EFFECTS = (CONSTANT, OFFSET_BY_RUN, MASS, GRAVITY_ERROR)
