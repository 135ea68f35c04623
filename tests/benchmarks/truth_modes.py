"""Whether a sampler that starts in one of two modes finds the other, or says that it did not.

Five densities with two modes, by twenty seeds each, with default settings: normal modes in one to
five coordinates, near and far, of equal and of unequal widths and weights, and the posterior of a
model whose parameter enters by its square. The walkers' start knows one mode. The weights of the
modes are known exactly, or by quadrature.

Of an estimate with a standard error one in twenty is beyond two of them, whatever is right; that
part is ``modes_beyond_two_errors``. A mode counts as *missed* if the run says that its effective
size was reached while the mode's weight is off by more than four standard errors: a mode without a
single draw is off by thirty.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayesoleo.estimation import FunctionProblem
from bayesoleo.model import Normal
from bayesoleo.posterior import LogDensity, Mixture, Samples, laplace_mixture, sample

Array = np.ndarray
SEEDS = 20
#: Standard errors beyond which a weight is wrong, and those that one in twenty exceeds by chance.
WRONG, USUAL = 4.0, 2.0


class TwoNormals:
    """A normal density about the origin, another one some way off."""

    runs = ("run",)

    def __init__(self, size: int, distance: float, width: float, share: float, seed: int):
        direction = np.random.default_rng([seed, size]).standard_normal(size)
        self.second = distance * direction / np.linalg.norm(direction)
        self.width, self.share = width, share
        self.names = tuple(f"x{k}" for k in range(size))
        self.evaluations, self.failures = 0, Counter[str]()

    def heights(self, phi: Array) -> tuple[Array, Array]:
        """Log density of either part."""
        away = np.sum(((phi - self.second) / self.width) ** 2, axis=-1)
        volume = len(self.names) * np.log(self.width)
        first = np.log(1 - self.share) - 0.5 * np.sum(phi**2, axis=-1)
        return first, np.log(self.share) - volume - 0.5 * away

    def natural(self, phi: Array) -> Array:
        return np.array(phi)

    def __call__(self, phi: Array) -> tuple[Array, Array]:
        self.evaluations += len(phi)
        height = np.logaddexp(*self.heights(phi))
        return height, height[:, None]


@dataclass(frozen=True)
class Outcome:
    """A run's weight of the second mode, in standard errors from the truth."""

    reached: bool
    off: float
    evaluations: int


def outcome(samples: Samples, inside: Array, share: float) -> Outcome:
    """Compare the draws in the second mode with its share."""
    error = np.sqrt(share * (1 - share) / samples.effective_size.min())
    return Outcome(samples.reached, float((inside.mean() - share) / error), samples.evaluations)


def normals(size: int, distance: float, width: float, share: float) -> Callable[[int], Outcome]:
    """Two normal modes, the start at the first."""

    def run(seed: int) -> Outcome:
        target = TwoNormals(size, distance, width, share, seed)
        start = Mixture(np.zeros((1, size)), np.eye(size)[None], np.zeros(1))
        samples = sample(target, start, seed=seed, progress=False)
        first, second = target.heights(samples.draws)
        return outcome(samples, second > first, share)

    return run


def squared(seed: int) -> Outcome:
    """``y = a**2 x`` with a prior that prefers neither sign much."""
    rng, x = np.random.default_rng([seed, 99]), np.linspace(0.0, 1.0, 40)
    noise, prior = 0.3, Normal(0.3, 1.0)
    y = 1.44 * x + noise * rng.standard_normal(x.size)
    problem = FunctionProblem(lambda at, t: t[0] ** 2 * at, x, y, [prior], ["a"])
    density = LogDensity(problem)
    samples = sample(density, laplace_mixture(density, np.array([[1.2]])), seed=seed,
                     progress=False)  # fmt: skip
    a, log_v = np.linspace(-2.5, 2.5, 2001), np.linspace(-5.0, 1.0, 401)
    squares = np.array([np.sum((y - t**2 * x) ** 2) for t in a])
    height = (
        -0.5 * x.size * log_v - 0.5 * squares[:, None] / np.exp(log_v)
        - 0.5 * ((a[:, None] - 0.3) / 1.0) ** 2
    )  # fmt: skip
    weight = np.exp(height - height.max()).sum(axis=1)
    return outcome(samples, samples.theta < 0, float(weight[a < 0].sum() / weight.sum()))


TARGETS: dict[str, Callable[[int], Outcome]] = {
    "two coordinates, 10 apart, 0.3": normals(2, 10.0, 1.0, 0.3),
    "a squared parameter": squared,
    "one coordinate, 6 apart": normals(1, 6.0, 1.0, 0.5),
    "five coordinates, 100 apart": normals(5, 100.0, 1.0, 0.5),
    "five coordinates, 20 apart, twice as wide": normals(5, 20.0, 2.0, 0.2),
}


def figures(fraction: float = 1.0, say: Callable[[str], object] = print) -> dict[str, float]:
    """Count the runs that miss a mode and say that they are done.

    Parameters
    ----------
    fraction : float
        Part of the seeds of each target.
    say : callable
        Told each target.

    Returns
    -------
    dict of str to float
        ``modes_missed``, ``mode_runs``, ``mode_runs_reached``, ``modes_beyond_two_errors`` (part of
        the runs that were reached), ``mode_worst_errors`` and ``mode_evaluations`` (mean).
    """
    done: list[Outcome] = []
    for name, run in TARGETS.items():
        found = [run(seed) for seed in range(max(1, round(fraction * SEEDS)))]
        off = [abs(one.off) for one in found if one.reached]
        worst = max(off, default=0.0)
        say(f"{name:45} reached {len(off)} of {len(found)}, worst {worst:.1f} errors")
        done += found
    off = np.array([abs(one.off) for one in done if one.reached])
    return {
        "modes_missed": float(np.sum(off > WRONG)),
        "mode_runs": float(len(done)),
        "mode_runs_reached": float(off.size),
        "modes_beyond_two_errors": float(np.mean(off > USUAL)) if off.size else 0.0,
        "mode_worst_errors": float(off.max(initial=0.0)),
        "mode_evaluations": float(np.mean([one.evaluations for one in done])),
    }


if __name__ == "__main__":
    print(figures())
