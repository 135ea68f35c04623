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
