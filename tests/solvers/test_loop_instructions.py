"""Machine code of generated loops does what Python does with the same text."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest

from bayesoleo._machine_code import address_of
from bayesoleo.solvers import _unrolled_program as program
from bayesoleo.solvers._loop_instructions import instructions
from bayesoleo.solvers._mesh import tableau

WORDS = """
def words(x, y, count, closed):
    total = 0.0
    found = 0
    if closed > 0:
        total = 3.0
    for i in range(count):
        for k in range(2):
            at = i*2 + k
            y[at] -= -x[at]/(2.5 + x[i])
            total += abs(x[at])
            found += 1 if (x[at] > 0.5 and total <= 7.0) else 0
        y[(i + (1 if i < closed else 0))] = total
    return found
"""

VECTORS = """
def vectors(x, y, count):
    low = 0
    for t in range(1, count):
        at = t*8
        v = x[at:at + 8]*2.0
        if any(v != 0.0):
            w = 1.0/(2.5 + abs(v)) - x[t]
            y[at:at + 8] -= -w
        low += 0 if all(v > 0.0) and all(1.0 <= v) else 1
        y[t:t + 8] = 7.0
    return low*10 + count//3
"""


def called(source: str, arrays: dict[str, np.ndarray], whole: dict[str, int], returned: str) -> int:
    """By machine code, in place."""
    text = instructions(source, arrays, returned)
    kinds = [ctypes.c_void_p if name in arrays else ctypes.c_int64 for name in arguments(source)]
    result = ctypes.c_int64 if returned == "i64" else None
    function = ctypes.CFUNCTYPE(result, *kinds)(address_of(text))
    given = {name: values.ctypes.data for name, values in arrays.items()} | whole
    return function(*(given[name] for name in arguments(source)))


def arguments(source: str) -> list[str]:
    head = source.strip().split("\n", 1)[0]
    return head[head.index("(") + 1 : head.index(")")].split(", ")


def by_python(source: str, arrays: dict[str, np.ndarray], whole: dict[str, int]) -> int:
    scope: dict = {}
    exec(source, scope)
    name = source.strip().split("(")[0].removeprefix("def ")
    return scope[name](**arrays, **whole)


@pytest.mark.parametrize("closed", [0, 1])
def test_every_statement_of_the_language(closed):
    x, y = np.linspace(-1.0, 2.0, 12), np.linspace(0.0, 1.0, 12)
    other = y.copy()
    whole = {"count": 6, "closed": closed}
    found = called(WORDS, {"x": x, "y": y}, whole, "i64")
    assert found == by_python(WORDS, {"x": x, "y": other}, whole) > 0
    np.testing.assert_allclose(y, other, rtol=1e-14)


def test_vectors():
    """Slices of eight numbers, and numbers beside them."""
    x, y = np.linspace(-1.0, 2.0, 64), np.linspace(0.0, 1.0, 64)
    x[16:24] = 0.0
    other = y.copy()
    found = called(VECTORS, {"x": x, "y": y}, {"count": 8}, "i64")
    assert found == by_python(VECTORS, {"x": x, "y": other}, {"count": 8})
    assert 10 < found < 80, "some are low, and not all"
    np.testing.assert_allclose(y, other, rtol=1e-14)


@pytest.mark.parametrize(
    ("statement", "told"),
    [
        ("x[0:4] = 1.0", r"x\[0:4\]"),
        ("x[0:1 + 8] = 1.0", r"x\[0:1 \+ 8\]"),
        ("for i in range(1, 2, 3): x[i] = 1.0", "for i in range"),
        ("x[0] = 1.0 if x[0] else 0.0", r"x\[0\]"),
        ("x[0] = 1", r"a whole number in x\[0\]"),
        ("x[0] = True", "True"),
        ("for i in reversed(x): x[i] = 1.0", "for i in reversed"),
    ],
)
def test_what_is_not_of_the_language_is_refused(statement, told):
    with pytest.raises(NotImplementedError, match=told):
        instructions(f"def odd(x):\n    {statement}\n", {"x"})


SIZES = {
    "rows": {"row": 96, "count": 8},
    "eliminate": {"count": 8},
    "chain": {"rows": 2, "width": 8},
    "substitute": {"count": 8},
    "follow": {"rows": 2, "width": 8},
    "product": {"whole": 1, "rest": 3, "width": 2},
    "begin": {"whole": 1, "rest": 3, "closed": 1},
    "update": {"row": 64, "rows": 2, "width": 8},
}


@pytest.mark.parametrize("name", list(SIZES))
@pytest.mark.parametrize("orders", [(1,), (2, 1), (2, 2, 1)])
def test_pieces_of_a_sweep(monkeypatch, orders, name):
    kept: list[str] = []
    monkeypatch.setattr(
        program, "_compile", lambda parts: kept.extend(parts) or dict.fromkeys(SIZES, 0)
    )
    program._collocation(tableau("radau3"), orders)
    source = kept[list(program.SIGNATURES).index(name)]
    rng = np.random.default_rng(3)
    names = [item for item in arguments(source) if item in program.ARRAYS]
    arrays = {item: rng.uniform(0.5, 1.5, 8192) for item in names}
    other = {item: values.copy() for item, values in arrays.items()}
    returned = "i64" if name == "eliminate" else "void"
    found = called(source, arrays, SIZES[name], returned)
    expected = by_python(source, other, SIZES[name])
    if returned == "i64":
        assert found == expected
    for item in names:
        # Of random matrices a pivot may be small; a product that is added without being rounded
        # first differs by the last bit.
        np.testing.assert_allclose(arrays[item], other[item], rtol=1e-8, atol=1e-10)
