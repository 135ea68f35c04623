"""Parameters of the declared model, averaged over structures.

About an estimate a structure gives a normal density of the parameters for each size of its effects
and each remainder outside the catalogue. Their mixture, weighted by evidence and by the structures'
probabilities, is the posterior of a parameter given any structure.

References
----------
Hoeting, Madigan, Raftery and Volinsky (1999), *Statistical Science* 14(4), eq. 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize
from scipy.special import logsumexp, ndtr

from bayesoleo._types import Array
from bayesoleo.discovery._assembly import Added
from bayesoleo.discovery._spectral_data import EstimatedModel, linearised
from bayesoleo.discovery._structure_comparison import (
    Columns,
    Comparison,
    grids_of,
    own_groups,
)
from bayesoleo.discovery._structure_evidence import Likelihood, fewer, moment_power
from bayesoleo.discovery._structures import AveragedParameter, Structure

#: Structures less probable than this, and parts of a mixture lighter than this, are left out.
LEAST, LIGHTEST = 0.005, 1e-4
#: Tail outside a central interval of 90 %, on each side.
TAIL = 0.05


@dataclass(frozen=True)
class _Normal:
    """A part of the posterior of all parameters: weight, means (l,) and standard deviations."""

    weight: float
    mean: Array
    sd: Array


def averaged(
    structures: Sequence[Structure],
    anchors: Mapping[tuple[frozenset[Added], bool], EstimatedModel],
    comparison: Comparison,
    columns: Columns,
    names: Sequence[str],
) -> dict[str, AveragedParameter]:
    """Mixtures over structures.

    Parameters
    ----------
    structures : sequence of Structure
    anchors : mapping of (effects, outside) to EstimatedModel
        The model about which each structure was compared.
    comparison : Comparison
    columns : Columns
        Of all candidates.
    names : sequence of str
        Parameters of the declared model. Where a structure lets one differ between runs, its value
        is that of each run with equal weight.
    """
    parts: dict[str, list[tuple[float, float, float]]] = {name: [] for name in names}
    for structure in structures:
        key = frozenset(structure.effects), structure.outside
        if structure.probability < LEAST or key not in anchors:
            continue
        known = _Structure.of(structure, anchors[key], comparison, columns)
        for part in known.normals():
            for name in names:
                own = [k for k, other in enumerate(known.names) if name == other]
                own = own or [k for k, n in enumerate(known.names) if n.split("[")[0] == name]
                weight = structure.probability * part.weight / max(len(own), 1)
                parts[name] += [(weight, part.mean[k], part.sd[k]) for k in own]
    return {name: _summary(np.array(found)) for name, found in parts.items() if found}


def _summary(parts: Array) -> AveragedParameter:
    """Moments and interval of a mixture, from rows of weight, mean and standard deviation."""
    weight, mean, sd = parts[:, 0] / parts[:, 0].sum(), parts[:, 1], np.maximum(parts[:, 2], 1e-300)
    centre = float(weight @ mean)
    spread = float(np.sqrt(weight @ (sd**2 + (mean - centre) ** 2)))
    low, high = float(np.min(mean - 6 * sd)), float(np.max(mean + 6 * sd))

    def at(chance: float) -> float:
        return float(optimize.brentq(lambda x: weight @ ndtr((x - mean) / sd) - chance, low, high))

    return AveragedParameter(centre, spread, at(TAIL), at(1.0 - TAIL))


@dataclass(frozen=True)
class _Structure:
    """One structure about its anchor.

    Parameters
    ----------
    products : ndarray, shape (P, 1 + p, 1 + p)
        Of the residual and all columns, by covariance: unknowns, errors of inputs, effects, law.
    logs : ndarray, shape (P,)
        Log determinants.
    counts : tuple of int
        Numbers of unknowns with errors of inputs, of columns of effects, and of the law.
    members : ndarray, shape (columns of effects,)
        Number of columns of the effect that each belongs to.
    offset : ndarray
        Centres of the unknowns' priors.
    parts : sequence of (pattern, variance of the law or None, weight)
    sizes : ndarray
        Of an effect.
    """

    names: tuple[str, ...]
    theta: Array
    change: Array
    products: Array
    logs: Array
    counts: tuple[int, int, int]
    members: Array
    offset: Array
    parts: Sequence[tuple[int, float | None, float]]
    sizes: Array
    likelihood: Likelihood

    @classmethod
    def of(
        cls, structure: Structure, anchor: EstimatedModel, comparison: Comparison, columns: Columns
    ) -> _Structure:
        """Columns of the anchor, and of the structure's other effects as scored."""
        data, here = comparison.data, linearised(anchor, comparison.data)
        more = [key for key in structure.effects if key not in anchor.effects]
        groups = [_best_group(columns, key, here.residual, comparison.variance) for key in more]
        members = [len(group.columns) for group in own_groups(anchor, comparison)]
        members += [len(group) for group in groups]
        own = here.own * comparison.unit(here.own)[:, None]
        effects = [own, *(columns.rows[list(group)] for group in groups)]
        law = columns.law if structure.outside else columns.law[:0]
        unknowns = np.concatenate([here.unknowns, comparison.shared])
        remainders, sizes = grids_of(comparison, data.signal(anchor.fit))
        rows = np.concatenate([here.residual[None], unknowns, *effects, law])
        products, logs = remainders.covariances.products(rows)
        outside = [
            (k, None if j is None else float(remainders.laws[j] ** 2), weight)
            for k, j, weight in remainders.weights[1:]
        ]
        return cls(
            here.names,
            here.theta,
            here.change,
            products,
            logs,
            (len(unknowns), sum(members), len(law)),
            np.repeat(members, members).astype(float),
            np.concatenate([here.offset, np.zeros(len(comparison.shared))]),
            outside if structure.outside else [(0, None, 1.0)],
            fewer(sizes) if members else sizes[:1],
            Likelihood(comparison.variance.size, comparison.freedom),
        )

    def normals(self) -> list[_Normal]:
        """Normal densities by remainder and size of the effects, with their weights."""
        found = list(self._each())
        logs = np.array([log for log, _, _ in found])
        weights = np.exp(logs - logsumexp(logs))
        return [
            _Normal(float(w), mean, sd)
            for w, (_, mean, sd) in zip(weights, found, strict=True)
            if w > LIGHTEST
        ]

    def _each(self) -> Iterator[tuple[float, Array, Array]]:
        """Log weight, means and standard deviations of the parameters."""
        unknowns, _, law = self.counts
        for pattern, power, weight in self.parts:
            for size in self.sizes:
                effects = 1.0 / moment_power(size, self.members)
                precision = np.concatenate([np.ones(unknowns), effects])
                if power is not None:
                    precision = np.concatenate([precision, np.full(law, 1.0 / power)])
                log, mean, covariance = self._posterior(pattern, precision)
                count = len(self.names)
                change = self.change @ covariance[:count, :count] @ self.change.T
                moved = self.theta + self.change @ mean[:count]
                yield log + np.log(weight), moved, np.sqrt(np.diag(change))

    def _posterior(self, pattern: int, precision: Array) -> tuple[float, Array, Array]:
        """Log evidence, means and covariance of the columns' coefficients."""
        size = 1 + precision.size
        gram = self.products[pattern, :size, :size]
        centre = np.zeros(precision.size)
        centre[: self.offset.size] = self.offset
        right = gram[1:, 0] + precision * centre
        covariance = np.linalg.inv(gram[1:, 1:] + np.diag(precision))
        mean = covariance @ right
        square = np.array(gram[0, 0] + precision @ centre**2 - right @ mean)
        log_det = -np.linalg.slogdet(covariance)[1] - np.log(precision).sum() + self.logs[pattern]
        likelihood = self.likelihood
        # Of Student's density whose noise is known to some degrees of freedom.
        scale = (likelihood.freedom + square) / (likelihood.freedom + likelihood.count)
        return float(likelihood(square, np.array(log_det))), mean, covariance * float(scale)


def _best_group(columns: Columns, key: Added, residual: Array, variance: Array) -> tuple[int, ...]:
    """Columns of an effect at the shapes at which it explains most."""

    def explained(index: tuple[int, ...]) -> float:
        rows = columns.rows[list(index)] / np.sqrt(variance)
        return float(np.sum((np.linalg.qr(rows.T)[0].T @ (residual / np.sqrt(variance))) ** 2))

    return max((group.columns for group in columns.groups[key]), key=explained)
