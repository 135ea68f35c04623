"""Records of two strange attractors and what fifty of each say, for the page ``plot_chaos.py``."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import version

import numpy as np
from scipy.integrate import solve_ivp

from bayesoleo import system
from bayesoleo.estimation import multiple_shooting
from bayesoleo.prediction import Record, transient_record

SEEDS, SAMPLES = 50, 401
#: Noise over the spread of each component, and how far off the parameters start at most.
NOISE, AWAY = 0.05, 0.2
#: What is measured.
CASES = (("lorenz", "xyz"), ("lorenz", "x"), ("rossler", "xyz"), ("rossler", "y"))
#: Multiple shooting, on all meshes together, needs fewer iterations than single shooting is given.
ITERATIONS = 50


def lorenz(_, state, sigma=10.0, rho=28.0, beta=8 / 3):
    """Rates of the Lorenz system."""
    x, y, z = state
    return [sigma * (y - x), x * (rho - z) - y, x * y - beta * z]


def rossler(_, state, a=0.2, b=0.2, c=5.7):
    """Rates of the Rössler system."""
    x, y, z = state
    return [-y - z, x + a * y, b + z * (x - c)]


RATES = {"lorenz": lorenz, "rossler": rossler}
STEP = {"lorenz": 0.05, "rossler": 0.25}


@dataclass(frozen=True)
class Attractor:
    """A motion on an attractor, from which noisy records of any seed are drawn.

    Parameters
    ----------
    name : str
        Of the declared system.
    time, motion : ndarray, shapes (n,) and (3, n)
        Without noise, by an integrator of SciPy's.
    """

    name: str
    time: np.ndarray
    motion: np.ndarray

    @classmethod
    def of(cls, name: str) -> Attractor:
        """After the transient from a start off the attractor has died out."""
        time = STEP[name] * np.arange(SAMPLES)
        way = solve_ivp(
            RATES[name], (0, 60 + time[-1]), [1.0, 1.0, 1.0], method="DOP853",
            t_eval=60 + time, rtol=1e-11, atol=1e-11,
        )  # fmt: skip
        return cls(name, time, way.y)

    def record(self, seed: int, channels: str = "xyz") -> Record:
        """Samples of some components with noise."""
        noise = NOISE * self.motion.std(axis=1, keepdims=True)
        noisy = self.motion + noise * np.random.default_rng(seed).standard_normal(self.motion.shape)
        return transient_record(self.name, self.time, {c: noisy["xyz".index(c)] for c in channels})

    def start(self, seed: int) -> np.ndarray:
        """Parameters to begin with."""
        away = np.random.default_rng([seed, 1]).uniform(-AWAY, AWAY, 3)
        return truth(self.name) * (1 + away)


@dataclass(frozen=True)
class Spread:
    """Estimates from fifty records.

    Parameters
    ----------
    theta, sd : ndarray, shape (50, 3)
    converged : ndarray of bool, shape (50,)
    """

    theta: np.ndarray
    sd: np.ndarray
    converged: np.ndarray


def spread(attractor: Attractor, channels: str, **options) -> Spread:
    """Fit the records of fifty seeds."""
    found = [
        multiple_shooting(
            system(attractor.name),
            [attractor.record(seed, channels)],
            start=attractor.start(seed),
            **options,
        ).point
        for seed in range(SEEDS)
    ]
    return Spread(
        np.array([point.theta for point in found]),
        np.array([np.sqrt(np.diag(point.covariance_likelihood)) for point in found]),
        np.array([point.status.ok for point in found]),
    )


def every_spread() -> dict[tuple[str, str, str], Spread]:
    """By system, components and way: all cases by multiple shooting, all components by single."""
    attractors = {name: Attractor.of(name) for name in RATES}
    table = {}
    for name, channels in CASES:
        table[name, channels, "multiple"] = spread(attractors[name], channels)
    for name in RATES:
        one = {"interval": np.inf, "steps": SAMPLES - 1, "max_iterations": ITERATIONS}
        table[name, "xyz", "single"] = spread(attractors[name], "xyz", **one)
    return table


def truth(name: str) -> np.ndarray:
    """Parameters of the motions, shape (3,)."""
    return np.array([item.value for item in system(name).parameters.values()])


def print_spread(table: dict[tuple[str, str, str], Spread]) -> None:
    """What fifty records say of each parameter, and what made the table."""
    print(
        "system   measured   shooting  converged  largest |error|/se  rms error/se  largest error"
    )
    for (name, channels, way), found in table.items():
        error = found.theta - truth(name)
        relative = np.abs(error / truth(name)).max()
        cells = f"{name:8} {', '.join(channels):10} {way:8} {found.converged.sum():7} of {SEEDS}"
        z = error / found.sd
        scores = f"{np.abs(z).max():18.2f} {np.sqrt(np.mean(z**2)):14.2f}"
        if way == "single":
            scores = f"{'-':>18} {'-':>14}"
        print(f"{cells}{scores} {100 * relative:13.3g} %")
    print(
        f"noise {100 * NOISE:g} % of the spread, {SAMPLES} samples, starts up to {100 * AWAY:g} % "
        f"off, seeds 0 to {SEEDS - 1}; bayesoleo {version('bayesoleo')};\n"
        "BAYESOLEO_STORE_FIGURES=1 PYTHONPATH=studies python studies/4_solvers/plot_chaos.py"
    )
