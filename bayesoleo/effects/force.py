"""Forces that follow no motion, and inertia."""

from __future__ import annotations

from bayesoleo.effects.effect import Amplitude
from bayesoleo.effects.force_effect import force_effect

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

EFFECTS = (CONSTANT, OFFSET_BY_RUN, MASS)
