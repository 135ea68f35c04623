"""The integrator's loop: steps of chosen or of given lengths, switches, derivatives.

Compiled once for all models: kernels come as addresses, so that the compiled loop is kept on disk
and a new model costs its own kernels only.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.solvers.schemes.elimination import jit
from bayesoleo.solvers.shooting.inner import inner
from bayesoleo.solvers.shooting.march_start import first_sizes, is_inside, starts
from bayesoleo.solvers.shooting.march_step import (
    DEGENERATE,
    FINISHED,
    LENGTH,
    LOST,
    NOT_A_NUMBER,
    OUTSIDE,
    Front,
    advance,
    attempt,
    front_of,
    next_length,
)
from bayesoleo.solvers.shooting.march_switch import exchange, find_switch
from bayesoleo.solvers.shooting.radau_step import Method, Workspace, copy_to
from bayesoleo.solvers.shooting.signals import InputSignal

#: More ways for a march to end than a step's. ``COARSE``: given steps miss the tolerance; ``FULL``:
#: out of memory given.
CHATTERS, COARSE, FULL = 5, 6, 7


class MarchTask(NamedTuple):
    """What one march does.

    Parameters
    ----------
    nodes : ndarray, shape (M + 1,)
        Times to step to, s. With ``adaptive`` only the first and the last count.
    cut : ndarray of bool, shape (M,)
        Steps that are expected to end at a switch before they get there; the next node may then
        lie before theirs.
    adaptive : bool
        Choose the lengths of steps.
    tolerance : float
        Local error of a step, over the size of the state component.
    enough : float
        Stages are solved until what is left is below this, over that size.
    first_step : float
        Length of the first step to be tried, s.
    longest : float
        Longest step, s.
    capacity : int
        Number of steps there is room for.
    dense : bool
        Keep derivatives at all steps, not at the end only.
    """

    nodes: Array
    cut: NDArray[np.bool_]
    adaptive: bool
    tolerance: float
    enough: float
    first_step: float
    longest: float
    capacity: int
    dense: bool


class Path(NamedTuple):
    """Steps taken: ``states (n + 1, D)`` at ``times (n + 1,)``, ``tops (n, s, d)`` and ``modes
    (n, ns)`` within; with derivatives ``by (n + 1, D, C)`` and ``tops_by (n, s d, C)`` of these.
    ``switched (n,)`` marks steps that end at a switch, ``aims (n,)`` where they were to end.
    """

    times: Array
    states: Array
    tops: Array
    modes: Array
    switched: NDArray[np.bool_]
    aims: Array
    by: Array
    tops_by: Array


class Addresses(NamedTuple):
    """Compiled kernels of the equations: where they stand in memory.

    Residuals with their derivatives by ``z``, derivatives by parameters, switching functions, their
    derivatives, and conditions on the admissible region.
    """

    jacobian: int
    parameters: int
    switches: int
    slopes: int
    admissible: int


class System(NamedTuple):
    """What is integrated.

    Parameters
    ----------
    kernels : Addresses
        Of the equations.
    orders : ndarray of int, shape (d,)
        Of the dofs.
    method : Method
        Radau IIA.
    signal : InputSignal
        Inputs.
    p : ndarray, shape (np + ns,)
        Constants, then modes, which a march exchanges.
    modes : ndarray of int, shape (ns,)
        Where in ``p`` the modes are.
    active : int
        Number of derivatives by parameters among those carried.
    conditions : int
        Number of conditions on the admissible region.
    """

    kernels: Addresses
    orders: NDArray[np.int64]
    method: Method
    signal: InputSignal
    p: Array
    modes: NDArray[np.int64]
    active: int
    conditions: int


def march(
    task: MarchTask, start: Array, columns: Array, scale: Array, system: System, work: Workspace
) -> tuple[Path, int, int, int]:
    """Integrate one lane from ``start (D,)`` through ``task.nodes``.

    ``columns (D, C)`` are derivatives at the start, ``system.active`` of them by parameters, and at
    the end on return; ``scale (D,)`` are sizes of the state components, enlarged as they are met.
    Returns a path, its number of steps, the outcome and the number of points evaluated.
    """
    front = front_of(start, columns, scale, system.method.c.size, system.orders.size,
                     system.modes.size, task.first_step)  # fmt: skip
    path = _room(task, front)
    run: Any = _walk  # mypy takes what Numba returns for a function without arguments
    return path, *run(task, system, front, path, work)


def _room(task: MarchTask, front: Front) -> Path:
    n, kept = task.capacity, task.capacity if task.dense else 0
    s, d = front.stages.shape
    D, columns = front.columns.shape
    return Path(
        np.empty(n + 1),
        np.empty((n + 1, D)),
        np.empty((n, s, d)),
        np.empty((n, front.largest.size)),
        np.zeros(n, dtype=np.bool_),
        np.empty(n),
        np.empty((kept + 1, D, columns)),
        np.empty((kept, s * d, columns)),
    )


@jit
def _walk(
    task: MarchTask, system: System, front: Front, path: Path, work: Workspace
) -> tuple[int, int, int]:
    """Step after step to the last node: number of steps, outcome, points."""
    t, end, s = task.nodes[0], task.nodes[-1], system.method.c.size
    shortest = 1e-14 * (end - t + abs(t))
    # Of one type throughout, or all is compiled twice; annotated because it is not Python's int.
    node: Any = np.int64(1)
    n: Any = np.int64(0)
    points, flips, reason = 1, 0, LOST
    if not starts(front, t, task.first_step, system, work):
        inside = is_inside(work.z1, work.u1, 1, system, work)
        return 0, NOT_A_NUMBER if inside else OUTSIDE, points
    first_sizes(front.state, front.rate, front.scale, system.orders, task.first_step)
    _keep(task.dense, front.state, front.columns, path, n, t)
    while t < end:
        if n >= task.capacity:
            return n, FULL, points
        node, aim = _aim(task, front.pace[LENGTH], node, t, shortest)
        h = aim - t
        if h < shortest and aim < end:
            return n, reason, points
        outcome, size, iterations = attempt(
            task.adaptive, task.tolerance, task.enough, system, front, t, h, work
        )
        points += s * (iterations + 1)
        if outcome != FINISHED:
            if not task.adaptive:
                return n, COARSE, points
            reason = outcome
            continue
        switch, length, slope = -1, h, 1.0
        if system.modes.size > 0:
            switch, length, slope = find_switch(task.enough, system, front, t, h, work)
            flips = flips + 1 if switch >= 0 and not (length > 1e-12 * abs(t)) else 0
            if flips > 2 * system.modes.size + 4:
                return n, CHATTERS, points
            if length < 0.0:
                return n, LOST, points
        if length > 0.0:
            if not advance(task.dense, system, front, path, n, length, work):
                return n, DEGENERATE, points
            path.switched[n], path.aims[n] = switch >= 0, aim
            t, n = (aim if switch < 0 else t + length), n + 1
        if switch >= 0:
            if not exchange(system, front, switch, slope, length, t, work):
                return n, NOT_A_NUMBER, points
        elif task.adaptive:
            next_length(front.pace, size, h, s)
        if length > 0.0:
            _keep(task.dense, front.state, front.columns, path, n, t)
            if switch < 0 or (not task.adaptive and task.cut[node - 1]):
                node += 1
    return n, FINISHED, points


@inner
def _aim(task: MarchTask, length: float, node: int, t: float, shortest: float) -> tuple[int, float]:
    """Number of the node ahead and time at which the next step is to end."""
    if not task.adaptive:
        while task.nodes[node] <= t + shortest:
            node += 1
        return node, task.nodes[node]
    h, end = min(length, task.longest), task.nodes[-1]
    return node, end if t + 1.01 * h >= end else t + h


@inner
def _keep(dense: bool, state: Array, columns: Array, path: Path, n: int, t: float) -> None:
    path.times[n] = t
    for j in range(state.size):
        path.states[n, j] = state[j]
    if dense:
        copy_to(columns, path.by[n])
