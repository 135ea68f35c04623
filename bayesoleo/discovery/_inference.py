"""Error model and run-to-run scatter of a fitted model, for posterior sampling."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._parallel import single_blas_thread
from bayesoleo._types import Array
from bayesoleo.discovery._assembly import Assembly
from bayesoleo.discovery._catalogue_mean import linearised_of, shifted
from bayesoleo.discovery._effects_beside_colour import gain_beside_colour
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._noise_of_estimates import NoiseOfEstimates
from bayesoleo.discovery._run_predictions import Prediction
from bayesoleo.discovery._scanned_columns import Scanned
from bayesoleo.discovery._signatures import (
    COLOUR_FALSE_ALARM,
    FittedSignatures,
    Noise,
    more_than_noise_p,
    noise_of,
)
from bayesoleo.effects._effect import Effect
from bayesoleo.error_models._base import Frame
from bayesoleo.error_models._catalogue_discrepancy import CatalogueErrors
from bayesoleo.error_models._correlated import CorrelatedErrors, PowerErrors, effective_samples
from bayesoleo.error_models._fitting import derivatives
from bayesoleo.error_models._independent import IndependentErrors
from bayesoleo.error_models._registry import AUTO, ERROR_MODELS, check_word
from bayesoleo.error_models._spectral import SpectralErrors
from bayesoleo.error_models._stretch import Stretch
from bayesoleo.errors import ModelError
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._identifiability import multistart
from bayesoleo.estimation._problem import ResidualProblem, undisturbed
from bayesoleo.model._model import Model
from bayesoleo.model._priors import Transforms
from bayesoleo.posterior._hierarchy import hierarchical
from bayesoleo.posterior._laplace import (
    Mode,
    find_mode,
    laplace_mixture,
    mixture_of,
    start_coordinates,
)
from bayesoleo.posterior._log_density import LogDensity, PlainUnknowns
from bayesoleo.posterior._mixture import Mixture
from bayesoleo.solvers._orbit import Status

#: The error model that needs signatures.
CATALOGUE = CatalogueErrors.word


@dataclass(frozen=True)
class Inference:
    """What is assumed of errors and of runs.

    Parameters
    ----------
    error_model : str
        One of :data:`~bayesoleo.error_models.ERROR_MODELS`, or ``"auto"`` for the choice of
        :func:`chosen_for`.
    between_runs : tuple of str
        Parameters that scatter between runs about a mean that is estimated.
    reason : str
        Why this error model was chosen; empty where the user did.

    Raises
    ------
    InputError
        If there is no such error model.
    """

    error_model: str = ERROR_MODELS[0]
    between_runs: tuple[str, ...] = ()
    reason: str = ""

    def __post_init__(self) -> None:
        check_word(self.error_model, automatic=True)

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

    def tell(self, fit: ModelFit) -> None:
        """Tell a fit's problem what the error model needs to know of the estimate."""
        # The covariance of a fit that was moved to the mode under these errors contains them.
        if fit.point.objective_name != self.error_model:
            _tell(self.error_model, fit)

    def density(self, fit: ModelFit, jobs: int | None = None, *, told: bool = False) -> LogDensity:
        """The log posterior density of a fitted model; the solver starts from the estimate.

        With ``told`` the fit's problem knows what :meth:`tell` says.
        """
        problem, point = fit.problem, fit.point
        unknowns = None
        if not told:
            self.tell(fit)
        if self.between_runs:
            unknowns = hierarchical(
                problem, self.between_runs, theta=point.theta, errors=self.error_model
            )
        problem.freeze(point.theta)
        density = LogDensity(problem, jobs, errors=self.error_model, unknowns=unknowns)
        density.reason = self.reason
        return density


def _tell(word: str, fit: ModelFit) -> None:
    """Tell the problem what an error model needs to know of the estimate."""
    problem, theta = fit.problem, fit.point.theta
    if word == PowerErrors.word:
        most = np.asarray(problem.counts) / NoiseOfEstimates.of(fit).inflation
        problem.effective = np.minimum(effective_at(problem, theta), most)
    if word == SpectralErrors.word:
        known, transforms = NoiseOfEstimates.of(fit), Transforms.of(problem.priors)
        problem.stretch = Stretch.of(transforms, theta, known.stated, known.covariance)


def effective_at(problem: ResidualProblem, theta: Array) -> Array:
    """Effective numbers of samples (N, s) by the residual at an estimate."""
    errors = [problem.residuals(theta[None], run)[0][0] for run in range(len(problem.runs))]
    return effective_samples(errors, problem.samples)


#: Log odds of the data above which noise alone does not explain a residual.
MORE_THAN_NOISE = 1.5
#: Fewest samples of which correlation is judged.
_FEWEST = 20
#: What errors of the fitted runs are by their size, as parts of reasons. A search that judges more
#: runs together may judge one at the limit of chance otherwise.
MORE = "more than noise is left in the fitted runs"
NO_MORE = f"no {MORE}"
_PLAIN = f"the noise is white, and {NO_MORE}"
_COLOURED = "the spectrum of the noise of {} is not flat (p = {:.1g})"
#: It says nothing of their size: small errors may be unlike noise.
_LEFT = "effects of the catalogue explain the residual better than noise alone: log odds {:.0f}"
_BY_INPUTS = f"noise of measured inputs reaches the outputs, and {NO_MORE}"
_NOT_FLAT = "the spectrum of what is left of {} in transients is not flat (p {})"
_NO_EFFECT = ", and no effect of the catalogue explains it better"
_BEYOND = f"{MORE}, and no effect of the catalogue explains it"
_UNDECIDED = "effects that the data do not tell apart are left: {}"
#: Probability of a residual by noise alone below which effects of the catalogue are looked for in
#: it. Of 145 residuals of simulated campaigns that the catalogue explained better than noise, with
#: effects of one to ten detection limits, 140 lay below; of 60 that lack nothing, 16 did.
LOOKED_FOR = 0.1
#: Part of an output's signal, and times the residual of the estimate, that errors of the catalogue
#: may leave to missing effects. Beyond either one the priors decide, and not the data.
MOST_LEFT, MOST_MORE = 0.8, 1.5
_NO_MORE = (
    "{} errors, although {}. Errors of the catalogue would take {:.0%} of the signal of {} for"
    " missing effects{}; intervals may be too narrow"
)
_NOT_SETTLED = (
    "{} errors, although {}. Outputs are too far from linear about the estimate to say where it"
    " would be under errors of the catalogue{}; intervals may be too narrow"
)
_BECAUSE = " errors, chosen because "
_PRIOR = ", since {} lies {:.3g} standard deviations from its prior"
#: Fall of a prior's log density that is worth a word.
_UNLIKELY = 4.5


@single_blas_thread()  # matrices are small: threads take longer to meet than to work
def chosen_for(
    inference: Inference,
    fit: ModelFit,
    assembly: Assembly,
    *,
    effects: Sequence[Effect] | None = None,
    held_out: Sequence[Prediction] = (),
    undecided: Sequence[str] = (),
    scanned: Scanned | None = None,
    jobs: int | None = None,
) -> Inference:
    """The inference with an error model that is chosen by what the data show.

    The fit's problem receives the signatures of the catalogue, if they are needed. A model that the
    user chose stays.

    Parameters
    ----------
    inference : Inference
    fit : ModelFit
    assembly : Assembly
        What was fitted.
    effects : sequence of Effect, optional
        That the model might lack; by default the catalogue.
    held_out : sequence of Prediction
        Runs that were not fitted, for predictions.
    undecided : sequence of str
        Effects between which the search could not decide.
    scanned : Scanned, optional
        What the last scores of the search computed.
    jobs : int, optional
        Processes.
    """
    word = inference.error_model
    if word not in (AUTO, CATALOGUE):
        return inference
    if not fit.point.status.ok:
        plain = ERROR_MODELS[0] if word == AUTO else word
        return replace(
            inference, error_model=plain, reason=f"the estimate: {fit.point.status.message}"
        )
    noise = noise_of(fit)
    if word == AUTO and not undecided:
        found = _without_catalogue(fit, noise)
        if found is not None:
            return replace(inference, error_model=found[0], reason=found[1])
    signatures = FittedSignatures.of(
        fit, assembly, noise, effects=effects, held_out=held_out, scanned=scanned, jobs=jobs
    )
    if word == CATALOGUE:
        fit.problem.signatures = signatures.with_curves(jobs)
        return inference
    known = NoiseOfEstimates.of(fit)

    def rise(_: bool) -> float:
        # Beside white noise effects explain slow noise too.
        if known.coloured and not undecided:
            beside = gain_beside_colour(fit, signatures.signatures)
            if beside < MORE_THAN_NOISE:
                return beside
        return linearised_of(fit.problem, fit.point.theta, signatures).log_odds

    word, reason = error_model_by(noise.p_value, rise, fit.predictor.outputs, undecided)
    if word == CATALOGUE:
        fit.problem.signatures = signatures.signatures
        word, reason = _unless_priors_decide(fit, reason)
    else:
        word, reason = _by_spectra(known, word, reason, asked=True)
    # Curves are for draws: what runs that were not fitted need of them is computed for these only.
    fit.problem.signatures = signatures.with_curves(jobs) if word == CATALOGUE else None
    return replace(inference, error_model=word, reason=reason)


def _without_catalogue(fit: ModelFit, noise: Noise) -> tuple[str, str] | None:
    """The error model and the reason where effects of the catalogue need not be looked for."""
    as_noise, known = more_than_noise_p(fit, noise) > LOOKED_FOR, NoiseOfEstimates.of(fit)
    # The colour of inputs' noise is that of the model's resonances: effects would imitate it.
    if not (as_noise and not known.beyond) and not (known.inputs_alone and known.shown):
        return None
    word, reason = error_model_by(noise.p_value, lambda _: -np.inf, fit.predictor.outputs)
    return _by_spectra(known, word, reason)


def _by_spectra(
    known: NoiseOfEstimates, word: str, reason: str, *, asked: bool = False
) -> tuple[str, str]:
    """An error model of noise alone, or another one where the spectra or the size of what is left
    say that intervals would be wrong; ``asked`` is whether effects were looked for."""
    spectral, power = SpectralErrors.word, PowerErrors.word
    if known.inputs_alone:
        return spectral, f"{spectral}{_BECAUSE}{_BY_INPUTS}"
    if word != ERROR_MODELS[0]:
        return word, reason
    if known.coloured:
        output = min(known.coloured, key=known.coloured.__getitem__)
        p_value, least = known.coloured[output], 1e-12
        chance = f"= {p_value:.1g}" if p_value > least else f"< {least:.0g}"
        left = _NOT_FLAT.format(output, chance) + (_NO_EFFECT if asked else "")
        return spectral, f"{spectral}{_BECAUSE}{left}"
    if known.beyond:
        return power, f"{power}{_BECAUSE}{_BEYOND}"
    return word, reason


def _unless_priors_decide(fit: ModelFit, reason: str) -> tuple[str, str]:
    """The catalogue's errors, unless they leave most of a signal to effects that may be missing.

    A flexible discrepancy can explain anything, so that the estimate goes where the priors want it.
    """
    before = fit.problem.evaluate(fit.point.theta).residual
    mean = shifted(fit.problem, fit.point.theta)
    if not mean.settled:
        cause = reason.partition(_BECAUSE)[2]
        return PowerErrors.word, _NOT_SETTLED.format(PowerErrors.word, cause, _conflict(fit))
    after = fit.problem.evaluate(mean.theta)
    for b, output in enumerate(fit.predictor.outputs):
        signal = float(np.std(np.concatenate([run.measured[b] for run in fit.predictor.runs])))
        left = np.inf
        if after.status.ok:
            left = float(np.sqrt(np.mean(after.residual[b] ** 2)))
        if left > max(MOST_LEFT * signal, MOST_MORE * float(np.sqrt(np.mean(before[b] ** 2)))):
            # What is left is alike from sample to sample, and is not to count as if it were noise.
            word, part = PowerErrors.word, min(left / signal, 1.0)
            cause = reason.partition(_BECAUSE)[2]
            return word, _NO_MORE.format(word, cause, part, output, _conflict(fit))
    return CATALOGUE, reason


def _conflict(fit: ModelFit) -> str:
    """The unknown whose estimate is least likely by its prior, if one is."""
    theta, priors = fit.point.theta, fit.problem.priors
    falls = [
        float(prior.log_density(prior.mean) - prior.log_density(value))
        for prior, value in zip(priors, theta, strict=True)
    ]
    worst = int(np.argmax(falls))
    if not falls[worst] > _UNLIKELY:
        return ""
    return _PRIOR.format(fit.problem.names[worst], float(np.sqrt(2 * falls[worst])))


def error_model_by(
    p_values: Sequence[float],
    rise: Callable[[bool], float],
    outputs: Sequence[str],
    undecided: Sequence[str] = (),
) -> tuple[str, str]:
    """The error model that suits what was found, and the reason in a sentence.

    Parameters
    ----------
    p_values : sequence of float, length s
        Probabilities of the outputs' noise if its spectrum were flat.
    rise : callable
        Of whether noise is coloured: log odds of more than noise, see :func:`linearised_of`.
    outputs : sequence of str, length s
    undecided : sequence of str
        Effects between which a search could not decide.
    """
    least = float(np.min(p_values, initial=1.0))
    coloured = least < COLOUR_FALSE_ALARM / len(p_values)
    word, left = ERROR_MODELS[0], _PLAIN
    if coloured:
        word = "correlated"
        left = _COLOURED.format(outputs[int(np.argmin(p_values))], least)
    if undecided:
        word, left = CATALOGUE, _UNDECIDED.format(", ".join(undecided))
    found = rise(coloured)
    if found > MORE_THAN_NOISE:
        word, left = CATALOGUE, _LEFT.format(found)
    return word, f"{word}{_BECAUSE}{left}"


#: Rise of the log-likelihood above which neighbouring residuals are alike: one chance in a
#: thousand, by a chi-square distribution with two degrees of freedom.
_ALIKE = 6.9


def function_errors(problem: ResidualProblem, theta: Array, word: str) -> tuple[str, str]:
    """The error model of a function's residual, and why; a user's choice stays, without reason.

    Without repetition, noise that is correlated and a smooth missing term look alike: both call for
    correlated errors.

    Parameters
    ----------
    problem : ResidualProblem
    theta : ndarray, shape (l,)
        The estimate.
    word : str
        One of :data:`~bayesoleo.error_models.ERROR_MODELS`, or ``"auto"``.
    """
    if word != AUTO:
        return word, ""
    plain = ERROR_MODELS[0]
    residual, status = problem.residuals(theta[None], 0)
    if status[0] or residual.shape[2] < _FEWEST:
        return plain, f"{plain} errors: too few samples to see whether they are correlated"
    errors = CorrelatedErrors(Frame.of(problem))
    eta = errors.start([residual[0]])[None]
    white = IndependentErrors(errors.frame)
    sums = np.sum(residual**2, axis=2)[None]
    before = white.of_sums(sums, white.start([residual[0]])[None])
    rise = float((errors.of_runs([residual], eta) - before).sum())
    if rise > _ALIKE:
        why = f"neighbouring residuals are alike: the log-likelihood rises by {rise:.3g}"
        return "correlated", f"correlated errors, chosen because {why}"
    return plain, f"{plain} errors, chosen because neighbouring residuals are not alike"


def mode_of(density: LogDensity, fit: ModelFit) -> Mode:
    """The mode next to an estimate; with the catalogue's errors the mean of the posterior.

    Under these the posterior is a mixture over effects, of which a mode knows one only.
    """
    plain = isinstance(density.unknowns, PlainUnknowns)
    if density.errors.word != CATALOGUE or not plain:
        return find_mode(density, start_coordinates(density, fit.point.theta))
    mean = shifted(fit.problem, fit.point.theta)
    theta, found = mean.theta, mean.found
    sd = np.array([prior.sd for prior in fit.problem.priors])
    fit.problem.freeze(theta)
    return _summary_mode(density, theta, found.covariance * np.outer(sd, sd))


def _summary_mode(density: LogDensity, theta: Array, covariance: Array) -> Mode:
    """A normal approximation with given moments of the unknowns; the errors at their mode."""
    phi, size = start_coordinates(density, theta), len(theta)
    chain = np.linalg.inv(density.unknowns.jacobian(phi[:size]))
    scales = np.diag(density.errors.scales())

    def height(eta: Array) -> Array:
        return density(np.hstack([np.repeat(phi[None, :size], len(eta), axis=0), eta]))[0]

    _, _, hessian = derivatives(height, phi[size:], scales)
    values, vectors = np.linalg.eigh(-hessian)
    # A direction that the residual does not determine keeps its prior, of about unit width.
    whole = scales @ vectors
    full = np.zeros((len(phi), len(phi)))
    full[:size, :size] = chain @ covariance @ chain.T
    full[size:, size:] = whole / np.maximum(values, np.diag(scales).min() ** 2) @ whole.T
    return Mode(phi, full, 0.0, Status.CONVERGED)


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
    if density.errors.word == CATALOGUE and isinstance(density.unknowns, PlainUnknowns):
        return _catalogue_mixture(density, theta)
    begins = [theta]
    # Other starts lead to other branches of a motion, from which none leads back.
    if starts:
        rng = np.random.default_rng(seed)
        with undisturbed(density.problem):
            begins += [mode.theta for mode in multistart(density.problem, starts, rng)]
    with undisturbed(density.problem):
        mixture = laplace_mixture(density, np.array(begins))
    heaviest = density.split(mixture.centres[:1])[0]
    if isinstance(density.problem, CampaignProblem):
        density.problem.freeze(density.unknowns.theta(heaviest)[0])
    return mixture


def _catalogue_mixture(density: LogDensity, theta: Array) -> Mixture:
    """One component for each of the likeliest effects that act alone, and one for all else.

    These are what the posterior under errors of the catalogue is made of.
    """
    problem = cast(CampaignProblem, density.problem)
    mean = shifted(problem, theta)
    centre, found, origin = mean.theta, mean.found, mean.place
    sd = np.array([prior.sd for prior in problem.priors])
    low, high = np.array([prior.support for prior in problem.priors], dtype=float).T
    groups = [(weight, origin + shift * sd, spread) for weight, shift, spread in found.groups]
    groups = [one for one in groups if one[0] > 0 and np.all((one[1] > low) & (one[1] < high))]
    # A step that was not believed leads nowhere for one effect alone either.
    near = mean.near([place for _, place, _ in groups])
    modes = []
    for (weight, place, covariance), known in zip(groups, near, strict=True):
        if known:
            mode = _summary_mode(density, place, covariance * np.outer(sd, sd))
            modes.append(replace(mode, log_weight=float(np.log(weight))))
    if not modes:
        modes = [_summary_mode(density, centre, found.covariance * np.outer(sd, sd))]
    problem.freeze(centre)
    return mixture_of(modes)


def at_mode(
    fit: ModelFit, density: LogDensity, mode: Mode, word: str, reason: str = ""
) -> ModelFit:
    """The fit with its point at the mode of a density under another error model, and why that."""
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
        remarks=(reason,) if reason else (),
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
