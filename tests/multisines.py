"""Campaigns of multisine runs, made by NumPy alone; what is between input and output is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesoleo.data import CampaignData, Channel, ReducedCampaign, Run, reduce_campaign

Array = NDArray[np.float64]
#: Odd lines, of each group of four of which one is not excited, chosen at random.
ODD_GRID = tuple(
    int(k)
    for group in np.array_split(np.arange(1, 128, 2), 16)
    for k in np.delete(group, np.random.default_rng(7).integers(group.size))
)
PER_PERIOD, FREQUENCY = 1024, 0.5


def multisine(
    orders: Sequence[int], rng: np.random.Generator, rms: float = 1.0, samples: int = PER_PERIOD
) -> Array:
    """One period with equal amplitudes and random phases."""
    spectrum = np.zeros(samples // 2 + 1, dtype=complex)
    spectrum[list(orders)] = np.exp(2j * np.pi * rng.random(len(orders)))
    size = rms * np.sqrt(0.5 / len(orders)) * samples
    return np.asarray(size * np.fft.irfft(spectrum, samples))


def resonance(u: Array) -> Array:
    """Steady answer of a resonator to one period of an input, and to its repetition."""
    order = np.arange(u.size // 2 + 1)
    ratio = order / 40.0
    return np.fft.irfft(np.fft.rfft(u) / (1.0 - ratio**2 + 0.1j * ratio), u.size)


def run(
    label: str,
    u: Array,
    y: Array,
    rng: np.random.Generator,
    *,
    periods: int = 4,
    noise: float = 0.0,
    input_noise: float = 0.0,
    frequency: float = FREQUENCY,
    **more: object,
) -> Run:
    """A run from one period of input and output, with white noise on both."""
    time = np.arange(periods * u.size) / (u.size * frequency)
    samples = {
        "force": np.tile(u, periods) + input_noise * rng.standard_normal(time.size),
        "displacement": np.tile(y, periods) + noise * rng.standard_normal(time.size),
    }
    rest = {"group": "", "role": "fit", "kind": "periodic", "frequency": frequency, **more}
    return Run(label=label, file="", time=time, samples=samples, **rest)  # type: ignore[arg-type]


def campaign(runs: Sequence[Run], controlled: str | None = "force") -> CampaignData:
    """A campaign in memory."""
    units = {"force": "N", "displacement": "m", "second": "N"}
    channels = {
        name: Channel(name=name, column=name, unit=units[name], si_unit=units[name])
        for name in runs[0].samples
    }
    return CampaignData("multisine", "", controlled, Path(), channels, tuple(runs), "")


def multisine_campaign(
    system: Callable[[Array], Array],
    seed: int = 0,
    *,
    realisations: int = 4,
    orders: Sequence[int] = ODD_GRID,
    levels: Sequence[float] = (1.0,),
    input_noise: float = 1e-4,
    **more: Any,
) -> ReducedCampaign:
    """Realisations of levels; ``system`` answers one period of an input.

    An input without any noise is none that was measured: its rounding errors have no period.
    """
    rng = np.random.default_rng(seed)
    made = []
    for level in levels:
        for number in range(realisations):
            u = multisine(orders, rng, level)
            label, noise = f"{level:g}-{number}", {"input_noise": input_noise, **more}
            made.append(run(label, u, system(u), rng, **noise))
    return reduce_campaign(campaign(made), jobs=1)
