"""Parameters of the declared model, averaged over structures.

About an estimate a structure gives a normal density of all unknowns for each size of its effects
and each remainder outside the catalogue, times the square of each effect's amplitude: the moment
density by which structures are compared. On each side of an amplitude's zero it is replaced by the
normal density with the same mean and covariance. The mixture of all, weighted by evidence and by
the structures' probabilities, is the posterior of a parameter given any structure.

References
----------
Hoeting, Madigan, Raftery and Volinsky (1999), *Statistical Science* 14(4), eq. 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from scipy import optimize
from scipy.special import logsumexp, ndtr, ndtri
from scipy.stats import qmc

from bayesoleo._types import Array
from bayesoleo.discovery._assembly import Added
from bayesoleo.discovery._spectral_data import EstimatedModel, linearised
from bayesoleo.discovery._structure_columns import (
    Group,
    Likelihood,
    Reduced,
    fewer,
    in_a_row,
    moment_power,
    root_of,
)
from bayesoleo.discovery._structure_comparison import (
    Columns,
    Comparison,
    grids_of,
    own_groups,
    visible,
)
from bayesoleo.discovery._structures import AveragedParameter, Structure

#: Structures less probable than this, and parts of a mixture lighter than this, are left out.
LEAST, LIGHTEST = 0.005, 1e-4
#: Tail outside a central interval of 90 %, on each side.
TAIL = 0.05
#: Nodes of a normal density in one dimension, in each of two, and in all of more; and how many
#: standard deviations they reach.
NODES, REACH = (61, 31, 1024), 6.0


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

    return AveragedParameter(centre, spread, at(TAIL), at(1.0 - TAIL), at(0.5))


@dataclass(frozen=True)
class _Structure:
    """One structure about its anchor.

    Parameters
    ----------
    products : ndarray, shape (P, 1 + p, 1 + p)
        Of the residual and all columns, by covariance: unknowns, errors of inputs, effects, law.
    logs : ndarray, shape (P,)
        Log determinants.
    effects : tuple of Group
        Columns of each effect, counted among all columns.
    law : int
        Number of columns of the law.
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
    effects: tuple[Group, ...]
    law: int
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
        own = here.own * comparison.unit(here.own)[:, None]
        rows = [own, *(columns.rows[list(group.columns)] for group in groups)]
        law = columns.law if structure.outside else columns.law[:0]
        unknowns = np.concatenate([here.unknowns, comparison.shared])
        offset = np.concatenate([here.offset, np.zeros(len(comparison.shared))])
        remainders, sizes = grids_of(comparison, data.signal(anchor.fit))
        every = np.concatenate([here.residual[None], unknowns, *rows, law])
        products, logs = remainders.covariances.products(every)
        effects = in_a_row([*own_groups(anchor, comparison), *groups], 0)
        reduced = Reduced.of(products, logs, len(unknowns), offset)
        factors = np.concatenate(
            [np.ones(1 + len(unknowns)), visible(reduced, effects, data.samples)]
        )
        outside = [
            (k, None if j is None else float(remainders.laws[j] ** 2), weight)
            for k, j, weight in remainders.weights[1:]
        ]
        return cls(
            here.names,
            here.theta,
            here.change,
            products * factors[:, None] * factors,
            logs,
            in_a_row(effects, len(unknowns)),
            len(law),
            offset,
            outside if structure.outside else [(0, None, 1.0)],
            fewer(sizes),
            Likelihood(comparison.variance.size, comparison.freedom),
        )

    def normals(self) -> list[_Normal]:
        """Normal densities by remainder, sizes and sides of the effects, with their weights."""
        found = list(self._each())
        logs = np.array([log for log, _, _ in found])
        weights = np.exp(logs - logsumexp(logs))
        return [
            _Normal(float(w), mean, sd)
            for w, (_, mean, sd) in zip(weights, found, strict=True)
            if w > LIGHTEST
        ]

    def _grid(self) -> list[tuple[float, ...]]:
        """Sizes of the effects; of more than two one size for all."""
        number = len(self.effects)
        if number <= 2:
            return list(product(self.sizes, repeat=number))
        return [(size,) * number for size in self.sizes]

    def _each(self) -> Iterator[tuple[float, Array, Array]]:
        """Log weight, means and standard deviations of the parameters."""
        members = [k for group in self.effects for k in group.columns]
        count = len(self.names)
        for (pattern, law, weight), sizes in product(self.parts, self._grid()):
            counts = [len(group.columns) for group in self.effects]
            power = moment_power(np.array(sizes), np.array(counts))
            precision = np.concatenate([
                np.ones(self.offset.size),
                np.repeat(1.0 / power, counts),
                np.full(0 if law is None else self.law, 1.0 if law is None else 1.0 / law),
            ])  # fmt: skip
            log, mean, covariance, noise = self._posterior(pattern, precision)
            inner, root = covariance[np.ix_(members, members)], np.sqrt(noise)
            follow = self.change @ covariance[:count, members] @ np.linalg.inv(inner)
            rest = self.change @ covariance[:count, :count] @ self.change.T
            rest = rest - follow @ inner @ follow.T
            moved = self.theta + self.change @ mean[:count]
            for share, shift, spread in _by_side(self.effects, power, mean[members] / root, inner):
                variance = noise * np.diag(rest + follow @ spread @ follow.T)
                here = moved + root * follow @ shift
                yield log + np.log(weight) + share, here, np.sqrt(np.maximum(variance, 0.0))

    def _posterior(self, pattern: int, precision: Array) -> tuple[float, Array, Array, float]:
        """Log evidence, means and covariance of the columns' coefficients, the latter in units of
        the noise, and its variance over that measured."""
        size = 1 + precision.size
        gram = self.products[pattern, :size, :size]
        centre = np.zeros(precision.size)
        centre[: self.offset.size] = self.offset
        right = gram[1:, 0] + precision * centre
        covariance = np.linalg.inv(gram[1:, 1:] + np.diag(precision))
        mean = covariance @ right
        square = np.array(gram[0, 0] + precision @ centre**2 - right @ mean)
        log_det = -np.linalg.slogdet(covariance)[1] - np.log(precision).sum() + self.logs[pattern]
        log = float(self.likelihood(square, np.array(log_det)))
        return log, mean, covariance, float(self.likelihood.noise(square))


def _by_side(
    effects: Sequence[Group], power: Array, mean: Array, covariance: Array
) -> Iterator[tuple[float, Array, Array]]:
    """What the moments of effects make of a normal density of their amplitudes, by sides.

    Parameters
    ----------
    effects : sequence of Group
    power : ndarray, shape (effects,)
        Variances of the normal parts of their priors.
    mean : ndarray, shape (m,)
        In units of the noise.
    covariance : ndarray, shape (m, m)

    Yields
    ------
    log weight : float
    shift : ndarray, shape (m,)
        Of the mean.
    covariance : ndarray, shape (m, m)
    """
    if not effects:
        yield 0.0, mean, covariance
        return
    nodes, weights = _normal_nodes(mean.size)
    least = float(np.finfo(float).eps * np.trace(covariance))
    moved = nodes @ root_of(covariance, least).T
    amplitudes, side, start = mean + moved, np.zeros(len(nodes), dtype=int), 0
    weights = weights.copy()
    for group, variance in zip(effects, power, strict=True):
        own = amplitudes[:, start : start + len(group.columns)]
        start += len(group.columns)
        weights *= np.mean(own**2, axis=1) / variance
        if len(group.columns) == 1:
            above = own[:, 0] > 0
            weights *= 2.0 * np.where(above, group.positive, 1.0 - group.positive)
            side = 2 * side + above
    for one in np.unique(side):
        share = weights * (side == one)
        total = share.sum()
        if total > 0.0:
            shift = share @ moved / total
            away = moved - shift
            yield float(np.log(total)), shift, (share[:, None] * away).T @ away / total


@cache
def _normal_nodes(count: int) -> tuple[Array, Array]:
    """Points and weights of a normal density with unit variances."""
    if count > 2:
        points = ndtri(qmc.Sobol(count, seed=0).random(NODES[2]))
        return points, np.full(NODES[2], 1.0 / NODES[2])
    line = np.linspace(-REACH, REACH, NODES[count - 1])
    points = np.stack(np.meshgrid(*[line] * count, indexing="ij"), axis=-1).reshape(-1, count)
    weights = np.exp(-0.5 * np.sum(points**2, axis=1))
    return points, weights / weights.sum()


def _best_group(columns: Columns, key: Added, residual: Array, variance: Array) -> Group:
    """Columns of an effect at the shapes at which it explains most."""

    def explained(group: Group) -> float:
        rows = columns.rows[list(group.columns)] / np.sqrt(variance)
        return float(np.sum((np.linalg.qr(rows.T)[0].T @ (residual / np.sqrt(variance))) ** 2))

    return max(columns.groups[key], key=explained)
