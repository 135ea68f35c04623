r"""Expected information of a run: about which of several models is true, or about parameters.

Rival ``i`` has the probability ``w_i`` and predicts the outputs as normal, ``N(m_i, I + A_i' A_i)``
in units of the noise: the noise of the samples plus the remaining uncertainty of its parameters.
The information about which rival is true is the mutual information of the rival and the outputs,

    I = sum_i w_i E_i[ sum_j q_j(y) ln(q_j(y) / w_j) ],     q_j(y) proportional to w_j p_j(y),

where ``E_i`` is the mean over outputs that rival ``i`` predicts. It is the expected fall of the
entropy of the probabilities, zero where all predictions agree and the entropy itself where the
outcome decides. The means are taken over a fixed set of draws. Averaging the divergence of ``q``
from ``w`` instead of ``ln(p_i(y) / p(y))`` makes every term non-negative and bounded, so that few
draws suffice both where little and where nearly everything is decided.

If ``i`` is true, the expected logarithm of the Bayes factor against ``j`` is the divergence

    KL(i, j) = [tr(S_j^-1 S_i) - n + d' S_j^-1 d + ln(|S_j| / |S_i|)] / 2,   d = m_i - m_j.

References
----------
Lindley (1956), Annals of Mathematical Statistics 27, 986-1005: expected information.
Box and Hill (1967), Technometrics 9, 57-71: choice among rival models.
Chaloner and Verdinelli (1995), Statistical Science 10, 273-304: precision of parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp

from bayesoleo._types import Array

#: Draws of the outputs by each rival. Their half is mirrored, so that means are exact. A small
#: information is then known to a tenth, one near its limit far better.
DRAWS = 256
#: Draws by each component of a rival at least.
FEWEST = 32
#: Directions in which no rival differs or is uncertain by this part of the noise are left out.
NEGLIGIBLE = 1e-4
_LOG_2 = float(np.log(2.0))


@dataclass(frozen=True)
class PredictiveDistribution:
    """Predictive distribution of an experiment by one rival, in units of the noise.

    Parameters
    ----------
    mean : ndarray, shape (n,)
        Outputs.
    spread : ndarray, shape (r, n)
        Their change by one standard deviation in each of ``r`` independent uncertain directions.
    parameters : int
        How many of these, the first ones, are of the model's unknowns; the others are errors of
        the run's inputs.
    """

    mean: Array
    spread: Array
    parameters: int = 0

    def given(self, direction: Array, shift: float, ratio: float) -> PredictiveDistribution:
        """The distribution with another one of an unknown, by linear theory.

        Parameters
        ----------
        direction : ndarray, shape (parameters,)
            Change of the unknown by one standard deviation in each direction.
        shift : float
            Of its mean.
        ratio : float
            Of its standard deviation.
        """
        variance = float(direction @ direction)
        own = self.spread[: self.parameters]
        along = direction @ own / variance
        changed = own + (ratio - 1.0) * np.outer(direction, along)
        spread = np.concatenate([changed, self.spread[self.parameters :]])
        return PredictiveDistribution(self.mean + shift * along, spread, self.parameters)


@dataclass(frozen=True)
class Component:
    """A rival with an effect of a certain size.

    Parameters
    ----------
    rival : int
        Which one.
    weight : float
        Its part of the rival's probability.
    predicted : PredictiveDistribution
    """

    rival: int
    weight: float
    predicted: PredictiveDistribution


@dataclass(frozen=True)
class Separation:
    """Separation of ``k`` rivals by an experiment.

    Parameters
    ----------
    log_bayes_factor : ndarray, shape (k, k)
        Expected value, in nats, for the rival of the row against that of the column if the former
        is true.
    information : float
        Expected information on which of them is true, in bits.
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
        """Separation of the weakest pair, in standard deviations."""
        above = self.sigma[np.triu_indices(len(self.sigma), 1)]
        return float(above.min()) if above.size else 0.0


@dataclass(frozen=True)
class Precision:
    """What an experiment adds to the knowledge of one model's parameters.

    Parameters
    ----------
    information : float
        Half the fall of the logarithm of the determinant of the posterior covariance, or of one
        parameter's variance, in bits.
    ratio : mapping of str to float
        Standard deviation with the experiment over that without it, by parameter.
    """

    information: float
    ratio: dict[str, float] = field(default_factory=dict)


def entropy(weights: Array) -> float:
    """Entropy of probabilities, in bits: the most that an experiment can tell."""
    some = np.asarray(weights)[np.asarray(weights) > 0]
    return float(-np.sum(some * np.log2(some)))


def separate(
    rivals: Sequence[PredictiveDistribution],
    weights: Sequence[float] | None = None,
    components: Sequence[Component] = (),
) -> Separation:
    """Expected log Bayes factors between all rivals, and the information about which is true.

    Parameters
    ----------
    rivals : sequence of PredictiveDistribution
        Two or more, of the same experiment in the same units.
    weights : sequence of float, optional
        Probabilities of the rivals before the experiment, by default equal. They are divided by
        their sum.
    components : sequence of Component, optional
        What the rivals are mixtures of, for the information; by default each is one component.

    Returns
    -------
    Separation
    """
    prior = np.full(len(rivals), 1.0) if weights is None else np.asarray(weights, dtype=float)
    parts = components or [Component(k, 1.0, one) for k, one in enumerate(rivals)]
    information = _mutual_information(parts, prior / prior.sum())
    return Separation(_log_bayes_factors(rivals), information)


def _log_bayes_factors(rivals: Sequence[PredictiveDistribution]) -> Array:
    """Expected log Bayes factors of all pairs, shape (k, k)."""
    means, spreads = _reduced(rivals)
    size, count = means.shape[1], len(rivals)
    roots = [_root(spread) for spread in spreads]
    logs = [2.0 * float(np.log(np.diag(L)).sum()) for L in roots]
    factor = np.zeros((count, count))
    for i in range(count):
        for j in range(count):
            if i != j:
                solved = solve_triangular(
                    roots[j], np.column_stack([roots[i], means[i] - means[j]]), lower=True
                )
                factor[i, j] = 0.5 * (np.sum(solved**2) - size + logs[j] - logs[i])
    return np.maximum(factor, 0.0)  # round-off may make zero negative


def _mutual_information(parts: Sequence[Component], weights: Array) -> float:
    """Mutual information of rival and outputs, in bits."""
    parts = [part for part in parts if weights[part.rival] * part.weight > 0]
    means, spreads = _reduced([part.predicted for part in parts])
    roots = [_root(spread) for spread in spreads]
    logs = np.array([np.log(np.diag(root)).sum() for root in roots])[:, None]
    group = np.array([part.rival for part in parts])
    share = np.log([weights[part.rival] * part.weight for part in parts])[:, None]
    members = [np.flatnonzero(group == k) for k in np.unique(group)]
    before = np.array([logsumexp(share[k]) for k in members])[:, None]
    rng, total = np.random.default_rng(0), 0.0
    for i, (mean, root) in enumerate(zip(means, roots, strict=True)):
        count = max(DRAWS // int(np.sum(group == group[i])), FEWEST)
        half = rng.standard_normal((means.shape[1], count // 2))
        outputs = mean[:, None] + root @ np.concatenate([half, -half], axis=1)
        squares = [
            np.sum(solve_triangular(one, outputs - other[:, None], lower=True) ** 2, axis=0)
            for one, other in zip(roots, means, strict=True)
        ]
        heights = share - logs - 0.5 * np.stack(squares)
        after = np.stack([logsumexp(heights[k], axis=0) for k in members])
        after = after - logsumexp(after, axis=0)
        divergence = np.sum(np.exp(after) * (after - before), axis=0)
        total += float(np.exp(share[i, 0]) * divergence.mean())
    return min(max(total / _LOG_2, 0.0), entropy(weights))


def _root(spread: Array) -> Array:
    """Lower triangular root of ``I + A'A`` for a spread ``A (r, d)``.

    By orthogonal rows: where a prediction is a hundred million times as uncertain as its noise, the
    sum itself has lost the noise to round-off, and is not positive definite.
    """
    rows = np.linalg.qr(np.vstack((spread, np.eye(spread.shape[1]))), mode="r")
    return np.asarray((rows * np.where(np.diag(rows) < 0, -1.0, 1.0)[:, None]).T)


def in_common_directions(
    rivals: Sequence[PredictiveDistribution],
) -> list[PredictiveDistribution]:
    """The same distributions in coordinates of the directions that occur in any of them.

    Lengths and angles stay, so that these separate as the outputs themselves do, and so do what
    :meth:`PredictiveDistribution.given` makes of them: of a long record with some hundred
    directions that is a small part of the work. Means count from that of the first.

    Parameters
    ----------
    rivals : sequence of PredictiveDistribution
        Of the same experiment in the same units.
    """
    moved = np.stack([rival.mean - rivals[0].mean for rival in rivals])
    rows = np.concatenate([moved, *(rival.spread for rival in rivals)])
    if len(rows) < rows.shape[1]:
        rows = np.linalg.qr(rows.T, mode="r").T
    ends = np.cumsum([len(rivals), *(len(rival.spread) for rival in rivals)])
    means, *spreads = np.split(rows, ends[:-1])
    return [
        PredictiveDistribution(mean, spread, rival.parameters)
        for mean, spread, rival in zip(means, spreads, rivals, strict=True)
    ]


def _reduced(rivals: Sequence[PredictiveDistribution]) -> tuple[Array, list[Array]]:
    """Means ``(k, d)`` and spreads ``(r, d)`` in the directions in which rivals differ or are
    uncertain; in all others their predictions are equal."""
    moved = np.stack([rival.mean - rivals[0].mean for rival in rivals])
    distinct = {id(rival.spread): rival.spread for rival in rivals}
    rows = np.concatenate([moved, *distinct.values()])
    # Of the rows' coordinates in their own directions, the triangle alone is needed.
    left, size, _ = np.linalg.svd(np.linalg.qr(rows.T, mode="r").T, full_matrices=False)
    own = (left * size)[:, size > NEGLIGIBLE]
    ends = np.cumsum([len(moved), *map(len, distinct.values())])
    parts = dict(zip(distinct, np.split(own, ends[:-1])[1:], strict=True))
    return own[: len(moved)], [parts[id(rival.spread)] for rival in rivals]


def precision_gain(
    predicted: PredictiveDistribution, root: Array, names: Sequence[str], of: Sequence[int]
) -> Precision:
    r"""What an experiment adds to the knowledge of parameters, by linear theory.

    The posterior covariance :math:`R^\top R` becomes :math:`R^\top (I + A N^{-1} A^\top)^{-1} R`,
    where ``A = R J`` is the change of the outputs by the rows of ``R`` and ``N`` the noise with the
    errors of the run's inputs.

    Parameters
    ----------
    predicted : PredictiveDistribution
        Its first ``r`` rows are ``A``.
    root : ndarray, shape (r, l)
        ``R``, the change of the unknowns by one standard deviation in each direction.
    names : sequence of str
        The ``l`` unknowns.
    of : sequence of int
        Unknowns of interest; the others are marginalised.
    """
    count = predicted.parameters
    own, inputs = predicted.spread[:count], predicted.spread[count:]
    gram = own @ own.T
    if len(inputs):
        cross = own @ inputs.T
        gram = gram - cross @ np.linalg.solve(np.eye(len(inputs)) + inputs @ inputs.T, cross.T)
    chosen = root[:, list(of)]
    before = chosen.T @ chosen
    after = chosen.T @ np.linalg.solve(np.eye(count) + gram, chosen)
    sd = np.sqrt(np.diag(before))
    unit = np.outer(sd, sd)
    fall = np.linalg.slogdet(before / unit)[1] - np.linalg.slogdet(after / unit)[1]
    ratio = np.sqrt(np.clip(np.diag(after) / np.diag(before), 0.0, 1.0))
    labels = [names[k] for k in of]
    return Precision(
        max(0.5 * float(fall) / _LOG_2, 0.0), dict(zip(labels, map(float, ratio), strict=True))
    )
