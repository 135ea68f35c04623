"""Fit an assembled model to the runs of a campaign."""

from bayesoleo.tracing.fitting.assembly import Assembly
from bayesoleo.tracing.fitting.fit import Fit, Numerics, fit_model
from bayesoleo.tracing.fitting.roles import Roles, assign

__all__ = ["Assembly", "Fit", "Numerics", "Roles", "assign", "fit_model"]
