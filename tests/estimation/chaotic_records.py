"""Records of the Lorenz and Rössler systems by an integrator that knows nothing of the package."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

from bayesoleo.prediction._records import Record, transient_record

LORENZ = np.array([10.0, 28.0, 8 / 3])
ROSSLER = np.array([0.2, 0.2, 5.7])
STEP = {"lorenz": 0.05, "rossler": 0.25}


def rates(name: str, theta: np.ndarray, s: np.ndarray) -> np.ndarray:
    """Rates of states ``(3, ...)``."""
    x, y, z = s
    a, b, c = theta
    if name == "lorenz":
        return np.array([a * (y - x), x * (b - z) - y, x * y - c * z])
    return np.array([-y - z, x + a * y, b + z * (x - c)])


@dataclass(frozen=True)
class Chaos:
    """A clean motion on the attractor, from which noisy records of any seed are drawn."""

    name: str
    theta: np.ndarray
    time: np.ndarray
    clean: np.ndarray

    @classmethod
    def of(cls, name: str, samples: int) -> Chaos:
        theta = {"lorenz": LORENZ, "rossler": ROSSLER}[name]
        settled = 60.0
        time = STEP[name] * np.arange(samples)
        motion = solve_ivp(
            lambda _, s: rates(name, theta, s),
            (0.0, settled + time[-1]),
            np.ones(3),
            t_eval=settled + time,
            rtol=1e-11,
            atol=1e-11,
            method="DOP853",
        )
        return cls(name, theta, time, motion.y)

    def record(self, seed: int, channels: str = "xyz", noise: float = 0.05) -> Record:
        """Samples with noise of a part of each channel's spread."""
        rng = np.random.default_rng(seed)
        noisy = self.clean + noise * self.clean.std(axis=1, keepdims=True) * rng.standard_normal(
            self.clean.shape
        )
        return transient_record(self.name, self.time, {c: noisy["xyz".index(c)] for c in channels})

    def start(self, seed: int, spread: float = 0.2) -> np.ndarray:
        """Parameters off by up to a part of their values."""
        rng = np.random.default_rng(1000 + seed)
        return self.theta * (1 + spread * rng.uniform(-1, 1, 3))
