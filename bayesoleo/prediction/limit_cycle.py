"""The limit cycle of a model without input, with its period."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from scipy.integrate import solve_ivp

from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.model import Model
from bayesoleo.model.kernels import kernels
from bayesoleo.prediction.branch import collocation_scheme
from bayesoleo.solvers.branches.autonomous import LimitCycle, solve_limit_cycle, with_error
from bayesoleo.solvers.periodic.solve import Boundary
from bayesoleo.solvers.schemes.choose import DEFAULT_SCHEME
from bayesoleo.solvers.transient.state_space import StateSpace

#: Of the motion towards a limit cycle, which only has to start Newton's method.
RELATIVE_TOLERANCE = 1e-8


def limit_cycle(
    model: Model,
    start: Mapping[str, float],
    settle: float,
    values: Mapping[str, float] | None = None,
    *,
    period: float | None = None,
    steps: int = 512,
    scheme_name: str = DEFAULT_SCHEME,
    backend: str = "numpy",
) -> LimitCycle:
    """The limit cycle to which a motion settles, or near which it starts, with inputs at zero.

    Parameters
    ----------
    model : Model
    start : mapping of str to float
        Where dofs start; those not given at zero. ``dot(x)`` is the velocity of a second-order dof.
    settle : float
        Time after which the motion is near the cycle, s; at least a few periods.
    values : mapping of str to float, optional
        Parameters that are not at their nominal value.
    period : float, optional
        Of an unstable cycle, about, s: nothing settles to it. The motion over that time from where
        it is after ``settle`` then begins the iteration.
    steps : int
        Of the mesh.
    scheme_name : str
        A collocation scheme.
    backend : {"numpy", "numba"}

    Returns
    -------
    LimitCycle
        With its period, multipliers, and the period's derivatives by the estimated parameters; its
        ``orbit.error`` is what halving the steps changes.

    Raises
    ------
    InputError
        If a dof is unknown, or the motion does not come back after the settling time.
    """
    compiled = kernels(model, model.estimated(), backend)
    derived = compiled.derived
    known = {str(item): value for item, value in model.nominal().items()} | dict(values or {})
    p = np.array([known[name] for name in derived.constants])
    method, nu = collocation_scheme(scheme_name, derived.orders), len(derived.inputs)
    space = StateSpace(
        compiled, derived.orders, lambda t: np.zeros((nu, t.size)), len(derived.active)
    )
    names = [
        dof if k == 0 else f"dot({dof})"
        for dof, order in zip(derived.dofs, derived.orders, strict=True)
        for k in range(order)
    ]
    for name in start:
        if name not in names:
            raise InputError("no such dof", key=name, hint=f"there are {', '.join(names)}")
    state = np.array([start.get(name, 0.0) for name in names])

    def problem(count: int) -> Boundary:
        still = np.zeros((nu, method.phases(count).size))
        return Boundary(compiled, method, 1.0, still, 0, len(derived.active))

    way = _motion(space, p, state, settle, period, model.name)
    begin, length = (settle, period) if period else _last_turn(way, settle, model.name)

    def rows(phase: Array) -> Array:
        times = begin + length * phase
        return space.complete(times, way(times)[None], p[None])[0]

    nodes, points = np.arange(steps) / steps, method.phases(steps)
    x = method.from_motion(rows(nodes), rows(points))[0]
    cycle = solve_limit_cycle(problem(steps), p, x, length)
    if not cycle.solution.status.ok:
        return cycle

    def again(phase: Array) -> Array:
        step, plan = cycle.solution.value / steps, method.plan(phase, steps)
        return np.asarray(method.sample(cycle.solution.x[None, :, :, None], plan, step)[:, :, 0])

    nodes, points = np.arange(2 * steps) / (2 * steps), method.phases(2 * steps)
    x = method.from_motion(again(nodes), again(points))[0]
    finer = solve_limit_cycle(problem(2 * steps), p, x, cycle.solution.value)
    return with_error(cycle, problem(steps), finer)


def _motion(
    space: StateSpace, p: Array, s: Array, settle: float, period: float | None, name: str
) -> Callable[[Array], Array]:
    """States ``(D, N)`` at times up to a period after settling, or twice as long."""
    end = settle + period if period else 2 * settle
    options = {"rtol": RELATIVE_TOLERANCE, "atol": RELATIVE_TOLERANCE * (1.0 + np.abs(s).max())}
    way = solve_ivp(
        space.right_side(p), (0.0, end), s, method="LSODA", dense_output=True, **options
    )
    if not way.success:
        raise InputError(f"model {name!r}: the motion cannot be computed", value=way.message)
    motion: Callable[[Array], Array] = way.sol
    return motion


def _last_turn(way: Callable[[Array], Array], settle: float, name: str) -> tuple[float, float]:
    """Beginning and length of the last turn of a motion."""
    fine = np.linspace(settle, 2 * settle, 4000)
    first = way(fine)[0]
    above = first - 0.5 * (first.max() + first.min())
    rising = np.flatnonzero((above[:-1] < 0) & (above[1:] >= 0))
    if np.ptp(first) <= 1e-6 * (1.0 + np.abs(first).max()) or rising.size < 2:
        raise InputError(
            f"model {name!r}: the motion does not come back",
            key="settle",
            value=settle,
            hint="give a longer time, or another start",
        )
    return float(fine[rising[-2]]), float(fine[rising[-1]] - fine[rising[-2]])
