"""What an earlier campaign has found, as the prior of a model."""

from __future__ import annotations

from dataclasses import replace

from bayesoleo.errors import ModelError
from bayesoleo.model.correlated import JointNormal
from bayesoleo.model.model import Model


def with_joint_prior(model: Model, joint: JointNormal) -> Model:
    """The model with this prior of some of its parameters, which start at its mean.

    Parameters
    ----------
    model : Model
    joint : JointNormal
        E.g. ``JointNormal.of(point.names, point.theta, point.covariance)`` after an estimate, or
        ``JointNormal.from_draws(names, draws)`` after sampling.

    Returns
    -------
    Model

    Raises
    ------
    ModelError
        If the model has no such parameter, or has it for each run anew: then what was found in the
        earlier runs says nothing of a new one.

    References
    ----------
    Verbeek (1993), section 2.2.4.
    """
    changed = {}
    for name, centre in zip(joint.names, joint.mean, strict=True):
        if name not in model.parameters:
            raise ModelError(
                "the model has no such parameter",
                key=name,
                hint="use " + ", ".join(model.parameters),
            )
        if model.parameters[name].by_run:
            raise ModelError(
                "a parameter by run has no earlier value", key=name, hint="leave it out"
            )
        changed[name] = replace(
            model.parameters[name], value=centre, prior=joint.prior(name), fixed=False
        )
    return model.with_parameters(**changed)
