r"""Periodic model discrepancy of which runs share a part.

.. math::

    e_r(t) = \epsilon(t) + \delta(\phi) + \delta_r(\phi), \qquad
    \operatorname{cov}(\delta(\phi), \delta(\phi')) = v \rho \kappa\, k_\ell(\phi - \phi'),

    \operatorname{cov}(\delta_r(\phi), \delta_r(\phi'))
    = v \rho (1 - \kappa)\, k_\ell(\phi - \phi').

An effect that the model lacks in all runs acts alike wherever they pass through the same part of
the motion. If each run had an independent discrepancy
(:class:`~bayesoleo.error_models.DiscrepancyErrors`), more runs would average it out, and intervals
would shrink about a biased value. Here :math:`\kappa` is the shared fraction; at zero each run has
its own discrepancy. Phases count from the crest of a run's input.

Runs are then not independent. The common curve has few coefficients, so each run adds a term to
one small system. The log-likelihood of a run is conditional on the runs before it; their sum is the
joint log-likelihood.

References
----------
Kennedy and O'Hagan (2001), "Bayesian calibration of computer models", *Journal of the Royal
Statistical Society* B 63, section 4. Rasmussen and Williams (2006), *Gaussian Processes for Machine
Learning*, eqs. A.9-A.10 (the lemma): once for each run's own curve and once for the common one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from bayesoleo import _schema as schema
from bayesoleo._compiled import jit
from bayesoleo._types import Array, Integers
from bayesoleo.error_models._base import Frame, Quantity, RunSamples
from bayesoleo.error_models._discrepancy import (
    DiscrepancyErrors,
    factorise,
    project,
    spectrum,
    without_products,
)

SQRT_2 = math.sqrt(2.0)
_LOG_2_PI = float(np.log(2 * np.pi))
# Least share of a run's own discrepancy, for rounding.
_LEAST_OWN = 1e-9


@jit
def _answer(factor: Array, right: Array, out: Array) -> float:
    """Solve ``L L' out = right``; returns the squared norm after the forward sweep."""
    size, total = right.size, 0.0
    for i in range(size):
        value = right[i]
        for k in range(i):
            value -= factor[i, k] * out[k]
        out[i] = value / factor[i, i]
        total += out[i] * out[i]
    for i in range(size - 1, -1, -1):
        value = out[i]
        for k in range(i + 1, size):
            value -= factor[k, i] * out[k]
        out[i] = value / factor[i, i]
    return total


@jit
def _add_inverse(factor: Array, scale: float, inverse: Array, total: Array) -> None:
    """Subtract ``scale (L L')^-1`` from the lower half of ``total``; ``inverse`` is work space."""
    size = factor.shape[0]
    for j in range(size):
        inverse[j, j] = 1.0 / factor[j, j]
        for i in range(j + 1, size):
            value = 0.0
            for k in range(j, i):
                value -= factor[i, k] * inverse[j, k]  # kept transposed: rows lie together
            inverse[j, i] = value / factor[i, i]
    for i in range(size):
        for j in range(i + 1):
            value = 0.0
            for k in range(i, size):
                value += inverse[i, k] * inverse[j, k]
            total[i, j] -= scale * value


@jit
def _dense(
    projected: Array, squares: Array, counts: Integers, grams: Array, weight: Array, eta: Array,
    out: Array,
) -> None:  # fmt: skip
    """Log-likelihood of runs given those before, ``out (L, N)``; projected ``(N, L, R)``."""
    runs, lanes, size = projected.shape
    factor, inverse, joint = np.empty((size, size)), np.empty((size, size)), np.empty((size, size))
    root, right, answer, common = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    ones = np.ones(size)
    for lane in range(lanes):
        share, noise, own, ratio = _parts(eta[lane])
        joint[:], common[:], before = 0.0, 0.0, 0.0
        level = math.exp(-eta[lane, 0])
        for j in range(size):
            root[j] = math.sqrt(share * own * weight[lane, j])
        for run in range(runs):
            logs = factorise(grams[run], root, noise, factor)
            for j in range(size):
                right[j] = root[j] * projected[run, lane, j]
            explained = _answer(factor, right, answer)
            _add_inverse(factor, ratio * noise, inverse, joint)
            for j in range(size):
                joint[j, j] += ratio
                common[j] += math.sqrt(ratio) * answer[j]
            shared = factorise(joint, ones, 1.0, factor)
            now = 0.5 * (level * _answer(factor, common, answer) - shared)
            logs += (counts[run] - size) * math.log(noise)
            logs += counts[run] * (_LOG_2_PI + eta[lane, 0])
            misfit = (squares[run, lane] - explained) / noise * level
            out[lane, run] = -0.5 * (logs + misfit) + now - before
            before = now


@jit
def _diagonal(
    projected: Array, squares: Array, counts: Integers, grams: Array, weight: Array, eta: Array,
    out: Array,
) -> None:  # fmt: skip
    """The same for an orthogonal basis."""
    runs, lanes, size = projected.shape
    joint, common = np.empty(size), np.empty(size)
    for lane in range(lanes):
        share, noise, own, ratio = _parts(eta[lane])
        joint[:], common[:], before = 1.0, 0.0, 0.0
        level = math.exp(-eta[lane, 0])
        for run in range(runs):
            logs = explained = shared = met = 0.0
            for j in range(size):
                power = share * own * weight[lane, j]
                pivot = noise + power * grams[run, j, j]
                right = math.sqrt(power) * projected[run, lane, j]
                explained += right * right / pivot
                logs += math.log(pivot)
                joint[j] += ratio * (1.0 - noise / pivot)
                common[j] += math.sqrt(ratio) * right / pivot
                shared += math.log(joint[j])
                met += common[j] * common[j] / joint[j]
            now = 0.5 * (level * met - shared)
            logs += (counts[run] - size) * math.log(noise)
            logs += counts[run] * (_LOG_2_PI + eta[lane, 0])
            misfit = (squares[run, lane] - explained) / noise * level
            out[lane, run] = -0.5 * (logs + misfit) + now - before
            before = now


@jit
def _parts(eta: Array) -> tuple[float, float, float, float]:
    """Shares of discrepancy and noise, the run's own part, and the ratio of common to own part."""
    share, noise = 0.5 * math.erfc(-eta[1] / SQRT_2), 0.5 * math.erfc(eta[1] / SQRT_2)
    own = max(0.5 * math.erfc(eta[3] / SQRT_2), _LEAST_OWN)
    return share, noise, own, (1.0 - own) / own


class SharedDiscrepancyErrors(DiscrepancyErrors):
    """White noise, a Gaussian process over phase that all runs share, and one of each run.

    Priors as of :class:`~bayesoleo.error_models.DiscrepancyErrors`; uniform in the shared fraction.
    """

    word = "shared-discrepancy"
    over_runs = True
    data_points = "one run, given the runs before it"

    def __init__(self, frame: Frame) -> None:
        super().__init__(frame)
        self._stack = np.stack(self._grams)
        self._kernel = _diagonal if without_products(self._stack) else _dense

    def _declare(self) -> tuple[Quantity, ...]:
        text = "part of the discrepancy of {} that all runs share"
        return (*super()._declare(), *self.frame.shares(schema.discrepancy_common, text))

    def _phase(self, run: RunSamples) -> Array:
        return run.phase + run.origin

    def start(self, residuals: Sequence[Array]) -> Array:
        eta = super().start(residuals)  # for independent discrepancies
        eta[3 * len(self.frame.outputs) :] = 0.0
        return eta

    def of_blocks(
        self, residuals: Sequence[Array], eta: Array, starts: Sequence[Integers]
    ) -> list[Array]:
        """Blocks are whole runs; periods conditional on all other runs would cost too much."""
        if any(len(first) != 1 for first in starts):
            raise ValueError("blocks of runs that have errors in common are whole runs")
        every = np.stack(self._by_output(residuals, eta), axis=1)
        return [every[:, :, run : run + 1] for run in range(len(residuals))]

    def of_runs(self, residuals: Sequence[Array], eta: Array) -> Array:
        total = np.zeros((len(eta), len(residuals)))
        for part in self._by_output(residuals, eta):
            total += part
        return total

    def _by_output(self, residuals: Sequence[Array], eta: Array) -> list[Array]:
        """Log-likelihood of each run given the runs before it, (L, N) by output."""
        outputs, lanes, found = len(self.frame.outputs), len(eta), []
        counts = np.array([e.shape[2] for e in residuals])
        for b in range(outputs):
            projected = np.empty((len(residuals), lanes, self._stack.shape[1]))
            squares = np.empty((len(residuals), lanes))
            for run, e in enumerate(residuals):
                rows = np.ascontiguousarray(e[:, b])
                project(rows, self._tables[run], projected[run], squares[run])
            part = np.column_stack([self._part(eta, b), eta[:, 3 * outputs + b]])
            weight = spectrum(np.exp(np.ascontiguousarray(part[:, 2])))
            out = np.empty((lanes, len(residuals)))
            self._kernel(projected, squares, counts, self._stack, weight, part, out)
            found.append(out)
        return found
