"""The error models by name.

Each model has up to two forms: quantities that are sampled with the parameters
(:class:`ErrorModel`), and a covariance that point estimators eliminate in each iteration
(:class:`ProfiledErrorModel`). A new model is one file, its import and one line in ``_REGISTRY``.

====================== =============================================================================
word                   errors
====================== =============================================================================
``independent``        one variance for each output (Verbeek 1993, eqs. 2.29-2.30)
``per-run``            one variance for each output and run
``full``               one covariance over the outputs (eqs. 2.27-2.28)
``correlated``         white noise and an Ornstein-Uhlenbeck process in time, for each output
``discrepancy``        white noise and a periodic Gaussian process over phase, for each output
``shared-discrepancy`` as ``discrepancy``, with a part of the process that all runs share
``catalogue``          all effects that the model might lack, and a smooth remainder
``power``              as ``independent``, the likelihood to the power of the effective samples
``spectral``           as ``independent``, as wide as the noise's spectra make the estimate
``common``             one variance for all outputs; eliminated only
``given``              known variances or covariances; eliminated only
====================== =============================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from bayesoleo.error_models._base import ErrorModel, Frame, Measured, ProfiledErrorModel
from bayesoleo.error_models._catalogue_discrepancy import CatalogueErrors
from bayesoleo.error_models._correlated import CorrelatedErrors, PowerErrors
from bayesoleo.error_models._discrepancy import DiscrepancyErrors, SharedDiscrepancyErrors
from bayesoleo.error_models._full import FullErrors, GivenErrors, ProfiledFullErrors
from bayesoleo.error_models._independent import (
    IndependentErrors,
    PerRunErrors,
    ProfiledCommonErrors,
    ProfiledIndependentErrors,
)
from bayesoleo.error_models._spectral import SpectralErrors
from bayesoleo.errors import InputError, choose
from bayesoleo.model._priors import Prior


@dataclass(frozen=True)
class _Forms:
    """The sampled and the eliminated form of a model; None where it lacks one."""

    sampled: type[ErrorModel] | None
    profiled: type[ProfiledErrorModel] | None


_REGISTRY = {
    "independent": _Forms(IndependentErrors, ProfiledIndependentErrors),
    "per-run": _Forms(PerRunErrors, None),
    "full": _Forms(FullErrors, ProfiledFullErrors),
    "correlated": _Forms(CorrelatedErrors, None),
    "discrepancy": _Forms(DiscrepancyErrors, None),
    "shared-discrepancy": _Forms(SharedDiscrepancyErrors, None),
    "catalogue": _Forms(CatalogueErrors, None),
    "power": _Forms(PowerErrors, None),
    "spectral": _Forms(SpectralErrors, None),
    "common": _Forms(None, ProfiledCommonErrors),
    "given": _Forms(None, GivenErrors),
}
#: Names of the models that can be sampled; the first is the default.
ERROR_MODELS: tuple[str, ...] = tuple(word for word, form in _REGISTRY.items() if form.sampled)


#: Chooses by what the data show.
AUTO = "auto"


def check_word(word: str, *, automatic: bool = False) -> str:
    """The word, if there is such an error model.

    Parameters
    ----------
    word : str
    automatic : bool
        Whether :data:`AUTO` is one.

    Raises
    ------
    InputError
        If there is none.
    """
    known = (AUTO, *ERROR_MODELS) if automatic else ERROR_MODELS
    if word not in known:
        hint = choose(word, known)
        raise InputError("unknown error model", key="error_model", value=word, hint=hint)
    return word


def error_model(
    word: str, problem: Measured, *, log_variance_prior: Mapping[str, Prior] | None = None
) -> ErrorModel:
    """The error model of that name, bound to a problem's outputs and runs.

    Parameters
    ----------
    word : str
        One of :data:`ERROR_MODELS`.
    problem : Problem
        Problem to fit. All but ``independent`` and ``per-run`` need one that gives residuals by
        sample, as a :class:`~bayesoleo.estimation.CampaignProblem` does.
    log_variance_prior : mapping of str to Prior, optional
        By output, the prior of the logarithm of its variance; by default flat.

    Raises
    ------
    InputError
        If there is no such model, or it does not suit the problem.
    """
    kind = _REGISTRY[check_word(word)].sampled
    assert kind is not None
    return kind(Frame.of(problem, log_variance_prior))


def profiled_error_model(word: str) -> ProfiledErrorModel:
    """The form of an error model that point estimators eliminate, for ``V`` that is unknown."""
    kind = _REGISTRY[word].profiled
    assert kind is not None
    return kind()
