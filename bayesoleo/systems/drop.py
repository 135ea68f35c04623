"""The oleo in a drop test: a mass on top, released at rest with the oleo fully extended.

Gravity compresses, nothing else drives, and the force of the oleo is measured (Verbeek 1993,
section 6.4: theta_1 = 350 or 825 kg, F_e = 0, theta_2 = -9.81 m/s**2).
"""

from __future__ import annotations

from dataclasses import replace

from bayesoleo.errors import InputError
from bayesoleo.model import Model, Output

#: Terms of the equation of motion that the oleo puts up against the mass.
REACTION = ("damping", "gas_spring", "friction", "atmosphere")


def drop_test(model: Model, mass: float) -> Model:
    """An oleo of the thesis as it stands in a drop test.

    Parameters
    ----------
    model : Model
        A built-in oleo in its own drive, at any parameter values; effects may have been added.
    mass : float
        Dropped, kg.

    Returns
    -------
    Model
        Without input; it starts extended, at rest and at ambient temperature, and has ``force`` as
        an output besides its own: damping, gas spring, friction and atmosphere together.

    Raises
    ------
    InputError
        If the model has no such equation of motion, or the mass is not positive.
    """
    terms = model.equations.get("stroke", {})
    missing = [name for name in ("inertia", "weight", "excitation", *REACTION) if name not in terms]
    if missing or "force" not in model.inputs:
        raise InputError(
            f"model {model.name!r} is no oleo driven by force",
            value=missing or list(model.inputs),
            hint="give a built-in one, e.g. system('f16n2d2'), before choosing another drive",
        )
    if not mass > 0:
        raise InputError("a drop needs a positive mass", key="mass", value=mass)
    motion = {name: term for name, term in terms.items() if name != "excitation"}
    starts = {"stroke": (0.0, 0.0), "temperature": ("ambient_temperature", None)}
    dofs = {
        name: replace(dof, initial=starts[name][0], initial_rate=starts[name][1])
        if name in starts
        else dof
        for name, dof in model.dofs.items()
    }
    gravity = abs(model.parameters["gravity"].value)
    return replace(
        model,
        name=f"{model.name}_drop",
        description=f"{model.description} In a drop test with {mass:g} kg.",
        inputs={},
        dofs=dofs,
        equations={**model.equations, "stroke": motion},
        outputs={**model.outputs, "force": Output({k: terms[k] for k in REACTION}, "N")},
    ).with_values({"mass": mass, "gravity": -gravity})
