"""Changes of the outputs by unnamed functions: what a law outside the catalogue may look like.

A law that has no name still acts alike in all runs. It is represented by a smooth function of one
quantity of the model, by itself, times the velocity, or by direction of motion, in each balance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial

import numpy as np

from bayesoleo._parallel import thread_map
from bayesoleo._types import Array
from bayesoleo.discovery._assembly import Assembly
from bayesoleo.discovery._nonparametric_quantities import Forced, Motions, quantities_of
from bayesoleo.discovery._nonparametric_search import coarser
from bayesoleo.discovery._score_basis import Base
from bayesoleo.effects._nonparametric import Axis, balance_places
from bayesoleo.errors import ModelError
from bayesoleo.solvers._orbit import Status

#: Pieces of the splines: a curve is either fine or coarse.
FINE, COARSE = 16, 4
#: Part of the largest velocity within which a change of direction takes place.
TURNING = 0.02
_VELOCITY = "velocity of "

#: What a curve is of, and its balance.
CurveKey = tuple[str, str]
_Courses = Callable[[int, Array], Array]


def curves_of(
    base: Base, assembly: Assembly, jobs: int | None = None
) -> dict[CurveKey, tuple[Array, ...]]:
    """Changes of the outputs by the splines of each curve, fine and coarse.

    Parameters
    ----------
    base : Base
        The present model at its estimate.
    assembly : Assembly
        The same, with its drive.
    jobs : int, optional
        Threads.

    Returns
    -------
    dict of (curve, balance) to tuple of ndarray, shape (K, n)
        On the lines of :class:`~bayesoleo.discovery._spectral_data.SpectralData`, per unit of each
        spline. Balances that could not be solved are left out.
    """
    motions = Motions(base.fit, assembly, quantities_of(assembly.native))
    axes = dict(motions.axes({}))
    places: list[tuple[str, str, Forced, _Courses]] = []
    for target in balance_places(assembly.native):
        try:
            forced = Forced(base.fit, assembly, target)
        except ModelError:
            continue  # nothing is left to solve for with a term there
        places += [(name, target, forced, courses) for name, courses in _curves(motions, axes)]
    found = thread_map(lambda place: _columns(base, place[2], place[3]), places, jobs)
    return {
        (name, target): (fine, coarser(1, COARSE, FINE).T @ fine)
        for (name, target, *_), fine in zip(places, found, strict=True)
        if fine is not None
    }


def _columns(base: Base, forced: Forced, courses: _Courses) -> Array | None:
    """Changes of the outputs by each spline (K, n); None where they could not be solved for."""
    assert base.data is not None
    by_run = []
    for r in range(len(base.runs)):
        found = forced.responses(r, partial(courses, r))
        if isinstance(found, Status) or not np.isfinite(found).all():
            return None
        by_run.append(found)
    return base.data.columns(by_run)


def _curves(motions: Motions, axes: Mapping[int, Axis]) -> Iterator[tuple[str, _Courses]]:
    """Functions by name, each as its splines (K, N) in a run at phases (N,)."""
    number = {axis.name: k for k, axis in axes.items()}

    def spline(k: int) -> _Courses:
        return lambda r, phase: axes[k].basis(motions.at(r, k, phase), FINE)

    def times(courses: _Courses, factor: _Courses) -> _Courses:
        return lambda r, phase: courses(r, phase) * factor(r, phase)

    for k, axis in axes.items():
        yield axis.name, spline(k)
        moving = number.get(f"{_VELOCITY}{axis.name}")
        if moving is None:
            continue
        largest = max(abs(axes[moving].low), abs(axes[moving].high))
        middle, half = 0.5 * (axis.low + axis.high), 0.5 * (axis.high - axis.low)

        def speed(r: int, phase: Array, of: int = moving, unit: float = largest) -> Array:
            return motions.at(r, of, phase) / unit

        def direction(r: int, phase: Array, of: int = moving, unit: float = largest) -> Array:
            return np.tanh(motions.at(r, of, phase) / (TURNING * unit))

        def place(
            r: int, phase: Array, of: int = k, zero: float = middle, unit: float = half
        ) -> Array:
            return (motions.at(r, of, phase) - zero) / unit

        yield f"{axis.name} times velocity", times(spline(k), speed)
        yield f"{axis.name} by direction", times(spline(k), direction)
        yield f"{axes[moving].name} times position", times(spline(moving), place)
