"""A drop test of a suspension: released from rest, fully extended (Verbeek 1993, section 6.4).

The mass sits on top, so that gravity compresses what it worked against on the shaker; no force
drives the motion, and the force that the ground feels is an output.
"""

from __future__ import annotations

from dataclasses import replace

import sympy as sp

from bayesoleo.errors import ModelError
from bayesoleo.model import Condition, Model, Output
from bayesoleo.model.expressions import split_derivative, symbol

#: Terms of the equation of motion that the ground does not feel.
_NOT_TRANSMITTED = ("inertia", "weight", "excitation")


def drop_test(model: Model) -> Model:
    """Turn a suspension's model into that of its drop test.

    Parameters
    ----------
    model : Model
        Driven by a force, with the parameters ``mass`` and ``gravity`` and, in the equation of its
        stroke, the terms ``inertia``, ``weight`` and ``excitation``: an oleo of the package, also
        one that effects have been added to, or one declared alike.

    Returns
    -------
    Model
        Without inputs. The mass is a condition of the run, kg; gravity compresses; every dof starts
        at its declared start, the stroke at zero and at rest, what has none in equilibrium. Beside
        the model's outputs there are ``velocity`` and ``force``, what gas, damping and friction
        (and every effect) put on the ground.

    Raises
    ------
    ModelError
        If the model has no such equation.

    References
    ----------
    Verbeek (1993), section 6.4: theta_1 is the mass, theta_2 = -9.81 m/s², F_e = 0.
    """
    dof = _suspended(model)
    (force,) = model.inputs
    terms = dict(model.equations[dof])
    del terms["excitation"]
    terms["weight"] = -terms["weight"]
    felt = {name: term for name, term in terms.items() if name not in _NOT_TRANSMITTED}
    dofs = {
        name: replace(item, initial="equilibrium") if item.initial is None else item
        for name, item in model.dofs.items()
    }
    dofs[dof] = replace(model.dofs[dof], initial=0.0, initial_rate=0.0)
    unit = model.dofs[dof].unit
    return replace(
        model,
        name=f"{model.name} drop test",
        description=f"{model.description} Released from rest at full extension.",
        inputs={},
        dofs=dofs,
        equations={**model.equations, dof: terms},
        parameters={name: item for name, item in model.parameters.items() if name != "mass"},
        conditions={**model.conditions, "mass": Condition("kg", None, "of what is dropped")},
        outputs={
            **{name: item for name, item in model.outputs.items() if name != force},
            "velocity": Output({"velocity": symbol(f"dot({dof})")}, f"{unit}/s"),
            "force": Output(felt, model.inputs[force]),
        },
    )


def _suspended(model: Model) -> str:
    """The dof that the mass moves in."""
    for dof, terms in model.equations.items():
        named = all(name in terms for name in _NOT_TRANSMITTED)
        if named and len(model.inputs) == 1 and {"mass", "gravity"} <= set(model.parameters):
            (force,) = model.inputs
            excited = sp.Add(*terms.values()).has(symbol(force))
            others = [model.expand(e) for name, e in terms.items() if name != "excitation"]
            elsewhere = any(
                split_derivative(item)[0] == force for e in others for item in e.free_symbols
            )
            if excited and not elsewhere:
                return dof
    raise ModelError(
        f"model {model.name!r} is no suspension that could be dropped",
        hint="it needs one input, a force; the parameters mass and gravity; and the terms"
        " inertia, weight and excitation in the equation of its stroke",
    )
