"""Partial derivatives against computer algebra's own and against differences."""

import pytest
import sympy as sp

from bayesoleo.model._derivatives import derive
from bayesoleo.model._expressions import bspline, bspline_slope, parse, symbol, with_symbol_as
from bayesoleo.model._partial_derivatives import partial, symbols_of
from bayesoleo.systems import system, systems

X, Y, A = symbol("x"), symbol("y"), symbol("a")
KNOWN = {"x": X, "y": Y, "a": A}

#: Smooth where they are evaluated, at positive values.
SMOOTH = [
    "a*x**3 - y/x + 4",
    "x**a*y",
    "a**(x*y)",
    "(x + y)**(-1.3)*(a + x)",
    "exp(-a*x)*sin(y*x)/tan(x)",
    "sqrt(x**2 + y**2)*log(a + x)",
    "tanh(a*x/(y + 1))*atan(x)*cos(y)",
    "abs(x - 3*y)*x + abs(a*x/y)",
    "max(x, 5*y, a)*x - min(x*y, a + 7)",
    "sign(x*y - 20)*x**2 + step(x - 1)*y*x",
    "bspline(0.3*x)*a + bspline_slope(0.4*x)*y",
    "max(0, x*a - y)**1.5/(1 + abs(x)*a)",
]


@pytest.mark.parametrize("text", SMOOTH)
def test_a_derivative_is_the_limit_of_differences(text):
    expression = parse(text, KNOWN, (), "here")
    at = {X: 1.37, Y: 0.52, A: 0.81}
    for item in at:
        low, high = (
            float(expression.subs({**at, item: at[item] + h}).evalf(40)) for h in (-1e-6, 1e-6)
        )
        found = float(partial(expression, item).subs(at).evalf(40))
        # Central differences err by some 1e-12 of the third derivative, and by round-off.
        assert found == pytest.approx((high - low) / 2e-6, rel=1e-7, abs=1e-8)


@pytest.mark.parametrize("name", systems())
def test_derivatives_of_models_are_those_of_computer_algebra(name):
    derived = derive(system(name))
    for expression in (*derived.residual, *derived.output):
        for item in (*derived.states, *derived.active_symbols):
            own = sp.diff(expression, item).replace(sp.DiracDelta, lambda *_: sp.Integer(0))
            assert partial(expression, item) == own


def test_impulses_are_dropped_and_kinks_have_the_mean_of_both_sides():
    assert partial(sp.sign(X) + sp.Heaviside(X, sp.Rational(1, 2)), X) == 0
    assert partial(sp.sign(X) * X, X) == sp.sign(X)
    for kink in (sp.Abs(X), sp.Max(X, -X)):
        assert partial(kink, X).subs(X, 0) == 0
    assert partial(sp.Max(X, 0), X).subs(X, 0) == sp.Rational(1, 2)


def test_a_modulus_of_what_may_be_infinite_is_real():
    """Computer algebra takes a quotient for complex there, and answers with imaginary parts."""
    z = sp.Symbol("z")  # of which nothing is known
    assert partial(sp.Abs(X / (z - 1)), X) == sp.sign(X / (z - 1)) / (z - 1)
    assert partial(sp.sign(X / (z - 1)), X) == 0


def test_a_derivative_of_a_derivative_has_no_impulse_left():
    twice = partial(partial(sp.Abs(X) * X**2 + bspline(X), X), X)
    assert not twice.has(sp.DiracDelta, sp.Derivative)
    assert float(twice.subs(X, 0.5)) == pytest.approx(6 * 0.5 + (3 * 0.5 - 2))
    assert partial(bspline(X), X) == bspline_slope(X)


def test_what_an_expression_lacks_does_not_move_it():
    expression = parse("a*x**2", KNOWN, (), "here")
    assert partial(expression, Y) == 0
    assert symbols_of(expression) == {A, X}
    assert symbols_of(sp.Integer(3)) == frozenset()


def test_one_symbol_is_replaced_in_all_terms():
    expression = parse("a*x**2 + max(x, y) + 3", KNOWN, (), "here")
    body = A * Y + 1
    assert with_symbol_as(expression, X, body) == expression.xreplace({X: body})
    assert with_symbol_as(expression, symbol("absent"), body) is expression
    assert with_symbol_as(X, X, body) == body
    assert with_symbol_as(expression, X, body).subs({A: 2, Y: 3}) == 2 * 7**2 + 7 + 3


def test_parts_of_what_is_real_are_itself_and_nothing():
    """Computer algebra writes the modulus of a power with both where it doubts the exponent."""
    both = sp.re(X * A, evaluate=False) + sp.conjugate(X**2, evaluate=False)
    assert partial(both, X) == A + 2 * X
    assert partial(sp.im(X * A, evaluate=False), X) == 0


def test_what_no_equation_may_hold_is_left_to_computer_algebra():
    either = sp.Piecewise((X**2, X < 1), (A, True))
    assert partial(either * A, X) == A * sp.Piecewise((2 * X, X < 1), (0, True))
    assert partial(sp.erf(X), X) == sp.diff(sp.erf(X), X)


def test_two_symbols_of_one_name_are_one():
    """They are two objects where computer algebra has forgotten the first."""
    again = sp.Symbol.__xnew__(sp.Symbol, "x", real=True)
    assert again is not X
    assert partial(again, X) == 1
    assert partial(A * again**2, X) == 2 * A * X
