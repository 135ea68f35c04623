"""Feasible runs, their predictive distributions, and how well they separate rivals.

The rig limits the amplitude, frequency and mean of the imposed motion, and the range of the rig and
the specimen.

Rival ``i`` predicts the outputs as normal, ``N(m_i, I + A_i' A_i)`` in units of the noise: the
noise of the samples plus the remaining uncertainty of its parameters. If ``i`` is true, the
expected logarithm of the Bayes factor against ``j`` is the Kullback-Leibler divergence

    KL(i, j) = [tr(S_j^-1 S_i) - n + d' S_j^-1 d + ln(|S_j| / |S_i|)] / 2,   d = m_i - m_j.

The Bhattacharyya distances bound the expected information on *which* of several rivals is true from
below. Unlike a sum over pairs, this bound cannot be large because of one pair alone.

References
----------
Box and Hill (1967), Technometrics 9, 57-71; Kolchinsky and Tracey (2017), Entropy 19, 361.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from bayesoleo._types import Array
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.errors import InputError
from bayesoleo.model._expressions import COSINE, SINE, WITHIN
from bayesoleo.model._model import Model
from bayesoleo.prediction._predictor import Layout, Predictor
from bayesoleo.prediction._records import Harmonics, Record
from bayesoleo.prediction._run_errors import input_columns
from bayesoleo.prediction._simulate import motion
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
class PredictiveDistribution:
    """Predictive distribution of an experiment by one rival, in units of the noise.

    Parameters
    ----------
    mean : ndarray, shape (n,)
        Outputs.
    spread : ndarray, shape (r, n)
        Their change by one standard deviation in each of ``r`` independent uncertain directions.
    """

    mean: Array
    spread: Array


@dataclass(frozen=True)
class Separation:
    """Separation of ``k`` rivals by an experiment.

    Parameters
    ----------
    log_bayes_factor : ndarray, shape (k, k)
        Expected value, in nats, for the rival of the row against that of the column if the former
        is true.
    information : float
        Lower bound of the expected information on which of them is true, with equal prior
        probabilities, in bits.
    """

    log_bayes_factor: Array
    information: float

    @property
    def sigma(self) -> Array:
        """Standard deviations by which each pair is separated, shape (k, k).

        ``sqrt(2 L)`` with the smaller of the pair's two expected log Bayes factors ``L``: with all
        parameters known, the distance of the two predictions in units of the noise.
        """
        smaller = np.minimum(self.log_bayes_factor, self.log_bayes_factor.T)
        return np.sqrt(2.0 * smaller)

    @property
    def weakest(self) -> float:
        """Separation of the weakest pair, in standard deviations."""
        return float(self.sigma[np.triu_indices(len(self.sigma), 1)].min())


def separate(rivals: Sequence[PredictiveDistribution]) -> Separation:
    """Expected log Bayes factors between all rivals, and the information about which is true.

    Parameters
    ----------
    rivals : sequence of PredictiveDistribution
        Two or more, of the same experiment in the same units.

    Returns
    -------
    Separation
    """
    means, spreads = _reduced(rivals)
    size, count = means.shape[1], len(rivals)
    covariances = [np.eye(size) + spread.T @ spread for spread in spreads]
    logs = [float(np.linalg.slogdet(S)[1]) for S in covariances]
    factor, overlap = np.zeros((count, count)), np.ones((count, count))
    for i in range(count):
        for j in range(count):
            if i == j:
                continue
            S, d = covariances[j], means[i] - means[j]
            solved = np.linalg.solve(S, np.column_stack([covariances[i], d]))
            twice = np.trace(solved[:, :-1]) - size + d @ solved[:, -1] + logs[j] - logs[i]
            factor[i, j] = max(twice / 2, 0.0)  # round-off may make zero negative
            overlap[i, j] = np.exp(-_bhattacharyya(covariances[i], S, d, logs[i], logs[j]))
    information = float(-np.mean(np.log2(overlap.mean(axis=1))))
    return Separation(factor, max(information, 0.0))


def _reduced(rivals: Sequence[PredictiveDistribution]) -> tuple[Array, list[Array]]:
    """Means ``(k, d)`` and spreads ``(r, d)`` in the directions in which rivals differ or are
    uncertain; in all others their predictions are equal."""
    moved = [rival.mean - rivals[0].mean for rival in rivals]
    rows = np.concatenate([np.stack(moved), *(rival.spread for rival in rivals)])
    basis, _ = np.linalg.qr(rows.T)
    return np.stack(moved) @ basis, [rival.spread @ basis for rival in rivals]


def _bhattacharyya(A: Array, B: Array, d: Array, log_a: float, log_b: float) -> float:
    """Bhattacharyya distance of two normal densities, from the logarithms of their determinants."""
    mean = (A + B) / 2
    between = float(np.linalg.slogdet(mean)[1]) - (log_a + log_b) / 2
    return max(float(d @ np.linalg.solve(mean, d)) / 8 + between / 2, 0.0)


@dataclass(frozen=True)
class Rival:
    """A model that may be true.

    Parameters
    ----------
    name : str
        The effect by which it differs.
    fit : ModelFit
        Its fit to the existing runs.
    """

    name: str
    fit: ModelFit


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
    """

    theta: Array
    root: Array
    model: Model

    @classmethod
    def of(cls, fit: ModelFit) -> Knowledge:
        """The distribution by the fit. Shared parameters have their posterior, by-run parameters
        the scatter between the runs, or their priors where there are few runs."""
        model = fit.model
        layout = Layout.of(model, ["any"])
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
                theta[k] = np.mean(own) if own else theta[k]
                if len(own) >= fit.policy.enough_runs and not model.parameters[owner].measured:
                    covariance[k, k] = np.var(own, ddof=1) * (1 + 1 / len(own))
        return cls(theta, _root(covariance), model)


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
    rival: Rival, known: Knowledge, record: Record, noise: Mapping[str, float]
) -> tuple[PredictiveDistribution, Array] | Status:
    """Predictive distribution of a run by one rival.

    Parameters
    ----------
    rival : Rival
    known : Knowledge
        Distribution of its parameters.
    record : Record
        From :func:`blank_record`.
    noise : mapping of str to float
        Standard deviation of the average over the run's periods at each point, by output, SI.

    Returns
    -------
    PredictiveDistribution
        In units of the noise, outputs one after the other.
    ndarray, shape (ny, POINTS)
        Outputs, SI.

    If there is no solution, its status is returned instead.
    """
    fit = rival.fit
    fed_back = [name for name in known.model.inputs if WITHIN in name]
    fed_back = [name for name in fed_back if not name.startswith((COSINE, SINE))]
    record = replace(record, harmonics={**record.harmonics, **_nothing(fed_back)})
    for _ in range(PASSES if fed_back else 1):
        predictor = Predictor(
            known.model, [record], steps=STEPS, scheme=fit.numerics.scheme, backend="numpy", jobs=1
        )
        found = predictor.evaluate(known.theta)[0]
        if found.status is not Status.CONVERGED:
            return found.status
        record = replace(
            record, harmonics={**record.harmonics, **_responses(predictor, found.y, fed_back)}
        )
    scale = np.array([1.0 / noise[name] for name in predictor.outputs])[:, None]
    sure = np.einsum("rl,yln->ryn", known.root, found.sensitivity) * scale
    entered = input_columns(predictor.runs[0], predictor.constants(known.theta[None], 0)[0])
    entered = np.moveaxis(entered, 1, 0) * scale
    size = found.y.size
    spread = np.concatenate([sure.reshape(-1, size), entered.reshape(-1, size)])
    if not (np.isfinite(spread).all() and np.isfinite(found.y).all()):
        return Status.INADMISSIBLE
    return PredictiveDistribution((found.y * scale).ravel(), spread), found.y


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
