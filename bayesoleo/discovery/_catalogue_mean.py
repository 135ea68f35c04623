"""Where unknowns are if errors are those of the catalogue: the mean of their posterior.

The posterior is a mixture of normal distributions where outputs are linear in the unknowns
(:meth:`~bayesoleo.error_models.CatalogueErrors.linearised`). Elsewhere its mean is approached in
steps, as in the method of Gauss and Newton. A missing effect that may be large lets the mean lie
far from the estimate, where the slopes of the outputs no longer hold. A step is therefore halved
until the density at its end is about what the slopes foresee.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array
from bayesoleo.discovery._principal_unknowns import PrincipalUnknowns
from bayesoleo.discovery._signatures import FittedSignatures
from bayesoleo.error_models._base import Frame
from bayesoleo.error_models._catalogue_discrepancy import CatalogueErrors
from bayesoleo.error_models._catalogue_evidence import Linearised
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.estimation._problem import Evaluation, undisturbed

#: Times that the estimate under the catalogue's errors is linearised anew.
_PASSES = 8
#: Step, in standard deviations, below which it is not, and below which the mean is known.
_SMALL, _KNOWN = 0.1, 1.0
#: Times that a step is halved, the part of a foreseen rise of the log density that must come, and
#: what it may lack of that or fall below a foreseen fall.
_HALVINGS, _SOME, _DOUBTED = 8, 0.25, 0.1
#: Error of a sample from which on a motion has run away.
_RUN_AWAY = 1e100
#: How far below the mean's an effect's own density may lie where that effect acts alone.
_FAR = 20.0


def linearised_of(
    problem: CampaignProblem, theta: Array, signatures: FittedSignatures
) -> Linearised:
    """Posterior about an estimate with effects of the catalogue and a smooth remainder.

    Unknowns are in units of their priors' standard deviations. See
    :meth:`~bayesoleo.error_models.CatalogueErrors.linearised`.
    """
    found, scale = problem.evaluate(theta), PriorScale.of(problem.priors, problem.names)
    unknowns = PrincipalUnknowns.of(found, scale, theta, signatures.about.noise)
    both = [np.vstack([j.T, e]) for j, e in zip(unknowns.sensitivity, found.residual, strict=True)]
    evidence, rows = signatures.evidence(_by_run(problem, both))
    return unknowns.back(evidence.linearised(rows, unknowns.precision, unknowns.pull))


def _by_run(problem: CampaignProblem, columns: Sequence[Array]) -> list[list[Array]]:
    """Arrays of each output over all samples, by run."""
    counts = problem.counts
    ends = np.cumsum(counts, axis=0)
    return [
        [column[..., a:b] for column, a, b in zip(columns, first, last, strict=True)]
        for first, last in zip(ends - counts, ends, strict=True)
    ]


class _About:
    """Errors of the catalogue for the residuals of a problem that has signatures."""

    def __init__(self, problem: CampaignProblem) -> None:
        self.problem = problem
        self.errors = CatalogueErrors(Frame.of(problem))
        self.scale = PriorScale.of(problem.priors, problem.names)
        assert problem.signatures is not None
        self.noise = problem.signatures.noise

    def linearised(self, theta: Array, found: Evaluation) -> Linearised:
        """Posterior about what was evaluated there."""
        unknowns = PrincipalUnknowns.of(found, self.scale, theta, self.noise)
        turned = self.errors.linearised(
            _by_run(self.problem, [j.T for j in unknowns.sensitivity]),
            _by_run(self.problem, found.residual),
            unknowns.precision,
            unknowns.pull,
        )
        return unknowns.back(turned)

    def height(self, theta: Array, residual: Sequence[Array]) -> float:
        """Log posterior density of unknowns with such residuals, up to a constant."""
        prior = float(self.scale.log_density(theta[None])[0])
        return prior + self.errors.log_evidence(_by_run(self.problem, residual))


@dataclass(frozen=True)
class CatalogueMean:
    """Where unknowns are if errors are those of the catalogue.

    Parameters
    ----------
    theta : ndarray, shape (l,)
        Mean of their posterior, as far as the slopes of the outputs lead there.
    found : Linearised
        The last linearisation.
    place : ndarray, shape (l,)
        Where that was.
    about : _About
        The errors, for what is asked of other places.
    settled : bool
        Whether the mean was reached: the last step to it was shorter than a standard deviation, and
        not the first one if no part of that was believed.
    """

    theta: Array
    found: Linearised
    place: Array
    about: _About
    settled: bool = True

    def near(self, places: Sequence[Array]) -> list[bool]:
        """Whether the density at places, each of shape (l,), is not far below that at the mean."""
        heights = []
        for theta in (self.theta, *places):
            with undisturbed(self.about.problem):
                there = self.about.problem.evaluate(theta)
            known = there.status.ok
            heights.append(self.about.height(theta, there.residual) if known else -np.inf)
        return [bool(height > heights[0] - _FAR) for height in heights[1:]]


def shifted(problem: CampaignProblem, theta: Array) -> CatalogueMean:
    """Mean of the posterior under the catalogue's errors, from an estimate."""
    about = _About(problem)
    sd, here, length = about.scale.sd, problem.evaluate(theta), np.inf
    for number in range(_PASSES):
        found, place = about.linearised(theta, here), theta
        step = _inside(found, _room(about, theta))
        length = float(np.max(np.abs(step) / np.sqrt(np.diag(found.covariance))))
        reached = _as_far_as_believed(about, theta, here, step * sd)
        if reached is None:
            length = np.inf if number == 0 and length >= _SMALL else length
            break
        theta, here = reached, problem.evaluate(reached)
        if length < _SMALL:
            break
    return CatalogueMean(theta, found, place, about, length < _KNOWN)


def _room(about: _About, theta: Array) -> tuple[Array, Array]:
    """From unknowns to the limits of their supports, in units of the priors' deviations."""
    low, high = np.array([prior.support for prior in about.problem.priors], dtype=float).T
    return (low - theta) / about.scale.sd, (high - theta) / about.scale.sd


def _inside(found: Linearised, room: tuple[Array, Array]) -> Array:
    """The step to the mean, in units of the priors' deviations, that leaves no support.

    An unknown that would go further goes half the way to its limit, and all others where they are
    most likely given that.
    """
    least, most = (0.5 * one for one in room)
    mean, covariance = found.shift, found.covariance
    step, held = mean, np.zeros(mean.size, dtype=bool)
    while True:
        beyond = ~held & ((step < least) | (step > most))
        if not beyond.any():
            return step
        held |= beyond
        step = np.where(held, np.clip(step, least, most), mean)
        off = np.linalg.solve(covariance[np.ix_(held, held)], (step - mean)[held])
        step[~held] += covariance[np.ix_(~held, held)] @ off


def _as_far_as_believed(about: _About, theta: Array, here: Evaluation, step: Array) -> Array | None:
    """The end of the step's largest part of one, a half, a quarter, ... that is believed.

    A step to the mean of a linearised posterior may go far where an effect that is missing could
    explain much. Where the slopes foresee a rise of the density, it must rise by some of that;
    where they foresee a fall, for the mean of a mixture need not be its top, it must not fall
    further. None if no part does.
    """
    length, before = 1.0, about.height(theta, here.residual)
    for _ in range(_HALVINGS):
        trial = theta + length * step
        with undisturbed(about.problem):
            there = about.problem.evaluate(trial)
        # The squares of a motion that runs away overflow.
        if there.status.ok and all(np.max(np.abs(e)) < _RUN_AWAY for e in there.residual):
            slopes = zip(here.residual, here.sensitivity, strict=True)
            rise = about.height(trial, [e - j @ (trial - theta) for e, j in slopes]) - before
            least = _SOME * rise if rise > 0.0 else rise
            if about.height(trial, there.residual) - before > least - _DOUBTED:
                return trial
        length /= 2
    return None
