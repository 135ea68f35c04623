"""Degrees of freedom that are velocities: of first order, in a unit of velocity.

Such a dof may have a position: another dof of first order whose equation says that its rate is that
velocity, as in the state-space form of a second-order equation, or the difference of two of them,
as the twist of a shaft is.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import sympy as sp

from bayesoleo._units import Dimensions, base_unit, dimensions
from bayesoleo.model._expressions import derivative_symbol, split_derivative

#: Units of velocities; other multiples of these are refused where a model is declared.
VELOCITIES = ("m/s", "rad/s")


@dataclass(frozen=True)
class Declared:
    """What a model says of its dofs.

    Parameters
    ----------
    equations : mapping of str to sympy.Expr
        By dof, with definitions expanded.
    orders : mapping of str to int
        Of dofs.
    units : mapping of str to str
        Of all that is declared.
    inputs : tuple of str
    """

    equations: Mapping[str, sp.Expr]
    orders: Mapping[str, int]
    units: Mapping[str, str]
    inputs: tuple[str, ...]

    def moving(self, expression: sp.Expr) -> dict[str, set[int]]:
        """Dofs and inputs in an expression, each with the orders of its derivatives."""
        found: dict[str, set[int]] = {}
        for name, order in map(split_derivative, expression.free_symbols):
            if name in self.equations or name in self.inputs:
                found.setdefault(name, set()).add(order)
        return found


@dataclass(frozen=True)
class VelocityDofs:
    """The velocities among a model's dofs, and their positions.

    Parameters
    ----------
    velocities : frozenset of str
        Dofs that are the velocity of a body.
    positions : mapping of str to tuple of str
        By dof the velocity that its rate is, or the two whose difference it is.
    """

    velocities: frozenset[str] = frozenset()
    positions: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    def position_of(self, *velocity: str) -> str | None:
        """The dof whose rate is a velocity, or the first less the second; None without one."""
        found = (name for name, rate in self.positions.items() if rate == velocity)
        return next(found, None)


def velocity_dofs(declared: Declared) -> VelocityDofs:
    """Find the velocities among a model's dofs.

    Parameters
    ----------
    declared : Declared

    Returns
    -------
    VelocityDofs
    """
    known = {
        name
        for name in declared.equations
        if declared.orders[name] == 1 and is_velocity(declared.units.get(name, ""))
    }
    if not known:
        return VelocityDofs()
    rates = {name: _rate(declared, name, known) for name in declared.equations}
    positions = {name: rate for name, rate in rates.items() if rate}
    free = known - set(positions)
    bodies = {name for name in free if not _follows(declared, name, free, positions)}
    # Where nothing else moves, what follows may be a servo drive.
    if not bodies and all(order == 1 for order in declared.orders.values()):
        bodies = free
    return VelocityDofs(frozenset(bodies), positions)


def is_velocity(unit: str) -> bool:
    """Whether a unit is one of velocity."""
    return bool(unit) and base_unit(unit) in map(base_unit, VELOCITIES)


def _rate(declared: Declared, name: str, velocities: set[str]) -> tuple[str, ...]:
    """The velocity that an equation says is the rate of a dof, or the two of which it is the
    difference; empty where it says something else."""
    if declared.orders[name] != 1:
        return ()
    equation, own = declared.equations[name], derivative_symbol(name, 1)
    factor = sp.diff(equation, own)
    if factor == 0 or declared.moving(factor):
        return ()
    rest = sp.expand(own - equation / factor)
    signs = {str(item): float(k) for item, k in rest.as_coefficients_dict().items()}
    if not set(signs) <= velocities:
        return ()
    plus, minus = ([v for v, k in signs.items() if k == sign] for sign in (1.0, -1.0))
    if len(plus) != 1 or len(minus) > 1 or len(plus) + len(minus) != len(signs):
        return ()
    return (*plus, *minus)


def _follows(
    declared: Declared,
    name: str,
    velocities: set[str],
    positions: Mapping[str, tuple[str, ...]],
) -> bool:
    """Whether a velocity is that of no body, but follows another motion, as what a filter or a slow
    sensor shows does.

    Its balance is then in its own unit. One over its inertia, in a unit of acceleration, may be a
    body's as well; but that acts on what it is moved by.
    """
    equation = declared.equations[name]
    moving = {k: orders for k, orders in declared.moving(equation).items() if k != name}
    unit = base_unit(declared.units[name])

    def is_motion(other: str, orders: set[int]) -> bool:
        if other in declared.inputs:
            own = declared.units.get(other, "")
            rates = {base_unit(own) / base_unit("s") ** k for k in orders} if own else set()
            return unit in rates
        turned = declared.orders[other] == 2 or other in positions
        return other in velocities or (turned and 1 in orders)

    if not any(is_motion(*item) for item in moving.items()):
        return False
    factor = _dimensions(sp.diff(equation, derivative_symbol(name, 1)), declared.units)
    if factor == dimensions("s"):
        return True
    felt = any(
        name in declared.moving(other) for k, other in declared.equations.items() if k != name
    )
    return factor == {} and not felt


def _dimensions(factor: sp.Expr, units: Mapping[str, str]) -> Dimensions | None:
    """Dimensions of a product, or of the first part of a sum; None where a unit is not declared."""
    if isinstance(factor, sp.Add):
        return _dimensions(factor.args[0], units)
    total: Dimensions = {}
    for base, exponent in factor.as_powers_dict().items():
        if base.is_number:
            continue
        unit = units.get(str(base), "")
        if not isinstance(base, sp.Symbol) or not exponent.is_number or not unit:
            return None
        for item, power in dimensions(unit).items():
            total[item] = total.get(item, 0.0) + power * float(exponent)
    return {item: power for item, power in total.items() if power}
