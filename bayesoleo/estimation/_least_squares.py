"""Scaled unknowns, batched normal equations, and least-squares steps within the priors' support.

Normal equations are formed for many parameter vectors at once. The estimate of one data set spends
most of its time in the interpreter, not in arithmetic. Where one model is fitted to thousands of
data sets, everything is therefore computed for all of them together, and only ``J'J``, ``J'e`` and
``e'e`` are kept for each output.

Each unknown is scaled, with the slope of its prior and its distance to the bounds of the support.
An unknown with a log-normal prior is stepped in its logarithm, all others as they are. Such an
unknown is a positive scale or shape for which the prior makes halving as likely as doubling: in the
logarithm that prior is normal, no step leaves the support, and a linear step that would cut the
unknown to a tenth has moderate length.

Only the steps use these coordinates. The objectives remain functions of the unknown itself, with
``Prior.log_density`` the density per unit of the unknown, so the maximum-likelihood point and the
mode of ``Phi_B`` do not depend on them. The mode of the density per unit of the logarithm, which is
the mode in a sampler's coordinates, is a different point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.linalg import solve_triangular

from bayesoleo._types import Array, Bool, Flags, Float, Int, Integers
from bayesoleo.error_models._fitting import RANK, inverse_gram, least_squares
from bayesoleo.errors import InputError
from bayesoleo.estimation._problem import EstimationProblem
from bayesoleo.model._correlated_priors import Correlated, log_density_of, scaled_root
from bayesoleo.model._priors import LogNormal, LogUniform, Normal, Prior

# A centred difference over this fraction of the prior's sd is exact for a quadratic log density and
# good to about 1e-8 for the others.
_SLOPE_STEP = 1e-4
# Room for one step of a logarithm, of which at most the part 0.9 is taken: a factor of six. Where
# an unknown sets a scale, as in atan(slope * velocity), the sensitivity to its logarithm changes by
# about the factor of the unknown itself, so further away the linear equations know nothing.
_FARTHEST = 2.0
# A step goes at most this part of the way to a limit, so that a limit is approached, not hit.
_PART = 0.9
# Nearer than this, in prior standard deviations, an unknown counts as lying on the limit.
_ON_LIMIT = 1e-8


@dataclass(frozen=True)
class BatchNormalEquations:
    """What a Gauss-Newton step needs, for ``L`` vectors, ``s`` outputs and ``l`` unknowns.

    Parameters
    ----------
    gram : ndarray, shape (L, s, l, l)
        ``J'J`` with ``J`` the sensitivities of the prediction.
    slope : ndarray, shape (L, s, l)
        ``J'e``.
    sums : ndarray, shape (L, s)
        Sums of squared residuals.
    status : ndarray of int, shape (L,)
        Values of :class:`~bayesoleo.solvers.Status`; where it is not ``CONVERGED`` the
        numbers mean nothing.
    """

    gram: Float[Array, "vectors outputs unknowns unknowns"]
    slope: Float[Array, "vectors outputs unknowns"]
    sums: Float[Array, "vectors outputs"]
    status: Int[Integers, " vectors"]


@runtime_checkable
class BatchProblem(EstimationProblem, Protocol):
    """A problem that can be fitted to many data sets of one shape."""

    @property
    def lanes(self) -> int:
        """Vectors that are best computed together, by the memory that one takes."""

    @property
    def data(self) -> tuple[Array, ...]:
        """Measured samples of each output, shape (n_b,), runs one after the other."""

    def with_data(self, data: Sequence[Array]) -> EstimationProblem:
        """The same problem with other measured samples, shape (n_b,) for each output."""

    def normal_equations(self, theta: Array, data: Sequence[Array]) -> BatchNormalEquations:
        """Equations at vectors (L, l), each compared with its own row of data (L, n_b)."""


def reduce_rows(residual: Array, sensitivity: Array) -> tuple[Array, Array, Array]:
    """``J'J`` (L, l, l), ``J'e`` (L, l) and ``e'e`` (L,) of rows (L, n) and (L, n, l)."""
    turned = np.swapaxes(sensitivity, 1, 2)
    slope = (turned @ residual[..., None])[..., 0]
    return turned @ sensitivity, slope, np.einsum("ln,ln->l", residual, residual)


@dataclass(frozen=True)
class PriorScale:
    """Unknowns, or their logarithms, in units of their priors' standard deviations.

    Physical parameters range over twelve decades in SI units; in these units they are of order one.
    These are the scaled unknowns.

    Parameters
    ----------
    priors : tuple of Prior, length l
        The priors.
    mean, sd, low, high : ndarray, shape (l,)
        Their moments and the limits of their support.
    logarithmic : ndarray of bool, shape (l,)
        Which unknowns are stepped in their logarithm.
    spread : ndarray, shape (l,)
        Standard deviation of what is stepped: of the unknown or of its logarithm.
    root : ndarray, shape (l, l)
        Rows ``P`` with ``P'P`` the prior's precision in scaled unknowns: the identity, but for
        unknowns with a joint prior.
    """

    priors: tuple[Prior, ...]
    mean: Float[Array, " unknowns"]
    sd: Float[Array, " unknowns"]
    low: Float[Array, " unknowns"]
    high: Float[Array, " unknowns"]
    logarithmic: Bool[Flags, " unknowns"]
    spread: Float[Array, " unknowns"]
    root: Float[Array, "unknowns unknowns"]

    @classmethod
    def of(cls, priors: Sequence[Prior], names: Sequence[str]) -> PriorScale:
        """Read the priors once, for asking a distribution for its moments is slow.

        Raises
        ------
        InputError
            If a prior has no finite, positive standard deviation.
        """
        sd = np.array([prior.sd for prior in priors], dtype=float)
        for name, value in zip(names, sd, strict=True):
            if not (np.isfinite(value) and value > 0):
                raise InputError(
                    "prior needs a finite, positive standard deviation",
                    key=name,
                    value=float(value),
                    hint="use Normal(centre, spread) with a wide spread for a weak prior",
                )
        mean = np.array([prior.mean for prior in priors], dtype=float)
        low, high = np.array([prior.support for prior in priors], dtype=float).reshape(-1, 2).T
        logarithmic = np.array([isinstance(prior, LogNormal) for prior in priors], dtype=bool)
        spread = sd.copy()
        for index, prior in enumerate(priors):
            if isinstance(prior, LogNormal):
                spread[index] = prior.log_spread
        root = scaled_root(priors, sd)
        return cls(tuple(priors), mean, sd, low, high, logarithmic, spread, root)

    def inside(self, theta: Array) -> Flags:
        """Which unknowns lie in their prior's support; zero has no logarithm. Shape (..., l)."""
        return (theta >= self.low) & (theta <= self.high) & ~(self.logarithmic & (theta <= 0))

    def unit(self, theta: Array) -> Array:
        """Derivative of each unknown with respect to its scaled one, shape (..., l)."""
        return np.where(self.logarithmic, theta * self.spread, self.spread)

    def moved(self, theta: Array, step: Array) -> Array:
        """Unknowns, shape (..., l), after a step of the scaled ones, shape (..., l)."""
        with np.errstate(over="ignore"):  # the loop refuses what is not finite
            factor = np.exp(np.where(self.logarithmic, self.spread * step, 0.0))
        return np.where(self.logarithmic, theta * factor, theta + self.spread * step)

    def room(self, theta: Array) -> tuple[Array, Array]:
        """Scaled distances down and up to how far one step may go, each shape (..., l).

        To the limits of the support; for a logarithm as far as linear equations are worth anything.
        """
        farthest = _FARTHEST / self.spread
        down, up = (theta - self.low) / self.sd, (self.high - theta) / self.sd
        return np.where(self.logarithmic, farthest, down), np.where(self.logarithmic, farthest, up)

    def log_density(self, theta: Array) -> Array:
        """Log prior of vectors, shape (L, l), per unit of the unknowns, shape (L,)."""
        return log_density_of(self.priors, theta)

    def slope(self, theta: Array) -> Array:
        """Derivative of the log prior with respect to the scaled unknowns, shape (..., l)."""
        away = (theta - self.mean) / self.sd
        slope = -away @ (self.root.T @ self.root)
        for index, prior in enumerate(self.priors):
            if not isinstance(prior, Normal | Correlated):
                slope[..., index] = self._slope(index, theta[..., index])
        return slope

    def quadratic(
        self, theta: Float[Array, " unknowns"]
    ) -> tuple[Float[Array, " unknowns"], Float[Array, "unknowns unknowns"]]:
        """Slope (l,) and precision (l, l) of the log prior about one vector, for steps of the
        unknowns themselves in units of their priors' standard deviations.

        A prior of a logarithm is the closer, the smaller the value. One that is flat in the
        logarithm is as the normal one with its moments: its own slope is no part of a parabola.
        Next to nothing is known of the curvature within bounds; the width says as much.
        """
        slope, unit = self.slope(theta), self.unit(theta)
        for index, prior in enumerate(self.priors):
            if isinstance(prior, LogUniform) and theta[index] > 0:
                low, high = np.log([prior.low, prior.high])
                spread = float(high - low) / np.sqrt(12.0)
                slope[index] = (0.5 * float(low + high) - np.log(theta[index])) / spread
                unit[index] = theta[index] * spread
        turn = self.sd / unit
        return slope * turn, turn[:, None] * (self.root.T @ self.root) * turn

    def _slope(self, index: int, value: Array) -> Array:
        prior, sd = self.priors[index], self.sd[index]
        if isinstance(prior, LogNormal):  # the density is per unit of the value, hence the second
            spread = prior.log_spread
            return -np.log(value / prior.median) / spread - spread
        room = np.minimum(value - self.low[index], self.high[index] - value)
        step = np.minimum(_SLOPE_STEP * sd, room / 2)
        # on the limit itself a one-sided look is all there is, and it is not needed
        with np.errstate(divide="ignore", invalid="ignore"):
            rise = prior.log_density(value + step) - prior.log_density(value - step)
            return np.where(step > 0, rise * sd / (2 * step), 0.0)


def bounded_step(
    rows: Array, target: Array, room: tuple[Array, Array], rank: float | None = None
) -> Array:
    """Solve ``rows @ d = target`` by least squares with ``d`` inside the room that is left.

    Unknowns whose step would leave are taken part of the way to their limit and the others are
    solved again given that, so that the step still points downhill.

    Parameters
    ----------
    rows : ndarray, shape (k, l)
    target : ndarray, shape (k,)
    room : tuple of ndarray, each shape (l,)
        Distances down and up to the limits, infinite where there is none.
    rank : float, optional
        See :func:`~bayesoleo.error_models._fitting.least_squares`.

    Returns
    -------
    ndarray, shape (l,)
    """
    lowest, highest = (-_reach(room[0]), _reach(room[1]))
    step = least_squares(rows, target, rank)
    stopped = np.zeros(step.size, dtype=bool)
    while True:
        beyond = ~stopped & ((step < lowest) | (step > highest))
        if not beyond.any():
            return step
        stopped |= beyond
        step[beyond] = np.clip(step[beyond], lowest[beyond], highest[beyond])
        free = ~stopped
        if free.any():
            left = target - rows[:, stopped] @ step[stopped]
            step[free] = least_squares(rows[:, free], left, rank)


def _reach(distance: Array) -> Array:
    return np.where(distance <= _ON_LIMIT, 0.0, _PART * distance)


def is_cut(step: Array, room: tuple[Array, Array]) -> bool:
    """Whether an unknown was stopped on its way to a limit that it does not lie on yet."""
    reach = _reach(np.where(step < 0, *room))
    return bool(np.any((reach > 0) & np.isfinite(reach) & (np.abs(step) >= reach)))


def on_limit(room: tuple[Array, Array]) -> Flags:
    """Which unknowns, shape (l,), lie on a limit of their support."""
    return np.minimum(*room) <= _ON_LIMIT


@dataclass(frozen=True)
class WhitenedEquations:
    """Whitened least squares in scaled unknowns (the prior's standard deviation is one).

    Of an unknown with a log-normal prior it is the logarithm that is scaled.

    Parameters
    ----------
    jacobian : ndarray, shape (k, l)
        Rows ``J`` with ``A = J'J``.
    residual : ndarray, shape (k,)
        Rows ``e`` with ``b = -J'e``.
    slope : ndarray, shape (l,)
        Derivative of the log prior where the prior is fixed at its centre, zero otherwise.
    room : tuple of ndarray, each shape (l,)
        Distances to the limits of the support, or to how far a logarithm may go in one step.
    root : ndarray, shape (l, l) or (0, l)
        Rows ``P`` with ``P'P`` the prior's precision; upper triangular. Newton's method has none:
        its matrix contains the prior.
    place : ndarray, shape (l,)
        Scaled unknowns where this is, by which a first step is judged.
    noise : float
        Standard deviation by which rows were whitened, the outputs' geometric mean.
    """

    jacobian: Float[Array, "rows unknowns"]
    residual: Float[Array, " rows"]
    slope: Float[Array, " unknowns"]
    room: tuple[Float[Array, " unknowns"], Float[Array, " unknowns"]]
    root: Float[Array, "_rows unknowns"]
    place: Float[Array, " unknowns"]
    noise: float = 1.0

    @property
    def gradient(self) -> Array:
        """Slope of the merit function, shape (l,)."""
        return self.jacobian.T @ self.residual + self.slope

    @property
    def held(self) -> Flags:
        """Which unknowns lie on a limit and would leave, shape (l,)."""
        down, up = self.room
        return on_limit(
            (np.where(self.gradient < 0, down, np.inf), np.where(self.gradient > 0, up, np.inf))
        )

    def solve(self, rows: Array, damping: Array | None = None) -> Array:
        """Step, shape (l,), with the weight ``rows' rows`` added to ``A``, and rows ``(l, l)`` of
        damping, which pull nowhere."""
        target, stacked = np.concatenate((self.residual, self.pull(rows))), [self.jacobian, rows]
        if damping is not None:
            target = np.append(target, np.zeros(len(damping)))
            stacked.append(damping)
        # without a weight, what the data leave open must not follow the derivatives' rounding
        rank = None if len(rows) else RANK
        return bounded_step(np.vstack(stacked), target, self.room, rank)

    def pull(self, rows: Array) -> Array:
        """Right-hand side of a prior's rows: only the fixed prior pulls, and it does so along its
        own rows, ``P'r`` is its slope."""
        if len(rows) != len(self.slope) or not self.slope.any():
            return np.zeros(len(rows))
        return np.asarray(solve_triangular(rows, self.slope, trans="T"))

    def expected_gain(self, step: Array) -> float:
        """Rise of the merit function that the linearisation promises for a step, shape (l,)."""
        change = self.jacobian @ step
        return float(step @ self.gradient - 0.5 * (change @ change))

    def distance(self) -> float:
        """Newton decrement: the way to the fixed point in linearised standard deviations."""
        step = self.solve(self.root)
        return float(np.sqrt(max(0.0, float(step @ self.gradient))))

    def sd(self) -> Array:
        """LinearisedResidual standard deviations ``[A + P'P]^-1/2``, shape (l,)."""
        weighted = np.vstack((self.jacobian, self.root))
        return np.sqrt(np.diag(inverse_gram(weighted)))
