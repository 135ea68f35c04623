"""Refit of a model with an added effect, and the weight of evidence for it.

The refit starts at the values that the score test suggests. The variance of the estimate comes from
the spectrum of the noise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array
from bayesoleo._worker_processes import process_map
from bayesoleo.discovery._assembly import Assembly
from bayesoleo.discovery._fit import COMPARED, ModelFit, fit_model
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._samples_that_count import weights
from bayesoleo.discovery._score_basis import Base, squared_distance
from bayesoleo.discovery._score_tests import Score, inflation_by_estimate
from bayesoleo.discovery._transient_variance import RunNoise, coloured_variance
from bayesoleo.effects._nonparametric import FAMILY
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Parameter
from bayesoleo.model._priors import LogNormal, Normal, TruncatedNormal
from bayesoleo.prediction._periodic_run import RunPredictor
from bayesoleo.prediction._predictor import Layout, RunPrediction
from bayesoleo.prediction._records import Record

#: Parts of the values that a score expects, from which an estimate may start.
STARTS = (1.0, 1 / 2, 1 / 4, 1 / 8, 1 / 16, 1 / 64, 1 / 256, 1 / 2**12, 1 / 2**16)


@dataclass(frozen=True)
class Inflation:
    """How much more an effect's part of the noise varies than white noise of the samples would.

    Parameters
    ----------
    value : float
        Of the sum of squares in units of the samples' noise, at least one.
    freedom : int
        Degrees of freedom with which it is known; zero where it is assumed.
    colour : float, optional
        Of the unknowns, over what the residual gives if it is taken for white; by default the
        same.
    """

    value: float
    freedom: int
    colour: float | None = None

    @property
    def on_trial(self) -> float:
        """By which an effect is taken on trial: the colour alone.

        In a transient, slow noise and the error of the model look alike. Of several missing effects
        each leaves the others, and beside them none would be significant. They are judged when what
        is left is known: in the final model, beside each other.
        """
        return self.value if self.colour is None else self.colour


@dataclass(frozen=True)
class Refit:
    """An extended model after estimation.

    Parameters
    ----------
    score : Score
        Score of the candidate.
    assembly : Assembly
        The model with the effect and its priors, at the estimate.
    fit : ModelFit
        Its fit to the fitted runs.
    share : float
        Part of the present excess that it explains after estimation.
    contribution : ndarray, shape (n,)
        Its change of the prediction, thinned, in noise units.
    remaining : float
        Remaining sum of squares beyond that of the noise, plus the excess that noise alone can
        cause.
    noise : Inflation
        Variance of the fall of the sum of squares over what white noise gives, where noise is
        coloured or, in a transient, larger than differences of neighbouring samples show.
    fall : float
        Fall of the weighted sum of squares.
    reached : bool
        Whether noise alone explains the remaining residual.
    price : float
        Price of an unknown in the sum of squares: the logarithm of the number of samples (Schwarz
        1978).
    policy : SearchPolicy
    feigned : float
        Excess that noise alone can cause.
    """

    score: Score
    assembly: Assembly
    fit: ModelFit
    share: float
    contribution: Array
    remaining: float
    noise: Inflation
    fall: float
    reached: bool
    price: float
    policy: SearchPolicy = SearchPolicy()
    feigned: float = 0.0

    @property
    def inflation(self) -> float:
        """Variance of the fall of the sum of squares over what white noise gives."""
        return self.noise.value

    def resembles(self, other: Refit, likely: float | None = None, scatter: float = 0.0) -> bool:
        """Whether the data cannot distinguish two estimated effects.

        Parameters
        ----------
        other : Refit
        likely, scatter : float, optional
            Differences of the sums of squares up to which they are about as likely, by the noise
            along their difference (``_fit_difference.Undecided``); by default by the larger of
            their inflations.

        Notes
        -----
        The noise decides how significant a difference is. Small effects may be different and still
        equally likely (Burnham and Anderson 2002, section 2.6); large effects may be similar and
        still differ clearly. Where one of them leaves more than noise, the likelihood overstates
        the evidence, and similar effects count as indistinguishable too.
        """
        if not (np.isfinite(self.share) and np.isfinite(other.share)):
            return False
        if self._leaves_clearly_less(other):
            return False
        gap = self.worth - other.worth
        policy = self.policy
        if likely is None:
            likely = policy.equal_likelihood * max(self.inflation, other.inflation)
        if -max(policy.not_taken_odds * likely, scatter) < gap < max(likely, scatter):
            return True
        lengths = np.linalg.norm(self.contribution) * np.linalg.norm(other.contribution)
        if (self.reached and other.reached) or lengths == 0:
            return False
        cosine = float(self.contribution @ other.contribution) / float(lengths)
        low, high = sorted((self.remaining, other.remaining))
        alike = cosine > 0 and cosine**2 > policy.same_cosine
        return alike and high < policy.equal_remainder * low

    def _leaves_clearly_less(self, other: Refit) -> bool:
        """Whether noise explains what the effect leaves, and not what another one leaves.

        The difference must exceed the excess that noise alone can cause. Coloured noise makes
        likelihoods of effects equal, but it does not change what a model leaves of a residual that
        repeats.
        """
        if not self.reached or other.reached:
            return False
        return other.remaining - self.remaining > self.feigned

    @property
    def unusual(self) -> bool:
        """Whether an amplitude lies on the unlikely side of its null."""
        usual = self.score.option.candidate.usual
        return any(
            usual.get(name.split("[")[0], 0) * value < 0
            for name, value in zip(self.fit.problem.names, self.fit.point.theta, strict=True)
        )

    def outdoes(self, other: Score) -> bool:
        """Whether the effect leaves only noise and clearly beats an effect that was only scored.

        Where nothing but noise is left, the other one cannot explain more, whatever it is scored:
        an effect with a value for each run contains those that are alike in all, and scores higher
        wherever outputs are not linear in them. What it costs decides.
        """
        own = self.score.fall
        mine, its = own - self.price * self.size, min(own, other.fall) - self.price * other.size
        # Scored in transients, the other one's inflation holds the level of what it leaves.
        inflation = max(self.inflation, other.inflation if self.noise.colour is None else 1.0)
        return self.reached and mine - its > self.policy.equal_likelihood * inflation

    @property
    def size(self) -> int:
        """Number of unknowns that the effect adds."""
        return self.score.size

    @property
    def worth(self) -> float:
        """Fall of the sum of squares beyond the price of the unknowns."""
        return self.fall - self.price * self.size

    def excludes_null(self) -> bool:
        """Whether the new amplitudes' posterior, by its Laplace approximation, excludes the null.

        One amplitude: the probability of its own side of zero is at least the policy's
        ``excluded_null``; several: zero lies outside their joint region. Where the likelihood
        falls by twice the price of all unknowns without the effect, the null is excluded whatever
        the curvature at the estimate says: far from the null, where amplitude and shape make up for
        each other, a distance in standard deviations shrinks again (Hauck and Donner 1977, JASA 72,
        851-853).
        """
        level, price = self.policy.excluded_null, self.policy.excluded_price * self.price
        if self.fall / self.noise.on_trial > price * self.size:
            return True
        names = [name for name in self.fit.problem.names if name in self.score.names]
        index = [self.fit.problem.names.index(name) for name in names]
        value = self.fit.point.theta[index]
        # Coloured noise, measured by its scatter between periods, widens the white covariance.
        white = self.fit.point.covariance[np.ix_(index, index)]
        covariance = white * self.noise.on_trial
        if not np.isfinite(covariance).all():
            return False
        free = self.noise.freedom or np.inf
        if len(index) == 1:
            return bool(
                distributions.t.cdf(abs(value[0]) / np.sqrt(covariance[0, 0]), free) >= level
            )
        distance = squared_distance(value, covariance)
        if self.noise.freedom:
            return bool(
                distributions.f.cdf(distance / len(index), len(index), free) >= 2 * level - 1
            )
        return bool(distributions.chi2.cdf(distance, len(index)) >= 2 * level - 1)


def refit(base: Base, score: Score, numerics: Numerics) -> Refit:
    """Estimate the model extended by a candidate.

    Parameters
    ----------
    base : Base
        Residuals and sensitivities of the present model.
    score : Score
        Score, for the starts and the scale of priors.
    numerics : Numerics
        The mesh is the present fit's.
    """
    assembly = score.option.assembly.with_values(base.fit.shared)
    assembly = assembly.with_parameters(new_parameters(assembly, score, base.policy))
    model = assembly.model()
    fit = quick_fit(base, model, _starts(base, score, model), numerics)
    found = refit_at(base, score, assembly, fit)
    # Its predictions are kept; those of the estimator are the same, and as large.
    fit.problem.forget()
    return found


def refit_at(base: Base, score: Score, assembly: Assembly, fit: ModelFit) -> Refit:
    """What an estimate of the extended model says of a candidate.

    Parameters
    ----------
    base : Base
        Residuals and sensitivities of the present model.
    score : Score
        Of the candidate.
    assembly : Assembly
        The model with the effect and its priors.
    fit : ModelFit
        Its estimate.
    """
    share, changes = compare(base, fit)
    contribution = np.concatenate(
        [change[run.chosen] for change, run in zip(changes, base.runs, strict=True)]
    )
    if not np.isfinite(share):
        share = -np.inf  # a model without a solution at its estimate explains nothing
    remaining = max(base.excess - share * base.fall_back, 0.0) + base.feigned
    grown = assembly.with_values(fit.shared)
    measured = inflation_along(base, fit, score.names, changes)
    noise = Inflation(score.inflation, score.freedom) if measured is None else measured
    fall = share * base.fall_back
    reached = base.excess - fall < base.feigned
    price = schwarz_price(base)
    return Refit(
        score, grown, fit, share, contribution, remaining, noise, fall, reached, price,
        base.policy, base.feigned,
    )  # fmt: skip


def refit_all(base: Base, scores: Sequence[Score], numerics: Numerics) -> list[Refit]:
    """Estimates of the model extended by each of some candidates; see :func:`refit`."""
    shared = base, numerics
    found = process_map(_apart, shared, scores, numerics.jobs, known=records_of)
    return [replace(one, score=score) for one, score in zip(found, scores, strict=True)]


def _apart(shared: tuple[Base, Numerics], score: Score) -> Refit:
    """The estimate without its score, which whoever asked has."""
    return replace(refit(shared[0], score, shared[1]), score=cast(Any, None))


def records_of(shared: tuple[Base, *tuple[Any, ...]]) -> Sequence[Record]:
    """Records of what calls of a worker share, a base first; results refer to them."""
    return shared[0].fit.records


def schwarz_price(base: Base) -> float:
    """Price of an unknown in the sum of squares: the logarithm of the number of samples."""
    return float(np.log(sum(run.residual.size for run in base.runs)))


def price_in(base: Base, noise: Inflation) -> float:
    """Price of an unknown in units of the noise along it: the logarithm is that of the effective
    number of independent samples."""
    return max(schwarz_price(base) - float(np.log(noise.on_trial)), 1.0)


def inflation_along(
    base: Base, fit: ModelFit, names: Sequence[str], changes: Sequence[Array]
) -> Inflation | None:
    """Variance along an effect over that in white noise; None where it is not finite.

    Parameters
    ----------
    base : Base
        Residuals and sensitivities of the present model.
    fit : ModelFit
        The fit with the effect.
    names : sequence of str
        Its unknowns.
    changes : sequence of ndarray, shape (m,)
        Its change of each run, in noise units.

    Notes
    -----
    For periodic runs it is computed as for a score, along the change by the estimate, with the
    noise of measured inputs. Linearisation at the null is poor for some effects, such as a lag
    where friction switches: its error is no noise, and the estimate avoids it. The residual of a
    transient is seldom white, and at the null it is mostly the effect itself. There the inflation
    is measured on the residual of the estimate. Its colour is over the residual's own white level.
    A sum of squares is in units of the samples' noise, which differences of neighbours show: slow
    noise and the remaining error of the model are larger, and inflate it by their level too.
    """
    if not all(np.isfinite(change).all() for change in changes):
        return None
    if fit.all_periodic:
        return Inflation(*inflation_by_estimate(base, changes))
    known = colour_of(fit, names)
    if known is None:
        return None
    colour, freedom = known
    # The level is that of all runs together; where a quiet run tells of the effect, both together
    # are small, whatever each of them is.
    value = max(1.0, colour * _level_along(base, fit, changes))
    # Averages over the spectrum do not show what repeats with the periodic runs among them.
    white = sum(float(change @ change) for change in changes)
    moved = sum(
        run.weighed_noise(change) + run.unweighed_noise(change)
        for run, change, record in zip(base.runs, changes, fit.records, strict=True)
        if record.periodic
    )
    by_inputs = moved / white if white > 0 else 0.0
    return Inflation(value + by_inputs, freedom, max(1.0, colour) + by_inputs)


def colour_of(fit: ModelFit, names: Sequence[str]) -> tuple[float, int] | None:
    """Largest variance of some unknowns over that of the fit, by the spectrum of what it leaves,
    and its degrees of freedom; None where a run has no solution."""
    noise = noise_of_fit(fit)
    if not all(np.isfinite(part).all() for run in noise for part in (run.columns, run.residual)):
        return None
    covariance, worst, freedom = fit.point.covariance, 0.0, 0
    for k, name in enumerate(fit.problem.names):
        if name not in names:
            continue
        moved = [np.tensordot(covariance[k], run.columns, axes=1) for run in noise]
        variance, degrees = coloured_variance(moved, noise)
        ratio = variance / covariance[k, k]
        if ratio > worst:
            worst, freedom = ratio, max(1, int(degrees))
    return worst, freedom


def _level_along(base: Base, fit: ModelFit, changes: Sequence[Array]) -> float:
    """Mean square of what a fit leaves over that of the samples' noise; outputs and runs count as
    they are changed."""
    whole = level = 0.0
    for change, run in zip(changes, base.runs, strict=True):
        size = change**2
        left = np.repeat(fit.point.variance, change.size // fit.point.variance.size)
        whole, level = whole + float(size.sum()), level + float(size @ (run.scale**2 * left))
    return level / whole if whole > 0 else 1.0


def noise_of_fit(fit: ModelFit) -> list[RunNoise]:
    """What a fit leaves of each run, in units of the noise of each output."""
    pairs = zip(fit.predictor.runs, fit.predictions, strict=True)
    return [_noise_of_run(run, predicted, fit) for run, predicted in pairs]


def _noise_of_run(run: RunPredictor, predicted: RunPrediction, fit: ModelFit) -> RunNoise:
    layout = fit.predictor.layout.names
    free = [layout.index(name) for name in fit.problem.names]
    weight = weights(run.record) / np.sqrt(fit.point.variance)[:, None]
    columns = np.moveaxis(predicted.sensitivity[:, free], 1, 0) * weight
    return RunNoise((run.measured - predicted.y) * weight, columns, fit.point.covariance)


def new_parameters(assembly: Assembly, score: Score, policy: SearchPolicy) -> dict[str, Parameter]:
    """Parameters of the effect with starts and priors from its score."""
    present = assembly.model().parameters
    changed: dict[str, Parameter] = {}
    for name in score.option.candidate.parameters:
        own = [
            abs(v)
            for key, v in zip(score.names, score.expected, strict=True)
            if key.split("[")[0] == name
        ]
        if score.option.candidate.family == FAMILY:
            own = [abs(v) for v in score.expected]  # a curve's coefficients are of one size
        size = max(max(own), 1e-30)
        width = policy.prior_width * size
        sign = score.option.candidate.sign.get(name, 0)
        value = float(score.expected[score.names.index(name)]) if name in score.names else 0.0
        prior: Normal | TruncatedNormal = Normal(0.0, width)
        if sign:
            low, high = (0.0, np.inf) if sign > 0 else (-np.inf, 0.0)
            prior = TruncatedNormal(0.0, width, low, high)
            value = value if value * sign > 0 else sign * 1e-3 * size
        changed[name] = replace(present[name], value=value, prior=prior)
    for name, value in score.shapes.items():
        prior_of_shape = LogNormal(value, policy.shape_spread)
        changed[name] = replace(present[name], value=value, prior=prior_of_shape)
    return changed


def _starts(base: Base, score: Score, model: Model) -> list[dict[str, float]]:
    """Where a candidate's estimate may start: what its score expects, and parts of that.

    A score knows the slope alone. Over many swings of a free motion the values that it expects of
    an effect and of the present unknowns may be far beyond where the motion follows its slope, and
    an estimate from there ends anywhere. Near the present estimate a part of them improves.
    """
    new = dict(zip(score.names, map(float, score.expected), strict=True))
    # The sign that an effect's amplitude must have is in the model.
    new |= {name: model.parameters[name].value for name in new if name in model.parameters}
    present = base.fit.values
    moved = dict(zip(present, map(float, score.beside), strict=True)) if score.beside.size else {}
    return [
        {name: value + part * moved.get(name, 0.0) for name, value in present.items()}
        | {name: part * value for name, value in new.items()}
        for part in STARTS
    ]


def quick_fit(
    base: Base,
    model: Model,
    known: Mapping[str, float] | Sequence[Mapping[str, float]],
    numerics: Numerics,
    method: str = "mbe",
) -> ModelFit:
    """Estimate a model to compare it with the present one, on the same runs and mesh.

    Parameters
    ----------
    base : Base
        Residuals and sensitivities of the present model.
    model : Model
        The driven model; unknowns start at its nominal values unless they are known.
    known : mapping of str to float, or several
        Starts of unknowns, as far as known. Of several the likeliest is taken; the solver starts
        from the last, at which the motion should be known.
    numerics : Numerics
    method : str
        Estimator that leads to the mode; BE goes there at once, from a start nearby.
    """
    # A comparison needs no higher accuracy than the data.
    quick = replace(numerics, steps=base.fit.steps, jobs=1)
    return fit_model(
        model,
        base.fit.records,
        quick,
        start=start_from(base.fit, known, model)
        if isinstance(known, Mapping)
        else np.array([start_from(base.fit, one, model) for one in known]),
        tolerance=1e-4,
        max_iterations=15,
        resolution=COMPARED,
        share=base.fit.predictor,
        check_mesh=False,
        damped=True,
        method=method,
    )


def start_from(fit: ModelFit, known: Mapping[str, float], model: Model) -> Array:
    """Known values inside the priors' support, and else nominal ones."""
    layout = Layout.of_records(model, fit.records)
    start = layout.start(model)
    priors = layout.priors(model)
    for k, name in enumerate(layout.names):
        low, high = priors[k].support
        if low < known.get(name, np.nan) < high:
            start[k] = known[name]
        if not low < start[k] < high:
            start[k] = model.parameters[layout.parameters[k]].value
    return start


def compare(base: Base, fit: ModelFit) -> tuple[float, list[Array]]:
    """Part of the excess that a refitted model takes away, and how it changes the prediction of
    each run, in noise units.

    What was measured beside the data counts with them: a model must not seem better for having
    moved a constant off what is known of it.
    """
    before, after = _beside_data(base.fit), _beside_data(fit)
    changes = []
    for r, run in enumerate(base.runs):
        residual = (fit.predictor.runs[r].measured - fit.predictions[r].y).ravel() * run.scale
        before += float(run.residual @ run.residual)
        after += float(residual @ residual)
        changes.append(run.residual - residual)
    return (before - after) / base.fall_back, changes


def fall_from(reference: Base, fit: ModelFit) -> float:
    """Fall of the weighted sum of squares from a common model; minus infinity where it could not be
    solved."""
    share, _ = compare(reference, fit)
    return share * reference.fall_back if np.isfinite(share) else -np.inf


def _beside_data(fit: ModelFit) -> float:
    """Sum of squares of what is measured beside the data: nuisance parameters and constants known
    to a tolerance."""
    return float(
        sum(
            ((value - prior.mean) / prior.sd) ** 2
            for name, value, prior in zip(
                fit.problem.names, fit.point.theta, fit.problem.priors, strict=True
            )
            if name in fit.problem.nuisances
        )
    )
