"""Densities with known moments."""

from __future__ import annotations

from collections import Counter

import numpy as np


class Gaussian:
    """Normal density over ``d`` independent coordinates with mean zero."""

    runs = ("run 1", "run 2")

    def __init__(self, sd) -> None:
        self.sd = np.asarray(sd, dtype=float)
        self.names = tuple(f"x{a}" for a in range(len(self.sd)))
        self.evaluations = 0
        self.failures: Counter[str] = Counter()

    def natural(self, phi):
        return np.array(phi)

    def __call__(self, phi):
        self.evaluations += len(phi)
        height = np.zeros(len(phi))
        for column, sd in zip(phi.T, self.sd, strict=True):
            height -= 0.5 * (column / sd) ** 2
        return height, np.column_stack([0.25 * height, 0.75 * height])


class Banana(Gaussian):
    """Normal in the first coordinate; the others are normal about its square."""

    def __call__(self, phi):
        straight = np.array(phi)
        straight[:, 1:] -= 0.5 * (phi[:, :1] ** 2 - 1.0)
        return super().__call__(straight)


class BentRidge(Gaussian):
    """Long in its first coordinate, a thirtieth as wide and bent in the second.

    What volume and exponent of a gas spring look like: a straight proposal along the ridge leaves
    it within two standard deviations.
    """

    def __init__(self) -> None:
        super().__init__([1.0, 0.033, 1.0, 1.0])

    def __call__(self, phi):
        straight = np.array(phi)
        straight[:, 1] -= 0.045 * phi[:, 0] ** 2
        return super().__call__(straight)


class Bimodal(Gaussian):
    """Normal about the origin, and about a second place, of another width and with a share."""

    def __init__(self, dimension: int, distance: float, width: float, share: float, seed: int):
        super().__init__(np.ones(dimension))
        direction = np.random.default_rng(seed).standard_normal(dimension)
        self.second = distance * direction / np.linalg.norm(direction)
        self.width, self.share = width, share

    def _heights(self, phi):
        size = phi.shape[-1]
        away = np.sum(((phi - self.second) / self.width) ** 2, axis=-1)
        first = np.log(1 - self.share) - 0.5 * np.sum(phi**2, axis=-1)
        return first, np.log(self.share) - size * np.log(self.width) - 0.5 * away

    def in_second(self, phi):
        """Whether points belong to the second mode."""
        first, second = self._heights(phi)
        return second > first

    def __call__(self, phi):
        self.evaluations += len(phi)
        height = np.logaddexp(*self._heights(phi))
        return height, np.column_stack([0.25 * height, 0.75 * height])
