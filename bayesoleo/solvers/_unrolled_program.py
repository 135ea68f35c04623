"""Generated straight-line code for finite differences, and its compilation.

The code of a scheme for dofs of given orders has no inner loop but that over steps. For backward
differences the unknowns are the dofs at the nodes, and the state those of past nodes.

A period is cut into :data:`WIDTH` chunks that are swept side by side. Step ``t`` of all chunks is
one vector instruction, and the recursion along the period, which cannot run in parallel by itself,
costs no more than the work at each node. Code is compiled once for a scheme and the orders of the
dofs, not once for a model. Rows of a block lie at constant distances, which lets the compiler prove
that they do not overlap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numba import types

from bayesoleo._compiled import BLOCK
from bayesoleo._machine_code import COMPILING, address_of
from bayesoleo.solvers import (
    _blocked_collocation as blocked_code,
    _unrolled_collocation as collocation_code,
)
from bayesoleo.solvers._loop_instructions import instructions
from bayesoleo.solvers._mesh import Tableau
from bayesoleo.solvers._unrolled_collocation import (
    REACH,
    WIDTH,
    Factors,
    Source,
    add_squares,
    begin,
    chain,
    gather,
    joined,
    product,
    rows_before,
    scatter,
    solve,
    solve_again,
)

#: Systems up to this size are solved by straight-line code; its length grows as the cube.
LARGEST = 6
#: Dofs up to which there are loops for collocation; the matrices of a period's steps, which are
#: kept, grow as their square.
LARGEST_BLOCKED = 16
#: Steps with old derivatives before new ones are made: of short code, where one with new ones costs
#: less than two, and of long, where it costs two to five.
FEW_CHORDS, MOST_CHORDS = 2, 5
_P, _I = types.CPointer(types.float64), types.intp
#: Of the pieces, see :class:`Program`.
SIGNATURES = {
    "rows": types.void(_P, _P, _P, _P, _I, _I),
    "eliminate": _I(_P, _P, _P, _P, _P, _P, _I),
    "chain": types.void(_P, _P, _I, _I),
    "substitute": types.void(_P, _P, _P, _P, _I),
    "follow": types.void(_P, _P, _I, _I),
    "product": types.void(_P, _P, _I, _I, _I),
    "begin": types.void(_P, _P, _P, _I, _I, _I),
    "update": types.void(_P, _P, _P, _P, _P, _I, _I, _I),
}
#: Their arguments that are arrays; the others are whole numbers.
ARRAYS = frozenset(
    {
        "x",
        "h",
        "z",
        "out",
        "sums",
        "transfer",
        "history",
        "products",
        "inverse",
        "start",
        "dx",
        "now",
        "block",
    }
)
_PROGRAMS: dict[tuple[str, tuple[int, ...]], Program | None] = {}


def past_nodes(orders: Sequence[int]) -> list[tuple[int, int]]:
    """How many nodes back, and which dof: three for one of second order, two for one of first."""
    return [(past, j) for past in (1, 2, 3) for j in range(len(orders)) if past <= orders[j] + 1]


def rows(orders: Sequence[int], first: Sequence[float], second: Sequence[float]) -> str:
    source = Source("rows", "now, x, h, z, row, count")
    gather(source, len(orders), BLOCK, 3)
    source.add("once = 1.0/h[0]")
    source.add("twice = once*once")
    source.loop("for i in range(count):")
    for j, row in enumerate(rows_before(orders)):
        for past in range(4):
            source.add(f"x{past} = x[{j * REACH + (3 - past) * WIDTH} + i]")
        source.add(f"z[{row * BLOCK} + i] = x0")
        rate = joined([f"{first[past]!r}*x{past}" for past in range(4) if first[past]])
        source.add(f"z[{(row + 1) * BLOCK} + i] = ({rate})*once")
        if orders[j] == 2:
            bend = joined([f"{second[past]!r}*x{past}" for past in range(4) if second[past]])
            source.add(f"z[{(row + 2) * BLOCK} + i] = ({bend})*twice")
    return "\n".join(source.lines)


def elimination(
    orders: Sequence[int], first: Sequence[float], second: Sequence[float], steps: int
) -> str:
    d, nz, columns = len(orders), sum(orders) + len(orders), len(past_nodes(orders)) + 1
    factors = Factors(d * columns, d, steps)
    source = Source("eliminate", "out, x, h, z, sums, transfer, count")
    source.add("bad = 0")
    source.add("once = 1.0/h[0]")
    source.add("twice = once*once")
    source.loop("for i in range(count):")
    entries = [[["" for _ in range(d)] for _ in range(d)] for _ in range(4)]
    for e in range(d):
        for j, row in enumerate(rows_before(orders)):
            for k in range(orders[j] + 1):
                source.add(f"g{k} = out[{(d + e * nz + row + k) * BLOCK} + i]")
                source.add(f"t{e}_{row + k} = g{k}*z[{(row + k) * BLOCK} + i]")
            source.add("g1 *= once")
            if orders[j] == 2:
                source.add("g2 *= twice")
            for past in range(4):
                terms = ["g0"] if past == 0 else []
                terms += [f"({first[past]!r})*g1"] if first[past] else []
                terms += [f"({second[past]!r})*g2"] if orders[j] == 2 and second[past] else []
                entries[past][e][j] = f"w{past}_{e}_{j}"
                source.add(f"w{past}_{e}_{j} = {joined(terms)}")
        source.add(f"g{e}_ = out[{e * BLOCK} + i]")
        add_squares(source, e, d, f"g{e}_", [f"t{e}_{k}" for k in range(nz)])
    right = [
        [f"-{entries[past][e][j]}" for past, j in past_nodes(orders)] + [f"-g{e}_"]
        for e in range(d)
    ]
    solution = solve(source, entries[0], right, factors)
    for e in range(d):
        for k in range(columns):
            source.add(f"transfer[{(e * columns + k) * steps} + i] = {solution[e][k]}")
    source.indent = "    "
    source.add("return bad")
    return "\n".join(source.lines)


def substitution(orders: Sequence[int], steps: int) -> str:
    d, columns = len(orders), len(past_nodes(orders)) + 1
    factors = Factors(d * columns, d, steps)
    source = Source("substitute", "out, x, h, transfer, count")
    source.loop("for i in range(count):")
    solution = solve_again(source, [f"-out[{e * BLOCK} + i]" for e in range(d)], factors)
    for e in range(d):
        source.add(f"transfer[{(e * columns + columns - 1) * steps} + i] = {solution[e]}")
    return "\n".join(source.lines)


def update(orders: Sequence[int]) -> str:
    d, past = len(orders), len(past_nodes(orders))
    columns, window = past + 1, 3 * d
    source = Source("update", "transfer, history, start, block, dx, row, rows, width")
    source.loop("for t in range(rows):")
    source.add(f"base = t*{d * columns * WIDTH}")
    source.add(f"at = t*{WIDTH}")
    source.loop("for c in range(width):")
    for k in range(past):
        source.add(f"s{k} = start[{k * WIDTH} + c]")
    for j in range(d):
        at = [f"history[base + {((window + j) * columns + k) * WIDTH} + c]" for k in range(columns)]
        terms = [at[past]] + [f"{at[k]}*s{k}" for k in range(past)]
        source.add(f"d{j} = {joined(terms)}")
    for j in range(d):
        source.add(f"block[{j * BLOCK} + at + c] = d{j}")
    scatter(source, d)
    return "\n".join(source.lines)


@dataclass(frozen=True)
class Program:
    """Compiled pieces of a Newton step, for one block of steps each, by their addresses.

    Parameters
    ----------
    rows : int
        ``(now, x, h, z, row, count)``: values and derivatives of the dofs at the points, and the
        block's unknowns ``x`` out of rows ``now`` of a length.
    eliminate : int
        ``(out, x, h, z, sums, transfer, count)``: solves for a step's own unknowns, and adds
        squares of residuals, and of all terms, to ``sums``; returns how many pivots were too small.
    chain : int
        ``(transfer, history, rows, width)``: runs the recursion of all chunks through the block.
    substitute : int
        ``(out, x, h, transfer, count)``: other equations' constants, by the last elimination.
    follow : int
        As ``chain``, for constants only.
    product : int
        ``(history, products, whole, rest, width)``: products of the chunks' matrices, of which
        ``rest`` are of ``whole + 1`` steps.
    begin : int
        ``(history, inverse, start, whole, rest, closed)``: the chunks' first states.
    update : int
        ``(transfer, history, start, block, dx, row, rows, width)``: the Newton step from the
        chunks' first states, into rows ``dx`` of a length; ``block`` is work space.
    orders : tuple of int
        Order of each dof.
    stages, unknowns, state, new, window, front : int
        Points of a step; unknowns of a step; size of the recursion's state; how many of its
        components a step makes anew; among how many of the history they stand; rows of steps before
        a block that it looks at.
    order : tuple of int
        Where in the history the components of the state stand.
    transfer : int
        Rows of a block's transfer, and of the factors behind it.
    chords : int
        How many steps with old derivatives cost less than one with new ones.
    """

    rows: int
    eliminate: int
    chain: int
    substitute: int
    follow: int
    product: int
    begin: int
    update: int
    orders: tuple[int, ...]
    stages: int
    unknowns: int
    state: int
    new: int
    window: int
    front: int
    order: tuple[int, ...]
    transfer: int
    chords: int

    @property
    def steps(self) -> int:
        """Steps in a block, a multiple of the width."""
        return BLOCK // self.stages // WIDTH * WIDTH


def _compile(parts: Sequence[str]) -> dict[str, int]:
    """Addresses of the pieces, in their order.

    Arrays of a call never overlap. The chain of many dofs is not told so: the compiler would read
    so far ahead that the sums of a tile lose their registers.
    """
    return {
        name: address_of(
            instructions(
                part,
                ARRAYS,
                returned="i64" if name == "eliminate" else "void",
                apart=name != "chain",
            )
        )
        for name, part in zip(SIGNATURES, parts, strict=True)
    }


def differences(
    orders: tuple[int, ...], first: tuple[float, ...], second: tuple[float, ...]
) -> Program | None:
    """Code for backward differences, or None where it would be too long."""
    return _known(("differences", orders), lambda: _differences(orders, first, second))


def collocation(method: Tableau, orders: tuple[int, ...]) -> Program | None:
    """Code for a collocation method, or None where it would be too long."""
    return _known((method.name, orders), lambda: _collocation(method, orders))


def _known(key: tuple[str, tuple[int, ...]], make: Callable[[], Program | None]) -> Program | None:
    with COMPILING:
        if key not in _PROGRAMS:
            _PROGRAMS[key] = make()
        return _PROGRAMS[key]


def _differences(
    orders: tuple[int, ...], first: tuple[float, ...], second: tuple[float, ...]
) -> Program | None:
    d = len(orders)
    if not 1 <= d <= 2:
        return None
    order = tuple((3 - past) * d + j for past, j in past_nodes(orders))
    D = len(order)
    pieces = _compile(
        [
            rows(orders, first, second),
            elimination(orders, first, second, BLOCK),
            chain(d, 3 * d, order, BLOCK),
            substitution(orders, BLOCK),
            chain(d, 3 * d, order, BLOCK, constants_only=True),
            product(d, order),
            begin(d, order),
            update(orders),
        ]
    )
    return Program(
        **pieces,
        orders=orders,
        stages=1,
        unknowns=d,
        state=D,
        new=d,
        window=3 * d,
        front=3,
        order=order,
        transfer=d * (D + 1) + d * d,
        chords=FEW_CHORDS,
    )


def _collocation(method: Tableau, orders: tuple[int, ...]) -> Program | None:
    d, s, D = len(orders), method.stages, sum(orders)
    if not 1 <= d <= LARGEST_BLOCKED:
        return None
    steps, straight = BLOCK // s // WIDTH * WIDTH, s * d <= LARGEST and D <= 4
    parts = _straight(method, orders, steps) if straight else _blocked(method, orders, steps)
    layout = blocked_code.Layout(orders, s)
    return Program(
        **_compile([collocation_code.rows(orders, method, steps), *parts]),
        orders=orders,
        stages=s,
        unknowns=D + s * d,
        state=D,
        new=D,
        window=D,
        front=0,
        order=tuple(range(D)),
        transfer=(D + s * d) * (D + 1) + (s * d) ** 2 if straight else layout.total,
        chords=MOST_CHORDS if D > 3 else FEW_CHORDS,
    )


def _straight(method: Tableau, orders: tuple[int, ...], steps: int) -> list[str]:
    D = sum(orders)
    return [
        collocation_code.elimination(orders, method, steps),
        chain(D, D, tuple(range(D)), steps),
        collocation_code.substitution(orders, method, steps),
        chain(D, D, tuple(range(D)), steps, constants_only=True),
        product(D, range(D)),
        begin(D, range(D)),
        collocation_code.update(orders, method.stages, steps),
    ]


def _blocked(method: Tableau, orders: tuple[int, ...], steps: int) -> list[str]:
    return [
        blocked_code.elimination(orders, method, steps),
        blocked_code.chain(orders, method.stages),
        blocked_code.substitution(orders, method, steps),
        blocked_code.chain(orders, method.stages, constants_only=True),
        blocked_code.product(sum(orders)),
        blocked_code.begin(sum(orders)),
        blocked_code.update(orders, method.stages),
    ]


def chunks(n: int) -> np.ndarray:
    """Lengths of the chunks of a period of ``n`` steps, shape (WIDTH,), the longest first."""
    return np.array([n // WIDTH + (c < n % WIDTH) for c in range(WIDTH)], dtype=np.int64)
