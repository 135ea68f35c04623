"""The region of equal fit in one plane of two parameters: its contour and its ellipse.

The contour is drawn along the valley: at values of the first parameter the second is brought to the
valley's floor, and from there the walls are climbed to both sides. So a valley may bend, as that of
a product of parameters does, which rays from the estimate would leave at the first bend.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from bayesoleo._types import Array
from bayesoleo.estimation.objectives.curvature import inverse_scaled
from bayesoleo.estimation.problems.held import Held
from bayesoleo.estimation.uncertainty.drop import LogLikelihoodRatio
from bayesoleo.estimation.uncertainty.profile import ProfileLine
from bayesoleo.estimation.uncertainty.rays import first_crossing

# Least curvature, as part of the prior's: an ellipse stays finite where the data say nothing.
_LEAST_CURVATURE = 1e-4
# How far an open region is drawn, in standard deviations of the prior.
_OPEN_REACH = 4.0


@dataclass(frozen=True)
class Plane:
    """A plane of two parameters; the others keep their estimates, or follow.

    Parameters
    ----------
    drop : LogLikelihoodRatio
        Over the two, or over all parameters.
    pair : tuple of int
        The two, among those of ``drop``.
    block : ndarray, shape (2, 2)
        Curvature in the plane.
    covariance : ndarray, shape (l, l)
        Inverse curvature in the unknowns of ``drop``, with the prior's.
    """

    drop: LogLikelihoodRatio
    pair: tuple[int, int]
    block: Array
    covariance: Array

    @classmethod
    def of(
        cls, drop: LogLikelihoodRatio, matrix: Array, pair: tuple[int, int], profiled: bool
    ) -> Plane:
        """A plane through the estimate.

        Parameters
        ----------
        drop : LogLikelihoodRatio
            Over all parameters.
        matrix : ndarray, shape (l, l)
            Curvature of the objective.
        pair : tuple of int
        profiled : bool
            Whether the other parameters are estimated again at every point.
        """
        index = list(pair)
        others = [k for k in range(len(matrix)) if k not in pair]
        block = matrix[np.ix_(index, index)]
        if profiled and others:
            cross = matrix[np.ix_(index, others)]
            with np.errstate(invalid="ignore"):
                shadow = block - cross @ inverse_scaled(matrix[np.ix_(others, others)]) @ cross.T
            block = shadow if np.isfinite(shadow).all() else block
            return cls(drop, pair, block, _foresight(drop, matrix))
        point, order = drop.point, sorted(index)
        section = Held(drop.problem, point.theta, others)
        inside = replace(point, names=section.names, theta=point.theta[order])
        own = LogLikelihoodRatio(section, inside, drop.kind)
        return cls(
            drop=own,
            pair=(order.index(pair[0]), order.index(pair[1])),
            block=block,
            covariance=_foresight(own, matrix[np.ix_(order, order)]),
        )

    @property
    def centre(self) -> Array:
        """The estimate, shape (2,)."""
        return self.drop.point.theta[list(self.pair)]

    @property
    def spread(self) -> Array:
        """Standard deviations of the two priors, shape (2,)."""
        return np.array([self.drop.problem.priors[k].sd for k in self.pair])

    def ellipse(self, epsilon: float, points: int) -> Array:
        """``1/2 d' H d = epsilon`` (Verbeek 1993, eq. 2.44), shape (points, 2)."""
        scaled = 0.5 * (self.block + self.block.T) * np.outer(self.spread, self.spread)
        values, vectors = np.linalg.eigh(scaled)
        half = np.sqrt(2 * epsilon / np.maximum(values, _LEAST_CURVATURE))
        turn = 2 * np.pi * np.arange(points) / points
        circle = np.stack((np.cos(turn), np.sin(turn)))
        return cast(
            Array, self.centre + (self.spread[:, None] * (vectors @ (half[:, None] * circle))).T
        )

    def half_widths(self, epsilon: float) -> Array:
        """How far the ellipse reaches in either parameter, shape (2,)."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(2 * epsilon * np.diag(inverse_scaled(self.block)))

    def contour(self, epsilon: float, points: int) -> Array:
        """``Phi* - Phi = epsilon`` (Verbeek 1993, eq. 2.43), shape (points, 2), in its order.

        From the lowest value of the first parameter along one wall to the highest and back along
        the other; an end that is open is infinite.
        """
        line = ProfileLine.follow(
            self.drop, self.pair[0], float(np.sqrt(2 * epsilon)), self.covariance
        )
        low, high, is_open = self._reach(line)
        nodes = points // 2
        # Dense towards the ends, where an ellipse turns back.
        x = low + (high - low) * 0.5 * (1 - np.cos(np.pi * np.arange(nodes) / (nodes - 1)))
        floor, fall = self._floor(line, x)
        y = floor[:, self.pair[1]]
        up, down = (self._wall(floor, fall, epsilon, sign) for sign in (1.0, -1.0))
        upper, lower = np.stack((x, y + up), axis=1), np.stack((x, y - down), axis=1)
        for end, unbounded in zip((0, -1), is_open, strict=True):
            if unbounded:
                upper[end] = lower[end] = np.inf
        return np.concatenate((upper, lower[::-1]))

    def _reach(self, line: ProfileLine) -> tuple[float, float, tuple[bool, bool]]:
        """Ends of the region in the first parameter, or of what is drawn; whether it goes on."""
        centre, most = self.centre[0], _OPEN_REACH * self.spread[0]
        ends, is_open = [], []
        support = self.drop.problem.priors[self.pair[0]].support
        for limit, last, edge in zip(
            (line.low, line.high), line.values[[0, -1]], support, strict=True
        ):
            at_edge = bool(np.isfinite(edge) and abs(last - edge) <= 0.01 * abs(centre - edge))
            drawn = float(np.clip(last, centre - most, centre + most))
            ends.append(float(limit) if np.isfinite(limit) else drawn)
            is_open.append(not np.isfinite(limit) and not (at_edge and drawn == last))
        return ends[0], ends[1], (is_open[0], is_open[1])

    def _floor(self, line: ProfileLine, x: Array) -> tuple[Array, Array]:
        """All unknowns along the valley's floor, shape (nodes, l), and the falls there.

        The line knows the floor at its own points; between them a narrow valley may bend away from
        any interpolation.
        """
        floor = np.repeat(line.paths[:1], len(x), axis=0)
        if len(line.values) > 1:
            inside = np.clip(x, line.values[0], line.values[-1])
            floor = PchipInterpolator(line.values, line.paths, axis=0)(inside)
        fall = np.empty(len(x))
        for k, value in enumerate(x):
            floor[k, self.pair[0]] = value
            fall[k], floor[k] = self.drop.profiled(floor[k], [self.pair[0]])
        freeze = getattr(self.drop.problem, "freeze", None)
        if freeze is not None:
            freeze(self.drop.point.theta)
        return floor, fall

    def _wall(self, floor: Array, fall: Array, epsilon: float, sign: float) -> Array:
        """Distance in the second parameter from the floor to the level, shape (nodes,)."""
        second = self.pair[1]
        rest = np.maximum(epsilon - fall, 1e-12 * epsilon)
        curvature = max(self.block[1, 1], _LEAST_CURVATURE / self.spread[1] ** 2)
        expected = np.sqrt(2 * rest / curvature)

        def climb(radius: Array, index: NDArray[np.int64]) -> Array:
            theta = floor[index].copy()
            theta[:, second] += sign * radius * expected[index]
            return (self._falls(theta) - fall[index]) / rest[index]

        return cast(Array, first_crossing(climb, len(floor), 1.0) * expected)

    def _falls(self, theta: Array) -> Array:
        """Fall at points of the plane; the other parameters start from where they stand."""
        if len(self.drop.problem.names) == 2:
            return self.drop(theta)
        return np.array([self.drop.profiled(row, self.pair)[0] for row in theta])


def _foresight(drop: LogLikelihoodRatio, matrix: Array) -> Array:
    """Inverse curvature with the prior's, by which steps are foreseen where the data are silent."""
    precision = np.array([prior.sd**-2 for prior in drop.problem.priors])
    return inverse_scaled(matrix + np.diag(precision))
