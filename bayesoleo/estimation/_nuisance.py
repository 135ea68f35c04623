r"""Nuisance parameters: quantities measured beside the records, known to a tolerance.

The conditions of a run are measured with a standard deviation; the offset and gain of a sensor lie
within its declared accuracy. Intervals are too narrow if these are held at their declared values,
and the quantities absorb physics if they are left free. They are therefore unknowns with a prior:
with sensitivities ``B`` of the outputs to the nuisances, in units of their standard deviations, the
physical parameters are estimated as if the noise covariance were :math:`V + B B^T`.

Maximum likelihood and MBE disregard that prior: the first would move a constant that is known to
1 % to fit the noise, the second re-centres priors. They hold the nuisances at their nominal values
and estimate the other unknowns. With sensitivities :math:`J` and :math:`B` of the outputs to both,
an error :math:`\delta` of the held values moves the estimate by
:math:`S\delta = -(J'WJ)^{-1} J'WB\,\delta`, so that its covariance is
:math:`(J'WJ)^{-1} + S \Sigma S'` with the covariance :math:`\Sigma` of the tolerances. The Bayesian
estimator starts from there with the nuisances free.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np

from bayesoleo._types import Array, Flags, Integers
from bayesoleo.data._disturbances import baseline_of
from bayesoleo.effects._catalogue import find_effect
from bayesoleo.effects._effect import Effect
from bayesoleo.effects._parts import Scales
from bayesoleo.effects._places import substitute
from bayesoleo.error_models._fitting import LinearisedResidual, least_squares
from bayesoleo.errors import InputError, choose
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.estimation._problem import EstimationProblem, Held
from bayesoleo.model._correlated_priors import scaled_root
from bayesoleo.model._expressions import symbol
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Condition, Parameter
from bayesoleo.prediction._records import Record

#: The words that choose them.
KINDS = ("conditions", "offset", "gain")
#: An accuracy is two standard deviations.
ACCURACY = 2.0
# Offsets and gains have no shape parameters, for which alone an effect asks sizes of the motion.
_NO_SCALES = Scales({}, {}, {}, 1.0, 1.0)


def without_measured(
    problem: EstimationProblem, theta: Array, measured: Flags
) -> EstimationProblem:
    """Copy of a problem without its nuisance parameters.

    Parameters
    ----------
    problem : EstimationProblem
    theta : ndarray, shape (l,)
        All unknowns, which start or stay here.
    measured : ndarray of bool, shape (l,)
        Which are held.
    """
    holding = getattr(problem, "holding", None)
    if holding is None:
        return Held(problem, theta, [int(k) for k in np.flatnonzero(measured)])
    pairs = zip(problem.names, theta, measured, strict=True)
    held: EstimationProblem = holding(
        {name: float(value) for name, value, is_held in pairs if is_held}
    )
    return held


def with_measured(
    point: PointEstimate, problem: EstimationProblem, theta: Array, measured: Flags
) -> PointEstimate:
    """An estimate of some unknowns as one of all.

    Parameters
    ----------
    point : PointEstimate
        Of the unknowns that were not held.
    problem : EstimationProblem
        In all unknowns.
    theta : ndarray, shape (l,)
        Holds the others.
    measured : ndarray of bool, shape (l,)
        Which were held.

    Returns
    -------
    PointEstimate
        The covariance carries the uncertainty of what was held; the one without priors is that
        given the held values, and NaN for these.
    """
    own, names = np.flatnonzero(~measured), problem.names

    def vectors(values: Array) -> Array:
        full = np.repeat(np.asarray(theta, dtype=float)[None], len(values), axis=0)
        full[:, own] = values
        return full

    found = vectors(point.theta[None])[0]
    likelihood = np.full((len(names), len(names)), np.nan)
    likelihood[np.ix_(own, own)] = point.covariance_likelihood
    return replace(
        point,
        names=tuple(names),
        theta=found,
        start=vectors(point.start[None])[0],
        covariance=_carried(point, problem, found, measured),
        covariance_likelihood=likelihood,
        history=vectors(point.history),
        known=tuple(name for name, held in zip(names, measured, strict=True) if held),
    )


def _carried(
    point: PointEstimate, problem: EstimationProblem, theta: Array, measured: Flags
) -> Array:
    """Covariance of all unknowns, (l, l): the held ones have that of their priors."""
    own, held = np.flatnonzero(~measured), np.flatnonzero(measured)
    priors = [problem.priors[k] for k in held]
    sd = np.array([prior.sd for prior in priors])
    root = np.linalg.inv(scaled_root(priors, sd)) * sd[:, None]
    sigma = root @ root.T
    full = np.full((measured.size, measured.size), np.nan)
    full[np.ix_(held, held)] = sigma
    shift = _shift(problem, theta, point.variance, own, held)
    if not own.size or shift is None:
        return full
    full[np.ix_(own, own)] = point.covariance + shift @ sigma @ shift.T
    full[np.ix_(own, held)] = shift @ sigma
    full[np.ix_(held, own)] = full[np.ix_(own, held)].T
    return full


def _shift(
    problem: EstimationProblem,
    theta: Array,
    variance: Array,
    own: Integers,
    held: Integers,
) -> Array | None:
    """Change of the estimate by that of a held value, (own, held); None where there is none."""
    evaluation = problem.evaluate(theta)
    if not evaluation.status.ok or not (np.isfinite(variance) & (variance > 0)).all():
        return None
    unit = np.array([problem.priors[k].sd for k in range(len(theta))])
    rows = LinearisedResidual.of(evaluation, unit).whitened(variance)[0]
    # As in the covariance, the prior bounds undetermined directions.
    prior = scaled_root([problem.priors[k] for k in own], unit[own])
    weighted = np.vstack((rows[:, own], prior))
    target = np.vstack((rows[:, held], np.zeros((len(own), len(held)))))
    return cast(Array, -unit[own, None] * least_squares(weighted, target) / unit[held])


@dataclass(frozen=True)
class Nuisance:
    """Uncertain quantities beside the parameters, with their standard deviations.

    Parameters
    ----------
    conditions : tuple of str
        Conditions with an error of each run's own.
    offset : mapping of str to float
        Standard deviation of a sensor's offset by channel, SI.
    gain : mapping of str to float
        Standard deviation of a sensor's relative gain error by channel.
    drifting : tuple of str
        Outputs whose mean is unknown in each run, because they drift.
    """

    conditions: tuple[str, ...] = ()
    offset: Mapping[str, float] = field(default_factory=dict)
    gain: Mapping[str, float] = field(default_factory=dict)
    drifting: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.conditions or self.offset or self.gain or self.drifting)

    def extend(self, model: Model) -> Model:
        """Model with nuisance parameters, whose null values leave its predictions unchanged.

        Parameters
        ----------
        model : Model
            In the drive in which it is solved.

        Returns
        -------
        Model
            A condition ``c`` becomes ``c + c_sd*c_error``, where the condition ``c_sd`` is a run's
            declared standard deviation and ``c_error`` one standard normal unknown a run. A channel
            ``y`` shows ``(1 + g) y + b``, with ``g`` and ``b`` common to all runs.
        """
        for channel in self.drifting:
            model = _with_baseline(model, channel)
        for name in (*self.conditions, *map(baseline_of, self.drifting)):
            model = _uncertain_condition(model, name)
        for effect, spread in (("sensor_gain", self.gain), ("sensor_offset", self.offset)):
            for channel, sd in spread.items():
                model = _uncertain_sensor(model, find_effect(effect), channel, sd)
        return model

    def complete(self, records: Sequence[Record]) -> tuple[Record, ...]:
        """Records that state the standard deviations of conditions as conditions of their own."""
        return tuple(
            replace(
                record,
                conditions={
                    **record.conditions,
                    **{
                        sd_of(name): record.condition_sd.get(name, 0.0)
                        for name in (*self.conditions, *map(baseline_of, self.drifting))
                    },
                },
            )
            for record in records
        )


def uncertain_conditions(model: Model) -> Nuisance:
    """The uncertain conditions that a model was extended by."""
    names = model.conditions
    return Nuisance(tuple(name for name in names if sd_of(name) in names))


def declared_nuisance(
    kinds: Iterable[str],
    model: Model,
    records: Sequence[Record],
    accuracy: Mapping[str, float | None],
) -> Nuisance:
    """The nuisance parameters that a campaign's declared tolerances make.

    Parameters
    ----------
    kinds : iterable of {"conditions", "offset", "gain"}
        ``conditions``: those of the model whose ``sd`` the runs declare. ``offset``, ``gain``: of
        every channel of the model whose ``accuracy`` is declared. The accuracy is taken as two
        standard deviations of the sensor's error at the largest reading: all of it is offset, or
        gain, or half of its variance each where both are asked for.
    model : Model
        In the drive in which it is solved.
    records : sequence of Record
        All runs, fitted and held out.
    accuracy : mapping of str to float or None
        By channel, SI.

    Returns
    -------
    Nuisance

    Raises
    ------
    InputError
        If a word is unknown, or nothing is declared that it could use.
    """
    chosen = tuple(dict.fromkeys(kinds))
    for kind in chosen:
        if kind not in KINDS:
            hint = choose(kind, KINDS)
            raise InputError("unknown nuisance", key="nuisance", value=kind, hint=hint)
    conditions = _declared_conditions(model, records) if "conditions" in chosen else ()
    sensors = [kind for kind in ("offset", "gain") if kind in chosen]
    if not sensors:
        return Nuisance(conditions)
    known = _declared_accuracy(model, accuracy)
    share = ACCURACY * np.sqrt(len(sensors))
    offset = {name: value / share for name, value in known.items()}
    gain = {name: sd / _largest(records, name) for name, sd in offset.items()}
    return Nuisance(
        conditions, offset if "offset" in chosen else {}, gain if "gain" in chosen else {}
    )


def _declared_conditions(model: Model, records: Sequence[Record]) -> tuple[str, ...]:
    uncertain = [
        name
        for name in model.conditions
        if any(record.condition_sd.get(name, 0.0) > 0 for record in records)
    ]
    if not uncertain:
        unit = next(iter(model.conditions.values())).unit if model.conditions else ""
        raise InputError(
            "no run declares how uncertain its conditions are",
            key="nuisance",
            value="conditions",
            hint=f"write e.g. {next(iter(model.conditions), 'temperature')} = "
            f'{{ value = …, unit = "{unit}", sd = … }} under [runs.conditions]',
        )
    for name in uncertain:
        for record in records:
            if not record.condition_sd.get(name, 0.0) > 0:
                raise InputError(
                    "other runs declare a standard deviation of this condition, this one does not",
                    run=record.label,
                    key=name,
                    hint="write sd = … in every run, or in none",
                )
    return tuple(uncertain)


def _declared_accuracy(model: Model, accuracy: Mapping[str, float | None]) -> dict[str, float]:
    channels = (*model.inputs, *model.outputs)
    known = {name: value for name in channels if (value := accuracy.get(name))}
    if not known:
        raise InputError(
            "no channel of the model declares its accuracy",
            key="nuisance",
            value="offset, gain",
            hint=f"write accuracy = … under [channels.{channels[0]}]; two standard deviations",
        )
    return known


def _largest(records: Sequence[Record], channel: str) -> float:
    return max(float(np.abs(record.samples[channel]).max()) for record in records)


def sd_of(condition: str) -> str:
    """Name of the condition that holds a run's standard deviation of another condition."""
    return f"{condition}_sd"


def error_of(condition: str) -> str:
    """Name of the unknown error of a condition, in its standard deviations."""
    return f"{condition}_error"


def _with_baseline(model: Model, channel: str) -> Model:
    """The model with a known baseline of one of its outputs, zero by default."""
    name = baseline_of(channel)
    about = f"mean of the drift of {channel}"
    extended = replace(
        model,
        conditions={**model.conditions, name: Condition(model.outputs[channel].unit, 0.0, about)},
    )
    return extended.with_term("output", channel, "baseline", symbol(name))


def _uncertain_condition(model: Model, name: str) -> Model:
    error, sd = error_of(name), sd_of(name)
    declared = model.conditions[name]
    extended = replace(
        model,
        # Zero where a run does not give one, so that simulations have no error.
        conditions={**model.conditions, sd: Condition(declared.unit, 0.0, f"sd of {name}")},
        parameters={
            **model.parameters,
            error: Parameter(
                0.0,
                sd=1.0,
                by_run=True,
                nuisance=True,
                description=f"error of {name} in its declared standard deviations",
            ),
        },
    )
    return substitute(extended, {symbol(name): symbol(name) + symbol(sd) * symbol(error)})


def _uncertain_sensor(model: Model, effect: Effect, channel: str, sd: float) -> Model:
    candidate = effect.extend(model, channel, _NO_SCALES)
    (name,) = candidate.parameters
    new = candidate.model.parameters[name]
    known = Parameter(
        0.0, new.unit, sd=sd, nuisance=True, latex=new.latex, description=new.description
    )
    return candidate.model.with_parameters(**{name: known})
