"""Feasible runs, and what rival models predict of them.

The rig limits the amplitude, frequency and mean of the imposed motion, and the range of the rig and
the specimen. A rival predicts the outputs as normal, linearised about its estimate, in units of the
noise that the average over a new run's periods would have.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bayesoleo._types import Array
from bayesoleo.discovery._expected_information import PredictiveDistribution
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._structure_columns import sizes_between
from bayesoleo.errors import InputError
from bayesoleo.model._drive_and_start import START
from bayesoleo.model._expressions import COSINE, SINE, WITHIN
from bayesoleo.model._model import Model
from bayesoleo.prediction._predictor import Layout, Predictor, RunPrediction
from bayesoleo.prediction._records import Harmonics, Record
from bayesoleo.prediction._run_errors import input_columns
from bayesoleo.prediction._simulate import motion
from bayesoleo.prediction._transient_run import TransientRun
from bayesoleo.solvers._orbit import Status

Range = tuple[float, float]

#: Points of a period at which a motion is evaluated.
GRID_POINTS = 256
#: A mean below this part of the amplitude is zero.
ROUND_OFF = 1e-9
#: A mean of the runs below this part of the amplitude is not proposed: no rig is set so finely.
NO_MEAN = 1e-3
#: Part of a motion's power that its fundamental must hold to be taken as a sine.
NEARLY_A_SINE = 0.9
#: Values tried of frequency and amplitude, each a constant factor apart, and of the mean.
FREQUENCIES, AMPLITUDES, MEANS = 6, 6, 3
#: Travel, rate and outputs may exceed those of the runs by this part of their range, because a
#: trial motion does not have all harmonics of the measured one.
BEYOND = 0.1
#: Names of the limits of the motion; any other name is an output.
MOTION = ("amplitude", "frequency", "mean", "travel", "rate")

#: Points of a period at which outputs are compared, and steps of the mesh; a choice between runs
#: needs no higher accuracy.
POINTS, STEPS = 128, 128
#: Fixed-point iterations for a response that is also an input, and its highest order.
PASSES, ORDERS = 4, 12


@dataclass(frozen=True)
class Limits:
    """Limits of the rig for the channel that drives the model.

    Parameters
    ----------
    amplitude : (float, float)
        Half of the peak-to-peak value, SI.
    frequency : (float, float)
        Fundamental, Hz.
    mean : (float, float)
        Mean value over a period, SI.
    travel : (float, float)
        Range of the motion, SI.
    rate : (float, float)
        Range of the largest rate of change, SI per second.
    outputs : mapping of str to (float, float)
        Range of each predicted output, SI.
    """

    amplitude: Range
    frequency: Range
    mean: Range
    travel: Range
    rate: Range
    outputs: Mapping[str, Range] = field(default_factory=dict)

    @classmethod
    def of(cls, records: Sequence[Record], drive: str, outputs: Sequence[str]) -> Limits:
        """Limits that the existing runs suggest.

        Parameters
        ----------
        records : sequence of Record
            Periodic runs.
        drive : str
            The channel that drives the model.
        outputs : sequence of str
            Channels that the model predicts.
        """
        moves = [Motion.of(record, drive) for record in records]
        seen = {
            name: _about([float(f(r.samples[name])) for r in records for f in (np.min, np.max)])
            for name in outputs
        }
        return cls(
            _between([move.amplitude for move in moves]),
            _between([record.frequency for record in records]),
            _between([move.mean for move in moves]),
            _about([edge for move in moves for edge in (move.lowest, move.highest)]),
            (0.0, (1 + BEYOND) * max(move.rate for move in moves)),
            seen,
        )

    def given(self, limits: Mapping[str, Range]) -> Limits:
        """The limits, with those of the user in place of those that the runs suggest.

        ``travel`` and ``rate`` follow from amplitude, mean and frequency. Where one of these is
        given, the suggested travel or rate no longer limits the motion.

        Parameters
        ----------
        limits : mapping of str to (float, float)
            ``amplitude``, ``frequency``, ``mean``, ``travel``, ``rate`` or an output, SI; infinite
            where there is no limit.

        Raises
        ------
        InputError
            If a name is unknown or a range is empty.
        """
        for name, (low, high) in limits.items():
            known = (*MOTION, *self.outputs)
            if name not in known:
                hint = f"write one of: {', '.join(known)}"
                raise InputError("no such limit", key=name, hint=hint)
            if not low <= high:
                hint = "write low = …, high = … with low below high"
                raise InputError("limits are the wrong way round", key=name, value=[low, high],
                                 hint=hint)  # fmt: skip
        chosen = {name: _within(limits[name], getattr(self, name)) for name in MOTION[:3]
                  if name in limits}  # fmt: skip
        if {"amplitude", "mean"} & limits.keys():
            chosen["travel"] = (-np.inf, np.inf)
        if {"amplitude", "frequency"} & limits.keys():
            chosen["rate"] = (0.0, np.inf)
        chosen |= {name: limits[name] for name in MOTION[3:] if name in limits}
        outputs = {name: limits.get(name, own) for name, own in self.outputs.items()}
        return replace(self, outputs=outputs, **chosen)


def _between(values: Sequence[float]) -> Range:
    return min(values), max(values)


def _about(values: Sequence[float]) -> Range:
    low, high = _between(values)
    return low - BEYOND * (high - low), high + BEYOND * (high - low)


def _within(wanted: Range, own: Range) -> Range:
    """Replace an infinite side by that of the runs, if it does not contradict the other side."""
    low, high = wanted
    low = low if np.isfinite(low) else min(own[0], high)
    return low, high if np.isfinite(high) else max(own[1], low)


@dataclass(frozen=True)
class Motion:
    """Amplitude, mean, extremes and largest rate of one periodic motion, SI."""

    amplitude: float
    mean: float
    lowest: float
    highest: float
    rate: float

    @classmethod
    def of(cls, record: Record, channel: str) -> Motion:
        """The motion of a channel of a run, by its significant harmonics."""
        return cls.of_signal(record.harmonics[channel], record.frequency)

    @classmethod
    def of_signal(cls, item: Harmonics, frequency: float) -> Motion:
        """The motion of a periodic signal."""
        phase = np.arange(GRID_POINTS) / GRID_POINTS
        x, v = (item.evaluate(phase, frequency, n) for n in (0, 1))
        low, high = float(x.min()), float(x.max())
        mean, half = float(item.coefficients[item.orders == 0].real.sum()), (high - low) / 2
        mean = mean if abs(mean) > ROUND_OFF * half else 0.0
        return cls(half, mean, low, high, float(np.abs(v).max()))

    def possible(self, limits: Limits) -> bool:
        """Whether the motion is within the limits, up to rounding."""
        slack = 1e-6 * self.amplitude
        low, high = limits.travel
        return (
            low - slack <= self.lowest
            and self.highest <= high + slack
            and self.rate <= limits.rate[1] * (1 + 1e-6)
            and self.rate >= limits.rate[0] * (1 - 1e-6)
        )


@dataclass(frozen=True)
class Planned:
    """A feasible run.

    Parameters
    ----------
    frequency : float
        Hz.
    mean, amplitude : float
        Of the driving channel, SI.
    waveform : Harmonics
        Harmonics of that channel.
    """

    frequency: float
    mean: float
    amplitude: float
    waveform: Harmonics


def planned_runs(limits: Limits, records: Sequence[Record], drive: str) -> list[Planned]:
    """Runs over the whole range of the rig.

    Parameters
    ----------
    limits : Limits
    records : sequence of Record
        Runs that give the shape of the motion: a sine if theirs is nearly one, else the shape of
        the run nearest in frequency.
    drive : str
        The channel that drives the model.

    Returns
    -------
    list of Planned
        By mean, amplitude and frequency, without those that leave the limits.
    """
    found = []
    for mean in _even(limits.mean, MEANS, limits.amplitude[1]):
        for amplitude in _factors(limits.amplitude, AMPLITUDES):
            for frequency in _factors(limits.frequency, FREQUENCIES):
                shape = _shape(records, drive, frequency)
                item = replace(shape, coefficients=amplitude * shape.coefficients)
                item.coefficients[item.orders == 0] = mean
                run = Planned(float(frequency), float(mean), float(amplitude), item)
                if Motion.of_signal(item, run.frequency).possible(limits):
                    found.append(run)
    return found


def _shape(records: Sequence[Record], drive: str, frequency: float) -> Harmonics:
    """Waveform without mean and of unit amplitude."""
    if all(_nearly_a_sine(record.harmonics[drive]) for record in records):
        return motion(0.0, [1.0])
    near = min(records, key=lambda record: abs(np.log(record.frequency / frequency)))
    item, own = near.harmonics[drive], Motion.of(near, drive)
    orders = np.union1d([0], item.orders)
    coefficients = np.zeros(orders.size, dtype=complex)
    coefficients[np.searchsorted(orders, item.orders)] = item.coefficients / own.amplitude
    coefficients[0] = 0.0
    return Harmonics(orders, coefficients, np.zeros(orders.size))


def _nearly_a_sine(item: Harmonics) -> bool:
    power = np.abs(item.coefficients[item.orders > 0]) ** 2
    first = power[item.orders[item.orders > 0] == 1].sum()
    return bool(first >= NEARLY_A_SINE * power.sum())


def _factors(limits: Range, count: int) -> Array:
    """Values a constant factor apart; a single value where the limits coincide."""
    low, high = max(limits[0], 1e-3 * limits[1]), limits[1]
    return np.array([high]) if high <= low * 1.001 else np.geomspace(low, high, count)


def _even(limits: Range, count: int, size: float) -> Array:
    """Values an equal step apart; one where the limits are close relative to the motion."""
    low, high = limits
    if high - low >= 0.05 * size:
        return np.linspace(low, high, count)
    # The means of a motion about zero are noise, which is not proposed.
    middle = 0.0 if low <= 0.0 <= high else (low + high) / 2
    return np.array([0.0 if abs(middle) < NO_MEAN * size else middle])


@dataclass(frozen=True)
class Size:
    """An amplitude, if its prior has a certain size.

    Parameters
    ----------
    name : str
        Of the amplitude.
    weight : float
        Probability of the size.
    mean, sd : float
        Of the amplitude, given the size.
    """

    name: str
    weight: float
    mean: float
    sd: float


#: Sizes that a prior is a mixture of, and the least probability of one.
SIZES, RARE = 8, 1e-3


def sizes_of(fit: ModelFit, amplitudes: Sequence[str], samples: int) -> tuple[Size, ...]:
    """What the least certain amplitude of an estimated structure is a mixture of.

    Probabilities of structures rest on a prior of sizes that reaches from the smallest visible
    change of the outputs to the signal itself. A better run shows smaller changes, and that prior
    then begins lower. The part of a structure's probability that it would have if its effect were
    absent is therefore not lowered by any run: it belongs to sizes that none shows, and predicts
    what the structure without the effect does.

    Parameters
    ----------
    fit : ModelFit
        Of the structure.
    amplitudes : sequence of str
        Unknowns of its effects' amplitudes.
    samples : int
        Of all runs and outputs.
    """
    names, covariance = fit.problem.names, fit.point.covariance
    place = [names.index(name) for name in amplitudes if name in names]
    if not place:
        return ()
    sd = np.sqrt(np.diag(covariance))
    k = min(place, key=lambda k: abs(fit.point.theta[k]) / sd[k])
    # The likelihood alone: the estimate without the prior of its own fit.
    prior = 1.0 / float(fit.problem.priors[k].sd) ** 2
    precision = max(1.0 / sd[k] ** 2 - prior, 1e-6 / sd[k] ** 2)
    mean, error = fit.point.theta[k] / sd[k] ** 2 / precision, 1.0 / np.sqrt(precision)
    column = fit.predictor.layout.names.index(names[k])
    seen = [p.sensitivity[:, column] for p in fit.predictions]
    signal = [run.measured for run in fit.predictor.runs]
    noise = np.sqrt(fit.point.variance)
    norm = np.sqrt(sum(np.sum((s / noise[:, None]) ** 2) for s in seen))
    if not norm > 0.0:  # it changes no run: whatever its size, nothing is seen of it
        return (Size(names[k], 1.0, 0.0, 0.0),)
    reach = max(float(np.max(np.std(y, axis=1) / noise)) for y in signal)
    sizes = sizes_between(reach, samples, SIZES) * np.sqrt(samples) / norm
    whole = sizes**2 + error**2
    logs = -0.5 * (mean**2 / whole + np.log(whole))
    shown = np.exp(logs - logs.max())
    absent = np.exp(-0.5 * (mean**2 / error**2 + np.log(whole)) - logs.max()).sum()
    unseen = min(float(absent / shown.sum()), 1.0)
    weights = (1.0 - unseen) * shown / shown.sum()
    means, sds = mean * sizes**2 / whole, sizes * error / np.sqrt(whole)
    rows = zip(weights, means, sds, strict=True)
    found = [Size(names[k], float(w), float(m), float(s)) for w, m, s in rows if w > RARE]
    return (Size(names[k], max(unseen, RARE), 0.0, 0.0), *found)


@dataclass(frozen=True)
class Rival:
    """A model that may be true.

    Parameters
    ----------
    name : str
        The effects by which it differs.
    fit : ModelFit
        Its fit to the existing runs.
    weight : float
        Its probability, but for a factor that all rivals share.
    sizes : tuple of Size
        What its least certain amplitude is a mixture of; none where it is as estimated.
    """

    name: str
    fit: ModelFit
    weight: float = 1.0
    sizes: tuple[Size, ...] = ()


@dataclass(frozen=True)
class NewRunNoise:
    """Noise that an output would have in a new run.

    Parameters
    ----------
    frequency : ndarray, shape (f,)
        Hz, ascending.
    variance : ndarray, shape (f,)
        Of an orthonormal Fourier coefficient, at that frequency, of the average over the run's
        periods at :data:`POINTS` points, SI.
    sample : float
        Standard deviation of a single sample of a transient, SI.
    """

    frequency: Array
    variance: Array
    sample: float

    def divided(self, values: Array, record: Record) -> Array:
        """Signals ``(..., n)`` of an output in units of the noise: coefficients ``(..., n)`` of a
        periodic run, samples of a transient."""
        if not record.periodic:
            return values / self.sample
        size = values.shape[-1]
        orders = np.arange(size // 2 + 1)
        single = (orders == 0) | (2 * orders == size)
        found = np.fft.rfft(values, norm="ortho", axis=-1)
        level = np.interp(orders * record.frequency, self.frequency, self.variance)
        found = found * np.where(single, 1.0, np.sqrt(2.0)) / np.sqrt(level)
        return np.concatenate([found.real, found.imag[..., ~single]], axis=-1)


@dataclass(frozen=True)
class Knowledge:
    """Distribution of a rival's parameters in a new run.

    Parameters
    ----------
    theta : ndarray, shape (l,)
        Expected values, constants known to a tolerance included.
    root : ndarray, shape (r, l)
        Their change by one standard deviation in each independent direction.
    model : Model
    names : tuple of str
        The ``l`` unknowns.
    """

    theta: Array
    root: Array
    model: Model
    names: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, fit: ModelFit, like: str = "", start: float = 1.0, *, periodic: bool = False
    ) -> Knowledge:
        """The distribution by the fit. Shared parameters have their posterior, by-run parameters
        the scatter between the runs, or their priors where there are few runs.

        Parameters
        ----------
        fit : ModelFit
        like : str
            Run that the new one varies: its by-run parameters are expected again. The start of a
            transient is known no better than by its prior.
        start : float
            Factor of that run's estimated start.
        periodic : bool
            Whether the new run is periodic, so that it has no start.
        """
        model = fit.model
        layout = Layout.of(model, ["any"], [periodic])
        values, names = fit.values, fit.problem.names
        theta = layout.start(model)
        covariance = np.diag([float(prior.sd) ** 2 for prior in layout.priors(model)])
        for k, (name, owner) in enumerate(zip(layout.names, layout.parameters, strict=True)):
            if name in values:
                theta[k] = values[name]
                for j, other in enumerate(layout.names):
                    if other in values:
                        a, b = names.index(name), names.index(other)
                        covariance[k, j] = fit.point.covariance[a, b]
            elif model.parameters[owner].by_run:
                own = [value for key, value in values.items() if key.startswith(f"{owner}[")]
                begins = owner.startswith(START)
                theta[k] = np.mean(own) if own else theta[k]
                theta[k] = values.get(f"{owner}[{like}]", theta[k]) * (start if begins else 1.0)
                known = len(own) >= fit.policy.enough_runs and not begins
                if known and not model.parameters[owner].measured:
                    covariance[k, k] = np.var(own, ddof=1) * (1 + 1 / len(own))
        return cls(theta, _root(covariance), model, layout.names)


def _root(covariance: Array) -> Array:
    """Rows whose outer products add up to a covariance, computed in scaled units."""
    scale = np.sqrt(np.diag(covariance))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return (vectors * np.sqrt(np.clip(values, 0.0, None))).T * scale


def blank_record(
    like: Record, frequency: float, drive: str, waveform: Harmonics, outputs: tuple[str, ...]
) -> Record:
    """A new run without outputs: one period of a known motion.

    Parameters
    ----------
    like : Record
        Run that gives the conditions.
    frequency : float
        Hz.
    drive : str
        The channel that moves.
    waveform : Harmonics
        Its motion.
    outputs : tuple of str
        Channels to be predicted.
    """
    phase = np.arange(POINTS) / POINTS
    samples = {name: np.zeros(POINTS) for name in outputs}
    samples[drive] = waveform.evaluate(phase, frequency)
    return replace(
        like,
        label="any",
        frequency=frequency,
        frequency_sd=0.0,
        periods=1,
        time=phase / frequency,
        samples=samples,
        harmonics={drive: waveform},
        kept=None,
    )


def predictive_distribution(
    fit: ModelFit,
    known: Knowledge,
    record: Record,
    noise: Mapping[str, NewRunNoise],
    begin: TransientRun | None = None,
) -> tuple[PredictiveDistribution, Array] | Status:
    """Predictive distribution of a run by one rival.

    Parameters
    ----------
    fit : ModelFit
        Of the rival.
    known : Knowledge
        Distribution of its parameters.
    record : Record
        From :func:`blank_record`, or a variation of a run that was measured.
    noise : mapping of str to NewRunNoise
        By output.
    begin : TransientRun, optional
        From :func:`solved_like`; its motion is where the solution begins.

    Returns
    -------
    PredictiveDistribution
        In units of the noise, outputs one after the other.
    ndarray, shape (ny, n)
        Outputs, SI.

    If there is no solution, its status is returned instead.
    """
    fed_back = [name for name in known.model.inputs if WITHIN in name]
    fed_back = [name for name in fed_back if not name.startswith((COSINE, SINE))]
    fed_back = fed_back if record.periodic else []
    record = replace(record, harmonics={**record.harmonics, **_nothing(fed_back)})
    for _ in range(PASSES if fed_back else 1):
        predictor, found = _solved(fit, known, record, begin)
        if found.status is not Status.CONVERGED:
            return found.status
        record = replace(
            record, harmonics={**record.harmonics, **_responses(predictor, found.y, fed_back)}
        )

    def divided(values: Array) -> Array:
        """Signals (ny, ..., n) in units of the noise, outputs one after the other."""
        pairs = zip(predictor.outputs, values, strict=True)
        return np.concatenate([noise[name].divided(rows, record) for name, rows in pairs], axis=-1)

    sure = np.einsum("rl,yln->yrn", known.root, found.sensitivity)
    entered = input_columns(predictor.runs[0], predictor.constants(known.theta[None], 0)[0])
    spread = np.concatenate([divided(sure), divided(entered)])
    if not (np.isfinite(spread).all() and np.isfinite(found.y).all()):
        return Status.INADMISSIBLE
    return PredictiveDistribution(divided(found.y), spread, len(known.root)), found.y


def solved_like(
    fit: ModelFit, known: Knowledge, records: Sequence[Record], like: str
) -> TransientRun | None:
    """The motion of a transient by one rival: that of the fit, or for a run that was held out one
    of its own; none of a periodic run, or without a solution."""
    for run in fit.predictor.runs:
        if isinstance(run, TransientRun) and run.record.label == like:
            return run
    for record in records:
        if record.label == like and not record.periodic:
            predictor, found = _solved(fit, known, record, None)
            run = predictor.runs[0]
            if found.status is Status.CONVERGED and isinstance(run, TransientRun):
                return run
    return None


def _solved(
    fit: ModelFit, known: Knowledge, record: Record, begin: TransientRun | None
) -> tuple[Predictor, RunPrediction]:
    """A run's prediction: from the motion of the run that it varies, or else from its start."""
    # Steps that did for the fit of long transients do for their variations.
    long = any(run.can_be_coarser for run in fit.predictor.runs) and not record.periodic
    steps = min(STEPS, fit.fineness) if long else STEPS
    predictor = Predictor(
        known.model, [record], steps=steps, scheme=fit.numerics.scheme, backend="numpy", jobs=1
    )
    (run,) = predictor.runs
    if begin is not None and isinstance(run, TransientRun):
        run.start_like(begin)
        (found,) = predictor.evaluate(known.theta)
        if found.status is not Status.CONVERGED:
            return _solved(fit, known, record, None)
    else:
        (found,) = predictor.evaluate(known.theta)
    return predictor, found


def _nothing(fed_back: list[str]) -> dict[str, Harmonics]:
    """Zero responses, as the start of responses that are also inputs."""
    orders = np.arange(ORDERS + 1)
    zero = Harmonics(orders, np.zeros(orders.size, dtype=complex), np.zeros(orders.size))
    return dict.fromkeys(fed_back, zero)


def _responses(predictor: Predictor, y: Array, fed_back: list[str]) -> dict[str, Harmonics]:
    """Predicted responses that are also inputs, at the orders of the driving channel."""
    found = {}
    for name in fed_back:
        channel, _, other = name.partition(WITHIN)
        driven = predictor.records[0].harmonics[other].orders
        spectrum = np.fft.rfft(y[predictor.outputs.index(channel)]) * 2 / POINTS
        spectrum[0] /= 2
        orders = np.array([k for k in range(ORDERS + 1) if k in driven])
        found[name] = Harmonics(orders, spectrum[orders], np.zeros(orders.size))
    return found
