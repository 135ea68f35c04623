"""Search for modes of a density beyond those from which its sampler would start.

If all walkers start in one mode, they do not find another: ensembles agree, and every quantity has
its effective sample size. Points scattered widely about the start are therefore moved uphill first,
with differences of the density alone and as one batch. A mode found in this way that holds a share
of the density becomes a component of the mixture from which walkers start and which proposes jumps.

No finite number of searches proves that there is no other mode. A mode is missed if no search
starts in its basin.

References
----------
Nocedal and Wright (2006), *Numerical Optimization*, 2nd ed., section 6.1 (BFGS). Gelman and Rubin
(1992), "Inference from iterative simulation using multiple sequences", *Statistical Science* 7,
section 2.1 (modes are searched for before chains start).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from bayesoleo._types import Array, Integers
from bayesoleo.error_models._fitting import derivatives
from bayesoleo.posterior._laplace import Mode
from bayesoleo.posterior._log_density import Density
from bayesoleo.posterior._mixture import Mixture
from bayesoleo.solvers._orbit import Status

Height = Callable[[Array], Array]

#: Scattered points for each climb, and how far they lie, in standard deviations of the start.
POINTS, NEAREST, FARTHEST = 12, 3.0, 3000.0
#: The same of a density that has a prior: so many about the start, so far, and so many from it.
POINTS_BESIDE, WITHIN_PRIOR = 2, 100.0
#: Standard deviations beyond which no climb begins: differences would not be seen there.
BEYOND = 1e8
#: By how much the logarithms of errors are enlarged at draws of a prior: far off, errors are large.
LARGER_ERRORS = (0.0, 3.0, 6.0, 10.0)
#: Part of the rows that may be taken before modes are made of what climbs have found.
CLIMBING = 0.6
#: Iterations of a climb, its differences, and the lengths tried of a step.
ITERATIONS, DIFFERENCE = 25, 0.02
LENGTHS = np.array([1.0, 3.0, 10.0, 30.0, 0.5, 0.25, 0.1, 0.03, 0.01, 1e-3])
#: Longest direction of a climb, in standard deviations; lengths multiply it.
LONGEST = 10.0
#: After so many iterations a climb is given up if so many times its gain would not lift it enough.
EARLIEST, PATIENCE = 3, 2.0
#: A climb that gains less, over so short a step, has arrived.
GAIN, SHORT = 0.02, 0.3
#: Points nearer than this to a mode, in its standard deviations, belong to it.
NEAR = 3.0
#: Logarithm of a weight, over that of all known modes, below which a mode does not matter.
LIGHT = -15.0
#: How far below the known modes a climb may end and still be worth a Hessian.
LOW = -40.0
#: Climbs that are made modes of, at most; Newton steps of each, and when they end.
MOST_MODES, NEWTON_STEPS, NEWTON_END = 8, 12, 0.05
#: Places between two modes where the density is looked for a dip, and how deep that is.
PLACES, DIP = 15, 0.5
#: Least and largest share of the proposals for the modes that were found.
LEAST_SHARE, LARGEST_SHARE = 0.05, 0.95


@dataclass(eq=False)
class _Counted:
    """Heights in whitened coordinates, how many rows they took, and how many they may take."""

    log_density: Density
    centre: Array
    factor: Array
    most: float
    rows: int = field(default=0)

    def afford(self, rows: int) -> bool:
        """Whether so many more rows may be evaluated."""
        return self.rows + rows <= self.most

    def __call__(self, y: Array) -> Array:
        self.rows += len(y)
        return np.asarray(self.log_density(self.phi(y))[0])

    def phi(self, y: Array) -> Array:
        return self.centre + y @ self.factor.T

    def whitened(self, phi: Array) -> Array:
        return np.asarray(np.linalg.solve(self.factor, (phi - self.centre).T).T)


def with_other_modes(
    log_density: Density,
    start: Mixture,
    climbs: int,
    rng: np.random.Generator,
    most: float = np.inf,
) -> tuple[Mixture, int]:
    """Search for modes beside those of a mixture, and add them to it.

    Parameters
    ----------
    log_density : Density
        Over ``d`` coordinates. Where it has a method ``dispersed(rng, count)``, that gives draws of
        the prior of the first of them to climb from.
    start : Mixture
        What is known.
    climbs : int
        Points from which to climb.
    rng : numpy.random.Generator
        Scatters them.
    most : float
        Rows of the log density that it may take. Climbs end where the next step would take more,
        and what is not known to be a mode by then is left out.

    Returns
    -------
    mixture : Mixture
        The same object if nothing was found.
    evaluations : int
        Rows of the log density that it took.
    """
    # Points where the density overflows are left out.
    with np.errstate(over="ignore", invalid="ignore"):
        return _search(log_density, start, climbs, rng, most)


def _search(
    log_density: Density, start: Mixture, climbs: int, rng: np.random.Generator, most: float
) -> tuple[Mixture, int]:
    heaviest = int(np.argmax(start.log_weights))
    factor = np.linalg.cholesky(start.covariances[heaviest])
    height = _Counted(log_density, start.centres[heaviest], factor, most)
    y, values = _scattered(height, start, climbs, rng)
    known = [_component(height, start, k) for k in range(len(start.centres))]
    if y.size == 0 or not any(np.isfinite(mode.log_weight) for mode in known):
        return start, height.rows
    tops = height(height.whitened(start.centres))
    places = [height.whitened(mode.centre) for mode in known]
    height.most = CLIMBING * most  # the rest is for what is found
    y, values = _climb(height, y, values, places, float(tops.max()))
    height.most = most
    found: list[Mode] = []
    for place in np.argsort(-values):
        if values[place] < np.max(tops) + LOW or len(found) >= MOST_MODES:
            break
        if _is_known(height, y[place], values[place], [*known, *found]):
            continue
        mode = _polished(height, y[place])
        if mode is not None and not _close(mode.centre, [*known, *found]):
            found.append(mode)
    return _joined(start, known, found), height.rows


# -- where to climb from -------------------------------------------------------------------------


def _scattered(
    height: _Counted, start: Mixture, climbs: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Points of finite density at all distances from the start: at each the highest, and others."""
    d, prior = start.dimension, getattr(_inner(height.log_density), "dispersed", None)
    farthest = FARTHEST if prior is None else WITHIN_PRIOR
    count = climbs * (POINTS if prior is None else POINTS_BESIDE)
    directions = rng.standard_normal((count, d))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    radii = np.exp(np.linspace(np.log(NEAREST), np.log(farthest), count))
    around = np.concatenate([directions * radii[:, None], _mirrored(height)])
    y, values = around, height(around)
    if prior is not None:
        far, tops = _from_prior(height, prior(rng, climbs * POINTS_BESIDE))
        y, values = np.concatenate([y, far]), np.concatenate([values, tops])
    usable = np.isfinite(values) & (np.abs(y).max(axis=1) < BEYOND)
    y, values = y[usable], values[usable]
    chosen = _spread(np.linalg.norm(y, axis=1), values, climbs, rng)
    return y[chosen], values[chosen]


def _inner(log_density: Density) -> Density:
    """The density itself, where its rows are evaluated elsewhere."""
    return getattr(log_density, "log_density", log_density)


def _from_prior(height: _Counted, block: Array) -> tuple[Array, Array]:
    """Draws of a prior of the first coordinates, the rest at the best of a few sizes of errors."""
    rows = []
    for larger in LARGER_ERRORS:
        phi = np.tile(height.centre, (len(block), 1))
        phi[:, : block.shape[1]] = block
        phi[:, block.shape[1] :] += larger
        rows.append(height.whitened(phi))
    y = np.stack(rows)
    values = height(y.reshape(-1, y.shape[2])).reshape(y.shape[:2])
    best = np.argmax(values, axis=0)
    lanes = np.arange(len(block))
    return y[best, lanes], values[best, lanes]


def _spread(distance: Array, values: Array, climbs: int, rng: np.random.Generator) -> Integers:
    """Indices of points to climb from: by distance in bands, of each the highest and another.

    The highest of all would be those next to the start.
    """
    if len(values) <= climbs:
        return np.arange(len(values))
    bands = np.array_split(np.argsort(distance, kind="stable"), max(climbs // 2, 1))
    best = np.array([band[np.argmax(values[band])] for band in bands])
    others = rng.permutation(np.setdiff1d(np.arange(len(values)), best))
    return np.concatenate([best, others[: climbs - best.size]])


def _mirrored(height: _Counted) -> Array:
    """The start with the sign of one coordinate changed, or of all: many models allow that."""
    centre = height.centre
    signs = np.concatenate([1.0 - 2.0 * np.eye(centre.size), -np.ones((1, centre.size))])
    return height.whitened(signs * centre)


# -- climbing ------------------------------------------------------------------------------------


def _climb(
    height: _Counted, y: Array, values: Array, known: list[Array], top: float
) -> tuple[Array, Array]:
    """Climb from all points together by BFGS.

    Those that come to a known mode are given up, and those that in what is left of the iterations
    would not get to a height that matters.
    """
    count, d = y.shape
    y, values = y.copy(), values.copy()
    inverse = np.repeat(np.eye(d)[None], count, axis=0)
    slopes, going = _slopes(height, y, values), np.arange(count)
    for iteration in range(ITERATIONS):
        if going.size == 0 or not height.afford(going.size * (LENGTHS.size + d)):
            break
        direction = np.einsum("kij,kj->ki", inverse[going], slopes[going])
        length = np.linalg.norm(direction, axis=1, keepdims=True)
        direction *= np.minimum(1.0, LONGEST / np.maximum(length, 1e-300))
        trials = y[going, None] + LENGTHS[:, None] * direction[:, None]
        heights = height(trials.reshape(-1, d)).reshape(going.size, -1)
        best = np.argmax(np.nan_to_num(heights, nan=-np.inf), axis=1)
        rows = np.arange(going.size)
        gain, step = heights[rows, best] - values[going], trials[rows, best] - y[going]
        rises = gain > 0.0
        going, step, gain = going[rises], step[rises], gain[rises]
        y[going] += step
        values[going] += gain
        after = _slopes(height, y[going], values[going])
        for k, lane in enumerate(going):
            inverse[lane] = _updated(inverse[lane], step[k], slopes[lane] - after[k])
        slopes[going] = after
        arrived = (gain < GAIN) & (np.linalg.norm(step, axis=1) < SHORT)
        left = PATIENCE * gain * (ITERATIONS - iteration)
        hopeless = (iteration >= EARLIEST) & (values[going] + left < top + LOW)
        going = _apart(y, going[~arrived & ~hopeless], known)
    return y, values


def _slopes(height: Height, y: Array, values: Array) -> Array:
    """Gradients by forward differences, shape of ``y``; away from where nothing is defined."""
    count, d = y.shape
    if count == 0:
        return np.zeros((0, d))
    ahead = height((y[:, None] + DIFFERENCE * np.eye(d)).reshape(-1, d)).reshape(count, d)
    with np.errstate(invalid="ignore"):
        slopes = (ahead - values[:, None]) / DIFFERENCE
    return np.where(np.isfinite(slopes), slopes, -1.0)


def _updated(inverse: Array, step: Array, change: Array) -> Array:
    """BFGS's inverse Hessian of the negative height after a step."""
    product = float(step @ change)
    if product <= 1e-10 * np.linalg.norm(step) * np.linalg.norm(change):
        return inverse
    left = np.eye(step.size) - np.outer(step, change) / product
    return np.asarray(left @ inverse @ left.T + np.outer(step, step) / product)


def _apart(y: Array, going: Integers, known: list[Array]) -> Integers:
    """Climbs that are neither at a known mode nor beside an earlier one."""
    kept: list[int] = []
    for lane in going:
        places = [*known, *(y[other] for other in kept)]
        if all(np.linalg.norm(y[lane] - place) > SHORT for place in places):
            kept.append(int(lane))
    return np.array(kept, dtype=np.int64)


# -- modes ---------------------------------------------------------------------------------------


def _component(height: _Counted, start: Mixture, k: int) -> Mode:
    """A component of the start with its Laplace integral."""
    centre, covariance = start.centres[k], start.covariances[k]
    top = float(height(height.whitened(centre[None]))[0])
    return Mode(centre, covariance, top + _log_volume(covariance), Status.CONVERGED)


def _log_volume(covariance: Array) -> float:
    sign, log_det = np.linalg.slogdet(covariance)
    return float(0.5 * log_det + 0.5 * len(covariance) * np.log(2 * np.pi)) if sign > 0 else -np.inf


def _close(centre: Array, modes: list[Mode]) -> bool:
    """Whether a point belongs to one of the modes."""
    for mode in modes:
        away = centre - mode.centre
        if away @ np.linalg.solve(mode.covariance, away) < NEAR**2:
            return True
    return False


def _is_known(height: _Counted, y: Array, value: float, modes: list[Mode]) -> bool:
    """Whether a point lies at a mode, or no dip lies between them."""
    if _close(height.phi(y[None])[0], modes):
        return True
    part = (np.arange(1, PLACES + 1) / (PLACES + 1))[:, None]
    for mode in modes:
        other = height.whitened(mode.centre[None])[0]
        between = height(np.concatenate([other[None], y + part * (other - y)]))
        if between[1:].min() > min(value, between[0]) - DIP:
            return True
    return False


def _polished(height: _Counted, y: Array) -> Mode | None:
    """The mode next to a point by Newton's method; None where there is none."""
    d = y.size
    factor, size = np.eye(d), np.inf
    for _ in range(NEWTON_STEPS):
        if not height.afford(1 + d + d * d):
            return None
        top, gradient, hessian = derivatives(height, y, factor)
        if not (np.isfinite(top) and np.isfinite(gradient).all() and np.isfinite(hessian).all()):
            return None
        values, vectors = np.linalg.eigh(-hessian)
        # A differently shaped mode is looked at in its own units, and in smaller ones until it is
        # seen to be one.
        scale = np.where(values > 0.0, 1.0 / np.sqrt(np.maximum(values, 1e-12)), 0.3)
        scale = np.clip(scale, 0.03, 30.0)
        newton = vectors @ (scale**2 * (vectors.T @ gradient))
        size = float(np.linalg.norm((vectors.T @ newton) / scale))
        if values.min() > 0.0 and size < NEWTON_END and np.all(np.abs(np.log(scale)) < 1.0):
            local = factor @ (vectors / values) @ vectors.T @ factor.T
            covariance = height.factor @ (0.5 * (local + local.T)) @ height.factor.T
            weight = top + _log_volume(covariance)
            return Mode(height.phi(y[None])[0], covariance, weight, Status.CONVERGED)
        trials = y + LENGTHS[[0, 4, 5, 6, 7]][:, None] * (factor @ newton)
        heights = height(trials)
        best = int(np.argmax(np.nan_to_num(heights, nan=-np.inf)))
        y = trials[best] if heights[best] > top else y
        factor = factor @ (vectors * scale)
    return None


def _joined(start: Mixture, known: list[Mode], found: list[Mode]) -> Mixture:
    """Mixture including the modes found, weighted by their Laplace integrals."""
    before = np.logaddexp.reduce([mode.log_weight for mode in known])
    heavy = [mode for mode in found if mode.log_weight > before + LIGHT]
    if not heavy:
        return start
    weights = np.array([mode.log_weight for mode in heavy])
    total = np.logaddexp.reduce(weights)
    share = np.clip(np.exp(total - np.logaddexp(total, before)), LEAST_SHARE, LARGEST_SHARE)
    own = np.maximum(np.exp(weights - total), LEAST_SHARE)
    degrees = np.asarray(start.degrees)
    return Mixture(
        np.concatenate([start.centres, [mode.centre for mode in heavy]]),
        np.concatenate([start.covariances, [mode.covariance for mode in heavy]]),
        np.log(np.concatenate([(1.0 - share) * start.weights, share * own / own.sum()])),
        np.concatenate([degrees, np.full(len(heavy), degrees[0])]),
    )
