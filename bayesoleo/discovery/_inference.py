"""Error model and run-to-run scatter of a fitted model, for posterior sampling."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._types import Array
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.error_models._registry import ERROR_MODELS, check_word
from bayesoleo.errors import ModelError
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._multistart import multistart
from bayesoleo.model._model import Model
from bayesoleo.posterior._hierarchy import hierarchical
from bayesoleo.posterior._laplace import Mode, find_mode, laplace_mixture, start_coordinates
from bayesoleo.posterior._log_density import LogDensity
from bayesoleo.posterior._mixture import Mixture


@dataclass(frozen=True)
class Inference:
    """What is assumed of errors and of runs.

    Parameters
    ----------
    error_model : str
        One of :data:`~bayesoleo.error_models.ERROR_MODELS`.
    between_runs : tuple of str
        Parameters that scatter between runs about a mean that is estimated.

    Raises
    ------
    InputError
        If there is no such error model.
    """

    error_model: str = ERROR_MODELS[0]
    between_runs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_word(self.error_model)

    @property
    def plain(self) -> bool:
        """Whether the estimate's own objective is what is sampled (Verbeek 1993, eq. 2.29)."""
        return self.error_model == ERROR_MODELS[0] and not self.between_runs

    def declare(self, model: Model) -> Model:
        """The model with a value of each run's own for what scatters between runs.

        Raises
        ------
        ModelError
            If it has no such parameter, or it is not estimated.
        """
        estimated = model.estimated()
        for name in self.between_runs:
            if name not in estimated:
                raise ModelError(
                    f"model {model.name!r} does not estimate this parameter",
                    key="between_runs",
                    value=name,
                    hint=f"choose from {', '.join(estimated)}",
                )
        for name in self.between_runs:
            for taken in (schema.population_mean(name), schema.spread(name)):
                if taken in model.parameters:
                    raise ModelError(
                        f"model {model.name!r}: parameter {taken!r} has the name of what scatters"
                        f" between runs of {name!r}",
                        key="between_runs",
                        value=name,
                        hint=f"rename {taken}",
                    )
        chosen = {name: replace(model.parameters[name], by_run=True) for name in self.between_runs}
        return model.with_parameters(**chosen) if chosen else model

    def density(self, fit: ModelFit, jobs: int | None = None) -> LogDensity:
        """The log posterior density of a fitted model; the solver starts from the estimate."""
        problem, point = fit.problem, fit.point
        unknowns = None
        if self.between_runs:
            unknowns = hierarchical(
                problem, self.between_runs, theta=point.theta, errors=self.error_model
            )
        problem.freeze(point.theta)
        return LogDensity(problem, jobs, errors=self.error_model, unknowns=unknowns)


def mode_of(density: LogDensity, theta: Array) -> Mode:
    """The mode next to a parameter vector."""
    return find_mode(density, start_coordinates(density, theta))


def mixture_at(density: LogDensity, theta: Array, *, starts: int = 0, seed: int = 0) -> Mixture:
    """Where walkers begin: the modes next to an estimate, and those that other starts lead to.

    Parameters
    ----------
    density : LogDensity
    theta : ndarray, shape (l,)
        The estimate.
    starts : int
        Starts drawn from the priors, from which MBE and BE look for other modes.
    seed : int
        Seeds them.

    Returns
    -------
    Mixture
        The solver is anchored at its heaviest mode, whatever was visited on the way.
    """
    begins = [theta]
    if starts:
        rng = np.random.default_rng(seed)
        begins += [mode.theta for mode in multistart(density.problem, starts, rng)]
    mixture = laplace_mixture(density, np.array(begins))
    heaviest = density.split(mixture.centres[:1])[0]
    if isinstance(density.problem, CampaignProblem):
        density.problem.freeze(density.unknowns.theta(heaviest)[0])
    return mixture


def at_mode(fit: ModelFit, density: LogDensity, mode: Mode, word: str) -> ModelFit:
    """The fit with its point at the mode of a density under another error model."""
    block, eta = (part[0] for part in density.split(mode.centre[None]))
    theta = density.unknowns.theta(block[None])[0]
    jacobian = density.unknowns.jacobian(block)
    size = len(block)
    covariance = jacobian @ mode.covariance[:size, :size] @ jacobian.T
    variance = np.exp(eta[: len(fit.problem.outputs)])
    point = replace(
        fit.point,
        theta=theta,
        covariance=covariance,
        variance=variance,
        error_covariance=np.diag(variance),
        status=mode.status,
        objective_name=word,
    )
    fit.problem.freeze(theta)
    predictions = fit.problem.predictor.predict(fit.problem.full(theta[None])[0])
    return replace(fit, point=point, predictions=predictions)


def mode_group(density: LogDensity, mode: Mode, word: str) -> xr.Dataset:
    """The group ``error_model``: the mode of all that is not a parameter of the model."""
    names = density.names
    first = len(density.problem.names)
    natural = density.natural(mode.centre[None])[0]
    # By differences of a hundredth of a standard deviation: a quantity may follow from several
    # coordinates.
    steps = 0.01 * np.diag(np.sqrt(np.diag(mode.covariance)))
    ahead, behind = (density.natural(mode.centre + sign * steps) for sign in (1, -1))
    slope = (ahead - behind) / (2 * np.diag(steps)[:, None])
    sd = np.sqrt(np.diag(slope.T @ mode.covariance @ slope))
    return xr.Dataset(
        {
            schema.ESTIMATE: (schema.QUANTITY, natural[first:], _about("posterior mode")),
            schema.SD: (schema.QUANTITY, sd[first:], _about("standard deviation at the mode")),
        },
        coords={schema.QUANTITY: list(names[first:])},
        attrs={"word": word},
    )


def _about(text: str) -> dict[str, str]:
    return {schema.LONG_NAME: text, schema.UNITS: "unit of each quantity"}
