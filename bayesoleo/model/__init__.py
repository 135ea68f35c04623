"""Declare a model as named terms, derive its partials, and generate kernels that evaluate them."""

from bayesoleo.model.correlated import JointNormal
from bayesoleo.model.drive import driven_by, possible_drives
from bayesoleo.model.earlier import with_joint_prior
from bayesoleo.model.model import Model
from bayesoleo.model.parameter import Condition, Coordinate, Dof, Output, Parameter
from bayesoleo.model.priors import LogNormal, Normal, Prior, TruncatedNormal, Uniform

__all__ = [
    "Condition",
    "Coordinate",
    "Dof",
    "JointNormal",
    "LogNormal",
    "Model",
    "Normal",
    "Output",
    "Parameter",
    "Prior",
    "TruncatedNormal",
    "Uniform",
    "driven_by",
    "possible_drives",
    "with_joint_prior",
]
