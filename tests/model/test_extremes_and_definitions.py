"""Maxima and minima without what SymPy looks for in vain, and definitions replaced by what they
stand for."""

import itertools

import pytest
import sympy as sp

from bayesoleo.model import Model, Output, Parameter
from bayesoleo.model._expressions import extreme, parse, symbol, with_symbol_as

X, Y = symbol("x"), symbol("y")
POSITIVE = sp.Symbol("p", positive=True)
ARGUMENTS = [
    sp.Integer(0), sp.Integer(2), X, X - Y, X**2, -(X**2) - 1, POSITIVE, -POSITIVE, X * POSITIVE,
    sp.Abs(X) - POSITIVE, sp.Max(X, 0), sp.Min(X, 0), sp.Max(X, Y), sp.Min(0, X - Y) - 1,
    X * Y - X - X * (Y - 1), X**2 - 2 * X * Y + Y**2,
]  # fmt: skip


@pytest.mark.parametrize("kind", [sp.Max, sp.Min])
def test_extremes_are_those_of_sympy(kind):
    """The same object, as hashes and the order of arguments show, but where it is a square that
    only its factors show to be one: that has the same values."""
    for pair in itertools.product(ARGUMENTS, repeat=2):
        found, expected = extreme(kind, *pair), kind(*pair)
        if ARGUMENTS[-1] in pair and found != expected:
            values = {X: 0.3, Y: -0.7, POSITIVE: 1.1}
            assert float(found.subs(values)) == pytest.approx(float(expected.subs(values)))
        else:
            assert (found, hash(found), found.args) == (expected, hash(expected), expected.args)


def test_a_symbol_in_an_extreme_becomes_what_its_sign_is_known_of():
    opened = parse("max(x, 0)", {"x": X}, (), "here")
    assert with_symbol_as(opened, X, POSITIVE) == POSITIVE
    assert with_symbol_as(opened, X, -POSITIVE) == 0
    assert with_symbol_as(opened, X, Y) == sp.Max(Y, 0)
    assert parse("positive(x)", {"x": X}, (), "here") == opened


def test_a_term_that_is_zero_in_other_words_is_none():
    """It would switch where nothing does."""
    hidden = X * Y - X - X * (Y - 1)
    assert hidden != 0
    opened = parse("max(z, 0)", {"z": symbol("z")}, (), "here")
    for found in (
        parse("positive(hidden)", {"hidden": hidden}, (), "here"),
        with_symbol_as(opened, symbol("z"), hidden),
    ):
        assert not found.has(sp.Max)
        assert sp.expand(found) == 0


def test_definitions_are_replaced_in_each_term_and_what_cancels_is_gone():
    model = Model(
        "spring",
        inputs={"stroke": "m"},
        parameters={"k": Parameter(1.0, "N/m", sd=0.1), "h": Parameter(0.1, "m", sd=0.1)},
        definitions={"gap": "stroke - h", "force": "k*gap", "whole": "2*force - k*gap"},
        outputs={"force_measured": Output("whole - k*stroke", "N")},
    )
    k, h, stroke = symbol("k"), symbol("h"), symbol("stroke")
    assert model.expand(symbol("whole")) == k * (stroke - h)
    assert sp.expand(model.output("force_measured")) == -k * h
    assert model.expand(3 * symbol("gap") + h) == 3 * stroke - 2 * h
