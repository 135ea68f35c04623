"""How well one experiment tells rival models apart, from what each of them foresees of it.

Rival ``i`` foresees the outputs as normal, ``N(m_i, I + A_i' A_i)`` in units of the noise: noise of
the samples, and what the runs made so far leave unknown of its parameters. If ``i`` is true, the
logarithm of the Bayes factor against ``j`` is expected to be the Kullback-Leibler divergence

    KL(i, j) = [tr(S_j^-1 S_i) - n + d' S_j^-1 d + ln(|S_j| / |S_i|)] / 2,   d = m_i - m_j.

What the outcome is expected to say about *which* of several is true is bounded from below by their
Bhattacharyya distances; unlike a sum over pairs it cannot be made up by one pair alone.

References
----------
Box and Hill (1967), Technometrics 9, 57-71; Kolchinsky and Tracey (2017), Entropy 19, 361.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from bayesoleo._types import Array


@dataclass(frozen=True)
class PredictiveDistribution:
    """What a rival foresees of an experiment, in units of the noise.

    Parameters
    ----------
    mean : ndarray, shape (n,)
        Outputs.
    spread : ndarray, shape (r, n)
        Their change by one standard deviation in each of ``r`` independent directions that are not
        known.
    """

    mean: Array
    spread: Array


@dataclass(frozen=True)
class Separation:
    """How well an experiment tells ``k`` rivals apart.

    Parameters
    ----------
    log_bayes_factor : ndarray, shape (k, k)
        Expected, in nats, for the rival of the row against that of the column if the former is
        true.
    information : float
        Least expected information about which of them is true, each as likely before, in bits.
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
        """Separation of the pair that is separated least, in standard deviations."""
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
            factor[i, j] = max(twice / 2, 0.0)  # zero may come out as a last digit below it
            overlap[i, j] = np.exp(-_bhattacharyya(covariances[i], S, d, logs[i], logs[j]))
    information = float(-np.mean(np.log2(overlap.mean(axis=1))))
    return Separation(factor, max(information, 0.0))


def _reduced(rivals: Sequence[PredictiveDistribution]) -> tuple[Array, list[Array]]:
    """Means ``(k, d)`` and spreads ``(r, d)`` in the directions in which rivals differ or are not
    sure; in all others they foresee the same."""
    moved = [rival.mean - rivals[0].mean for rival in rivals]
    rows = np.concatenate([np.stack(moved), *(rival.spread for rival in rivals)])
    basis, _ = np.linalg.qr(rows.T)
    return np.stack(moved) @ basis, [rival.spread @ basis for rival in rivals]


def _bhattacharyya(A: Array, B: Array, d: Array, log_a: float, log_b: float) -> float:
    """Bhattacharyya distance of two normal densities, from the logarithms of their determinants."""
    mean = (A + B) / 2
    between = float(np.linalg.slogdet(mean)[1]) - (log_a + log_b) / 2
    return max(float(d @ np.linalg.solve(mean, d)) / 8 + between / 2, 0.0)
