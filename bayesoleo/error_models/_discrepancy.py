r"""Periodic model discrepancy: white noise and a Gaussian process over phase.

.. math::

    e(t) = \epsilon(t) + \delta(f t), \qquad
    \operatorname{cov}(\delta(\phi), \delta(\phi')) = v \rho\, k_\ell(\phi - \phi').

Model discrepancy is a function of the motion. In a periodic steady state the motion repeats, so the
discrepancy :math:`\delta` is the same function of phase in every period. More periods separate it
from noise but never average it out, whereas they would average out a process in time. Each run has
its own :math:`\delta`; variance and length are common to the runs of an output.

The correlation is Matérn's of order 3/2 around the circle, with length :math:`\ell` in cycles. It
is once differentiable, because friction and contacts leave kinks. A truncated Fourier series
represents it, so a record costs one projection on its harmonics and, unless it holds whole periods
of equal steps, one small factorisation. The record of a run that does not repeat is taken as half a
cycle, over which a periodic function is unrestricted.

:class:`SharedDiscrepancyErrors` has a part that all runs share:

.. math::

    e_r(t) = \epsilon(t) + \delta(\phi) + \delta_r(\phi), \qquad
    \operatorname{cov}(\delta(\phi), \delta(\phi')) = v \rho \kappa\, k_\ell(\phi - \phi'),

    \operatorname{cov}(\delta_r(\phi), \delta_r(\phi'))
    = v \rho (1 - \kappa)\, k_\ell(\phi - \phi').

An effect that the model lacks in all runs acts alike wherever they pass through the same part of
the motion. If each run had an independent discrepancy
(:class:`DiscrepancyErrors`), more runs would average it out, and intervals
would shrink about a biased value. Here :math:`\kappa` is the shared fraction; at zero each run has
its own discrepancy. Phases count from the crest of a run's input.

Runs are then not independent. The common curve has few coefficients, so each run adds a term to
one small system. The log-likelihood of a run is conditional on the runs before it; their sum is the
joint log-likelihood.

References
----------
Kennedy and O'Hagan (2001), "Bayesian calibration of computer models", *Journal of the Royal
Statistical Society* B 63, eq. 5. Rasmussen and Williams (2006), *Gaussian Processes for Machine
Learning*, eqs. 4.15 (the spectrum) and A.9-A.10 (the lemma, of a shared part used twice: for each
run's own curve and for the common one). Solin and Särkkä (2014), "Explicit
link between periodic covariance functions and state space models", *AISTATS*, eq. 14 (series of
a periodic covariance).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import log_ndtr, ndtr

from bayesoleo import _schema as schema
from bayesoleo._compiled import jit
from bayesoleo._types import Array, Integers
from bayesoleo.error_models._base import Frame, Quantity, RunSamples
from bayesoleo.error_models._independent import ByOutput
from bayesoleo.model._priors import LogNormal

#: Harmonics of the series: the shortest length that it resolves is about a fiftieth of a cycle.
HARMONICS = 24
#: Prior of the length in cycles: within a factor of four of a tenth.
_LENGTH = LogNormal(0.1, 0.7)
# Products of two basis functions, relative to their squares, that count as zero.
_NONE = 1e-10
SQRT_2 = math.sqrt(2.0)
_LOG_2_PI = float(np.log(2 * np.pi))
# Least share of a run's own discrepancy, for rounding.
_LEAST_OWN = 1e-9


def spectrum(length: Array) -> Array:
    """Variances of the coefficients of 1, cos, sin, cos 2 ..., summing to one at any phase.

    Parameters
    ----------
    length : ndarray, shape (L,)
        In cycles.

    Returns
    -------
    ndarray, shape (L, 2 HARMONICS + 1)
    """
    order = np.arange(HARMONICS + 1)
    weight = (1 + (2 * np.pi * order * np.asarray(length)[:, None]) ** 2 / 3) ** -2.0
    weight[:, 1:] *= 2
    total = np.zeros(len(weight))
    for column in weight.T:  # in a fixed order, whatever the number of rows
        total += column
    return np.repeat(weight / total[:, None], [1] + [2] * HARMONICS, axis=1)


def basis(phase: Array) -> Array:
    """1, cos, sin, cos 2 ... at phases in cycles, shape (n, 2 HARMONICS + 1)."""
    angle = 2 * np.pi * np.outer(phase % 1.0, np.arange(1, HARMONICS + 1))
    table = np.empty((phase.size, 2 * HARMONICS + 1))
    table[:, 0], table[:, 1::2], table[:, 2::2] = 1.0, np.cos(angle), np.sin(angle)
    return table


@jit
def project(rows: Array, table: Array, out: Array, squares: Array) -> None:
    """Products of rows ``(L, n)`` with the basis ``(n, R)``, and their sums of squares."""
    for lane in range(rows.shape[0]):
        squares[lane] = 0.0
        for j in range(table.shape[1]):
            out[lane, j] = 0.0
        for i in range(rows.shape[1]):
            e = rows[lane, i]
            squares[lane] += e * e
            for j in range(table.shape[1]):
                out[lane, j] += e * table[i, j]


@jit
def factorise(gram: Array, root: Array, noise: float, factor: Array) -> float:
    """Cholesky factor of ``noise + D G D`` with ``D = diag(root)``, in place, and ln det."""
    size, logs = root.size, 0.0
    for i in range(size):
        for j in range(i + 1):
            total = root[i] * gram[i, j] * root[j]
            if i == j:
                total += noise
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = np.sqrt(total) if i == j else total / factor[j, j]
        logs += np.log(factor[i, i])
    return 2.0 * logs


@jit
def _log_likelihood(
    projected: Array, squares: Array, count: int, gram: Array, weight: Array, eta: Array, out: Array
) -> None:
    """Log-likelihood of rows by the matrix inversion and determinant lemmas."""
    size = gram.shape[0]
    factor, root, answer = np.empty((size, size)), np.empty(size), np.empty(size)
    for lane in range(projected.shape[0]):
        share = 0.5 * math.erfc(-eta[lane, 1] / SQRT_2)
        noise = 0.5 * math.erfc(eta[lane, 1] / SQRT_2)
        for j in range(size):
            root[j] = np.sqrt(share * weight[lane, j])
        logs = factorise(gram, root, noise, factor)
        explained = 0.0
        for i in range(size):
            total = root[i] * projected[lane, i]
            for k in range(i):
                total -= factor[i, k] * answer[k]
            answer[i] = total / factor[i, i]
            explained += answer[i] * answer[i]
        logs += (count - size) * np.log(noise) + count * (_LOG_2_PI + eta[lane, 0])
        misfit = (squares[lane] - explained) / noise * np.exp(-eta[lane, 0])
        out[lane] = -0.5 * (logs + misfit)


@jit
def _without_products(
    projected: Array, squares: Array, count: int, gram: Array, weight: Array, eta: Array, out: Array
) -> None:
    """The same for an orthogonal basis."""
    size = gram.shape[0]
    for lane in range(projected.shape[0]):
        share = 0.5 * math.erfc(-eta[lane, 1] / SQRT_2)
        noise = 0.5 * math.erfc(eta[lane, 1] / SQRT_2)
        logs = explained = 0.0
        for j in range(size):
            power = share * weight[lane, j]
            pivot = noise + power * gram[j, j]
            explained += power * projected[lane, j] ** 2 / pivot
            logs += np.log(pivot)
        logs += (count - size) * np.log(noise) + count * (_LOG_2_PI + eta[lane, 0])
        misfit = (squares[lane] - explained) / noise * np.exp(-eta[lane, 0])
        out[lane] = -0.5 * (logs + misfit)


def without_products(gram: Array) -> bool:
    """Whether the basis is orthogonal, as over whole periods of equal steps.

    Parameters
    ----------
    gram : ndarray, shape (..., R, R)
    """
    diagonal = np.einsum("...ii->...i", gram)
    beside = np.abs(gram - diagonal[..., None] * np.eye(gram.shape[-1]))
    return bool(beside.max() <= _NONE * diagonal.min())


class DiscrepancyErrors(ByOutput):
    """White noise and a Gaussian process over phase for each output; independent between runs.

    The prior is flat in the logarithm of the total variance, uniform in the share of the
    discrepancy, and log-normal in its length.
    """

    word = "discrepancy"

    def __init__(self, frame: Frame) -> None:
        super().__init__(frame)
        self._tables = [basis(self._phase(run)) for run in frame.sampled()]
        self._grams = [table.T @ table for table in self._tables]
        self._kernels = [
            _without_products if without_products(gram) else _log_likelihood for gram in self._grams
        ]

    def _declare(self) -> tuple[Quantity, ...]:
        share_text = "share of the error variance of {} that repeats every period"
        shares = self.frame.shares(schema.discrepancy_share, share_text)
        length_text = "length in cycles over which the discrepancy of {} is alike"
        lengths = self.frame.lengths(schema.discrepancy_length, _LENGTH, "1", length_text)
        return (*self.frame.log_variances(), *shares, *lengths)

    def log_new(self, share: Array, log_length: Array) -> Array:
        """Variance of the white part: a repeating curve is known after its first period."""
        return np.asarray(log_ndtr(-share))

    def _phase(self, run: RunSamples) -> Array:
        """Phase of a run's samples, in cycles."""
        return run.phase

    def of_output(self, run: int, residual: Array, eta: Array) -> Array:
        table, gram = self._tables[run], self._grams[run]
        projected, squares = np.empty((len(residual), len(gram))), np.empty(len(residual))
        project(residual, table, projected, squares)
        out = np.empty(len(residual))
        weight = spectrum(np.exp(eta[:, 2]))
        self._kernels[run](projected, squares, residual.shape[1], gram, weight, eta, out)
        return out

    def blocks_of_output(self, run: int, residual: Array, eta: Array, starts: Integers) -> Array:
        # Log density of all blocks up to one, less that of all before it.
        table, weight = self._tables[run], spectrum(np.exp(eta[:, 2]))
        lanes, size = len(residual), table.shape[1]
        gram, projected, squares = np.zeros((size, size)), np.zeros((lanes, size)), np.zeros(lanes)
        total = np.zeros((lanes, len(starts) + 1))
        more, square = np.empty_like(projected), np.empty_like(squares)
        ends = np.append(starts[1:], residual.shape[1])
        for k, (first, last) in enumerate(zip(starts, ends, strict=True)):
            rows = table[first:last]
            project(np.ascontiguousarray(residual[:, first:last]), rows, more, square)
            gram, projected, squares = gram + rows.T @ rows, projected + more, squares + square
            _log_likelihood(projected, squares, int(last), gram, weight, eta, total[:, k + 1])
        return np.diff(total, axis=1)

    def products_of_output(self, run: int, columns: Array, eta: Array) -> Array:
        share, noise = ndtr(eta[1]), ndtr(-eta[1])
        root = np.sqrt(share * spectrum(np.exp(eta[2:]))[0])
        inner = noise * np.eye(root.size) + root[:, None] * self._grams[run] * root
        projected = root[:, None] * (self._tables[run].T @ columns.T)
        left = columns @ columns.T - projected.T @ np.linalg.solve(inner, projected)
        return np.asarray(left / noise * np.exp(-eta[0]))

    def draw_coloured(self, length: Array, samples: RunSamples, rng: np.random.Generator) -> Array:
        table = basis(samples.phase)
        root = np.sqrt(spectrum(length))
        return np.asarray((root * rng.standard_normal(root.shape)) @ table.T)


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
