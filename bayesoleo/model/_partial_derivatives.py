"""Partial derivatives of expressions, kept by part.

The models of a search share most of their expressions, and each has hundreds of derivatives.
Computer algebra's own differentiation looks at every part anew. Here the derivative of a part is
kept for all expressions that it occurs in.

The derivative at a kink is the mean of those on its two sides, and the impulse of a step is
dropped: it acts for no time at all.
"""

from __future__ import annotations

from functools import lru_cache

import sympy as sp

_ZERO, _ONE = sp.Integer(0), sp.Integer(1)


def partial(expression: sp.Expr, item: sp.Symbol) -> sp.Expr:
    """Partial derivative by a symbol, impulses dropped.

    Parameters
    ----------
    expression : sympy.Expr
        Real, whatever computer algebra knows of it: that a quotient may be infinite makes it no
        complex number.
    item : sympy.Symbol

    Returns
    -------
    sympy.Expr
    """
    if expression.is_Symbol and expression == item:  # two symbols of one name may be two objects
        return _ONE
    # Most parts lack most symbols: only what is more than nothing is kept.
    return _partial(expression, item) if item in symbols_of(expression) else _ZERO


@lru_cache(maxsize=50_000)
def _partial(expression: sp.Expr, item: sp.Symbol) -> sp.Expr:
    if expression.is_Add:
        return sp.Add(*(partial(term, item) for term in expression.args))
    if expression.is_Mul:
        return _of_product(expression, item)
    if expression.is_Pow:
        return _of_power(expression, item)
    if not _has_rules(expression):  # what no equation may hold is told where it is compiled
        return sp.diff(expression, item)
    slopes = [partial(argument, item) for argument in expression.args]
    return sp.Add(*(
        _by_argument(expression, k) * slope
        for k, slope in enumerate(slopes, start=1) if slope is not _ZERO
    ))  # fmt: skip


@lru_cache(maxsize=50_000)
def symbols_of(expression: sp.Expr) -> frozenset[sp.Symbol]:
    """Free symbols, kept by part like the derivatives."""
    if expression.is_Atom:
        return frozenset(expression.free_symbols)
    return frozenset().union(*map(symbols_of, expression.args))


def _of_product(product: sp.Mul, item: sp.Symbol) -> sp.Expr:
    factors = product.args
    slopes = [partial(factor, item) for factor in factors]
    return sp.Add(*(
        sp.Mul(*factors[:k], slope, *factors[k + 1 :])
        for k, slope in enumerate(slopes) if slope is not _ZERO
    ))  # fmt: skip


def _of_power(power: sp.Pow, item: sp.Symbol) -> sp.Expr:
    base, exponent = power.args
    in_base = partial(base, item) * exponent / base
    grown = partial(exponent, item)
    return power * (in_base if grown is _ZERO else in_base + grown * sp.log(base))


def _has_rules(function: sp.Expr) -> bool:
    """Whether an expression is a function of numbers, which says how it depends on each."""
    numbers = all(isinstance(argument, sp.Expr) for argument in function.args)
    return numbers and hasattr(function, "fdiff")


@lru_cache(maxsize=50_000)
def _by_argument(function: sp.Function, k: int) -> sp.Expr:
    """Derivative of a function by its argument ``k``, from one."""
    if isinstance(function, sp.Abs):
        return sp.sign(function.args[0])
    if isinstance(function, sp.re | sp.conjugate):  # of what is real
        return _ONE
    if isinstance(function, sp.sign | sp.Heaviside | sp.im):
        return _ZERO
    return function.fdiff(k)
