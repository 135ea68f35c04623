"""Confirmation of an effect by hold-out runs.

An effect is confirmed if it lowers the squared error on runs that were not fitted. The uncertainty
of this reduction decides whether it can be due to chance.

References
----------
McCullagh and Nelder (1989), Generalized Linear Models, section 4.5: dispersion. Theiler et al.
(1992), Physica D 58, 77-94: a remainder with the same spectrum and random phases.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array, ProgressCallback
from bayesoleo.data._noise import NoiseSpectrum
from bayesoleo.discovery._assembly import Roles, in_halves
from bayesoleo.discovery._fit_and_hold_out_error import RunError
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._ranking import Ranked
from bayesoleo.discovery._refit import Refit, noise_of_fit
from bayesoleo.discovery._run_predictions import Prediction, crossed
from bayesoleo.discovery._samples_that_count import weights
from bayesoleo.discovery._state import State, fit_state
from bayesoleo.discovery._transient_variance import coloured_variance, noise_along
from bayesoleo.prediction._inputs import lacking
from bayesoleo.prediction._run_errors import input_columns


@dataclass(frozen=True)
class Fall:
    """Fall of the weighted sum of squares on hold-out runs.

    Parameters
    ----------
    value : float
        Sum over the runs, less the charge for parameters that were estimated on them.
    error : float
        Standard error if the effect is absent: by the noise, the remaining model error and the
        parameters of the model without it.
    expected : float
        Mean of the fall if the effect is exactly right.
    spread : float, optional
        Standard error if the effect is present, including its parameters; by default the same.
    policy : SearchPolicy
    """

    value: float
    error: float
    expected: float
    spread: float | None = None
    policy: SearchPolicy = SearchPolicy()

    @property
    def scatter(self) -> float:
        """Standard error if the effect is present."""
        return self.error if self.spread is None else self.spread

    @property
    def confirms(self) -> bool:
        """Whether the fall is significant, and exceeds the fall that one superfluous unknown would
        cause at the same significance."""
        enough = self.policy.confirming_errors
        return bool(self.value > max(enough * self.error, enough**2))

    @property
    def may_be_tried(self) -> bool:
        """Whether the fall is large enough for an effect to be added on trial."""
        least = self.policy.confirming_errors**2
        return bool(self.value > max(self.policy.trial_errors * self.error, least))

    @property
    def contradicts(self) -> bool:
        """Whether the squared error rises significantly."""
        enough = self.policy.confirming_errors
        return bool(-self.value > enough * max(self.error, self.scatter))

    @property
    def undecided(self) -> bool:
        """Whether these runs would probably not confirm even a real effect."""
        missed = distributions.norm.isf(self.policy.missed_confirmation)
        least = self.policy.confirming_errors * self.error + missed * self.scatter
        return bool(self.expected < least)

    @property
    def _weight(self) -> float:
        return self.expected / self.scatter**2 if self.scatter > 0 else 0.0

    def and_by(self, other: Fall) -> Fall:
        """Both together, each weighted by the expected fall over its variance, which gives the
        most powerful test. The larger weight is one. Runs that the effect does not change, or that
        could not be solved, have no weight."""
        weights = np.array([one._weight for one in (self, other)])
        first, second = weights / max(weights.max(), 1e-300)
        return Fall(
            float(first * self.value + second * other.value),
            float(np.hypot(first * self.error, second * other.error)),
            float(first * self.expected + second * other.expected),
            float(np.hypot(first * self.scatter, second * other.scatter)),
            self.policy,
        )

    def __str__(self) -> str:
        return with_error(self.value, self.error)

    @property
    def in_words(self) -> str:
        """What the error does, with the standard error by which that is judged."""
        if self.value < 0.0:
            return f"rises by {with_error(-self.value, max(self.error, self.scatter))}"
        return f"falls by {self}"


def with_error(value: float, error: float) -> str:
    """A value with its standard error, to the significant digits that the error allows."""
    if not (np.isfinite(value) and np.isfinite(error) and error > 0):
        return f"{value:.3g} ± {error:.2g}"
    last = int(np.floor(np.log10(error))) - 1  # two digits of the error
    if max(abs(value), error) < 1e6 and last > -6:
        digits = max(0, -last)
        step = 10.0**last
        return f"{round(value / step) * step:.{digits}f} ± {round(error / step) * step:.{digits}f}"
    return f"{value:.3g} ± {error:.2g}"


def fall_on_hold_out(before: State, after: State, inflation: float = 1.0) -> Fall:
    """Fall of the weighted sum of squares on hold-out runs, and its standard error.

    With predictions ``a`` and ``b`` the fall is ``sum w ((y - a)^2 - (y - b)^2)``. Noise with the
    covariance ``1/w + B B'`` in ``y - a``, the input's included, gives it the variance
    ``4 d' w (1/w + B B') w d`` with ``d = b - a``; coloured noise multiplies the first part by the
    inflation. The remaining model error adds to it, and so do the errors of the parameters:
    ``4 d' w J S J' w d`` with their sensitivities and covariance. What the model leaves of a
    transient holds all noise and the remaining error: its spectrum gives both parts. Runs that
    could not be solved in both states do not count.

    Parameters
    ----------
    before, after : State
        Without and with the effect.
    inflation : float
        Variance of the output's noise along the change by the effect, over that of white noise;
        for transients it is measured here instead.

    Returns
    -------
    Fall
        The fall is reduced for each parameter that only the model with the effect estimates on
        the runs themselves: by the noise that such a parameter absorbs on average.
    """
    runs: list[_RunFall] = []
    pulls = [np.zeros(len(state.fit.problem.names)) for state in (before, after)]
    charge = 0.0
    for old, new in zip(before.held_out, after.held_out, strict=True):
        more, absorbs = new.re_estimated - old.re_estimated, inflation
        if old.status.ok and new.status.ok:
            runs.append(_of_run(before, after, old, new, inflation))
            absorbs = runs[-1].inflation
            pulls[0] += _pull(before, old, before, new.y - old.y)
            pulls[1] += _pull(after, new, before, new.y - old.y)
        charge += more * absorbs
    variance = sum(run.variance for run in runs)
    error, spread = (
        float(np.sqrt(variance + 4.0 * _known_to(state, other, pull, inflation)))
        for state, other, pull in zip((before, after), (after, before), pulls, strict=True)
    )
    value, expected = sum(run.value for run in runs), sum(run.expected for run in runs)
    return Fall(value - charge, error, expected, spread, before.policy)


def _pull(state: State, prediction: Prediction, measured: State, change: Array) -> Array:
    """Derivative of the fall in one run by each unknown of a fit: ``J' w d``, shape (l,)."""
    predictor, names = prediction.predictor, state.fit.problem.names
    found, layout = np.zeros(len(names)), predictor.layout.names
    sensitivity = predictor.predict(prediction.vector)[0].sensitivity
    if not np.isfinite(sensitivity).all():
        return found
    counts, label = weights(prediction.record), prediction.record.label
    for b, output in enumerate(predictor.outputs):
        weight = measured.hold_errors.at(output, label).average.sigma ** -2
        along = sensitivity[b] @ (weight * change[b] * counts)
        for k, name in enumerate(names):
            # A parameter that is estimated on the run itself adapts to errors of the others.
            if name in layout and name in state.fit.model.parameters:
                found[k] += along[layout.index(name)]
    return found


def _known_to(state: State, other: State, pull: Array, inflation: float) -> float:
    """Variance along a direction by the errors of a fit's parameters.

    Those of transients follow the noise, with its spectrum, by what the better of both fits leaves.
    """
    covariance = state.fit.point.covariance
    if not np.isfinite(covariance).all():
        return 0.0
    white = max(float(pull @ covariance @ pull), 0.0)
    if not pull.any() or state.fit.all_periodic:
        return inflation * white
    mine = noise_of_fit(state.fit)
    level = float(np.mean(other.fit.point.variance / state.fit.point.variance))
    if level < 1.0:
        unit = np.sqrt(other.fit.point.variance / state.fit.point.variance)[:, None]
        pairs = zip(mine, noise_of_fit(other.fit), strict=True)
        mine = [replace(run, residual=quiet.residual * unit) for run, quiet in pairs]
    moved = [np.tensordot(covariance @ pull, run.columns, axes=1) for run in mine]
    return max(coloured_variance(moved, mine)[0], min(level, 1.0) * white)


@dataclass(frozen=True)
class _RunFall:
    """Fall in one run, its mean if the effect is right, its variance, and the variance of noise
    along the change over that of a sample."""

    value: float
    expected: float
    variance: float
    inflation: float


@dataclass(frozen=True)
class _Changed:
    """What an effect changes of one output in one run.

    Parameters
    ----------
    entry : RunError
        The error without it.
    change, left : ndarray, shape (N,)
        Of the prediction, and what the model with it leaves, SI; zero where samples do not count.
    pulled : ndarray, shape (k,)
        Derivative of the fall by the errors of the input, halved.
    """

    entry: RunError
    change: Array
    left: Array
    pulled: Array

    @property
    def weight(self) -> float:
        """One over the variance of a sample's noise."""
        return float(self.entry.average.sigma**-2)

    @property
    def size(self) -> float:
        """Squared change in units of the noise."""
        return self.weight * float(self.change @ self.change)

    @property
    def fall(self) -> float:
        """Of the weighted sum of squares."""
        return self.weight * float(np.sum((self.left + self.change) ** 2 - self.left**2))


def _of_run(
    before: State, after: State, old: Prediction, new: Prediction, inflation: float
) -> _RunFall:
    record, changed = old.record, _changed(before, old, new)
    fall, expected = sum(one.fall for one in changed), sum(one.size for one in changed)
    moved = sum((one.pulled for one in changed), np.zeros(1))
    by_input = float(np.sum(np.square(moved)))
    if record.periodic:
        parts = [_of_periodic(one, after, record.label, inflation) for one in changed]
        variance = sum(parts) + by_input
    else:
        sigmas = [one.entry.average.sigma for one in changed]
        changes, rests = (
            np.array([values / sigma for values, sigma in zip(rows, sigmas, strict=True)])
            for rows in ([one.change for one in changed], [one.left for one in changed])
        )
        variance = max(_between_models(changes, rests), expected + by_input)
        inflation = variance / expected if expected > 0 else 1.0
    return _RunFall(fall, expected, 4.0 * variance, inflation)


def _changed(before: State, old: Prediction, new: Prediction) -> list[_Changed]:
    predictor, record = old.predictor, old.record
    columns = input_columns(predictor.runs[0], predictor.constants(old.vector[None], 0)[0])
    counts, found = weights(record), []
    for b, output in enumerate(new.predictor.outputs):
        entry = before.hold_errors.at(output, record.label)
        change = (new.y[b] - old.y[b]) * counts
        left = (record.samples[output] - new.y[b]) * counts
        pulled = entry.average.sigma**-2 * entry.input_scale * (columns[b] @ change)
        found.append(_Changed(entry, change, left, pulled))
    return found


def _of_periodic(one: _Changed, after: State, run: str, inflation: float) -> float:
    """Variance of the fall of one output in a periodic run, a quarter of it, without what outputs
    share: by its noise and the error that still repeats."""
    weight, change, left = one.weight, one.change, one.left
    noise = max(inflation * one.size, weight**2 * _between_harmonics(one.entry.spectrum, change))
    if after.at_floor:
        return noise
    own = noise + float(np.sum(np.square(one.pulled)))
    ratio = after.hold_errors.at(one.entry.output, run).ratio_to_expected
    spread = max(ratio**2 - 1.0, 0.0) * own
    return noise + min(spread, weight**2 * surrogate_variance(change, left))


def _between_harmonics(spectrum: NoiseSpectrum | None, change: Array) -> float:
    """Variance of ``change @ noise`` in a periodic run, by its own noise between the harmonics;
    zero where it has none."""
    return 0.0 if spectrum is None else float(spectrum.power(change) @ spectrum.level)


def _between_models(changes: Array, rests: Array) -> float:
    """Variance of ``changes @ noise`` in a transient, by what the better of two models leaves.

    Parameters
    ----------
    changes, rests : ndarray, shape (ny, N)
        What the second model changes, and what it leaves, in units of the noise of each output.
    """
    # No model leaves less than the noise: the smaller of the two residuals is nearer to it.
    left = min(rests, rests + changes, key=lambda values: float(np.sum(values**2)))
    return noise_along(changes, left)


def surrogate_variance(change: Array, left: Array) -> float:
    """Variance of ``change @ s`` over remainders ``s`` with the spectrum of ``left`` and random
    phases.

    A repeating residual scatters the fall: an effect may follow it by chance. Its power is assumed
    to be distributed like that of the noise, but limited to the observed power at the frequencies
    of the effect.

    Parameters
    ----------
    change, left : ndarray, shape (N,)
    """
    power = np.abs(np.fft.rfft(change)) ** 2 * np.abs(np.fft.rfft(left)) ** 2
    power[1 : (change.size + 1) // 2] *= 2.0  # each line stands for its conjugate too
    return float(power.sum() / change.size**2)


def lacks_input(result: Refit, roles: Roles) -> str | None:
    """Why a hold-out run cannot be predicted with an estimated effect; None where all can."""
    return lacking(result.assembly.model().inputs, roles.held_out)


def confirmed(
    state: State,
    item: Ranked,
    result: Refit,
    roles: Roles,
    numerics: Numerics,
    callback: ProgressCallback,
    *,
    on_trial: bool = False,
    fitted: dict[int, State] | None = None,
) -> tuple[State | None, str]:
    """The state with an estimated effect, if the hold-out runs confirm it, and the reason.

    The state is kept in ``fitted`` by the id of the result, whatever comes of it.

    In transients an effect may be added on trial where the fall exceeds fewer standard errors: it
    is judged in the final model (``_judged_together.py``).
    """
    if not np.isfinite(result.share):
        return None, f"{item.effect} could not be estimated"
    policy = numerics.policy
    if result.share < (policy.least_share if result.reached else policy.fair_share):
        share = f"{100 * result.share:.0f} % of the excess, {_on_fitted(result)}"
        return None, f"{item.effect} would explain only {share}"
    if not result.excludes_null():
        return (
            None,
            f"the posterior of {item.effect} does not exclude its null: {_on_fitted(result)}",
        )
    reason = lacks_input(result, roles)
    if reason is not None:
        return None, f"{item.effect} cannot be confirmed: {reason}"
    callback(f"confirm {item.effect} on hold-out runs")
    after = fit_state(result.assembly, roles, numerics, start=result.fit.point.theta)
    if fitted is not None:
        fitted[id(result)] = after
    if not after.hold_errors.entries:
        return after, f"{_explains(item)}, {_on_fitted(result)}; no run was held out"
    fall = fall_on_hold_out(*judged(state, after), result.noise.on_trial)
    if fall.error == 0.0:
        return None, f"{item.effect} cannot be confirmed: it changes no hold-out run that is solved"
    both, other = fall, None
    # Halves of a run share its peculiarities. They confirm a by-run parameter in any case, which is
    # no evidence where more than noise remains.
    alike = item.absorbs and not result.reached
    able = fall.undecided and not fall.contradicts and not alike
    halves = in_halves(roles) if able else None
    if halves is not None:
        # An effect at the end of the stroke shows only in runs that reach it.
        callback(
            f"hold-out runs would often miss {item.effect}: confirm it on the other half of the"
            " periods"
        )
        pair = _on_halves(state, after, halves, numerics)
        other = fall_on_hold_out(*pair, result.inflation)
        both = fall.and_by(other)
    if both.confirms:
        return after, _confirming(item, fall, other)
    if on_trial and not state.fit.all_periodic and both.may_be_tried:
        where = f"on hold-out runs the weighted squared error {fall.in_words}{_beside(other)}"
        return after, f"{_explains(item)}; it is added on trial, because {where}"
    return None, _refusing(item, fall, other)


def _confirming(item: Ranked, fall: Fall, other: Fall | None) -> str:
    """Why an effect is added, by its result on the hold-out runs and on the second half of fitted
    ones, where that was asked."""
    where = f"hold-out runs: the weighted squared error {fall.in_words}"
    if other is None or fall.confirms:
        return f"{_explains(item)} and lowers the error on {where}{_beside(other)}"
    return (
        f"{_explains(item)}; the error is not significantly different on {where}, but these runs"
        f" would often miss a real effect, which lowers it by {fall.expected:.3g} on"
        f" average{_beside(other)}, and both together confirm it"
    )


def _refusing(item: Ranked, fall: Fall, other: Fall | None) -> str:
    """Why an effect is not added, by the same results."""
    where = f"the weighted squared error {fall.in_words}{_beside(other)}"
    if fall.contradicts:
        return f"{item.effect} raises the error on hold-out runs: {where}"
    errors, alarms = fall.policy.confirming_errors, 100 * fall.policy.false_confirmation
    small = other is None and fall.value > errors * fall.error
    least = f", and a fall of {errors**2:.2f}" if small else ""
    together = "" if other is None else " together with the second half of fitted ones"
    return (
        f"{item.effect} does not lower the error on hold-out runs significantly{together}: {where};"
        f" {errors:.2f} standard errors{least} are required (false alarms {alarms:g} %)"
    )


def _beside(other: Fall | None) -> str:
    """The result on the second half of fitted runs, as a part of a sentence."""
    return "" if other is None else f"; on the second half of fitted ones it {other.in_words}"


def contradicted(one: State, other: State, inflation: float) -> bool:
    """Whether hold-out runs contradict another model in the place of one.

    Parameters
    ----------
    one, other : State
    inflation : float
        Variance of the noise along the difference of the models, over that of white noise.
    """
    if not one.hold_errors.entries:
        return False
    return fall_on_hold_out(*judged(other, one), inflation).confirms


def _on_fitted(result: Refit) -> str:
    """The reduction of the error on the fitted runs, as text."""
    fall = with_error(result.fall, fall_error(result.fall, result.size, result.inflation))
    return f"lowering the weighted squared error on fitted runs by {fall}"


def fall_error(fall: float, size: int, inflation: float) -> float:
    """Standard error of a fall of the sum of squares by some unknowns.

    In units of the inflation ``I`` it is a non-central chi-square variate of ``k`` degrees of
    freedom, whose variance is ``2 k`` and four times its non-centrality, ``fall / I - k``.
    """
    beyond = max(fall - inflation * size, 0.0)
    return float(np.sqrt(inflation * (4.0 * beyond + 2.0 * size * inflation)))


def _on_halves(
    before: State, after: State, halves: Roles, numerics: Numerics
) -> tuple[State, State]:
    """Both models estimated on the first half of each fitted run and compared on the second."""
    quick = replace(numerics, steps=after.fit.steps_for(halves.fitted))
    old, new = (
        fit_state(state.assembly, halves, quick, start=state.fit.point.theta)
        for state in (before, after)
    )
    return judged(old, new)


def judged(before: State, after: State) -> tuple[State, State]:
    """Both states, prepared for the comparison. Where the effect has by-run parameters, each half
    of a run is predicted from the other half, both with and without the effect."""
    pairs = []
    for old, new in zip(before.held_out, after.held_out, strict=True):
        if new.re_estimated > old.re_estimated:
            across = crossed(old) if old.re_estimated else old, crossed(new)
            if across[0] is not None and across[1] is not None:
                old, new = across[0], across[1]
        pairs.append((old, new))
    return (
        replace(before, held_out=[old for old, _ in pairs]),
        replace(after, held_out=[new for _, new in pairs]),
    )


def _explains(item: Ranked) -> str:
    return f"{item.effect} explains {100 * item.gain:.0f} % of the excess"
