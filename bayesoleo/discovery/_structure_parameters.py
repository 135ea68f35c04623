"""Parameters given a structure, by outputs linearised about an estimate.

About an estimate a structure gives a normal density of all unknowns for each size of its effects
and each remainder outside the catalogue, times the square of each effect's amplitude: the moment
density by which structures are compared. On each side of an amplitude's zero it is replaced by the
normal density with the same mean and covariance. The mixture of all, weighted by evidence and by
the structures' probabilities, is the posterior of a parameter given any structure.

A density is normal in the parameter, or in its logarithm where its prior has nothing below zero,
and lies within the limits of the priors
(:mod:`bayesoleo.discovery._limited_parameters`). This holds near the estimate only: a parameter
that the data determine poorly ranges far from it.

References
----------
Hoeting, Madigan, Raftery and Volinsky (1999), *Statistical Science* 14(4), eq. 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
from scipy.linalg import solve_triangular
from scipy.special import logsumexp, ndtri

from bayesoleo._types import Array, Flags, Integers
from bayesoleo.discovery._assembly import Added
from bayesoleo.discovery._fit import ModelFit
from bayesoleo.discovery._limited_parameters import ROUGH, STEPS, Coordinates, powers
from bayesoleo.discovery._parameter_mixture import Mixture, part_of
from bayesoleo.discovery._spectral_data import EstimatedModel, LinearisedModel, linearised
from bayesoleo.discovery._structure_columns import (
    Covariances,
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
from bayesoleo.discovery._structures import Structure

#: Parts of a mixture lighter than this are left out.
LIGHTEST = 1e-4
#: Nodes of a normal density in one dimension, in each of two, and in all of more; and how many
#: standard deviations they reach.
NODES, REACH = (61, 31, 1024), 6.0
#: Draws of a part of a posterior that reaches a limit: at most, at least, and by its weight.
MANY, FEW, OF_ALL = 4096, 16, 32768
#: Logarithm by which a part is farther below the lightest one that counts before it is left out by
#: a bound, and by how much amplitudes may be larger than those by which it is bounded.
FAR, AMPLER = 7.0, 2.0
#: Draws that correct the evidence of one value of a parameter for the priors of the others.
FEWEST = 128


#: A pattern of the covariance, the variance of a law or None, their weight, sizes of the effects.
Cell = tuple[int, float | None, float, tuple[float, ...]]


@dataclass(frozen=True)
class _Normal:
    """A part of the posterior of all parameters, in their coordinates: weight, means (l,) and
    covariance (l, l)."""

    weight: float
    mean: Array
    covariance: Array

    @property
    def sd(self) -> Array:
        """Standard deviations (l,)."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


@dataclass(frozen=True)
class Frame:
    """What a structure has about whatever vector its anchor's outputs are linearised.

    Parameters
    ----------
    structure : Structure
    anchor : EstimatedModel
    comparison : Comparison
    unit : ndarray, shape (k,)
        Factors of the columns of the anchor's own effects.
    more, law : ndarray, shape (m, n)
        Columns of other effects as scored, and of a law outside the catalogue.
    effects : tuple of Group
        Columns of each effect among those of all.
    covariances : Covariances
    parts, sizes
        As of :class:`GivenStructure`.
    factors : ndarray, optional
        By which columns of effects grow so that what can be seen of them has unit size; by default
        those about the same vector.
    """

    structure: Structure
    anchor: EstimatedModel
    comparison: Comparison
    unit: Array
    more: Array
    law: Array
    effects: tuple[Group, ...]
    covariances: Covariances
    parts: Sequence[tuple[int, float | None, float]]
    sizes: Array
    factors: Array | None = None

    @classmethod
    def of(
        cls,
        structure: Structure,
        anchor: EstimatedModel,
        comparison: Comparison,
        columns: Columns,
        here: LinearisedModel,
    ) -> Frame:
        """About an anchor, linearised at its estimate."""
        keys = [key for key in structure.effects if key not in anchor.effects]
        groups = [_best_group(columns, key, here.residual, comparison.variance) for key in keys]
        more = [columns.rows[list(group.columns)] for group in groups]
        remainders, sizes = grids_of(comparison, comparison.data.signal(anchor.fit))
        outside = [
            (k, None if j is None else float(remainders.laws[j] ** 2), weight)
            for k, j, weight in remainders.weights[1:]
        ]
        return cls(
            structure,
            anchor,
            comparison,
            comparison.unit(here.own),
            np.concatenate([columns.law[:0], *more]),
            columns.law if structure.outside else columns.law[:0],
            in_a_row([*own_groups(anchor, comparison), *groups], 0),
            remainders.covariances,
            outside if structure.outside else [(0, None, 1.0)],
            fewer(sizes),
        )

    def about(self, here: LinearisedModel, patterns: int | None = None) -> GivenStructure:
        """The structure about a vector of unknowns, with the first patterns of the covariance."""
        products, logs, offset = self._products(here, patterns)
        count, factors = len(here.names), self.factors
        coordinates = Coordinates.of(
            here.priors, here.theta, np.diag(here.change), here.offset[:count]
        )
        if factors is None:
            factors = self._factors(products, logs, offset)
        return GivenStructure(
            here.names,
            coordinates,
            coordinates.place,
            here.change / coordinates.slope[:, None],
            products * factors[:, None] * factors,
            logs,
            in_a_row(self.effects, offset.size),
            len(self.law),
            offset,
            self.parts,
            self.sizes,
            Likelihood(self.comparison.variance.size, self.comparison.freedom),
        )

    def fixed(self, here: LinearisedModel) -> Frame:
        """The same with the factors of one vector wherever outputs are linearised: what is known of
        an effect's size beforehand depends on no parameter."""
        return replace(self, factors=self._factors(*self._products(here, 1)))

    @property
    def units(self) -> Array:
        """Amplitudes (k,) of the anchor's effects by a unit of their coefficients, SI."""
        assert self.factors is not None
        first = self.factors.size - sum(map(len, (self.unit, self.more, self.law)))
        return np.asarray(self.unit * self.factors[first : first + self.unit.size])

    def _products(self, here: LinearisedModel, patterns: int | None) -> tuple[Array, Array, Array]:
        """Products of the residual and all columns, log determinants, and centres of unknowns."""
        shared = self.comparison.shared
        unknowns = np.concatenate([here.unknowns, shared])
        offset = np.concatenate([here.offset, np.zeros(len(shared))])
        rows = [here.residual[None], unknowns, here.own * self.unit[:, None], self.more, self.law]
        return *self.covariances.products(np.concatenate(rows), patterns), offset

    def _factors(self, products: Array, logs: Array, offset: Array) -> Array:
        """Factors of the residual and of all columns."""
        reduced = Reduced.of(products, logs, offset.size, offset)
        seen = visible(reduced, self.effects, self.comparison.data.samples)
        return np.concatenate([np.ones(1 + offset.size), seen])


@dataclass(frozen=True)
class GivenStructure:
    """One structure about its anchor.

    Parameters
    ----------
    products : ndarray, shape (P, 1 + p, 1 + p)
        Of the residual and all columns, by covariance: unknowns, errors of inputs, effects, law.
    logs : ndarray, shape (P,)
        Log determinants.
    coordinates : Coordinates
        Of the parameters.
    theta : ndarray, shape (l,)
        Coordinates of the estimate.
    change : ndarray, shape (l, l)
        Changes of the coordinates (rows) by the unknowns.
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
    coordinates: Coordinates
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
    ) -> GivenStructure:
        """Columns of the anchor, and of the structure's other effects as scored."""
        here = linearised(anchor, comparison.data)
        return Frame.of(structure, anchor, comparison, columns, here).about(here)

    def mixtures(
        self,
        coordinates: Coordinates | None = None,
        normals: Sequence[_Normal] | None = None,
        share: float = 1.0,
    ) -> list[Mixture]:
        """Posterior of each parameter; none if all of it lies outside the limits.

        Parameters
        ----------
        coordinates : Coordinates, optional
            Those of :meth:`bent`.
        normals : sequence, optional
            Those of :meth:`normals`, where they are known.
        share : float
            The structure's part of what is averaged: a light one needs fewer draws.
        """
        normals = normals or self.normals()
        coordinates = coordinates or self.coordinates
        found, logs = [list[Mixture]() for _ in self.names], list[float]()
        for part in normals:
            if coordinates.rough(part.mean, part.sd).any():
                count = _draws_of(share * part.weight)
                values, log = coordinates.draws(part.mean, part.covariance, count)
                total = float(logsumexp(log))
                if not np.isfinite(total):
                    continue  # none of it lies within the limits
                rows = [part_of(np.exp(log - total), own, 0.0, False) for own in values.T]
                logs.append(float(np.log(part.weight / count)) + total)
            else:
                each = zip(part.mean, part.sd, coordinates.logarithmic, strict=True)
                rows = [part_of(1.0, mean, sd, flag) for mean, sd, flag in each]
                logs.append(float(np.log(part.weight)))
            for own, row in zip(found, rows, strict=True):
                own.append(row)
        if not logs:
            return []
        weights = np.exp(np.array(logs) - logsumexp(logs))
        return [
            Mixture.of([one.scaled(w) for one, w in zip(own, weights, strict=True)])
            for own in found
        ]

    def bent(self, fit: ModelFit, normals: Sequence[_Normal]) -> Coordinates:
        """Coordinates in which outputs are linear of what is known poorly, by the anchor's fit."""
        return replace(self.coordinates, power=powers(fit, self.names, self._shift(normals)))

    def poorly(self, mean: Array, sd: Array) -> Flags:
        """Parameters (l,) that range far from their estimates, where the model need not be linear:
        by a part of themselves and of what their priors allow; from the moments of all parts."""
        logarithmic = self.coordinates.logarithmic
        of_prior = np.where(logarithmic, sd, sd / self.coordinates.spread)
        return np.asarray((of_prior > ROUGH) & (logarithmic | (sd > ROUGH * np.abs(mean))))

    def _shift(self, normals: Sequence[_Normal]) -> Array:
        """How far the posterior of each logarithm that is known poorly lies, or reaches, from the
        estimate (l,); zero for the others."""
        mean, sd = moments(normals)
        away = mean - self.theta
        reach = np.maximum(np.abs(away), sd)
        # By as much as of a parameter that outputs are linear in.
        steps = np.where(away < 0.0, -np.minimum(reach, 1.0), np.log1p(reach))
        steps = np.sign(steps) * np.clip(np.abs(steps), *STEPS)
        return np.where(self.coordinates.logarithmic & (sd > ROUGH), steps, 0.0)

    def normals(self) -> list[_Normal]:
        """Normal densities by remainder, sizes and sides of the effects, with their weights."""
        found, best = list[tuple[float, Array, Array]](), -np.inf
        for bound, cell in self._bounds():
            if bound < best + np.log(LIGHTEST) - FAR:
                break
            found += self.each([cell])
            best = max((log for log, _, _ in found), default=-np.inf)
        if not found:
            return []  # no side of an effect is both physical and likely
        logs = np.array([log for log, _, _ in found])
        weights = np.exp(logs - logsumexp(logs))
        return [
            _Normal(float(w), mean, covariance)
            for w, (_, mean, covariance) in zip(weights, found, strict=True)
            if w > LIGHTEST
        ]

    def _bounds(self) -> list[tuple[float, Cell]]:
        """All cells with rough bounds of their log weights, the largest first.

        Errors of inputs and the law are eliminated once for all sizes of the effects. An effect's
        moment is at most that of an amplitude far out in its density.
        """
        found = []
        for part in self.parts:
            reduced, log_det = self._without_others(part[0], part[1])
            for sizes in self._grid():
                cell = (*part, sizes)
                found.append((self._bound(cell, reduced, log_det), cell))
        return sorted(found, key=lambda item: -item[0])

    def _without_others(self, pattern: int, law: float | None) -> tuple[Array, float]:
        """Products of the residual, parameters and effects with all other columns projected out,
        and what these add to the log determinant."""
        count, known = len(self.names), self.offset.size
        end = 1 + known + sum(len(group.columns) for group in self.effects)
        own = np.r_[0 : 1 + count, 1 + known : end]
        others = np.r_[1 + count : 1 + known, end : end + (0 if law is None else self.law)]
        gram = self.products[pattern]
        precision = np.ones(others.size)
        precision[known - count :] = 1.0 if law is None else 1.0 / law
        block, across = gram[np.ix_(others, others)], gram[np.ix_(others, own)]
        root, along = _root_and_solution(block, precision, across)
        log_det = 2 * np.log(np.diag(root)).sum() - np.log(precision).sum()
        return gram[np.ix_(own, own)] - along.T @ along, log_det + float(self.logs[pattern])

    def _bound(self, cell: Cell, reduced: Array, log_det: float) -> float:
        """What the log weight of a cell does not exceed by more than a small part of :data:`FAR`:
        priors of unknowns are not scaled by its noise here."""
        count, known = len(self.names), self.offset.size
        power, precision = self._precision(cell)
        members = reduced.shape[0] - 1 - count
        precision = np.concatenate([precision[:count], precision[known : known + members]])
        centre = np.concatenate([self.offset[:count], np.zeros(members)])
        right = reduced[1:, 0] + precision * centre
        covariance = np.linalg.inv(reduced[1:, 1:] + np.diag(precision))
        mean = covariance @ right
        square = np.array(reduced[0, 0] + precision @ centre**2 - right @ mean)
        own = -np.linalg.slogdet(covariance)[1] - np.log(precision).sum() + log_det
        total = float(self.likelihood(square, own)) + float(np.log(cell[2]))
        root = np.sqrt(float(self.likelihood.noise(square)))
        sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        farthest, start = (np.abs(mean) / root + REACH * sd)[count:] * AMPLER, 0
        for group, variance in zip(self.effects, power, strict=True):
            end = start + len(group.columns)
            total += float(np.log(2.0 * np.mean(farthest[start:end] ** 2) / variance))
            start = end
        return total

    def _grid(self) -> list[tuple[float, ...]]:
        """Sizes of the effects; of more than two one size for all."""
        number = len(self.effects)
        if number <= 2:
            return list(product(self.sizes, repeat=number))
        return [(size,) * number for size in self.sizes]

    def cells(self) -> list[Cell]:
        """All remainders and sizes of the effects."""
        return [(*part, sizes) for part, sizes in product(self.parts, self._grid())]

    def _precision(self, cell: Cell) -> tuple[Array, Array]:
        """Variances of the effects' amplitudes, and precisions of all coefficients."""
        counts = [len(group.columns) for group in self.effects]
        power = moment_power(np.array(cell[3]), np.array(counts))
        law = cell[1]
        return power, np.concatenate([
            np.ones(self.offset.size),
            np.repeat(1.0 / power, counts),
            np.full(0 if law is None else self.law, 1.0 if law is None else 1.0 / law),
        ])  # fmt: skip

    def each(self, cells: Sequence[Cell]) -> Iterator[tuple[float, Array, Array]]:
        """Log weight, means and covariances of the parameters' coordinates."""
        members = [k for group in self.effects for k in group.columns]
        count = len(self.names)
        wanted = np.array([*range(count), *members], dtype=int)
        for cell in cells:
            pattern, _, weight, _ = cell
            power, precision = self._precision(cell)
            log, mean, covariance, noise = self._posterior(pattern, precision, wanted)
            inner, root = covariance[count:, count:], np.sqrt(noise)
            follow = self.change @ covariance[:count, count:] @ np.linalg.inv(inner)
            rest = self.change @ covariance[:count, :count] @ self.change.T
            rest = rest - follow @ inner @ follow.T
            moved = self.theta + self.change @ mean[:count]
            for share, shift, spread in _by_side(self.effects, power, mean[count:] / root, inner):
                here = moved + root * follow @ shift
                spread_out = noise * (rest + follow @ spread @ follow.T)
                yield log + np.log(weight) + share, here, spread_out

    def log_evidence(self, cells: Sequence[Cell], power: Array) -> tuple[float, Array, Array]:
        """Log evidence of some remainders and sizes, under the priors themselves, with means and
        deviations (l,) of the parameters' coordinates under their normal parts.

        Parameters
        ----------
        cells : sequence of Cell
        power : ndarray, shape (l,)
            Of the coordinates in which outputs are linear.

        Returns
        -------
        float
            Minus infinity where data want a sign of an effect that physics forbids; the moments
            are not numbers then.
        ndarray, ndarray
        """
        found = list(self.each(cells))
        if not found:
            nothing = np.full(len(self.names), np.nan)
            return -np.inf, nothing, nothing
        logs = np.array([log for log, _, _ in found])
        _, mean, covariance = found[int(np.argmax(logs))]
        total, sd = float(logsumexp(logs)), np.sqrt(np.maximum(np.diag(covariance), 0.0))
        if self.names:
            total += replace(self.coordinates, power=power).log_ratio(mean, covariance, FEWEST)
        return total, mean, sd

    def expected(self, cell: Cell) -> tuple[Array, Array]:
        """Means of all coefficients, and their covariance, given a remainder and sizes."""
        precision = self._precision(cell)[1]
        every = np.arange(precision.size)
        _, mean, covariance, noise = self._posterior(cell[0], precision, every)
        return mean, noise * covariance

    @property
    def is_finite(self) -> bool:
        """Whether products of columns are numbers; those of a motion that runs away overflow."""
        return bool(np.isfinite(self.products).all())

    def without(self, k: int) -> GivenStructure:
        """The same where one parameter is held."""
        rows = np.delete(np.arange(self.products.shape[1]), 1 + k)
        rest = np.delete(np.arange(len(self.names)), k)
        return replace(
            self,
            names=tuple(self.names[j] for j in rest),
            coordinates=self.coordinates.of_some(rest),
            theta=self.theta[rest],
            change=self.change[np.ix_(rest, rest)],
            products=self.products[:, rows[:, None], rows],
            effects=in_a_row(self.effects, self.offset.size - 1),
            offset=np.delete(self.offset, k),
        )

    def _posterior(
        self, pattern: int, precision: Array, wanted: Integers
    ) -> tuple[float, Array, Array, float]:
        """Log evidence, means and covariance of some coefficients, the latter in units of the
        noise, and its variance over that measured."""
        size = 1 + precision.size
        # What is wanted stands last in the root, whose last rows are all that its moments need.
        order = np.concatenate([np.setdiff1d(np.arange(precision.size), wanted), wanted])
        gram = self.products[pattern, :size, :size]
        inner, cross = gram[1:, 1:][np.ix_(order, order)], gram[1:, 0][order]
        centre = np.zeros(precision.size)
        centre[: self.offset.size] = self.offset
        precision, centre = precision[order], centre[order]

        right = cross + precision * centre
        root, whole = _root_and_solution(inner, precision, right)
        square = np.array(gram[0, 0] + precision @ centre**2 - whole @ whole)
        log_det = 2 * np.log(np.diag(root)).sum() - np.log(precision).sum() + self.logs[pattern]
        log, noise = self.likelihood(square, log_det), float(self.likelihood.noise(square))
        # What is known of an unknown beforehand is not known worse where noise is larger than it
        # was measured.
        precision = np.where(order < self.offset.size, noise, 1.0) * precision
        right = cross + precision * centre
        root, whole = _root_and_solution(inner, precision, right)
        first = order.size - wanted.size
        inverse = solve_triangular(root[first:, first:], np.eye(wanted.size), lower=True)
        return float(log), inverse.T @ whole[first:], inverse.T @ inverse, noise


def _root_and_solution(gram: Array, precision: Array, right: Array) -> tuple[Array, Array]:
    """Lower triangular root ``L`` of products of columns and precisions, and ``L^-1 r``.

    Unknowns differ in size by decades: the matrix is scaled to a unit diagonal before.
    """
    matrix = gram + np.diag(precision)
    scale = np.sqrt(np.diag(matrix))
    least = float(np.min(precision / scale**2, initial=1.0))
    root = scale[:, None] * root_of(matrix / np.outer(scale, scale), least)
    return root, np.asarray(solve_triangular(root, right, lower=True))


def _draws_of(weight: float) -> int:
    """Draws of a part of a posterior, a power of two: draws of all parts weigh about the same."""
    return int(np.clip(2 ** np.ceil(np.log2(weight * OF_ALL)), FEW, MANY))


def moments(normals: Sequence[_Normal]) -> tuple[Array, Array]:
    """Means and deviations (l,) of all parts together, but for the differences of their means."""
    weight = np.array([part.weight for part in normals])
    mean = weight @ np.array([part.mean for part in normals]) / weight.sum()
    sd = np.sqrt(weight @ np.array([part.sd**2 for part in normals]) / weight.sum())
    return mean, sd


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
        from scipy.stats import qmc  # few structures need it, and importing it takes half a second

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
