r"""Gradient of a log density over coordinates without bounds, by the problem's sensitivities.

A run's errors are normal with a covariance :math:`V(\eta)` that the parameters do not change, and
the residual's derivatives are the sensitivities with the other sign. So

.. math:: \frac{\partial \ln p}{\partial \theta} = J' V^{-1} e ,

from one solution with its sensitivities, and without an error of differences. Where runs share
errors, or an error model is a mixture, the density of residuals that are moved along each column of
:math:`J` is differenced instead. That takes no solution of the model either, and is exact but for
rounding where the density is normal. The same holds for the quantities :math:`\eta` of the error
model, and for the priors.

A sampler by Hamiltonian dynamics draws from the density itself even if its gradient were rough: its
steps need the same vector at the same place, and are accepted by the density.

References
----------
Verbeek (1993), eqs. 2.29 and 3.19. Neal (2011), "MCMC using Hamiltonian dynamics", *Handbook of
Markov Chain Monte Carlo*, section 5.5 (trajectories by approximations).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np

from bayesoleo._types import Array, Float
from bayesoleo.errors import InputError
from bayesoleo.estimation._problem import Evaluation, anchored_evaluation
from bayesoleo.posterior._log_density import LANES, Density, LogDensity
from bayesoleo.solvers._orbit import Status

#: Step of central differences of priors and of quantities of the error model, in standard
#: deviations of the posterior, and of residuals along a sensitivity, in those of the unknown.
STEP = 1e-4
RESIDUAL_STEP = 1e-3


@runtime_checkable
class Differentiable(Protocol):
    """A density that gives its gradient."""

    def with_gradient(
        self, phi: Float[Array, " quantities"]
    ) -> tuple[float, Float[Array, " quantities"]]:
        """Log density and its gradient at one point, from several threads at once."""


class Gradient:
    """Log density of one point and its gradient.

    Parameters
    ----------
    density : LogDensity
        Over ``d`` coordinates.
    scale : ndarray, shape (d,)
        Rough standard deviation of each coordinate: a unit for differences.

    Attributes
    ----------
    failures : collections.Counter
        Points of density zero so far, by the lower-case name of their status.

    Raises
    ------
    InputError
        If the problem has no derivatives.
    """

    def __init__(self, density: LogDensity, scale: Float[Array, " quantities"]) -> None:
        if not getattr(density.problem, "has_derivatives", True):
            raise InputError(
                "the no-U-turn sampler needs derivatives, and this function gives none",
                key="sampler",
                value="nuts",
                hint='use sampler="ensemble", or a FunctionProblem with "jacobian"',
            )
        self.density, self.scale = density, np.asarray(scale, dtype=float)
        self.failures: Counter[str] = Counter()

    def __call__(
        self, phi: Float[Array, " quantities"]
    ) -> tuple[float, Float[Array, " quantities"]]:
        """Log density and gradient, shape (d,); minus infinity and zeros where there is none."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            value, gradient, status = self._evaluate(np.asarray(phi, dtype=float))
        if status.ok and not (np.isfinite(value) and np.isfinite(gradient).all()):
            status = Status.NOT_FINITE
        if not status.ok:
            self.failures[status.name.lower()] += 1
            return -np.inf, np.zeros_like(gradient)
        return value, gradient

    def _evaluate(self, phi: Array) -> tuple[float, Array, Status]:
        value, gradient = self._prior(phi)
        if not np.isfinite(value):
            return value, gradient, Status.OUT_OF_BOUNDS
        density = self.density
        unknowns, errors = density.unknowns, density.errors
        block, eta = (part[0] for part in density.split(phi[None]))
        theta = unknowns.theta(block[None])
        found = anchored_evaluation(density.problem, errors.moved(theta)[0])
        if not found.status.ok:
            return value, gradient, found.status
        residuals, columns = _by_run(found, np.asarray(density.problem.counts))
        likelihood, slope, of_errors = self._likelihood(residuals, columns, eta)
        gradient[: len(block)] += (slope @ errors.slope(theta[0])) @ unknowns.jacobian(block)
        gradient[len(block) :] += of_errors
        return value + likelihood, gradient, Status.CONVERGED

    def _prior(self, phi: Array) -> tuple[float, Array]:
        """Log prior and its slopes."""
        shifts = np.diag(STEP * self.scale)
        rows = np.concatenate([phi[None], phi + shifts, phi - shifts])
        values, size = self.density.log_prior(rows), len(phi)
        # The steps that floating point took.
        taken = np.diagonal(rows[1 : 1 + size] - rows[1 + size :])
        return float(values[0]), (values[1 : 1 + size] - values[1 + size :]) / taken

    def _likelihood(
        self, residuals: Sequence[Sequence[Array]], columns: Sequence[Sequence[Array]], eta: Array
    ) -> tuple[float, Array, Array]:
        """Log-likelihood, and its slopes by the problem's unknowns and by the errors' coordinates.

        ``residuals`` holds (n,) by run and output, ``columns`` sensitivities (l, n).
        """
        errors, count = self.density.errors, len(eta)
        step = STEP * self.scale[len(self.scale) - count :]
        etas = np.concatenate([eta[None], eta + np.diag(step), eta - np.diag(step)])
        if not errors.over_runs:
            heights = self._heights(residuals, etas)
            rows = [
                [np.vstack([c, e]) for c, e in zip(own, left, strict=True)]
                for own, left in zip(columns, residuals, strict=True)
            ]
            slope = errors.products_of_all(rows, eta)[-1, :-1]
        else:
            unit = RESIDUAL_STEP * self._sds(columns, eta)
            # Columns that change nothing are not moved along.
            along = [[c * unit[:, None] for c in own] for own in columns]
            moves = np.repeat(eta[None], 2 * unit.size, axis=0)
            heights = self._heights(residuals, np.concatenate([etas, moves]), along)
            heights, moved = heights[: len(etas)], heights[len(etas) :]
            change = (moved[: unit.size] - moved[unit.size :]) / 2
            slope = np.divide(change, unit, out=np.zeros_like(unit), where=unit > 0)
        ahead, behind = heights[1 : 1 + count], heights[1 + count :]
        return float(heights[0]), slope, (ahead - behind) / (2 * step)

    def _sds(self, columns: Sequence[Sequence[Array]], eta: Array) -> Array:
        """Rough standard deviations of the unknowns given the errors' variances, shape (l,)."""
        precision = np.exp(-eta[: len(self.density.problem.outputs)])
        squares = sum(
            np.sum(c * c, axis=1) * weight
            for own in columns
            for c, weight in zip(own, precision, strict=True)
        )
        known = np.asarray(squares) > 0
        return np.where(known, 1 / np.sqrt(np.where(known, squares, 1.0)), 0.0)

    def _heights(
        self,
        residuals: Sequence[Sequence[Array]],
        etas: Array,
        along: Sequence[Sequence[Array]] | None = None,
    ) -> Array:
        """Log-likelihoods at coordinates of the errors (W, m), shape (W,).

        The last rows have residuals that are moved: by each of ``along``, then by its opposite.
        """
        errors = self.density.errors
        if errors.by_sums:
            sums = np.array([[e @ e for e in outputs] for outputs in residuals])
            return errors.of_sums(np.repeat(sums[None], len(etas), axis=0), etas).sum(axis=1)
        found = np.empty(len(etas))
        still = [np.stack(outputs) for outputs in residuals]
        moves = [] if along is None else [np.stack(outputs, axis=1) for outputs in along]
        number = len(moves[0]) if moves else 0
        first = len(etas) - 2 * number
        for k in range(0, len(etas), LANES):
            rows = np.arange(k, min(k + LANES, len(etas)))
            parts = [np.repeat(e[None], len(rows), axis=0) for e in still]
            for part, move in zip(parts, moves, strict=False):
                for lane, row in enumerate(rows - first):
                    if row >= 0:
                        # A larger unknown makes the prediction larger and the residual smaller.
                        part[lane] -= move[row] if row < number else -move[row - number]
            found[rows] = errors.of_runs(parts, etas[rows]).sum(axis=1)
        return found


def _by_run(evaluation: Evaluation, counts: Array) -> tuple[list[list[Array]], list[list[Array]]]:
    """Residuals (n,) and sensitivities (l, n) by run and output."""
    ends = np.cumsum(counts, axis=0)
    residuals, columns = [], []
    for first, last in zip(ends - counts, ends, strict=True):
        cuts = [slice(a, b) for a, b in zip(first, last, strict=True)]
        residuals.append([e[c] for e, c in zip(evaluation.residual, cuts, strict=True)])
        columns.append(
            [
                np.ascontiguousarray(j[c].T)
                for j, c in zip(evaluation.sensitivity, cuts, strict=True)
            ]
        )
    return residuals, columns


def gradient_of(density: Density, scale: Array) -> Gradient | Differentiable:
    """What gives the gradient of a density, for one thread.

    Raises
    ------
    InputError
        If it has none.
    """
    if isinstance(density, Differentiable):
        return density
    if not isinstance(density, LogDensity):
        raise InputError(
            "the no-U-turn sampler needs the gradient of the density",
            key="sampler",
            value="nuts",
            hint='use sampler="ensemble", or give the density a method with_gradient(phi)',
        )
    return Gradient(density.for_thread(), scale)
