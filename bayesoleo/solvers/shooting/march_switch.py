"""A step of a march that meets a switch: shortened to end there, the mode exchanged."""

from __future__ import annotations

from typing import TYPE_CHECKING

from bayesoleo.solvers.shooting.inner import inner
from bayesoleo.solvers.shooting.march_start import rate_at_start
from bayesoleo.solvers.shooting.march_step import KNOWN, Front
from bayesoleo.solvers.shooting.radau_step import Workspace
from bayesoleo.solvers.shooting.switching import (
    first_switch,
    jump_of_derivatives,
    slope_of_switch,
    step_to_switch,
)

if TYPE_CHECKING:
    from bayesoleo.solvers.shooting.march import System


@inner
def find_switch(
    enough: float, system: System, front: Front, t: float, h: float, work: Workspace
) -> tuple[int, float, float]:
    """Switch in the solved step, or -1, with the length up to it and the switching function's
    slope there; the step is solved again to end there. A negative length is a failure, zero a
    switch where the step begins.
    """
    orders, method, signal, p = system.orders, system.method, system.signal, system.p
    jacobian, switches = system.kernels.jacobian, system.kernels.switches
    position, switch = first_switch(
        switches, t, front.state, front.stages, h, system.modes, front.largest, method, orders,
        signal, p, work,
    )  # fmt: skip
    if switch < 0:
        return -1, h, 1.0
    if position <= 1e-13:
        return switch, 0.0, 1.0
    length = step_to_switch(
        jacobian, switches, switch, position, t, front.state, front.stages, h, front.scale,
        enough, front.largest, method, orders, signal, p, work,
    )  # fmt: skip
    slope = slope_of_switch(
        switches, switch, t, front.state, front.stages, length, method, orders, signal, p, work
    )
    return switch, length, slope


@inner
def exchange(
    system: System, front: Front, switch: int, slope: float, length: float, t: float,
    work: Workspace,
) -> bool:  # fmt: skip
    """Exchange a mode: rates are new, and derivatives jump where they do; false without rates."""
    mode = system.modes[switch]
    system.p[mode] = 1.0 - system.p[mode]
    front.pace[KNOWN] = 0.0
    if not rate_at_start(front.state, front.rate, t, system, work):
        return False
    if length > 0.0 and front.columns.shape[1] > 0:
        jump_of_derivatives(
            system.kernels.slopes, switch, slope, front.stages_by, front.before, front.rate,
            front.columns, system.method.c.size, system.modes.size, system.orders, system.p, work,
            system.active,
        )  # fmt: skip
    return True
