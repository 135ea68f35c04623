"""A model's equations of motion in explicit form, for solvers of others.

Taken from the model's declaration by computer algebra, with common subexpressions shared, and
printed for whoever is to evaluate it: compiled for one state, or for JAX, or for CasADi. So all
contestants solve the same equations, each in its own fast form.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
import sympy as sp
from numpy.typing import NDArray

from bayesoleo.model import Model
from bayesoleo.model._derivatives import derive
from bayesoleo.model._expressions import symbol
from bayesoleo.prediction._records import Harmonics

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Explicit:
    """``ds/dt`` of a model with one input, over symbols of states, the input and constants.

    Parameters
    ----------
    states : tuple of sympy.Symbol
        Value, and velocity of a second-order dof, of each dof in turn.
    force : sympy.Symbol
        The input.
    constants : tuple of str
        Parameters and conditions, in the order of a predictor's.
    rates : tuple of sympy.Expr
    """

    states: tuple[sp.Symbol, ...]
    force: sp.Symbol
    constants: tuple[str, ...]
    rates: tuple[sp.Expr, ...]

    @staticmethod
    def of(model: Model) -> Explicit:
        """Solve the equations, which are linear in them, for the highest derivatives."""
        derived = derive(model)
        ((name, _),) = derived.inputs
        first = np.cumsum([0, *(order + 1 for order in derived.orders)])
        highest = [derived.states[k - 1] for k in first[1:]]
        matrix, right = sp.linear_eq_to_matrix(derived.residual, highest)
        solved = dict(zip(highest, matrix.LUsolve(right), strict=True))
        states = tuple(s for s in derived.states if s not in solved)
        following = dict(zip(derived.states, derived.states[1:], strict=False))
        rates = tuple(solved.get(following[s], following[s]) for s in states)
        return Explicit(states, symbol(name), derived.constants, rates)

    def function(self, modules: object, *, jacobian: bool = False) -> Callable:
        """``f(*states, force, *constants)``: a list of rates, or of their derivatives by the states
        in rows, in terms of the functions in ``modules``.
        """
        arguments = [*self.states, self.force, *map(symbol, self.constants)]
        rates = self.rates
        if jacobian:
            rates = tuple(sp.Matrix(rates).jacobian(self.states))
        # The derivative of |v| is needed at zero as well.
        expressions = [r.doit().replace(sp.Derivative, lambda *_: sp.S.Zero) for r in rates]
        return sp.lambdify(arguments, expressions, modules=modules, cse=True)


@dataclass(frozen=True)
class Compiled:
    """One run for SciPy: ``rates(t, s)`` and its Jacobian, compiled, and many points at once."""

    rates: Callable[[float, Array], Array]
    many: Callable[[Array, Array], Array]
    jacobian_many: Callable[[Array, Array], Array]


def compiled(explicit: Explicit) -> Callable[[Array, Harmonics, float], Compiled]:
    """Functions of a run's constants ``p (np,)``, its force and its frequency in Hz."""
    size = len(explicit.states)
    point = numba.njit(explicit.function("math"))
    slope = numba.njit(explicit.function([{"sign": _sign}, "math"], jacobian=True))
    point_of, slope_of = (_spread(f, size, len(explicit.constants)) for f in (point, slope))

    @numba.njit
    def rates(t, s, p, c, w):
        return np.array(point_of(s, _signal(t, c, w), p))

    @numba.njit
    def many(t, s, p, c, w):
        values = np.empty(s.shape)
        for i in range(t.size):
            values[:, i] = np.array(point_of(s[:, i], _signal(t[i], c, w), p))
        return values

    @numba.njit
    def jacobian_many(t, s, p, c, w):
        values = np.empty((size, size, t.size))
        for i in range(t.size):
            row = np.array(slope_of(s[:, i], _signal(t[i], c, w), p))
            values[:, :, i] = row.reshape(size, size)
        return values

    def bind(p: Array, force: Harmonics, frequency: float) -> Compiled:
        w = 2 * math.pi * frequency
        a = dense(force)
        return Compiled(
            lambda t, s: rates(t, s, p, a, w),
            lambda t, s: many(t, np.ascontiguousarray(s), p, a, w),
            lambda t, s: jacobian_many(t, np.ascontiguousarray(s), p, a, w),
        )

    return bind


def dense(force: Harmonics) -> NDArray[np.complex128]:
    """Coefficients of all orders from zero on."""
    table = np.zeros(int(force.orders.max()) + 1, dtype=complex)
    table[force.orders] = force.coefficients
    return table


@numba.njit
def _signal(t, coefficients, w):
    """Horner's rule on the unit circle."""
    z = np.exp(1j * w * t)
    value = 0j
    for k in range(coefficients.size - 1, -1, -1):
        value = value * z + coefficients[k]
    return value.real


@numba.njit
def _sign(x):
    return np.sign(x)


def _spread(function: Callable, states: int, constants: int) -> Callable:
    """The same with arrays instead of many arguments."""
    arguments = [f"s[{k}]" for k in range(states)] + ["u"]
    arguments += [f"p[{k}]" for k in range(constants)]
    scope: dict[str, object] = {"function": function}
    exec(f"def spread(s, u, p):\n    return function({', '.join(arguments)})", scope)
    return numba.njit(scope["spread"])
