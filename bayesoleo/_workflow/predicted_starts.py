"""Where a transient that is predicted starts, by its record and by the prior of its start.

The start is estimated on the record, all else held at the estimate. About it the solution is taken
as linear: each draw of the other unknowns then has a start of its own, which fits the record as
well as it can, and what noise leaves open of it is drawn (the conditional normal distribution of a
linear model; Bishop 2006, Pattern Recognition and Machine Learning, section 3.3.1). Where the noise
is correlated, a record tells less of it than independent samples would.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from bayesoleo._types import Array, Integers
from bayesoleo.discovery._beginnings import LIMITS, UNSEEN, on_beginning
from bayesoleo.discovery._samples_that_count import weights
from bayesoleo.discovery._transient_variance import RunNoise, coloured_variance
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._estimate import estimate
from bayesoleo.model._drive_and_start import start_parameters
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.solvers._orbit import Status

#: How often a start beyond its prior's limits is drawn anew, before it is the estimate.
REDRAWN = 50


def unknown_starts(predictor: Predictor, known: Collection[str]) -> Integers:
    """Columns of one run's unknowns that say where it starts, and that a result does not know.

    Parameters
    ----------
    predictor : Predictor
        Of one run.
    known : collection of str
        Unknowns of the result.
    """
    layout, starts = predictor.layout, start_parameters(predictor.model)
    owners = zip(layout.names, layout.parameters, strict=True)
    found = [k for k, (name, owner) in enumerate(owners) if owner in starts and name not in known]
    return np.array(found, dtype=np.int64)


def estimated_starts(predictor: Predictor, theta: Array, starts: Integers) -> Array:
    """Unknowns of one run with starts as its record says, shape (l,).

    Parameters
    ----------
    predictor : Predictor
        Of one run.
    theta : ndarray, shape (l,)
        All unknowns; those that are not starts are held.
    starts : ndarray of int
        Columns of the starts.

    Returns
    -------
    ndarray, shape (l,)
        As given, where the record cannot say.
    """
    names = predictor.layout.names
    held = {n: float(v) for k, (n, v) in enumerate(zip(names, theta, strict=True))
            if k not in starts}  # fmt: skip
    problem = CampaignProblem(predictor).holding(held)
    problem = on_beginning(problem, held, theta[starts]) or problem
    # A declared height of fall may be known better than its record tells it.
    found = estimate(problem, "be", start=theta[starts], **LIMITS)  # type: ignore[arg-type]
    usable = found.status in (Status.CONVERGED, Status.NO_CONVERGENCE)
    return np.asarray(problem.full(found.theta[None])[0]) if usable else theta


def drawn_starts(
    predictor: Predictor,
    theta: Array,
    starts: Integers,
    draws: Array,
    noise: Array,
    rng: np.random.Generator,
) -> Array:
    """Starts that go with draws of the other unknowns, shape (m, starts).

    Parameters
    ----------
    predictor : Predictor
        Of one run.
    theta : ndarray, shape (l,)
        With the estimated starts.
    starts : ndarray of int
        Their columns.
    draws : ndarray, shape (m, l)
        Of all unknowns; those of the starts are not read.
    noise : ndarray, shape (ny,)
        Standard deviation of each output's errors; where the record is fitted worse, that of what
        is left counts.
    rng : numpy.random.Generator

    Returns
    -------
    ndarray, shape (m, starts)
        The priors' own draws, where nothing can be solved at ``theta``.
    """
    (found,) = predictor.evaluate(theta)
    if not found.status.ok:
        return np.asarray(draws[:, starts])
    (run,) = predictor.runs
    counts = weights(run.record) > 0
    left = np.where(counts, run.measured - found.y, 0.0)
    rms = np.sqrt(np.mean(left[:, counts] ** 2, axis=1))
    size = np.maximum(np.maximum(noise, rms), 1e-300)
    rows = np.where(counts, found.sensitivity / size[:, None, None], 0.0)
    others = np.setdiff1d(np.arange(theta.size), starts)
    priors = predictor.layout.priors(predictor.model)
    width = np.array([float(priors[k].sd) for k in starts])
    # In units of the priors' standard deviations, which are some of any size.
    scaled = rows[:, starts] * width[:, None]
    told = np.einsum("ban,bcn->ac", scaled, scaled)
    prior = np.eye(starts.size)
    by_other = np.einsum("bon,ban->oa", rows[:, others], scaled)
    centre = -np.linalg.solve(told + prior, ((draws[:, others] - theta[others]) @ by_other).T)
    root = np.linalg.cholesky(_as_coloured(told, scaled, left / size[:, None]) + prior)

    def drawn(rows: Integers) -> Array:
        free = np.linalg.solve(root.T, rng.standard_normal((starts.size, rows.size)))
        return np.asarray(theta[starts] + width * (centre[:, rows] + free).T)

    chosen = drawn(np.arange(len(draws)))
    low, high = np.array([priors[k].support for k in starts], dtype=float).T

    def outside() -> Integers:
        return np.flatnonzero(((chosen <= low) | (chosen >= high)).any(axis=1))

    for _ in range(REDRAWN):
        if not (again := outside()).size:
            break
        chosen[again] = drawn(again)
    chosen[outside()] = theta[starts]
    return chosen


def _as_coloured(told: Array, columns: Array, left: Array) -> Array:
    """Information on the starts, shape (s, s), where what is left is correlated from one sample to
    the next, or larger where the start shows: as of independent samples it was ``told``.

    Of ``columns (ny, s, N)`` and ``left (ny, N)``, in units of the noise. Along each axis of what
    is told, the variance of the estimate is that under the spectrum of what is left; more than
    independent samples tell is never taken.
    """
    size, axes = np.linalg.eigh(told)
    run = RunNoise(left, np.moveaxis(columns, 1, 0), np.linalg.pinv(told, hermitian=True))
    for k in np.flatnonzero(size > UNSEEN * size[-1]):
        influence = np.einsum("a,ban->bn", axes[:, k] / size[k], columns)
        variance, _ = coloured_variance([influence], [run])
        size[k] = min(size[k], 1.0 / variance) if variance > 0.0 else size[k]
    return np.asarray((axes * size) @ axes.T)
