"""Density of one parameter on a grid that is finer where the density is.

Each place costs a solution of the model, so that they are few. A cell is halved where the
logarithm of the density may differ from a straight line between its ends, by what the lines of the
neighbouring cells say: of a density whose logarithm is concave they bound it. By their share of the
probability alone, cells would be halved beside a cliff, and not where it stands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import PchipInterpolator

from bayesoleo._types import Array, Flags

#: Places at most, and the part of the probability by which bounds may differ in the end.
MOST, CLOSE = 35, 0.05
#: Logarithm below the largest from which on the density ends, and after how many places in a row
#: that could not be solved the search on one side ends.
FAR, LOST = 14.0, 2
#: Places between one that could not be solved and the last one that could, from which it may be.
HALVINGS = 2
#: Points in each cell between places, and values of equal probability by which a density is kept.
WITHIN, FINE = 32, 400
#: Logarithm by which a density falls between two modes.
DIP = 2.0
#: Distance to a place that cannot be solved, over the range of a parameter, that is near enough.
NEAR = 0.02
#: Largest difference of logarithms that counts.
_FALL = 40.0


@dataclass(frozen=True)
class GridDensity:
    """A density and what is known of its errors.

    Parameters
    ----------
    values : ndarray, shape (FINE,)
        Places of equal probability, in rising order.
    unknown : float
        Part of the probability where nothing could be computed.
    gap : float
        Bound of the part of the probability that straight lines between the places miss.
    modes : int
    """

    values: Array
    unknown: float
    gap: float
    modes: int


def on_a_grid(
    log_prior: Callable[[Array], Array],
    log_evidence: Callable[[float], float],
    centre: float,
    sides: Sequence[Sequence[float]],
) -> GridDensity | None:
    """The density of a parameter.

    Parameters
    ----------
    log_prior : callable
        Logarithm of the prior's density at places (n,).
    log_evidence : callable
        Logarithm of what the data make of a place; NaN where it is not known.
    centre : float
        Where the grid begins.
    sides : sequence of sequence of float
        Places outwards from the centre, on each side; the last ones are the ends of the prior.

    Returns
    -------
    GridDensity or None
        None where next to nothing could be computed.
    """
    grid = _Grid(
        log_prior,
        log_evidence,
        tuple(max(side, key=lambda p: abs(p - centre)) if side else centre for side in sides),
    )
    if not np.isfinite(grid.add(centre)):
        return None
    for side in sides:
        grid.outwards(side)
    while grid.place.size < MOST and (place := grid.next_place()) is not None:
        grid.add(place)
    return grid.density()


class _Grid:
    """Places so far, in rising order, with logarithms of the evidence and of the density."""

    def __init__(
        self,
        log_prior: Callable[[Array], Array],
        log_evidence: Callable[[float], float],
        ends: tuple[float, ...],
    ) -> None:
        self.log_prior, self.log_evidence = log_prior, log_evidence
        self.low, self.high = min(ends), max(ends)
        self.place, self.evidence = np.empty(0), np.empty(0)

    def add(self, place: float) -> float:
        """Compute one more place; the logarithm of its density."""
        return self._kept(place, self.log_evidence(place))

    def _kept(self, place: float, log: float) -> float:
        k = int(np.searchsorted(self.place, place))
        self.place = np.insert(self.place, k, place)
        self.evidence = np.insert(self.evidence, k, log)
        return log + float(self.log_prior(np.array([place]))[0])

    @property
    def known(self) -> Flags:
        """Which places could be computed."""
        return np.isfinite(self.evidence)

    def outwards(self, side: Sequence[float]) -> None:
        """Places on one side until nothing is left of the density, or of the solutions."""
        lost, last = 0, float(self.place[self.known][0 if side and side[0] < self.place[0] else -1])
        for place in side:
            log, near = self.log_evidence(place), last
            for _ in range(HALVINGS):
                if np.isfinite(log):
                    break
                middle = 0.5 * (near + place)
                if np.isfinite(self.add(middle)):
                    near, log = middle, self.log_evidence(place)
            log = self._kept(place, log)
            last, lost = (place, 0) if np.isfinite(log) else (near, lost + 1)
            if lost == LOST or log < self._top() - FAR:
                return

    def _top(self) -> float:
        log = self.evidence + self.log_prior(self.place)
        return float(np.max(log[self.known], initial=-np.inf))

    def next_place(self) -> float | None:
        """The middle of the cell of which least is known; None where all is known well enough."""
        known = self.known
        if known.sum() < 2:
            return None
        gaps = self._gaps()
        largest = int(np.argmax(gaps))
        if gaps.sum() < CLOSE or gaps[largest] <= 0.0:
            return None
        return float(0.5 * (self.place[largest] + self.place[largest + 1]))

    def _gaps(self) -> Array:
        """Part of the probability by which each cell between places may be wrong."""
        place, known = self.place, self.known
        x, h = place[known], (self.evidence + self.log_prior(place))[known]
        h = np.maximum(h - h.max(), -_FALL)
        slope = np.diff(h) / np.diff(x)
        part = (np.arange(WITHIN) + 0.5) / WITHIN
        gaps, total = np.zeros(place.size - 1), 0.0
        index = np.flatnonzero(known)
        for c, (i, j) in enumerate(pairwise(index)):
            chord = h[c] + (h[c + 1] - h[c]) * part
            off = [np.full(WITHIN, _FALL)]
            if c > 0:
                off.append(h[c] + slope[c - 1] * (x[c + 1] - x[c]) * part - chord)
            if c + 2 < x.size:
                off.append(h[c + 1] - slope[c + 1] * (x[c + 1] - x[c]) * (1.0 - part) - chord)
            nearest = np.argmin(np.abs(off), axis=0)
            bound = np.clip(np.array(off)[nearest, np.arange(WITHIN)], -_FALL, _FALL)
            width = (x[c + 1] - x[c]) / WITHIN
            total += float(np.exp(chord).sum()) * width
            gap = (
                float(np.abs(np.exp(np.minimum(chord + bound, _FALL)) - np.exp(chord)).sum())
                * width
            )
            if j == i + 1:
                gaps[int(i)] = gap
            elif gap > 0.0:  # places between them could not be solved: the wider side of these
                k = int(i) if place[i + 1] - place[i] > place[j] - place[j - 1] else int(j) - 1
                gaps[k] = gap
        for edge, end in ((0, self.low), (-1, self.high)):
            if not known[edge]:
                k = int(index[edge]) - (1 if edge == 0 else 0)
                beyond = np.linspace(x[edge], end, WITHIN)
                here = np.array([self.evidence[index[edge]]])
                log = here + self.log_prior(beyond) - self._top()
                if place[k + 1] - place[k] > NEAR * (self.high - self.low):
                    gaps[k] = float(np.exp(log).sum()) * abs(end - x[edge]) / WITHIN
        return gaps / max(total, 1e-300)

    def density(self) -> GridDensity | None:
        """The density by an interpolation of the evidence, times the prior."""
        known = self.known
        if known.sum() < 3:
            return None
        x, log = self.place[known], self.evidence[known]
        fine = [np.linspace(a, b, WITHIN, endpoint=False) for a, b in pairwise(x)]
        inner = np.concatenate([*fine, x[-1:]])
        # Beyond the last place that could be solved the data say what they say there.
        below = np.linspace(self.low, x[0], WITHIN, endpoint=False) if not known[0] else inner[:0]
        above = np.linspace(x[-1], self.high, WITHIN + 1)[1:] if not known[-1] else inner[:0]
        points = np.concatenate([below, inner, above])
        h = PchipInterpolator(x, log)(np.clip(points, x[0], x[-1])) + self.log_prior(points)
        density = np.exp(np.maximum(h - np.max(h[np.isfinite(h)]), -700.0))
        cells = 0.5 * (density[1:] + density[:-1]) * np.diff(points)
        sums = np.concatenate([[0.0], np.cumsum(cells)])
        wanted = (np.arange(FINE) + 0.5) / FINE * sums[-1]
        middle = 0.5 * (points[1:] + points[:-1])
        doubtful = self._doubtful(middle)
        return GridDensity(
            np.interp(wanted, sums, points),
            float(cells[doubtful].sum() / sums[-1]),
            float(self._gaps().sum()),
            _modes(density, cells),
        )

    def _doubtful(self, points: Array) -> Flags:
        """Points nearer to a place that could not be solved than to one that could."""
        nearest = np.argmin(np.abs(points[:, None] - self.place), axis=1)
        return np.asarray(~self.known[nearest])


def _modes(density: Array, cells: Array) -> int:
    """Number of peaks that differ by more than a dip between them, each with some probability."""
    log, count, top, floor = np.log(np.maximum(density, 1e-300)), 0, -np.inf, np.inf
    climbing = True
    for value in log:
        if climbing:
            top = max(top, value)
            if value < top - DIP:
                count, floor, climbing = count + (top > log.max() - 4.0), value, False
        else:
            floor = min(floor, value)
            if value > floor + DIP:
                top, climbing = value, True
    return count + int(climbing and top > log.max() - 4.0)
