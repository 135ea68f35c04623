"""Experiments repeated by simulation, shared by the page and the command.

The gas spring of Verbeek (1993), section 3.4.2, and one run of the campaign ``shaker-plain``.
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import bayesoleo
from bayesoleo._schema import LabelledResult
from bayesoleo.data import dataset_folder, load_campaign, reduce_campaign
from bayesoleo.discovery import Numerics, fit_model
from bayesoleo.estimation import FunctionProblem, sampling_distribution
from bayesoleo.model import Normal, driven_by

POSITION = np.linspace(0.0, 0.9, 100)
EXPONENT = 1.2
#: 2 sigma is 1 % of full scale.
NOISE = 0.005 * 10**EXPONENT
#: A run of the middle of the campaign's frequencies, and in the high group: all that it can tell.
OLEO_RUN = "d"


@dataclass(frozen=True)
class Timed:
    """A sampling distribution, and what it took.

    Parameters
    ----------
    found : LabelledResult
        The group ``sampling_distribution``.
    seconds, cpu_seconds : float
        Of wall and of all threads.
    """

    found: LabelledResult
    seconds: float
    cpu_seconds: float

    def numbers(self) -> dict[str, float]:
        """How far from theory: bias in its standard errors and in sd, sd over theory's, worst."""
        data = self.found.data
        bias = np.abs(data["bias"])
        return {
            "replications": int(data.attrs["replications"]),
            "converged": int(data.attrs["converged"]),
            "s": self.seconds,
            "cpu_s": self.cpu_seconds,
            "per_cpu_s": data.attrs["replications"] / self.cpu_seconds,
            "largest_bias_over_standard_error": float((bias / data["bias_standard_error"]).max()),
            "largest_bias_over_sd": float((bias / data["sd"]).max()),
            "smallest_sd_over_expected": float((data["sd"] / data["expected_sd"]).min()),
            "largest_sd_over_expected": float((data["sd"] / data["expected_sd"]).max()),
            "smallest_efficiency": float(data["efficiency"].min()),
            "largest_efficiency": float(data["efficiency"].max()),
        }


def gas_spring() -> FunctionProblem:
    """``y = (1 - x)**-theta`` at 100 positions."""

    def force(x: np.ndarray, theta: np.ndarray) -> np.ndarray:
        return (1 - x) ** -theta[0]

    data = force(POSITION, np.array([EXPONENT]))
    return FunctionProblem(force, POSITION, data, [Normal(1.0, 0.1)], ["exponent"])


def repeat_gas_spring(
    replications: int = 10_000, out: str | os.PathLike[str] | None = None, jobs: int | None = None
) -> Timed:
    """Estimate the gas spring again and again."""
    problem = gas_spring()
    return _timed(
        problem, [EXPONENT], replications=replications, variance=[NOISE**2], out=out, jobs=jobs
    )


def repeat_oleo(
    replications: int = 1000, out: str | os.PathLike[str] | None = None, jobs: int | None = None
) -> Timed:
    """Estimate an oleo from one run again and again, with new noise on outputs and input."""
    reduced = reduce_campaign(load_campaign(dataset_folder("shaker-plain")), jobs=jobs)
    model = driven_by(bayesoleo.system("f16n2d2"), "displacement")
    fit = fit_model(model, [reduced.record(OLEO_RUN)], Numerics(jobs=jobs))
    return _timed(fit.problem, fit.point, replications=replications, block=20, out=out, jobs=jobs)


def _timed(problem: object, point: object, **options: object) -> Timed:
    wall, cpu = time.perf_counter(), time.process_time()
    found = sampling_distribution(problem, point, **options)
    return Timed(found, time.perf_counter() - wall, time.process_time() - cpu)


def folder(out: str | None, name: str) -> Path | None:
    """Where the blocks of one of them are kept."""
    return None if out is None else Path(out) / name
