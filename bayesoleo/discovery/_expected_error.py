r"""Expected error of a run: its noise, and the uncertainty of the parameters.

Let :math:`N` be the covariance of a run's noise, including that of its inputs propagated through
the model, :math:`J` its sensitivities, :math:`W` the weights of the estimator and :math:`C` the
covariance that the estimator states. The estimation error is :math:`-C J' W e`, summed over the
fitted runs, plus the error of the prior, so that its covariance is

.. math:: \Sigma = C + C \Big(\sum_r J_r' W N_r W J_r - \sum_r J_r' W J_r\Big) C,

which equals :math:`C` where the noise is white and of the size that the estimator found. The error
of a hold-out run has the covariance :math:`N + J \Sigma J'`. The estimates contain some of the
noise of a fitted run, whose residual has the covariance
:math:`N - J C J' W N - N W J C J' + J \Sigma J'`, in the simplest case :math:`N - J C J'`. The same
holds for a hold-out run with respect to the by-run parameters that are estimated on it.

Draws of the posterior check whether this linearisation holds.

References
----------
White (1980), Econometrica 48(4), 817-838: the covariance between two estimates of one. Seber and
Lee (2003), Linear Regression Analysis, sections 5.3 and 10.2: predictions and residuals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from bayesoleo import _distributions as distributions
from bayesoleo._types import Array
from bayesoleo.data._noise import local_means
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._fit_and_hold_out_error import RunError
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.discovery._run_predictions import Prediction
from bayesoleo.discovery._samples_that_count import weights
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Record
from bayesoleo.solvers._orbit import Status

#: Errors of one run by output, and the input's noise in them; see
#: :func:`bayesoleo.discovery._fit_and_hold_out_error.compared`.
Compared = tuple[list[RunError], Array]


def curved(prediction: Prediction, root: Array, averaged: Array, policy: SearchPolicy) -> Array:
    """Mean square change over draws of the unknowns, over the linearised one, by output.

    Parameters
    ----------
    prediction : Prediction
        Of a run without unknowns of its own.
    root : ndarray, shape (l, l)
        ``R`` with ``R R'`` the covariance of its unknowns.
    averaged : ndarray, shape (ny, l, N)
        Sensitivities.
    policy : SearchPolicy

    Returns
    -------
    ndarray, shape (ny,)
        One where nothing moves, or too few draws can be solved.
    """
    outputs = averaged.shape[0]
    linear = np.array([float(np.sum((root.T @ J) ** 2)) for J in averaged]) / averaged.shape[2]
    record = prediction.record
    left = np.stack([record.samples[o] for o in prediction.predictor.outputs]) - prediction.y
    size = np.mean((left * weights(record)) ** 2, axis=1)
    if not np.any(linear > policy.curvature_matters * size):
        return np.ones(outputs)
    draws = _inside(prediction, root, policy.curvature_draws)
    found = prediction.predictor.simulate(draws, 0)
    good = found.status == Status.CONVERGED.value
    if good.sum() < policy.curvature_draws // 2:
        return np.ones(outputs)
    changes = (found.y[good] - prediction.y) * weights(record)
    if not record.periodic:
        changes = local_means(changes, record.kept)
    squares = np.mean(changes**2, axis=2)
    squares = np.minimum(squares, policy.farthest_draw**2 * np.mean(squares, axis=0))
    return np.where(linear > 0, np.mean(squares, axis=0) / np.maximum(linear, 1e-300), 1.0)


def _inside(prediction: Prediction, root: Array, count: int) -> Array:
    """Vectors of all unknowns drawn about the estimate, within their priors' supports."""
    rng = np.random.default_rng(0)
    # Opposite pairs: the mean of the changes is then that of the curvature alone.
    half = rng.standard_normal((count // 2, root.shape[1])) @ root.T
    draws = prediction.vector + np.concatenate([half, -half])
    predictor = prediction.predictor
    for k, prior in enumerate(predictor.layout.priors(predictor.model)):
        low, high = prior.support
        room = 1e-3 * prior.sd
        draws[:, k] = np.clip(draws[:, k], low + room, high - room)
    return cast(Array, draws)


@dataclass(frozen=True)
class EstimateCovariance:
    """What estimates are known to.

    Parameters
    ----------
    names : tuple of str, length l
    covariance : ndarray, shape (l, l)
        Of the estimates about the truth, ``Sigma``.
    """

    names: tuple[str, ...]
    covariance: Array

    def of(self, names: Sequence[str]) -> Array:
        """Covariance of some unknowns, zero for what was not estimated, shape (m, m)."""
        place = [self.names.index(name) if name in self.names else -1 for name in names]
        there = np.array([k >= 0 for k in place], dtype=bool)
        return self.covariance[np.ix_(place, place)] * np.outer(there, there)


@dataclass(frozen=True)
class LinearisedRun:
    """One run in terms of some unknowns, outputs apart.

    Parameters
    ----------
    weight : ndarray, shape (ny,)
    averaged : ndarray, shape (ny, l, N)
        Sensitivities of the averaged residual.
    raw : ndarray, shape (ny, l, N)
        Those of single samples.
    inputs : ndarray, shape (ny, k, N)
        The input's noise in it.
    through : ndarray, shape (ny, l, l)
        ``J N J'`` of the averaged residual, without the input's noise.
    information, scatter : ndarray, shape (l, l)
        ``J' W J`` and ``J' W N W J``, over all outputs.
    pulled : ndarray, shape (l, k)
        ``J' W B``.
    """

    weight: Array
    averaged: Array
    raw: Array
    inputs: Array
    through: Array
    information: Array
    scatter: Array
    pulled: Array

    @classmethod
    def of(
        cls, record: Record, found: Compared, sensitivity: Array, weight: Array
    ) -> LinearisedRun:
        entries, columns = found
        counts = weights(record)
        raw, columns = sensitivity * counts, columns * counts
        through = np.stack([_through(e, J) for e, J in zip(entries, raw, strict=True)])
        pulled = np.einsum("y,yln,ykn->lk", weight, raw, columns)
        scatter = np.einsum("y,ylm->lm", weight**2, through) + pulled @ pulled.T
        information = np.einsum("y,yln,ymn->lm", weight, raw, raw)
        averaged, inputs = raw, columns
        if not record.periodic:
            averaged, inputs = (local_means(one, record.kept) for one in (raw, columns))
            through = np.stack([_through(e, J) for e, J in zip(entries, averaged, strict=True)])
        return cls(weight, averaged, raw, inputs, through, information, scatter, pulled)

    def lent(self, output: int, response: Array) -> float:
        """Trace of ``J C J' W N`` in one output, ``C`` the response of the estimates."""
        own = self.weight[output] * float(np.sum(response * self.through[output]))
        mixed = self.averaged[output] @ self.inputs[output].T
        return cast(float, own + float(np.sum(mixed * (response @ self.pulled))))

    def spread(self, output: int, covariance: Array) -> float:
        """Mean over the samples of the diagonal of ``J Sigma J'`` in one output."""
        J = self.averaged[output]
        return cast(float, float(np.sum(covariance * (J @ J.T))) / J.shape[1])


def _through(entry: RunError, columns: Array) -> Array:
    """``J N J'`` of columns ``(l, N)``, by the noise's spectrum where there is one."""
    spectrum = entry.spectrum
    if spectrum is None:
        white: Array = entry.sigma**2 * columns @ columns.T
        return white
    lines = scipy.fft.rfft(columns, axis=1)
    power = spectrum.weights * spectrum.level / spectrum.samples
    rounded = max(entry.sigma**2 - entry.average.sigma**2, 0.0)
    coloured: Array = ((lines * power) @ lines.conj().T).real + rounded * columns @ columns.T
    return coloured


def expected_of_fitted(
    fit: ModelFit, fitted: Sequence[Prediction], found: Sequence[Compared]
) -> tuple[list[RunError], dict[str, EstimateCovariance]]:
    """Errors of the fitted runs with what is expected of them, and what is known for other runs.

    Parameters
    ----------
    fit : ModelFit
    fitted : sequence of Prediction
        Of its runs, in its order.
    found : sequence of Compared
        Of the same.

    Returns
    -------
    list of RunError
    dict of str to EstimateCovariance
        Under ``""`` what the fit knows; by label what it would know without that run. Empty where
        the fit has no covariance.
    """
    names, response = fit.problem.names, fit.point.covariance
    runs = linearised_runs(fit, fitted, found)
    if not runs:
        return [entry for entries, _ in found for entry in entries], {}
    surplus = sum((run.scatter - run.information for run in runs), np.zeros_like(response))
    covariance = response + response @ surplus @ response
    entries = [
        _left(entry, run, b, response, covariance, fit.policy)
        for (errors, _), run in zip(found, runs, strict=True)
        for b, entry in enumerate(errors)
    ]
    known = {"": EstimateCovariance(names, covariance)}
    for p, run in zip(fitted, runs, strict=True):
        known[p.record.label] = _without(names, response, surplus, run, p.record.label)
    return entries, known


def linearised_runs(
    fit: ModelFit, fitted: Sequence[Prediction], found: Sequence[Compared]
) -> list[LinearisedRun]:
    """The fitted runs in terms of the unknowns; none where the fit has no covariance."""
    if not np.isfinite(fit.point.covariance).all() or not all(p.status.ok for p in fitted):
        return []
    free = [fit.predictor.layout.names.index(name) for name in fit.problem.names]
    return [
        LinearisedRun.of(p.record, one, predicted.sensitivity[:, free], 1.0 / fit.point.variance)
        for p, one, predicted in zip(fitted, found, fit.predictions, strict=True)
    ]


def _left(
    entry: RunError,
    run: LinearisedRun,
    output: int,
    response: Array,
    covariance: Array,
    policy: SearchPolicy,
) -> RunError:
    """What a run leaves that took part in estimating all of its unknowns."""
    size = run.averaged.shape[2]
    square = entry.noise**2 - 2.0 * run.lent(output, response) / size
    square += run.spread(output, covariance)
    return _with(entry, run, output, square, np.zeros((0, 0)), policy)


def _with(
    entry: RunError,
    run: LinearisedRun,
    output: int,
    square: float,
    parameters: Array,
    policy: SearchPolicy,
) -> RunError:
    """An entry with its expected error, and what of it is noise."""
    coefficients = _coefficients(entry, run.inputs[output])
    # Each unknown absorbs one of them at most; where a matrix is nearly singular, its rounding
    # would have a few absorb nearly all.
    left = 1.0 - run.information.shape[0] / coefficients
    least = max(policy.least_expected**2, left) * entry.noise**2
    square = max(square, least)
    own = max(square - float(np.trace(parameters)), least)
    return replace(
        entry,
        expected_error=float(np.sqrt(square)),
        parameters=parameters / square,
        own_share=own / square,
        own_coefficients=coefficients * min(own / entry.noise**2, 1.0),
    )


def _coefficients(entry: RunError, inputs: Array) -> float:
    """Equally noisy coefficients that the noise of an average scatters like, the input's with it:
    each of its columns is one."""
    if entry.input_noise == 0 or inputs.shape[0] == 0:
        return entry.coefficients
    own = max(entry.noise**2 - entry.input_noise**2, 0.0)
    gram = inputs @ inputs.T / inputs.shape[1]
    mixed = 2.0 * own / entry.coefficients * float(np.trace(gram))
    squares = own**2 / entry.coefficients + mixed + float(np.sum(gram**2))
    return float(max(entry.noise**4 / squares, 1.0))


def _without(
    names: tuple[str, ...], response: Array, surplus: Array, run: LinearisedRun, label: str
) -> EstimateCovariance:
    """What a fit to all runs but one would know, by linearisation at the fit to all."""
    keep = [k for k, name in enumerate(names) if not name.endswith(f"[{label}]")]
    unit = np.sqrt(np.diag(response))
    units = np.outer(unit, unit)
    precision = np.linalg.pinv(response / units, hermitian=True) - run.information * units
    values, vectors = np.linalg.eigh(precision[np.ix_(keep, keep)])
    # Round-off where that run alone said anything.
    partial = (vectors / np.maximum(values, 1e-10 * np.max(values, initial=1e-300))) @ vectors.T
    partial = partial * units[np.ix_(keep, keep)]
    rest = (surplus - run.scatter + run.information)[np.ix_(keep, keep)]
    return EstimateCovariance(tuple(names[k] for k in keep), partial + partial @ rest @ partial)


def expected_of_held_out(
    prediction: Prediction,
    found: Compared,
    known: Mapping[str, EstimateCovariance],
    *,
    policy: SearchPolicy = SearchPolicy(),
) -> list[RunError]:
    """Errors of a run that was not fitted, with what is expected of them.

    Parameters
    ----------
    prediction : Prediction
    found : Compared
        Of the same.
    known : mapping of str to EstimateCovariance
        What is known without this run, else under ``""``.
    policy : SearchPolicy
    """
    mine = known.get(prediction.record.label, known.get(""))
    entries, _ = found
    if mine is None or not prediction.status.ok:
        return entries
    predictor = prediction.predictor
    names = predictor.layout.names
    at_estimate = predictor.predict(prediction.vector)[0].sensitivity
    if not np.isfinite(at_estimate).all():
        return entries
    re_estimated = prediction.re_estimated > 0
    own = np.array([re_estimated and name not in mine.names for name in names], dtype=np.bool_)
    sigma = np.array([max(entry.sigma, 1e-300) for entry in entries])
    run = LinearisedRun.of(prediction.record, found, at_estimate, sigma**-2)
    shared = mine.of(names)
    response, moved = _own_response(predictor, run, own)
    shared = moved @ shared @ moved.T
    estimated = shared + response + response @ (run.scatter - run.information) @ response
    root = _root(shared)
    bent = np.ones(len(entries))
    if not own.any():
        bent = curved(prediction, root, run.averaged, policy)
    size, left = run.averaged.shape[2], []
    for b, entry in enumerate(entries):
        J = root.T @ run.averaged[b]
        parameters = J @ J.T / size * bent[b]
        square = entry.noise**2 - 2.0 * run.lent(b, response) / size
        square += run.spread(b, estimated - shared) + float(np.trace(parameters))
        linear = _with(entry, run, b, square, parameters, policy)
        moved_by = float(np.mean(np.sum((root.T @ run.raw[b]) ** 2, axis=0)))
        by_chance = most_by_chance(moved_by * bent[b], policy)
        left.append(replace(linear, feigned=entry.feigned + by_chance))
    return left


def most_by_chance(square: float, policy: SearchPolicy) -> float:
    """What chance makes of a mean square by errors of the unknowns at most, were they one."""
    return square * float(distributions.chi2.isf(policy.floor_false_alarm, 1))


def _own_response(
    predictor: Predictor, run: LinearisedRun, own: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Response of the by-run unknowns to the residual ``(l, l)``, and the map from errors of the
    shared unknowns to errors of all ``(l, l)``."""
    size = own.size
    response, moved = np.zeros((size, size)), np.diag((~own).astype(float))
    if not own.any():
        return response, moved
    information = run.information[np.ix_(own, own)]
    layout, parameters = predictor.layout, predictor.model.parameters
    owners = [parameters[layout.parameters[k]] for k in np.flatnonzero(own)]
    if any(owner.measured for owner in owners):  # their priors count
        priors = [layout.priors(predictor.model)[k] for k in np.flatnonzero(own)]
        information = information + np.diag([prior.sd**-2 for prior in priors])
    unit = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = np.linalg.pinv(information * np.outer(unit, unit), rcond=1e-10, hermitian=True)
    inside = scaled * np.outer(unit, unit)
    response[np.ix_(own, own)] = inside
    moved[np.ix_(own, ~own)] = -inside @ run.information[np.ix_(own, ~own)]
    return response, moved


def _root(covariance: Array) -> Array:
    """``R`` with ``R R'`` the covariance, the largest share in the first columns."""
    unit = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    unit = np.where(unit > 0, unit, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(unit, unit))
    root: Array = unit[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    return root
