"""Text becomes expressions over declared names, and nothing else."""

from __future__ import annotations

import pytest
import sympy as sp
from hypothesis import given, strategies as st

from bayesoleo.errors import ModelError
from bayesoleo.model._expressions import (
    derivative_symbol,
    parse,
    split_derivative,
    symbol,
    total_derivative,
    with_symbols_as,
)
from bayesoleo.model._partial_derivatives import partial

KNOWN = {name: symbol(name) for name in ("q", "stiffness", "force")}


def read(text):
    return parse(text, KNOWN, ("q", "force"), "here")


def test_reads_what_an_engineer_writes():
    q, k = symbol("q"), symbol("stiffness")
    assert read("stiffness*q**3 - 2") == k * q**3 - 2
    assert read("positive(-q)") == sp.Max(-q, 0)
    assert read("ddot(q)") == derivative_symbol("q", 2)
    assert read(3) == 3


def test_time_derivative_follows_the_chain_rule():
    q, rate = symbol("q"), derivative_symbol("q", 1)
    assert read("dot(q**2)") == 2 * q * rate
    assert read("ddot(q**2)") == 2 * rate**2 + 2 * q * derivative_symbol("q", 2)
    assert read("dot(stiffness)") == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stifness*q", "here: unknown name stifness.*'stifness[*]q'.*did you mean stiffness"),
        ("q +", "here: not an expression.*k[*]q[*][*]3"),
        ("exec('1')", "here: '1' has no place|unknown function exec"),
        ("q.real", "here: a dot between names has no place"),
        ("[q]", "here: a list has no place"),
        ("q if q else 1", r"if … else has no place .*write step\(x\)"),
        ("cosh(q)", "here: unknown function cosh.*there are dot, ddot, abs"),
        ("atan(q, q)", "here: atan takes one argument"),
        ("max(q)", "here: max takes two arguments"),
        ("1/0", "here: not a finite real number"),
        ("sqrt(-1)", "here: not a finite real number"),
        ("True", "here: True has no place"),
        ("q^3 + v", r"here: \^ has no place .*write \*\* for a power: q\*\*3 \+ v"),
        ("q = v", "write all of it on one side"),
        ("2q", r"a product needs \*: write 2\*q for 2q"),
        ("q²", r"write q\*\*2 for q²"),
        ("q v", r"write q\*v for q v"),
        ("q % 2", "here: % .a remainder. has no place"),
        ("not q", "here: not has no place"),
        (None, "here: not an expression"),
        ("", "here: not an expression"),
    ],
)
def test_what_is_no_expression_is_refused(text, message):
    with pytest.raises(ModelError, match=message):
        read(text)


@pytest.mark.parametrize("text", ["abs(q)", "sign(q)", "max(q, 0)", "step(q)", "q*abs(q)"])
def test_derivatives_at_kinks_have_no_impulses(text):
    assert not partial(read(text), symbol("q")).has(sp.DiracDelta)


@given(st.sampled_from(["q", "stroke_2", "x"]), st.integers(0, 5))
def test_derivative_symbols_split_into_what_made_them(name, order):
    assert split_derivative(derivative_symbol(name, order)) == (name, order)


@given(st.integers(1, 4), st.integers(1, 4))
def test_time_derivative_of_a_product(m, n):
    """Leibniz' rule."""
    left, right = symbol("q") ** m, sp.sin(symbol("q")) * n
    whole = total_derivative(left * right, ["q"])
    parts = total_derivative(left, ["q"]) * right + left * total_derivative(right, ["q"])
    assert sp.expand(whole - parts) == 0


def test_no_derivative_is_left_undone_at_a_kink():
    # The argument of the modulus may be infinite, so that SymPy does not know it to be real.
    a, x = symbol("a"), symbol("x")
    slope = partial(sp.Abs(a / (1 - x)), x)
    curvature = partial(slope, x)
    assert not curvature.has(sp.Derivative)
    at = {a: sp.Rational(3), x: sp.Rational(1, 2)}
    # Of |3/(1 - x)| where it is positive: 6/(1 - x)**3.
    assert float(curvature.subs(at)) == pytest.approx(48.0)


def test_a_modulus_inside_a_modulus_stays_real():
    a, x = symbol("a"), symbol("x")
    inner = sp.Abs(a / (1 - x))
    slope = partial(partial(sp.Abs(inner - 5 / x), x), x)
    assert not slope.has(sp.re, sp.im, sp.Derivative)
    at = {a: sp.Rational(3), x: sp.Rational(1, 2)}
    # There it is 5/x - 3/(1 - x), whose second derivative is 10/x**3 - 6/(1 - x)**3.
    assert float(slope.subs(at)) == pytest.approx(80.0 - 48.0)


def test_a_modulus_inside_a_maximum_has_the_slope_of_its_side():
    a, b, x = symbol("a"), symbol("b"), symbol("x")
    slope = partial(sp.Max(sp.Abs(a / (1 - x)) - b, 0), x)
    half = {a: sp.Rational(-3), x: sp.Rational(1, 2)}
    # Of 3/(1 - x) - b where it is positive, and of nothing.
    assert float(slope.subs({**half, b: 5})) == pytest.approx(12.0)
    assert float(slope.subs({**half, b: 7})) == pytest.approx(0.0)


def test_symbols_are_replaced_everywhere_and_at_once():
    q, v, lag = symbol("q"), symbol("v"), symbol("lag")
    before = sp.Max(q - v, 0) * sp.sqrt(q**2 + 1) + sp.Min(v, q)
    found = with_symbols_as(before, {q: q - lag * v, v: q})
    expected = before.subs({q: q - lag * v, v: q}, simultaneous=True)
    for values in ((1.0, 2.0, 0.3), (-1.0, 0.5, 2.0), (3.0, -2.0, 0.1)):
        at = dict(zip((q, v, lag), values, strict=True))
        assert float(found.subs(at)) == pytest.approx(float(expected.subs(at)), rel=1e-12)
    assert with_symbols_as(before, {lag: q}) is before


def test_the_same_text_is_read_anew_where_a_name_means_something_else():
    q, force = symbol("q"), symbol("force")
    known = {"x": q, "k": symbol("stiffness")}
    assert parse("k*x", known, ("q",), "here") == known["k"] * q
    assert parse("k*x", known | {"x": force}, ("q",), "here") == known["k"] * force
    rate = derivative_symbol("force", 1)
    assert parse("dot(x)", known | {"x": force}, ("force",), "here") == rate
    whole = {"x": force**2}
    assert parse("dot(x)", known | {"x": force}, ("force",), "here", whole) == 2 * force * rate
    for where in ("here", "there", "there"):
        with pytest.raises(ModelError, match=rf"^{where}"):
            parse("k*unheard_of", known, ("q",), where)
