"""Error models: what the errors of the outputs have in common."""

from bayesoleo.error_models.base import ErrorModel, Frame, ProfiledErrorModel, Quantity
from bayesoleo.error_models.correlated import CorrelatedErrors
from bayesoleo.error_models.discrepancy import DiscrepancyErrors
from bayesoleo.error_models.full import FullErrors
from bayesoleo.error_models.given import GivenErrors
from bayesoleo.error_models.independent import IndependentErrors, PerRunErrors
from bayesoleo.error_models.registry import (
    ERROR_MODELS,
    check_word,
    error_model,
    profiled_error_model,
)
from bayesoleo.error_models.shared import SharedDiscrepancyErrors

__all__ = [
    "ERROR_MODELS",
    "CorrelatedErrors",
    "DiscrepancyErrors",
    "ErrorModel",
    "Frame",
    "FullErrors",
    "GivenErrors",
    "IndependentErrors",
    "PerRunErrors",
    "ProfiledErrorModel",
    "Quantity",
    "SharedDiscrepancyErrors",
    "check_word",
    "error_model",
    "profiled_error_model",
]
