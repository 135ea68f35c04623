"""Initial value problems of implicit equations, with derivatives, in compiled steps.

The method is Radau IIA of order five or nine with error control. Derivatives with respect to the
initial state and to parameters come from the same steps and the same linear systems (internal
differentiation), so that they are those of the computed numbers. Kinks and jumps of the equations
are located and stepped to.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesoleo._compiled import PiecewiseEquations
from bayesoleo._types import Array, Bool, Flags, Float
from bayesoleo.errors import InputError, number_of
from bayesoleo.solvers import _march as loop
from bayesoleo.solvers._march import DEGENERATE, FINISHED, LOST, NOT_A_NUMBER, OUTSIDE
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._radau_step import radau_method, workspace
from bayesoleo.solvers._switching import InputSignal

#: Room for steps at first; more is made where it does not do.
CAPACITY = 1024
STATUS = {
    FINISHED: Status.CONVERGED,
    LOST: Status.NO_CONVERGENCE,
    OUTSIDE: Status.INADMISSIBLE,
    NOT_A_NUMBER: Status.NOT_FINITE,
    DEGENERATE: Status.SINGULAR,
    loop.CHATTERS: Status.NO_CONVERGENCE,
    loop.COARSE: Status.NO_CONVERGENCE,
}


@dataclass(frozen=True)
class Dynamics:
    """Equations of motion under given inputs, as analytic pieces.

    Parameters
    ----------
    kernels : PiecewiseEquations
        Their last constants are the modes of the switching functions.
    orders : tuple of int
        Order (1 or 2) of each dof.
    signal : InputSignal
        Inputs and their derivatives in time.
    active : int
        Number of parameters with derivatives.
    conditions : int
        Number of conditions on the admissible region.
    switches : int
        Number of switching functions.
    """

    kernels: PiecewiseEquations
    orders: tuple[int, ...]
    signal: InputSignal
    active: int
    conditions: int = 0
    switches: int = 0

    @property
    def size(self) -> int:
        """Number D of state components."""
        return sum(self.orders)

    def addresses(self) -> loop.Addresses:
        """The kernels as the compiled integrator takes them."""
        k = self.kernels
        used = (k.jacobian, k.parameters, k.output, k.output_jacobian, k.admissible)
        return loop.Addresses(*(kernel.address for kernel in used))


@dataclass(frozen=True, eq=False)
class DenseTrajectory:
    """A motion of one parameter vector in steps, with derivatives if asked for.

    Parameters
    ----------
    times : ndarray, shape (n + 1,)
        Where steps begin and end, s.
    states : ndarray, shape (n + 1, D)
        Value, and velocity of a second-order dof, of each dof in turn; SI.
    tops : ndarray, shape (n, s, d)
        Highest derivatives at the stages.
    switched : ndarray of bool, shape (n,)
        Steps that end where the equations switch.
    aims : ndarray, shape (n,)
        Where steps were to end, s.
    derivatives : ndarray, shape (D, C)
        Of the last state.
    by, tops_by : ndarray, shapes (n + 1, D, C) and (n, s d, C)
        Of all of them; empty unless asked for.
    scale : ndarray, shape (D,)
        Sizes of the state components.
    status : Status
        Unless ``CONVERGED`` the motion ends where it could not go on.
    evaluations : int
        Points at which the equations were evaluated.
    orders : tuple of int
        Of the dofs.
    coarse : bool
        The given steps were too long.
    """

    times: Float[Array, " nodes"]
    states: Float[Array, "nodes states"]
    tops: Float[Array, "steps stages dofs"]
    switched: Bool[Flags, " steps"]
    aims: Float[Array, " steps"]
    derivatives: Float[Array, "states columns"]
    by: Array
    tops_by: Array
    scale: Float[Array, " states"]
    status: Status
    evaluations: int
    orders: tuple[int, ...]
    coarse: bool = False

    @property
    def mesh(self) -> Array:
        """Where the steps were to end, from the first time on: to integrate again in the same steps
        from a start nearby, of which ``switched`` are expected to be cut short.
        """
        return np.concatenate([self.times[:1], self.aims])

    def sample(self, times: Array) -> Array:
        """Values and derivatives ``(nz, N)`` of all dofs at times in s."""
        return self._evaluate(times, self.states[:, :, None], self.tops[..., None])[:, 0]

    def sample_derivatives(self, times: Array) -> Array:
        """Derivatives ``(nz, C, N)`` of what :meth:`sample` returns."""
        n, s, d = self.tops.shape
        return self._evaluate(times, self.by, self.tops_by.reshape(n, s, d, -1))

    def _evaluate(self, times: Array, states: Array, tops: Array) -> Array:
        """Rows ``(nz, C, N)`` from states ``(n + 1, D, C)`` and stages ``(n, s, d, C)``."""
        n, s, _, _ = tops.shape
        lagrange = radau_method(s).lagrange
        index = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, n - 1)
        h = self.times[index + 1] - self.times[index]
        x = (times - self.times[index]) / h
        k = np.arange(s)
        powers = x[:, None] ** k
        once, twice = powers * x[:, None] / (k + 1), powers * x[:, None] ** 2
        weights = [
            powers @ lagrange.T,
            h[:, None] * (once @ lagrange.T),
            h[:, None] ** 2 * ((twice / ((k + 1) * (k + 2))) @ lagrange.T),
        ]
        rows, first = [], 0
        for j, order in enumerate(self.orders):
            integrals = [np.einsum("ns,nsc->cn", w, tops[index, :, j]) for w in weights]
            low = np.moveaxis(states[index, first : first + order], 0, 2)
            if order == 1:
                rows += [low[0] + integrals[1], integrals[0]]
            else:
                value = low[0] + h * x * low[1] + integrals[2]
                rows += [value, low[1] + integrals[1], integrals[0]]
            first += order
        return np.stack(rows)


def solve_initial_value(
    dynamics: Dynamics,
    p: Array,
    start: Array,
    times: Array,
    *,
    tolerance: float = 1e-8,
    stages: int = 3,
    cut: Flags | None = None,
    adaptive: bool = True,
    columns: Array | None = None,
    by_parameter: bool = False,
    dense: bool = False,
    scale: Array | None = None,
    first_step: float | None = None,
    longest_step: float | None = None,
    most_steps: int = 1_000_000,
    exact: bool = True,
) -> DenseTrajectory:
    """Integrate one parameter vector from a start.

    Parameters
    ----------
    dynamics : Dynamics
        Equations and inputs.
    p : ndarray, shape (np,)
        Constants, without modes.
    start : ndarray, shape (D,)
        State at the first time.
    times : ndarray, shape (M + 1,)
        First and last time, s; what is between are ends of steps if not ``adaptive``.
    tolerance : float
        Local error of a step over the size of each state component.
    stages : {3, 5}
        Order five or nine.
    cut : ndarray of bool, shape (M,), optional
        Of the steps between ``times``, those expected to be cut short by a switch.
    adaptive : bool
        Choose steps, or go by ``times``.
    columns : ndarray, shape (D, C), optional
        Derivatives of the start; none by default. With ``by_parameter`` the last
        ``dynamics.active`` of them are by the active parameters.
    by_parameter : bool
        Whether they are.
    dense : bool
        Keep derivatives at all times.
    scale : ndarray, shape (D,), optional
        Sizes of the state components so far known.
    first_step : float, optional
        First step to be tried, s.
    longest_step : float, optional
        Longest step, s, where steps are chosen.
    most_steps : int
        Number of steps at which the integration has failed.
    exact : bool
        Solve stages to round-off, so that derivatives are exact too.

    Returns
    -------
    DenseTrajectory

    Raises
    ------
    InputError
        If shapes do not fit, or times do not rise.

    References
    ----------
    Hairer, E. and Wanner, G. (1996). Solving Ordinary Differential Equations II, 2nd ed., section
    IV.8. Bock, H. G. (1983) for internal differentiation.
    """
    _check(dynamics, start, times, stages)
    span = times[-1] - times[0]
    longest = span if longest_step is None else longest_step
    first = span / 100 if first_step is None else first_step
    sizes = np.full(dynamics.size, 1e-30) if scale is None else np.array(scale, dtype=float)
    if scale is None:
        _first_sizes(dynamics, start, first, sizes)
    capacity = CAPACITY if adaptive else times.size + 64
    while True:
        flags = np.zeros(times.size - 1, dtype=np.bool_) if cut is None else cut
        task = loop.MarchTask(
            np.array(times, dtype=float), flags, adaptive, tolerance,
            1e-13 if exact else 1e-2 * tolerance, min(first, longest), longest, capacity, dense,
        )  # fmt: skip
        kept = np.zeros((dynamics.size, 0)) if columns is None else np.array(columns, order="C")
        size = sizes.copy()
        path, n, outcome, evaluations = _run(
            dynamics, p, start, task, kept, size, stages, by_parameter
        )
        if outcome != loop.FULL or capacity >= most_steps:
            break
        capacity = min(4 * capacity, most_steps)
    few = n if dense else 0
    return DenseTrajectory(
        path.times[: n + 1].copy(), path.states[: n + 1].copy(), path.tops[:n].copy(),
        path.switched[:n].copy(), path.aims[:n].copy(), kept, path.by[: few + 1].copy(),
        path.tops_by[:few].copy(), size,
        STATUS.get(outcome, Status.NO_CONVERGENCE), evaluations, dynamics.orders,
        outcome == loop.COARSE,
    )  # fmt: skip


def _first_sizes(dynamics: Dynamics, start: Array, step: float, sizes: Array) -> None:
    """A state's own size stands for its change until it has changed; at rest, its rate's."""
    sizes[:] = np.maximum(sizes, 1e-3 * np.abs(start))
    first = 0
    for order in dynamics.orders:
        if order == 2:
            sizes[first] = max(sizes[first], step * abs(start[first + 1]))
            sizes[first + 1] = max(sizes[first + 1], 1e-3 * abs(start[first]) / step)
        first += order


def _run(
    dynamics: Dynamics, p: Array, start: Array, task: loop.MarchTask, columns: Array, scale: Array,
    stages: int, by_parameter: bool,
) -> tuple[loop.Path, int, int, int]:  # fmt: skip
    constants = np.concatenate([p, np.ones(dynamics.switches + 1)])
    system = loop.System(
        dynamics.addresses(), np.array(dynamics.orders, dtype=np.int64), radau_method(stages),
        dynamics.signal, constants,
        np.arange(p.size, p.size + dynamics.switches, dtype=np.int64),
        dynamics.active if by_parameter else 0, dynamics.conditions,
    )  # fmt: skip
    work = workspace(
        stages, dynamics.orders, dynamics.signal.cosine.shape[0], dynamics.active,
        dynamics.conditions, dynamics.switches,
    )  # fmt: skip
    return loop.march(task, np.array(start, dtype=float), columns, scale, system, work)


def _check(dynamics: Dynamics, start: Array, times: Array, stages: int) -> None:
    if stages not in (3, 5):
        raise InputError("no such method", key="stages", value=stages, hint="use 3 or 5")
    if start.shape != (dynamics.size,):
        numbers = number_of(dynamics.size, "number")
        hint = f"give {numbers}: each dof's value, and its velocity at second order"
        raise InputError("the start does not fit", key="start", value=start.shape, hint=hint)
    if times.size < 2 or not times[-1] > times[0]:
        raise InputError("times must rise", key="times", value=times[:4], hint="give two or more")
