"""What the errors of the outputs have in common: one word each, sampled with the parameters.

=============== ====================================================================================
word            errors
=============== ====================================================================================
``independent`` one variance for each output (Verbeek 1993, eqs. 2.29-2.30)
``per-run``     one variance for each output and run
``full``        one covariance over the outputs (eqs. 2.27-2.28)
``correlated``  white noise and an Ornstein-Uhlenbeck process in time, for each output
``discrepancy`` white noise and a Gaussian process over phase that repeats itself, for each output
=============== ====================================================================================

``shared-discrepancy`` is the last with a part of the process that all runs share.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping

from bayesoleo.errors import InputError
from bayesoleo.estimation.problems.problem import Problem
from bayesoleo.model.priors import Prior
from bayesoleo.posterior.density.error_models.base import ErrorModel, Frame, Quantity
from bayesoleo.posterior.density.error_models.correlated import CorrelatedErrors
from bayesoleo.posterior.density.error_models.discrepancy import DiscrepancyErrors
from bayesoleo.posterior.density.error_models.full import FullErrors
from bayesoleo.posterior.density.error_models.independent import IndependentErrors, PerRunErrors
from bayesoleo.posterior.density.error_models.shared import SharedDiscrepancyErrors

__all__ = [
    "ERROR_MODELS",
    "CorrelatedErrors",
    "DiscrepancyErrors",
    "ErrorModel",
    "Frame",
    "FullErrors",
    "IndependentErrors",
    "PerRunErrors",
    "Quantity",
    "SharedDiscrepancyErrors",
    "check_word",
    "error_model",
]

_KINDS: tuple[type[ErrorModel], ...] = (
    IndependentErrors,
    PerRunErrors,
    FullErrors,
    CorrelatedErrors,
    DiscrepancyErrors,
    SharedDiscrepancyErrors,
)
#: The words that choose them; the first is the default.
ERROR_MODELS: tuple[str, ...] = tuple(kind.word for kind in _KINDS)


def check_word(word: str) -> str:
    """The word, if there is such an error model.

    Raises
    ------
    InputError
        If there is none.
    """
    if word not in ERROR_MODELS:
        close = difflib.get_close_matches(word, ERROR_MODELS, 1)
        hint = f"did you mean {close[0]}? " if close else ""
        raise InputError(
            "unknown error model",
            key="error_model",
            value=word,
            hint=f"{hint}one of {', '.join(ERROR_MODELS)}",
        )
    return word


def error_model(
    word: str, problem: Problem, *, log_variance_prior: Mapping[str, Prior] | None = None
) -> ErrorModel:
    """The error model of that name, bound to a problem's outputs and runs.

    Parameters
    ----------
    word : str
        One of :data:`ERROR_MODELS`.
    problem : Problem
        What is fitted. All but ``independent`` and ``per-run`` need one that gives residuals by
        sample, :class:`~bayesoleo.estimation.problems.residuals.ResidualProblem`.
    log_variance_prior : mapping of str to Prior, optional
        By output, the prior of the logarithm of its variance; by default flat.

    Raises
    ------
    InputError
        If there is no such model, or it does not suit the problem.
    """
    kind = _KINDS[ERROR_MODELS.index(check_word(word))]
    return kind(Frame.of(problem, log_variance_prior))
