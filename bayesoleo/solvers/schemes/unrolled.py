"""Straight-line code of one scheme for dofs of given orders: no inner loop is left but that over
steps.

A period is cut into :data:`WIDTH` chunks that are swept side by side: step ``t`` of all chunks is
one vector instruction, and the recursion along the period, which has no parallelism of its own,
costs no more than what is done node by node. Compiled once for a signature (scheme, orders), not
once for a model. Rows of a block lie at constant distances, which lets the compiler prove that they
do not overlap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numba import types

from bayesoleo.compiled import BLOCK, COMPILING, load
from bayesoleo.solvers.schemes.sweep import SMALL_PIVOT
from bayesoleo.solvers.schemes.tableau import Tableau

#: Chunks of a period that are swept side by side.
WIDTH = 8
#: Distance of rows of unknowns in a block: its own steps, three before and one after.
REACH = BLOCK + 4 * WIDTH
#: Systems up to this size are solved by straight-line code; its length grows as the cube.
LARGEST = 6

_P, _I = types.CPointer(types.float64), types.intp
#: Of the pieces, see :class:`Program`.
SIGNATURES = {
    "rows": types.void(_P, _P, _P, _I),
    "eliminate": _I(_P, _P, _P, _P, _P, _P, _I),
    "chain": types.void(_P, _P, _I, _I),
    "substitute": types.void(_P, _P, _P, _P, _I),
    "follow": types.void(_P, _P, _I, _I),
    "update": types.void(_P, _P, _P, _P, _I, _I),
}


@dataclass(frozen=True)
class Program:
    """Compiled pieces of a Newton step, for one block of steps each, by their addresses.

    Parameters
    ----------
    rows : int
        ``(x, h, z, count)``: values and derivatives of the dofs at the points.
    eliminate : int
        ``(out, x, h, z, sums, transfer, count)``: solves for a step's own unknowns, and adds
        squares of residuals, and of all terms, to ``sums``; returns how many pivots were too small.
    chain : int
        ``(transfer, history, rows, width)``: runs the recursion of all chunks through the block.
    substitute : int
        ``(out, x, h, transfer, count)``: other equations' constants, by the last elimination.
    follow : int
        As ``chain``, for constants only.
    update : int
        ``(transfer, history, start, dx, rows, width)``: the Newton step from the chunks' first
        states.
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
    """

    rows: int
    eliminate: int
    chain: int
    substitute: int
    follow: int
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

    @property
    def steps(self) -> int:
        """Steps in a block, a multiple of the width."""
        return BLOCK // self.stages // WIDTH * WIDTH


def _rows_before(orders: Sequence[int]) -> list[int]:
    return [sum(orders[:j]) + j for j in range(len(orders))]


class _Source:
    """Lines of one function over pointers."""

    def __init__(self, name: str, arguments: str, sizes: dict[str, int]):
        self.lines = [f"def {name}({arguments}):"]
        self.lines += [f"    {key} = numba.carray({key}, ({n},))" for key, n in sizes.items()]
        self.indent = "    "

    def add(self, line: str) -> None:
        self.lines.append(self.indent + line)

    def loop(self, head: str) -> None:
        self.add(head)
        self.indent += "    "


def _sum(terms: Sequence[str]) -> str:
    return " + ".join(terms) if terms else "0.0"


@dataclass(frozen=True)
class _Factors:
    """Where an elimination keeps what a later right-hand side needs: behind the transfer."""

    first: int
    size: int
    steps: int

    def at(self, i: int, j: int) -> str:
        return f"transfer[{(self.first + i * self.size + j) * self.steps} + i]"


def _solve(
    source: _Source, matrix: list[list[str]], right: list[list[str]], factors: _Factors
) -> list[list[str]]:
    """Emit elimination without exchange of rows, counting pivots that ask for one."""
    m, k = len(matrix), len(right[0])
    for i in range(m):
        for j in range(m):
            source.add(f"m{i}_{j} = {matrix[i][j]}")
        for j in range(k):
            source.add(f"r{i}_{j} = {right[i][j]}")
        source.add(f"s{i} = abs(m{i}_{i})")
        source.add(f"o{i} = s{i}")
    for c in range(m):
        # What is lost by cancellation shows in the pivot, what is lost beside a large multiple in
        # the sum of sizes; both comparisons are blind to the units of rows and of columns.
        source.add(f"size = {SMALL_PIVOT!r}*s{c}")
        source.add(f"bad += 0 if (abs(m{c}_{c}) > size and size <= o{c}) else 1")
        source.add(f"v{c} = 1.0/m{c}_{c}")
        source.add(f"{factors.at(c, c)} = v{c}")
        for i in range(c + 1, m):
            source.add(f"f = m{i}_{c}*v{c}")
            source.add(f"{factors.at(i, c)} = f")
            for j in range(c + 1, m):
                source.add(f"g = f*m{c}_{j}")
                source.add(f"m{i}_{j} -= g")
                if i == j:
                    source.add(f"s{i} += abs(g)")
            for j in range(k):
                source.add(f"r{i}_{j} -= f*r{c}_{j}")
        for j in range(c + 1, m):
            source.add(f"{factors.at(c, j)} = m{c}_{j}")
    for i in range(m - 1, -1, -1):
        for j in range(k):
            done = [f"m{i}_{o}*r{o}_{j}" for o in range(i + 1, m)]
            source.add(f"r{i}_{j} = (r{i}_{j} - ({_sum(done)}))*v{i}")
    return [[f"r{i}_{j}" for j in range(k)] for i in range(m)]


def _solve_again(source: _Source, right: list[str], factors: _Factors) -> list[str]:
    """Emit the solution for another right-hand side."""
    m = len(right)
    for i in range(m):
        done = [f"{factors.at(i, c)}*r{c}" for c in range(i)]
        source.add(f"r{i} = {right[i]} - ({_sum(done)})")
    for i in range(m - 1, -1, -1):
        done = [f"{factors.at(i, o)}*r{o}" for o in range(i + 1, m)]
        source.add(f"r{i} = (r{i} - ({_sum(done)}))*{factors.at(i, i)}")
    return [f"r{i}" for i in range(m)]


def _add_squares(source: _Source, e: int, d: int, g: str, terms: Sequence[str]) -> None:
    """Emit the sums of squares of an equation's residual and of its terms."""
    source.add(f"total = {g}*{g}")
    source.add(f"sums[{e * BLOCK} + i] += total")
    for term in terms:
        source.add(f"term = {term}")
        source.add("total += term*term")
    source.add(f"sums[{(d + e) * BLOCK} + i] += total")


def _chain(
    new: int, window: int, order: Sequence[int], steps: int, constants_only: bool = False
) -> str:
    """Recursion of the chunks; the history is ``(t, new, D + 1, WIDTH)``, oldest first."""
    past = len(order)
    columns = past + 1
    source = _Source(
        "follow" if constants_only else "chain",
        "transfer, history, rows, width",
        {"transfer": new * columns * steps, "history": 10**9},
    )
    source.loop("for t in range(rows):")
    source.add(f"base = t*{new * columns * WIDTH}")
    source.add(f"at = t*{WIDTH}")
    source.loop("for c in range(width):")  # no constant, or it would be unrolled before
    factors = [[f"a{i}_{o}" for o in range(columns)] for i in range(new)]
    for i in range(new):
        for o in range(columns):
            source.add(f"{factors[i][o]} = transfer[{(i * columns + o) * steps} + at + c]")
    for k in range(past if constants_only else 0, columns):
        for o in range(past):
            source.add(f"h{o} = history[base + {(order[o] * columns + k) * WIDTH} + c]")
        for i in range(new):
            terms = [factors[i][past]] if k == past else []
            # The latest last: they are what the next step has to wait for.
            terms += [f"{factors[i][o]}*h{o}" for o in sorted(range(past), key=order.__getitem__)]
            target = f"history[base + {((window + i) * columns + k) * WIDTH} + c]"
            source.add(f"{target} = {_sum(terms)}")
    return "\n".join(source.lines)


# Backward differences: the unknowns are the dofs at the nodes, the state those of past nodes.


def _past(orders: Sequence[int]) -> list[tuple[int, int]]:
    """How many nodes back, and which dof: three for one of second order, two for one of first."""
    return [(past, j) for past in (1, 2, 3) for j in range(len(orders)) if past <= orders[j] + 1]


def _difference_rows(orders: Sequence[int], first: Sequence[float], second: Sequence[float]) -> str:
    nz = sum(orders) + len(orders)
    source = _Source(
        "rows",
        "x, h, z, count",
        {"x": len(orders) * REACH, "h": BLOCK, "z": nz * BLOCK},
    )
    source.add("once = 1.0/h[0]")
    source.add("twice = once*once")
    source.loop("for i in range(count):")
    for j, row in enumerate(_rows_before(orders)):
        for past in range(4):
            source.add(f"x{past} = x[{j * REACH + (3 - past) * WIDTH} + i]")
        source.add(f"z[{row * BLOCK} + i] = x0")
        rate = _sum([f"{first[past]!r}*x{past}" for past in range(4) if first[past]])
        source.add(f"z[{(row + 1) * BLOCK} + i] = ({rate})*once")
        if orders[j] == 2:
            bend = _sum([f"{second[past]!r}*x{past}" for past in range(4) if second[past]])
            source.add(f"z[{(row + 2) * BLOCK} + i] = ({bend})*twice")
    return "\n".join(source.lines)


def _difference_elimination(
    orders: Sequence[int], first: Sequence[float], second: Sequence[float], steps: int
) -> str:
    d, nz, columns = len(orders), sum(orders) + len(orders), len(_past(orders)) + 1
    factors = _Factors(d * columns, d, steps)
    source = _Source(
        "eliminate",
        "out, x, h, z, sums, transfer, count",
        {
            "out": d * (1 + nz) * BLOCK,
            "h": BLOCK,
            "z": nz * BLOCK,
            "sums": 2 * d * BLOCK,
            "transfer": (d * columns + d * d) * steps,
        },
    )
    source.add("bad = 0")
    source.add("once = 1.0/h[0]")
    source.add("twice = once*once")
    source.loop("for i in range(count):")
    entries = [[["" for _ in range(d)] for _ in range(d)] for _ in range(4)]
    for e in range(d):
        for j, row in enumerate(_rows_before(orders)):
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
                source.add(f"w{past}_{e}_{j} = {_sum(terms)}")
        source.add(f"g{e}_ = out[{e * BLOCK} + i]")
        _add_squares(source, e, d, f"g{e}_", [f"t{e}_{k}" for k in range(nz)])
    right = [
        [f"-{entries[past][e][j]}" for past, j in _past(orders)] + [f"-g{e}_"] for e in range(d)
    ]
    solution = _solve(source, entries[0], right, factors)
    for e in range(d):
        for k in range(columns):
            source.add(f"transfer[{(e * columns + k) * steps} + i] = {solution[e][k]}")
    source.indent = "    "
    source.add("return bad")
    return "\n".join(source.lines)


def _difference_substitution(orders: Sequence[int], steps: int) -> str:
    d, columns = len(orders), len(_past(orders)) + 1
    factors = _Factors(d * columns, d, steps)
    source = _Source(
        "substitute",
        "out, x, h, transfer, count",
        {"out": d * BLOCK, "transfer": (d * columns + d * d) * steps},
    )
    source.loop("for i in range(count):")
    solution = _solve_again(source, [f"-out[{e * BLOCK} + i]" for e in range(d)], factors)
    for e in range(d):
        source.add(f"transfer[{(e * columns + columns - 1) * steps} + i] = {solution[e]}")
    return "\n".join(source.lines)


def _difference_update(orders: Sequence[int]) -> str:
    d, past = len(orders), len(_past(orders))
    columns, window = past + 1, 3 * d
    source = _Source(
        "update",
        "transfer, history, start, dx, rows, width",
        {"history": 10**9, "start": past * WIDTH, "dx": d * BLOCK},
    )
    source.loop("for t in range(rows):")
    source.add(f"base = t*{d * columns * WIDTH}")
    source.add(f"at = t*{WIDTH}")
    source.loop("for c in range(width):")
    for k in range(past):
        source.add(f"s{k} = start[{k * WIDTH} + c]")
    for j in range(d):
        at = [f"history[base + {((window + j) * columns + k) * WIDTH} + c]" for k in range(columns)]
        terms = [at[past]] + [f"{at[k]}*s{k}" for k in range(past)]
        source.add(f"d{j} = {_sum(terms)}")
    for j in range(d):
        source.add(f"dx[{j * BLOCK} + at + c] = d{j}")
    return "\n".join(source.lines)


# Collocation: the unknowns of a step are its first state and the highest derivatives at its stages.


def _number(value: float) -> str:
    return f"({float(value)!r})"


def _collocation_rows(orders: Sequence[int], method: Tableau, steps: int) -> str:
    d, s, D = len(orders), method.stages, sum(orders)
    aa = method.a @ method.a
    source = _Source(
        "rows",
        "x, h, z, count",
        {"x": (D + s * d) * REACH, "h": BLOCK, "z": (D + d) * BLOCK},
    )
    source.loop("for i in range(count):")
    source.add("h1 = h[i]")
    state = 0
    for j, row in enumerate(_rows_before(orders)):
        last = state + orders[j] - 1
        source.add(f"low = x[{state * REACH} + i]")
        source.add(f"rate = x[{last * REACH} + i]")
        for st in range(s):
            source.add(f"a{st} = x[{(D + st * d + j) * REACH} + i]")
        for i in range(s):
            once = _sum([f"{_number(method.a[i, st])}*a{st}" for st in range(s)])
            twice = _sum([f"{_number(aa[i, st])}*a{st}" for st in range(s)])
            point = f"{i * steps} + i"
            if orders[j] == 1:
                source.add(f"z[{row * BLOCK} + {point}] = low + h1*({once})")
            else:
                inner = f"{_number(method.c[i])}*rate + h1*({twice})"
                source.add(f"z[{row * BLOCK} + {point}] = low + h1*({inner})")
                source.add(f"z[{(row + 1) * BLOCK} + {point}] = rate + h1*({once})")
            source.add(f"z[{(row + orders[j]) * BLOCK} + {point}] = a{i}")
        state += orders[j]
    return "\n".join(source.lines)


def _stage_equations(
    source: _Source, orders: Sequence[int], method: Tableau, steps: int
) -> tuple[list[list[str]], list[list[str]]]:
    """Emit the loads; return matrix and right-hand side of a step's stages."""
    d, s, D = len(orders), method.stages, sum(orders)
    nz, aa = D + d, method.a @ method.a
    matrix, right = [], []
    for i in range(s):
        for e in range(d):
            line, states = [["" for _ in range(d)] for _ in range(s)], []
            for j, row in enumerate(_rows_before(orders)):
                names = [f"g{i}_{e}_{row + k}" for k in range(orders[j] + 1)]
                for k, name in enumerate(names):
                    at = (d + e * nz + row + k) * BLOCK + i * steps
                    source.add(f"{name} = out[{at} + i]")
                for st in range(s):
                    own = [names[-1]] if st == i else []
                    once = f"{_number(method.a[i, st])}*h1*{names[-2]}"
                    twice = [f"{_number(aa[i, st])}*h2*{names[0]}"] if orders[j] == 2 else []
                    line[st][j] = _sum([*own, once, *twice])
                states.append(f"-{names[0]}")
                if orders[j] == 2:
                    states.append(f"-({_number(method.c[i])}*h1*{names[0]} + {names[1]})")
            matrix.append([line[st][j] for st in range(s) for j in range(d)])
            right.append([*states, f"-out[{e * BLOCK + i * steps} + i]"])
    return matrix, right


def _stage_squares(source: _Source, orders: Sequence[int], first: int) -> None:
    """Emit the sums of squares at one stage, whose points begin at ``first``."""
    d, nz = len(orders), sum(orders) + len(orders)
    for e in range(d):
        source.add(f"g = out[{e * BLOCK + first} + i]")
        terms = [
            f"out[{(d + e * nz + k) * BLOCK + first} + i]*z[{k * BLOCK + first} + i]"
            for k in range(nz)
        ]
        _add_squares(source, e, d, "g", terms)


def _collocation_source(
    name: str, orders: Sequence[int], method: Tableau, steps: int, *, squares: bool = False
) -> _Source:
    d, s, D = len(orders), method.stages, sum(orders)
    sizes = {
        "out": d * (1 + D + d) * BLOCK,
        "x": (D + s * d) * REACH,
        "h": BLOCK,
        "transfer": ((D + s * d) * (D + 1) + (s * d) ** 2) * steps,
    }
    if squares:
        sizes |= {"z": (D + d) * BLOCK, "sums": 2 * d * BLOCK}
    more = "z, sums, " if squares else ""
    return _Source(name, f"out, x, h, {more}transfer, count", sizes)


def _collocation_elimination(orders: Sequence[int], method: Tableau, steps: int) -> str:
    m, D = len(orders) * method.stages, sum(orders)
    source = _collocation_source("eliminate", orders, method, steps, squares=True)
    source.add("bad = 0")
    # In loops of their own: the elimination leaves no registers for more.
    for stage in range(method.stages):
        source.loop("for i in range(count):")
        _stage_squares(source, orders, stage * steps)
        source.indent = "    "
    source.loop("for i in range(count):")
    source.add("h1 = h[i]")
    source.add("h2 = h1*h1")
    factors = _Factors((D + m) * (D + 1), m, steps)
    solution = _solve(source, *_stage_equations(source, orders, method, steps), factors)
    for k in range(D + 1):
        own = [solution[line][k] for line in range(m)]
        _collocation_column(source, orders, method, steps, k, own)
    source.indent = "    "
    source.add("return bad")
    return "\n".join(source.lines)


def _collocation_substitution(orders: Sequence[int], method: Tableau, steps: int) -> str:
    d, m, D = len(orders), len(orders) * method.stages, sum(orders)
    source = _collocation_source("substitute", orders, method, steps)
    source.loop("for i in range(count):")
    source.add("h1 = h[i]")
    source.add("h2 = h1*h1")
    factors = _Factors((D + m) * (D + 1), m, steps)
    right = [f"-out[{e * BLOCK + i * steps} + i]" for i in range(method.stages) for e in range(d)]
    _collocation_column(source, orders, method, steps, D, _solve_again(source, right, factors))
    return "\n".join(source.lines)


def _collocation_column(
    source: _Source, orders: Sequence[int], method: Tableau, steps: int, k: int, own: list[str]
) -> None:
    """Emit one column of the transfer: what the end of a step and its stages owe to a component of
    its first state or, the last column, to the residual."""
    d, s, D = len(orders), method.stages, sum(orders)
    ba, columns = method.b @ method.a, D + 1
    state = 0
    for j in range(d):
        last = state + orders[j] - 1
        a = [f"x[{(D + st * d + j) * REACH} + i]" for st in range(s)]
        mine = [own[st * d + j] for st in range(s)]
        once = _sum([f"{_number(method.b[st])}*{mine[st]}" for st in range(s)])
        total = ["1.0"] if k == last else []
        if k == D:
            gain = _sum([f"{_number(method.b[st])}*{a[st]}" for st in range(s)])
            total = [f"(x[{last * REACH} + i] - x[{last * REACH + WIDTH} + i]) + h1*({gain})"]
        source.add(
            f"transfer[{(last * columns + k) * steps} + i] = {_sum([*total, f'h1*({once})'])}"
        )
        if orders[j] == 2:
            twice = _sum([f"{_number(ba[st])}*{mine[st]}" for st in range(s)])
            total = ["1.0"] if k == state else ["h1"] if k == last else []
            if k == D:
                gain = _sum([f"{_number(ba[st])}*{a[st]}" for st in range(s)])
                jump = f"(x[{state * REACH} + i] - x[{state * REACH + WIDTH} + i])"
                total = [f"{jump} + h1*(x[{last * REACH} + i] + h1*({gain}))"]
            source.add(
                f"transfer[{(state * columns + k) * steps} + i] = "
                + _sum([*total, f"h2*({twice})"])
            )
        state += orders[j]
    for line in range(s * d):
        source.add(f"transfer[{((D + line) * columns + k) * steps} + i] = {own[line]}")


def _collocation_update(orders: Sequence[int], stages: int, steps: int) -> str:
    d, D = len(orders), sum(orders)
    columns = D + 1
    source = _Source(
        "update",
        "transfer, history, start, dx, rows, width",
        {
            "transfer": (D + stages * d) * columns * steps,
            "history": 10**9,
            "start": D * WIDTH,
            "dx": (D + stages * d) * BLOCK,
        },
    )
    source.loop("for t in range(rows):")
    source.add(f"base = t*{D * columns * WIDTH}")
    source.add(f"at = t*{WIDTH}")
    source.loop("for c in range(width):")
    for i in range(D):
        now = [f"history[base + {(i * columns + k) * WIDTH} + c]" for k in range(columns)]
        terms = [now[D]] + [f"{now[k]}*start[{k * WIDTH} + c]" for k in range(D)]
        source.add(f"d{i} = {_sum(terms)}")
        source.add(f"dx[{i * BLOCK} + at + c] = d{i}")
    for line in range(stages * d):
        own = [f"transfer[{((D + line) * columns + k) * steps} + at + c]" for k in range(columns)]
        terms = [own[D]] + [f"{own[k]}*d{k}" for k in range(D)]
        source.add(f"dx[{(D + line) * BLOCK} + at + c] = {_sum(terms)}")
    return "\n".join(source.lines)


def _compile(parts: Sequence[str]) -> dict[str, int]:
    source = "import numba\n\n\n" + "\n\n\n".join(parts) + "\n"
    module = load(source)
    addresses = {}
    for name, signature in SIGNATURES.items():
        compiler = numba.cfunc(signature, cache=True, error_model="numpy", fastmath={"contract"})
        function: Any = compiler(getattr(module, name))
        _ALIVE.append(function)
        addresses[name] = int(function.address)
    return addresses


#: An address does not keep what stands there.
_ALIVE: list[Any] = []


def differences(
    orders: tuple[int, ...], first: tuple[float, ...], second: tuple[float, ...]
) -> Program | None:
    """Code for backward differences, or None where it would be too long."""
    return _known(("differences", orders), lambda: _differences(orders, first, second))


def collocation(method: Tableau, orders: tuple[int, ...]) -> Program | None:
    """Code for a collocation method, or None where it would be too long."""
    return _known((method.name, orders), lambda: _collocation(method, orders))


_PROGRAMS: dict[tuple[str, tuple[int, ...]], Program | None] = {}


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
    order = tuple((3 - past) * d + j for past, j in _past(orders))
    D = len(order)
    pieces = _compile(
        [
            _difference_rows(orders, first, second),
            _difference_elimination(orders, first, second, BLOCK),
            _chain(d, 3 * d, order, BLOCK),
            _difference_substitution(orders, BLOCK),
            _chain(d, 3 * d, order, BLOCK, constants_only=True),
            _difference_update(orders),
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
    )


def _collocation(method: Tableau, orders: tuple[int, ...]) -> Program | None:
    d, s, D = len(orders), method.stages, sum(orders)
    if not 1 <= s * d <= LARGEST or D > 4:
        return None
    steps = BLOCK // s // WIDTH * WIDTH
    pieces = _compile(
        [
            _collocation_rows(orders, method, steps),
            _collocation_elimination(orders, method, steps),
            _chain(D, D, tuple(range(D)), steps),
            _collocation_substitution(orders, method, steps),
            _chain(D, D, tuple(range(D)), steps, constants_only=True),
            _collocation_update(orders, s, steps),
        ]
    )
    return Program(
        **pieces,
        orders=orders,
        stages=s,
        unknowns=D + s * d,
        state=D,
        new=D,
        window=D,
        front=0,
        order=tuple(range(D)),
        transfer=(D + s * d) * (D + 1) + (s * d) ** 2,
    )


def chunks(n: int) -> np.ndarray:
    """Lengths of the chunks of a period of ``n`` steps, shape (WIDTH,), the longest first."""
    return np.array([n // WIDTH + (c < n % WIDTH) for c in range(WIDTH)], dtype=np.int64)
