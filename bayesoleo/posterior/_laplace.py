"""Laplace approximations at the modes, their mixture, and importance sampling from it.

Where the approximation is good, independent draws from it, weighted by target over proposal, are
worth about a third as many draws of the target itself, and no walker has to warm up. The cost is a
hundredth of sampling. The weights show whether the approximation is good: the largest of them
follow a generalised Pareto distribution whose shape determines how many of their moments exist.
Below 0.7 sums of weights converge at a practicable rate; above, use
:func:`~bayesoleo.posterior.sample`.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import logsumexp

from bayesoleo._types import Array, Float
from bayesoleo.error_models._fitting import derivatives
from bayesoleo.errors import InputError
from bayesoleo.posterior._log_density import Density, LogDensity, information_at, residuals_at
from bayesoleo.posterior._mixture import DEGREES_OF_FREEDOM, Mixture
from bayesoleo.solvers._orbit import Status

#: A mode is found when the Newton step is shorter than this many standard deviations.
TOLERANCE = 1e-3
#: Longest Newton step, in standard deviations; a quadratic model is not trusted further.
RADIUS = 3.0
#: Most Newton steps: where correlated errors take over from independent ones the mode lies tens of
#: standard deviations away, along a valley that bends.
ITERATIONS = 200
#: Eigenvalue of a precision of unit diagonal below which a direction counts as open.
OPEN = 1e-12
#: Largest shape of the weights' tail (Vehtari et al. 2024, section 3.2.4).
LARGEST_SHAPE = 0.7


@dataclass(frozen=True)
class Mode:
    """A mode of a log density with its normal approximation.

    Parameters
    ----------
    centre : ndarray, shape (d,)
        Where the density is highest, in coordinates without bounds.
    covariance : ndarray, shape (d, d)
        Inverse of the negative Hessian there.
    log_weight : float
        Logarithm of the Laplace approximation of the density's integral around the mode.
    status : Status
        ``CONVERGED``; ``NO_CONVERGENCE`` when the polishing ran out of iterations; ``SINGULAR``
        when the Hessian is not negative definite and the covariance is the Gauss-Newton one
        instead; a failure of the density otherwise.

    References
    ----------
    Tierney and Kadane (1986), "Accurate approximations for posterior moments and marginal
    densities", *JASA* 81, eq. 2.2.
    """

    centre: Float[Array, " coordinates"]
    covariance: Float[Array, "coordinates coordinates"]
    log_weight: float
    status: Status


def gauss_newton_covariance(log_density: LogDensity, phi: Array) -> Array:
    """Block-diagonal approximation of the covariance at a point.

    Parameters
    ----------
    log_density : LogDensity
        Over ``p + m`` coordinates.
    phi : ndarray, shape (p + m,)
        The point.

    Returns
    -------
    ndarray, shape (p + m, p + m)
        Inverse of ``A + w^-1`` at fixed ``v`` for the unknowns (in coordinates without bounds,
        ``w`` the curvature of prior and Jacobian there), and rough variances for the quantities of
        the error model: ``2 / n_b`` for ``ln v_b``. Where the sensitivities cannot be computed,
        ``A`` is left out.

    References
    ----------
    Verbeek (1993), eq. 3.19 (the matrix) and Appendix A (``H_vv`` at ``v = M / n``).
    """
    unknowns, errors = log_density.unknowns, log_density.errors
    block, eta = (part[0] for part in log_density.split(phi[None]))
    theta, chain = unknowns.theta(block[None])[0], unknowns.jacobian(block)
    information = information_at(log_density.problem, errors, theta, eta)
    precision = unknowns.precision(block) + chain.T @ information @ chain
    size = len(block)
    covariance = np.zeros((len(phi), len(phi)))
    covariance[:size, :size] = _inverse(precision)
    covariance[size:, size:] = np.diag(errors.scales() ** 2)
    return covariance


def _inverse(precision: Array) -> Array:
    """Inverse of a precision as a covariance, also where that is singular to rounding.

    Directions that data and priors leave open, as two gains of which one answers the other, keep a
    large variance.
    """
    with suppress(np.linalg.LinAlgError):
        covariance: Array = np.linalg.inv(precision)
        np.linalg.cholesky(covariance)
        return covariance
    unit = np.sqrt(np.abs(np.diag(precision)))
    unit[~(unit > 0.0)] = 1.0
    size, axes = np.linalg.eigh(0.5 * (precision + precision.T) / np.outer(unit, unit))
    size = np.maximum(size, OPEN * max(float(size[-1]), OPEN))
    return np.asarray((axes / size) @ axes.T / np.outer(unit, unit))


def find_mode(log_density: LogDensity, start: Array, *, iterations: int = ITERATIONS) -> Mode:
    """Climb to the mode next to a point and approximate the density there.

    Newton's method in coordinates whitened by the Gauss-Newton covariance; gradient and Hessian
    come from one batch of ``d^2 + d + 1`` rows, the step length from a second one.

    Parameters
    ----------
    log_density : LogDensity
        Over ``d`` coordinates.
    start : ndarray, shape (d,)
        Where to begin, for example the estimate.
    iterations : int
        Most Newton iterations.

    Returns
    -------
    Mode
        With a status; nothing is raised for a numerical failure.

    References
    ----------
    Verbeek (1993), Appendix A (full Newton), here by finite differences.
    """
    phi = np.array(start, dtype=float)
    status, height = Status.NO_CONVERGENCE, -np.inf
    for _ in range(iterations):
        covariance = gauss_newton_covariance(log_density, phi)
        factor = np.linalg.cholesky(covariance)
        height, gradient, hessian = derivatives(lambda rows: log_density(rows)[0], phi, factor)
        if not np.isfinite(height):
            return Mode(phi, covariance, -np.inf, Status.NOT_FINITE)
        step = _newton_step(gradient, hessian)
        if np.linalg.norm(step) < TOLERANCE:
            status = Status.CONVERGED
            break
        phi, moved = _line_search(log_density, phi, factor @ step, height)
        if (
            not moved
        ):  # no height to gain along an ascent direction: the top, as far as rounding shows
            status = Status.CONVERGED
            break
    covariance, positive = _covariance(factor, hessian)
    if not positive:
        status = Status.SINGULAR
    half_log_det = float(np.sum(np.log(np.diagonal(np.linalg.cholesky(covariance)))))
    weight = height + half_log_det + 0.5 * len(phi) * np.log(2 * np.pi)
    return Mode(phi, covariance, float(weight), status)


def _newton_step(gradient: Array, hessian: Array) -> Array:
    gradient = np.nan_to_num(gradient, nan=0.0, posinf=RADIUS, neginf=-RADIUS)
    try:
        if not np.all(np.isfinite(hessian)):
            raise np.linalg.LinAlgError
        np.linalg.cholesky(-hessian)
        step = np.linalg.solve(-hessian, gradient)
    except np.linalg.LinAlgError:
        step = gradient  # whitened by Gauss-Newton: its Hessian is minus the identity
    length = np.linalg.norm(step)
    return step if length <= RADIUS else step * (RADIUS / length)


def _line_search(
    log_density: LogDensity, phi: Array, step: Array, height: float
) -> tuple[Array, bool]:
    """Best of the full step and its halves, all in one call, and whether it is higher."""
    lengths = 0.5 ** np.arange(12)
    trials = phi + lengths[:, None] * step
    values, _ = log_density(trials)
    best = int(np.argmax(values))
    return (trials[best], True) if values[best] > height else (phi, False)


def _covariance(factor: Array, hessian: Array) -> tuple[Array, bool]:
    """Covariance from the whitened Hessian; Gauss-Newton's where it is not negative definite."""
    try:
        if not np.all(np.isfinite(hessian)):
            raise np.linalg.LinAlgError
        np.linalg.cholesky(-hessian)
    except np.linalg.LinAlgError:
        return factor @ factor.T, False
    covariance = factor @ np.linalg.inv(-hessian) @ factor.T
    return 0.5 * (covariance + covariance.T), True


def start_coordinates(log_density: LogDensity, theta: Array) -> Array:
    """Coordinates of a parameter vector with the errors' quantities at likely values.

    Parameters
    ----------
    log_density : LogDensity
        Over ``p + m`` coordinates.
    theta : ndarray, shape (l,)
        Parameters in their units, inside their supports.

    Returns
    -------
    ndarray, shape (p + m,)

    Raises
    ------
    InputError
        If the misfit at ``theta`` cannot be computed.

    References
    ----------
    Verbeek (1993), eq. 3.17.
    """
    theta = np.asarray(theta, dtype=float)
    errors = log_density.errors
    eta = errors.start(residuals_at(log_density.problem, errors, theta))
    return np.concatenate([log_density.unknowns.start(theta), eta])


def laplace_mixture(
    log_density: LogDensity, starts: Array, *, degrees: float = DEGREES_OF_FREEDOM
) -> Mixture:
    """Find the modes next to some parameter vectors and make a mixture of them.

    Parameters
    ----------
    log_density : LogDensity
        Over ``l + s`` coordinates.
    starts : ndarray, shape (K, l)
        Parameter vectors in their units: point estimates from several starts.
    degrees : float
        Degrees of freedom of the components' tails.

    Returns
    -------
    Mixture
        One component for each distinct mode.

    Raises
    ------
    InputError
        If no start can be evaluated.
    """
    modes: list[Mode] = []
    problems: list[InputError] = []
    for theta in np.atleast_2d(np.asarray(starts, dtype=float)):
        try:
            modes.append(find_mode(log_density, start_coordinates(log_density, theta)))
        except InputError as error:
            problems.append(error)
    if not any(np.isfinite(mode.log_weight) for mode in modes):
        raise problems[0] if problems else InputError("no start has a finite log density")
    return mixture_of(modes, degrees=degrees)


def mixture_of(modes: list[Mode], *, degrees: float = DEGREES_OF_FREEDOM) -> Mixture:
    """Mixture of the distinct modes, weighted by their Laplace integrals.

    Parameters
    ----------
    modes : list of Mode
        Those that lie within half a standard deviation of a heavier one are taken for the same;
        those that are lighter by a factor of 3e6 or not finite are dropped.
    degrees : float
        Degrees of freedom of the components' tails.

    Returns
    -------
    Mixture
        Weights are at least 0.05 each before normalisation, because a Laplace integral can be wrong
        and the sampler corrects a weight that is too large but cannot find a mode that is never
        proposed.

    Raises
    ------
    InputError
        If no mode has a finite weight.
    """
    finite = sorted(
        (mode for mode in modes if np.isfinite(mode.log_weight)), key=lambda m: -m.log_weight
    )
    if not finite:
        raise InputError("no mode has a finite log density")
    kept: list[Mode] = []
    for mode in finite:
        known = any(_distance(mode, other) < 0.5 for other in kept)
        if not known and mode.log_weight > finite[0].log_weight - 15.0:
            kept.append(mode)
    log_weights = np.array([mode.log_weight for mode in kept])
    weights = np.exp(log_weights - log_weights.max())
    weights = np.maximum(weights / weights.sum(), 0.05)
    return Mixture(
        np.array([mode.centre for mode in kept]),
        np.array([mode.covariance for mode in kept]),
        np.log(weights / weights.sum()),
        degrees,
    )


def _distance(one: Mode, other: Mode) -> float:
    away = one.centre - other.centre
    return float(np.sqrt(away @ np.linalg.solve(other.covariance, away)))


@dataclass(frozen=True)
class Weighted:
    """Draws of a posterior with weights.

    Parameters
    ----------
    names : tuple of str
        Names of the ``d`` quantities.
    draws : ndarray, shape (M, d)
        In natural units.
    weights : ndarray, shape (M,)
        Smoothed; they sum to one.
    effective_size : float
        Of the draws, ``1 / sum(weights^2)``.
    shape : float
        Of the largest weights' Pareto distribution.
    evaluations : int
        Rows of the log density.
    reached : bool
        Whether the size asked for was reached with a shape below :data:`LARGEST_SHAPE`.
    """

    names: tuple[str, ...]
    draws: Float[Array, "draws quantities"]
    weights: Float[Array, " draws"]
    effective_size: float
    shape: float
    evaluations: int
    reached: bool

    def quantiles(self, probabilities: ArrayLike) -> Array:
        """Quantiles of every quantity, shape (k, d), at probabilities (k,)."""
        wanted = np.asarray(probabilities, dtype=float)
        found = np.empty((wanted.size, len(self.names)))
        for column, values in zip(found.T, self.draws.T, strict=True):
            order = np.argsort(values)
            # A draw's own probability is the middle of its step of the distribution function.
            below = np.cumsum(self.weights[order]) - 0.5 * self.weights[order]
            column[:] = np.interp(wanted, below, values[order])
        return found


def importance_sample(
    log_density: Density,
    start: Mixture,
    *,
    seed: int,
    effective_size: float = 400.0,
    draws: int = 1000,
    rounds: int = 6,
) -> Weighted:
    """Draw from a mixture and weight, adapting the mixture until that is good enough.

    Draws of all rounds are kept and weighted by the mean of all rounds' mixtures, so that no early
    draw in a region that was proposed too rarely then keeps a large weight.

    Parameters
    ----------
    log_density : Density
        Over ``d`` coordinates without bounds.
    start : Mixture
        Laplace approximations at the modes.
    seed : int
    effective_size : float
        At which to stop.
    draws : int
        Of each round.
    rounds : int
        At most.

    Returns
    -------
    Weighted
        With ``reached`` False if the rounds were not enough.

    Raises
    ------
    InputError
        If no draw has a finite log density.

    References
    ----------
    Cornuet, Marin, Mira and Robert (2012), "Adaptive multiple importance sampling", *Scandinavian
    Journal of Statistics* 39, section 2. Vehtari, Simpson, Gelman, Yao and Gabry (2024), "Pareto
    smoothed importance sampling", *Journal of Machine Learning Research* 25.
    """
    rng = np.random.default_rng(seed)
    first = start.defended()
    proposals, phi, height = [first], np.empty((0, first.dimension)), np.empty(0)
    for _ in range(rounds):
        new = proposals[-1].sample(rng, draws)
        phi, height = np.concatenate([phi, new]), np.concatenate([height, log_density(new)[0]])
        weights, shape = _weights(proposals, phi, height)
        size = float(1 / np.sum(weights**2))
        reached = size >= effective_size and shape < LARGEST_SHAPE
        if reached:
            break
        picks = rng.choice(len(phi), size=len(phi), p=weights)
        proposals.append(first.refitted(phi[picks]))
    natural = log_density.natural(phi)
    return Weighted(log_density.names, natural, weights, size, shape, len(phi), reached)


def _weights(proposals: list[Mixture], phi: Array, height: Array) -> tuple[Array, float]:
    """Normalised weights, smoothed, and the shape of their tail."""
    from arviz_stats.base import array_stats

    finite = np.flatnonzero(np.isfinite(height))
    if not finite.size:
        raise InputError(
            "no draw has a finite log density",
            hint="give starts further inside the priors' supports",
        )
    parts = np.stack([proposal.log_density(phi[finite]) for proposal in proposals])
    # It takes the negative of log ratios, as leave-one-out has them.
    smoothed, shape = array_stats.psislw(logsumexp(parts, axis=0) - height[finite])
    weights = np.zeros(len(phi))
    weights[finite] = np.exp(smoothed - logsumexp(smoothed))
    return weights, float(shape)
