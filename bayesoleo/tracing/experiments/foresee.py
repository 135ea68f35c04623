"""What an estimated model foresees of a run that was not made, with all that it does not know."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from bayesoleo._types import Array
from bayesoleo.model import Model
from bayesoleo.model.expressions import COSINE, SINE, WITHIN
from bayesoleo.prediction.input_noise import input_columns
from bayesoleo.prediction.layout import Layout
from bayesoleo.prediction.predictor import Predictor
from bayesoleo.prediction.records import Harmonics, Record
from bayesoleo.solvers.status import Status
from bayesoleo.tracing.experiments.separation import PredictiveDistribution
from bayesoleo.tracing.fitting.fit import Fit

#: Points of a period at which outputs are compared, and steps of the mesh: a choice between runs
#: needs no more digits than it shows.
POINTS, STEPS = 128, 128
#: Passes that make a response which is an input as well agree with itself, and the orders of it.
PASSES, ORDERS = 4, 12


@dataclass(frozen=True)
class Rival:
    """A model that stands for what might be true.

    Parameters
    ----------
    name : str
        The effect by which it differs.
    fit : Fit
        To the runs that there are.
    """

    name: str
    fit: Fit


@dataclass(frozen=True)
class Knowledge:
    """What is known of a rival's parameters in a run that was not made.

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
    def of(cls, fit: Fit) -> Knowledge:
        """Shared parameters as the runs know them; those of single runs as they scatter between
        these; what few runs say nothing of, as in their priors."""
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
    """Rows whose outer products add up to a covariance; units must not matter to its digits."""
    scale = np.sqrt(np.diag(covariance))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return (vectors * np.sqrt(np.clip(values, 0.0, None))).T * scale


def blank_record(
    like: Record, frequency: float, drive: str, waveform: Harmonics, outputs: tuple[str, ...]
) -> Record:
    """A run that was not made: one period of a known motion.

    Parameters
    ----------
    like : Record
        Gives the conditions.
    frequency : float
        Hz.
    drive : str
        The channel that moves.
    waveform : Harmonics
        How it moves.
    outputs : tuple of str
        Channels that are to be predicted.
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
    """What a rival foresees of a run.

    Parameters
    ----------
    rival : Rival
    known : Knowledge
        Of its parameters.
    record : Record
        From :func:`blank_record`.
    noise : mapping of str to float
        Standard deviation that the average over the run's periods has at each point, by output, SI.

    Returns
    -------
    PredictiveDistribution
        In units of the noise, outputs one after the other.
    ndarray, shape (ny, POINTS)
        Outputs, SI.

    Or the status of the solution, where there is none.
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
    """Responses that are inputs too, before they are known."""
    orders = np.arange(ORDERS + 1)
    zero = Harmonics(orders, np.zeros(orders.size, dtype=complex), np.zeros(orders.size))
    return dict.fromkeys(fed_back, zero)


def _responses(predictor: Predictor, y: Array, fed_back: list[str]) -> dict[str, Harmonics]:
    """The same as the model foresees them, at the orders of what it is driven by."""
    found = {}
    for name in fed_back:
        channel, _, other = name.partition(WITHIN)
        driven = predictor.records[0].harmonics[other].orders
        spectrum = np.fft.rfft(y[predictor.outputs.index(channel)]) * 2 / POINTS
        spectrum[0] /= 2
        orders = np.array([k for k in range(ORDERS + 1) if k in driven])
        found[name] = Harmonics(orders, spectrum[orders], np.zeros(orders.size))
    return found
