"""Posteriors that are curved, or of many dimensions, with known moments and exact gradients.

``bent`` is an exponential rise of which only the beginning was measured: amplitude and rate are
known by their product. ``funnel`` and ``wide`` are straight lines in 21 runs whose levels scatter
about a common mean: 25 quantities. Of the funnel the levels are nearly equal and each known badly.
Peers are given the log density of the same quantities, in the coordinates in which they are usually
sampled, written for JAX, which compiles it and its gradient.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import digamma, polygamma

sys.path.insert(0, str(Path(__file__).parents[1] / "posterior"))
from linear_runs import LinearRuns, hierarchical_quadrature, linear_runs

from bayesoleo.estimation._problem import Evaluation, Misfit
from bayesoleo.model._priors import Normal
from bayesoleo.posterior import LogDensity, Mixture, hierarchical, laplace_mixture
from bayesoleo.solvers._orbit import Status

Array = NDArray[np.float64]
#: Log density of a vector in a peer's coordinates, and quantities in natural units from them.
PeerForm = tuple[Callable[[Any], Any], Callable[[Array], Array], Callable[[Array], Array]]
RUNS, COUNT = 21, 20


@dataclass(frozen=True)
class Case:
    """A posterior, its moments, and forms of it for peers.

    Parameters
    ----------
    density : LogDensity
    mixture : Mixture
    mean, sd : ndarray, shape (k,)
        Of the first ``k`` quantities.
    forms : dict
        By name: log density for JAX, natural quantities from coordinates (M, d), and back.
    """

    density: LogDensity
    mixture: Mixture
    mean: Array
    sd: Array
    forms: dict[str, PeerForm]


@dataclass(frozen=True)
class Rise:
    """``a (1 - exp(-b t))`` with normal errors of unknown variance."""

    time: Array
    y: Array

    names = ("a", "b")
    outputs = ("y",)
    runs = ("run 1",)
    priors = (Normal(3.0, 1.5), Normal(0.8, 0.4))
    start = np.array([3.0, 0.8])

    @property
    def counts(self) -> NDArray[np.int64]:
        return np.array([[self.y.size]])

    def evaluate(self, theta: Array) -> Evaluation:
        fall = np.exp(-theta[1] * self.time)
        slope = np.column_stack([1 - fall, theta[0] * self.time * fall])
        return Evaluation((self.y - theta[0] * (1 - fall),), (slope,), Status.CONVERGED)

    def misfit(self, theta: Array) -> Misfit:
        away = self.y + theta[:, :1] * np.expm1(-theta[:, 1:2] * self.time)
        sums = np.sum(away * away, axis=1)
        return Misfit(sums[:, None, None], np.zeros(len(theta), dtype=int))


def bent() -> Case:
    """Rise of amplitude 3 and rate 0.8, measured until 0.6."""
    time = np.linspace(0.0, 0.6, 40)
    noise = 0.1 * np.random.default_rng(5).standard_normal(time.size)
    problem = Rise(time, 3.0 * (1 - np.exp(-0.8 * time)) + noise)
    density = LogDensity(problem)
    mean, sd = _rise_moments(problem)

    def height(x: Any) -> Any:
        import jax.numpy as jnp

        away = problem.y - x[0] * (1 - jnp.exp(-x[1] * time))
        total = -0.5 * time.size * x[2] - 0.5 * jnp.sum(away**2) * jnp.exp(-x[2])
        for k, prior in enumerate(problem.priors):
            total -= 0.5 * ((x[k] - prior.mean) / prior.sd) ** 2
        return total

    forms = {"plain": (height, _same, _same)}
    return Case(density, laplace_mixture(density, problem.start[None]), mean, sd, forms)


def _same(x: Array) -> Array:
    return x


def _rise_moments(problem: Rise) -> tuple[Array, Array]:
    """By quadrature over amplitude and rate; given these, 1 / v has a gamma distribution."""
    a, b = np.linspace(0.2, 10.0, 1201), np.linspace(-0.6, 3.0, 1201)
    half = problem.y.size / 2
    # A sum of squares is quadratic in the amplitude.
    rise = -np.expm1(-b[:, None] * problem.time)
    first, second = rise @ problem.y, np.sum(rise * rise, axis=1)
    sums = problem.y @ problem.y - 2 * a[:, None] * first + a[:, None] ** 2 * second
    log = -half * np.log(sums)
    for k, (prior, values) in enumerate(zip(problem.priors, (a, b), strict=True)):
        log += np.expand_dims(prior.log_density(values), 1 - k)
    weight = np.exp(log - log.max())
    weight /= weight.sum()
    log_v = np.log(sums / 2) - digamma(half)
    quantities = (a[:, None], b[None], log_v)
    mean = np.array([np.sum(weight * q) for q in quantities])
    second_moment = np.array([np.sum(weight * q**2) for q in quantities])
    second_moment[2] += polygamma(1, half)
    return mean, np.sqrt(second_moment - mean**2)


@dataclass(frozen=True)
class ManyRuns(LinearRuns):
    """The same straight lines, all rows and runs at once."""

    def misfit(self, theta: Array) -> Misfit:
        y = np.stack([part[0] for part in self.y])
        wave = np.cos(2 * np.pi * self.times[0])
        away = y - theta[:, :-1, None] - theta[:, -1, None, None] * wave
        sums = np.sum(away * away, axis=2)[:, :, None]
        return Misfit(sums, np.zeros(len(theta), dtype=int))


def runs_case(spread: float, noise: float) -> Case:
    """Straight lines whose levels scatter so much, with so much noise."""
    rng = np.random.default_rng(3)
    levels = 0.5 + spread * rng.standard_normal(RUNS)
    plain = linear_runs(
        [noise * rng.standard_normal((1, COUNT)) for _ in range(RUNS)], levels=levels
    )
    problem = ManyRuns(plain.y, plain.times)
    table = np.concatenate([problem.columns(k) for k in range(RUNS)])
    y = np.concatenate([part[0] for part in problem.y])
    theta = np.linalg.lstsq(table, y)[0]
    density = LogDensity(problem, unknowns=hierarchical(problem, ["level"], theta=theta))
    mean, sd = hierarchical_quadrature(problem, 2 * np.log(noise))
    return Case(density, laplace_mixture(density, theta[None]), mean, sd, _runs_forms(problem))


def _runs_forms(problem: ManyRuns) -> dict[str, PeerForm]:
    """Coordinates (levels, slope, mean, ln spread, ln v), and levels as standard deviations."""
    y = np.stack([part[0] for part in problem.y])
    wave = np.cos(2 * np.pi * problem.times[0])

    def height(levels: Any, rest: Any, of_levels: Any) -> Any:
        import jax.numpy as jnp

        slope, mean, log_spread, log_v = rest
        away = y - levels[:, None] - slope * wave
        total = -0.5 * y.size * log_v - 0.5 * jnp.sum(away**2) * jnp.exp(-log_v)
        total += of_levels - 0.5 * (slope / 10) ** 2 - 0.5 * (mean / 2) ** 2
        return total - 0.5 * (jnp.exp(log_spread) / 2) ** 2 + log_spread

    def centred(x: Any) -> Any:
        import jax.numpy as jnp

        levels, rest = x[:RUNS], x[RUNS:]
        scaled = (levels - rest[1]) * jnp.exp(-rest[2])
        return height(levels, rest, -0.5 * jnp.sum(scaled**2) - RUNS * rest[2])

    def deviations(x: Any) -> Any:
        import jax.numpy as jnp

        z, rest = x[:RUNS], x[RUNS:]
        return height(rest[1] + jnp.exp(rest[2]) * z, rest, -0.5 * jnp.sum(z**2))

    def natural(x: Array) -> Array:
        out = np.array(x)
        out[:, -2] = np.exp(x[:, -2])
        return out

    def back(q: Array) -> Array:
        out = np.array(q)
        out[:, -2] = np.log(q[:, -2])
        return out

    def natural_of_deviations(x: Array) -> Array:
        out = natural(x)
        out[:, :RUNS] = out[:, -3:-2] + out[:, -2:-1] * x[:, :RUNS]
        return out

    def deviations_of(q: Array) -> Array:
        out = back(q)
        out[:, :RUNS] = (q[:, :RUNS] - q[:, -3:-2]) / q[:, -2:-1]
        return out

    return {
        "centred": (centred, natural, back),
        "deviations": (deviations, natural_of_deviations, deviations_of),
    }


#: Cases by name. The funnel's levels do not scatter and are known to 0.45 each; those of ``wide``
#: scatter as much as they are known.
CASES: dict[str, Callable[[], Case]] = {
    "bent": bent,
    "funnel": lambda: runs_case(0.0, 2.0),
    "wide": lambda: runs_case(0.4, 1.0),
}
