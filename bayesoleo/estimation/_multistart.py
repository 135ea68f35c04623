"""Estimates from several starts, and the distinct modes to which they lead."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from html import escape

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from bayesoleo import _schema as schema
from bayesoleo._display import columns
from bayesoleo._parallel import thread_map
from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation._estimate import Method, estimate, polish
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.estimation._problem import EstimationProblem
from bayesoleo.model._correlated_priors import sample_of
from bayesoleo.solvers._orbit import count, counted


@dataclass(frozen=True, eq=False, repr=False)
class Modes:
    """Distinct modes of the posterior, the highest first.

    Parameters
    ----------
    modes : tuple of PointEstimate
        Each the best of the estimates that ended there.
    hits : tuple of int
        Number of estimates that ended in each.
    status : dict of str to int
        How all estimates ended, by name.
    """

    modes: tuple[PointEstimate, ...]
    hits: tuple[int, ...]
    status: dict[str, int]

    def __len__(self) -> int:
        return len(self.modes)

    def __iter__(self) -> Iterator[PointEstimate]:
        return iter(self.modes)

    def __getitem__(self, index: int) -> PointEstimate:
        return self.modes[index]

    def to_dataset(self) -> xr.Dataset:
        """``estimate`` and ``sd`` (mode, parameter), ``objective`` and ``hits`` (mode)."""
        names = self.modes[0].names if self.modes else ()
        shape, both = (len(self), len(names)), ("mode", schema.PARAMETER)
        theta = np.array([mode.theta for mode in self]).reshape(shape)
        sd = np.array([mode.sd for mode in self]).reshape(shape)
        unit = {"units": "unit of each parameter"}
        height = np.array([mode.objective for mode in self])
        return xr.Dataset(
            {
                schema.ESTIMATE: (both, theta, {"long_name": "mode of the posterior", **unit}),
                schema.SD: (both, sd, {"long_name": "linearised standard deviation", **unit}),
                schema.OBJECTIVE: ("mode", height, {"long_name": "log posterior"}),
                "hits": (
                    "mode",
                    np.array(self.hits, dtype=np.int64),
                    {"long_name": "estimates that ended there"},
                ),
            },
            coords={schema.PARAMETER: list(names)},
            attrs={"status": json.dumps(self.status)},
        )

    def __str__(self) -> str:
        if not self.modes:
            return f"no mode was found: {counted(self.status)}"
        head = ["mode", *self.modes[0].names, "log posterior", "hits"]
        rows = [
            [str(number), *(f"{v:.6g}" for v in mode.theta), f"{mode.objective:.2f}", str(hits)]
            for number, (mode, hits) in enumerate(zip(self, self.hits, strict=True), start=1)
        ]
        return columns(head, rows)

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>{self.to_dataset()._repr_html_()}"


def multistart(
    problem: EstimationProblem,
    starts: int | ArrayLike = 8,
    rng: np.random.Generator | None = None,
    *,
    distance: float = 0.1,
    tolerance: float = 1e-6,
    max_iterations: int = 50,
    jobs: int | None = 1,
    progress: Callable[[int, PointEstimate], None] | None = None,
) -> Modes:
    """Find the posterior's modes from several starts.

    From each start two ways are gone: MBE followed by BE, which reaches the mode that the data
    want, and BE alone, which also reaches a mode near the prior's centre.

    Parameters
    ----------
    problem : EstimationProblem
    starts : int or array_like, shape (m, l), optional
        Number of starts drawn from the priors, or the starts. The problem's own comes on top.
    rng : numpy.random.Generator, optional
        Draws the starts; needed if ``starts`` is a number above zero.
    distance : float, optional
        Modes nearer than this, in posterior standard deviations, are one.
    tolerance, max_iterations
        As in :func:`~bayesoleo.estimation.estimate`.
    jobs : int, optional
        Threads over starts; None for all cores. The default leaves the threads to the problem.
    progress : callable, optional
        Called with the index and the result of each start that is done.

    Returns
    -------
    Modes
        Empty of modes if no estimate converged; ``status`` tells why.

    Raises
    ------
    InputError
        If ``rng`` is missing, or a given start does not fit.
    """

    def from_start(start: Array, method: Method) -> PointEstimate:
        return estimate(
            problem, method, start=start, tolerance=tolerance, max_iterations=max_iterations
        )

    def both_ways(item: tuple[int, Array]) -> list[PointEstimate]:
        index, start = item
        found, robust = [from_start(start, "be")], from_start(start, "mbe")
        if np.isfinite(robust.objective):
            polished = polish(problem, robust, tolerance=tolerance, max_iterations=max_iterations)
            found.append(polished)
        if progress is not None:
            progress(index, found[-1])
        return found

    begins = enumerate(_starts(problem, starts, rng))
    points = [point for pair in thread_map(both_ways, begins, jobs) for point in pair]
    modes, hits = _merge([point for point in points if point.status.ok], distance)
    return Modes(modes, hits, count([int(point.status) for point in points]))


def _starts(
    problem: EstimationProblem, starts: int | ArrayLike, rng: np.random.Generator | None
) -> list[Array]:
    own = np.array(problem.start, dtype=float)
    if not isinstance(starts, int):
        given = np.array(starts, dtype=float).reshape(-1, own.size)
        return [own, *given]
    if starts < 0:
        raise InputError("number of starts must not be negative", key="starts", value=starts)
    if starts and rng is None:
        raise InputError(
            "drawing starts needs a generator", key="rng", hint="pass numpy.random.default_rng(1)"
        )
    if not starts or rng is None:
        return [own]
    return [own, *sample_of(problem.priors, rng, starts)]


def _merge(
    points: list[PointEstimate], distance: float
) -> tuple[tuple[PointEstimate, ...], tuple[int, ...]]:
    modes: list[PointEstimate] = []
    hits: list[int] = []
    for point in sorted(points, key=lambda point: -point.objective):
        for index, mode in enumerate(modes):
            if _separation(mode, point) < distance:
                hits[index] += 1
                break
        else:
            modes.append(point)
            hits.append(1)
    return tuple(modes), tuple(hits)


def _separation(mode: PointEstimate, other: PointEstimate) -> float:
    """Mahalanobis distance by the higher mode's covariance."""
    away, sd = (other.theta - mode.theta) / mode.sd, mode.sd
    try:
        factor = cho_factor(mode.covariance / np.outer(sd, sd))
    except LinAlgError:
        return float(np.linalg.norm(away))
    return float(np.sqrt(max(0.0, away @ cho_solve(factor, away))))
