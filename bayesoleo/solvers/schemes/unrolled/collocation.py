"""Source for collocation: the unknowns of a step are its first state and the highest derivatives at
its stages.
"""

from __future__ import annotations

from collections.abc import Sequence

from bayesoleo.compiled import BLOCK
from bayesoleo.solvers.schemes.tableau import Tableau
from bayesoleo.solvers.schemes.unrolled.emit import (
    REACH,
    WIDTH,
    Factors,
    Source,
    add_squares,
    joined,
    rows_before,
    solve,
    solve_again,
)


def _number(value: float) -> str:
    return f"({float(value)!r})"


def rows(orders: Sequence[int], method: Tableau, steps: int) -> str:
    d, s, D = len(orders), method.stages, sum(orders)
    aa = method.a @ method.a
    source = Source(
        "rows",
        "x, h, z, count",
        {"x": (D + s * d) * REACH, "h": BLOCK, "z": (D + d) * BLOCK},
    )
    source.loop("for i in range(count):")
    source.add("h1 = h[i]")
    state = 0
    for j, row in enumerate(rows_before(orders)):
        last = state + orders[j] - 1
        source.add(f"low = x[{state * REACH} + i]")
        source.add(f"rate = x[{last * REACH} + i]")
        for st in range(s):
            source.add(f"a{st} = x[{(D + st * d + j) * REACH} + i]")
        for i in range(s):
            once = joined([f"{_number(method.a[i, st])}*a{st}" for st in range(s)])
            twice = joined([f"{_number(aa[i, st])}*a{st}" for st in range(s)])
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
    source: Source, orders: Sequence[int], method: Tableau, steps: int
) -> tuple[list[list[str]], list[list[str]]]:
    """Emit the loads; return matrix and right-hand side of a step's stages."""
    d, s, D = len(orders), method.stages, sum(orders)
    nz, aa = D + d, method.a @ method.a
    matrix, right = [], []
    for i in range(s):
        for e in range(d):
            line, states = [["" for _ in range(d)] for _ in range(s)], []
            for j, row in enumerate(rows_before(orders)):
                names = [f"g{i}_{e}_{row + k}" for k in range(orders[j] + 1)]
                for k, name in enumerate(names):
                    at = (d + e * nz + row + k) * BLOCK + i * steps
                    source.add(f"{name} = out[{at} + i]")
                for st in range(s):
                    own = [names[-1]] if st == i else []
                    once = f"{_number(method.a[i, st])}*h1*{names[-2]}"
                    twice = [f"{_number(aa[i, st])}*h2*{names[0]}"] if orders[j] == 2 else []
                    line[st][j] = joined([*own, once, *twice])
                states.append(f"-{names[0]}")
                if orders[j] == 2:
                    states.append(f"-({_number(method.c[i])}*h1*{names[0]} + {names[1]})")
            matrix.append([line[st][j] for st in range(s) for j in range(d)])
            right.append([*states, f"-out[{e * BLOCK + i * steps} + i]"])
    return matrix, right


def _stage_squares(source: Source, orders: Sequence[int], first: int) -> None:
    """Emit the sums of squares at one stage, whose points begin at ``first``."""
    d, nz = len(orders), sum(orders) + len(orders)
    for e in range(d):
        source.add(f"g = out[{e * BLOCK + first} + i]")
        terms = [
            f"out[{(d + e * nz + k) * BLOCK + first} + i]*z[{k * BLOCK + first} + i]"
            for k in range(nz)
        ]
        add_squares(source, e, d, "g", terms)


def _source(
    name: str, orders: Sequence[int], method: Tableau, steps: int, *, squares: bool = False
) -> Source:
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
    return Source(name, f"out, x, h, {more}transfer, count", sizes)


def elimination(orders: Sequence[int], method: Tableau, steps: int) -> str:
    m, D = len(orders) * method.stages, sum(orders)
    source = _source("eliminate", orders, method, steps, squares=True)
    source.add("bad = 0")
    # In loops of their own: the elimination leaves no registers for more.
    for stage in range(method.stages):
        source.loop("for i in range(count):")
        _stage_squares(source, orders, stage * steps)
        source.indent = "    "
    source.loop("for i in range(count):")
    source.add("h1 = h[i]")
    source.add("h2 = h1*h1")
    factors = Factors((D + m) * (D + 1), m, steps)
    solution = solve(source, *_stage_equations(source, orders, method, steps), factors)
    for k in range(D + 1):
        own = [solution[line][k] for line in range(m)]
        _column(source, orders, method, steps, k, own)
    source.indent = "    "
    source.add("return bad")
    return "\n".join(source.lines)


def substitution(orders: Sequence[int], method: Tableau, steps: int) -> str:
    d, m, D = len(orders), len(orders) * method.stages, sum(orders)
    source = _source("substitute", orders, method, steps)
    source.loop("for i in range(count):")
    source.add("h1 = h[i]")
    source.add("h2 = h1*h1")
    factors = Factors((D + m) * (D + 1), m, steps)
    right = [f"-out[{e * BLOCK + i * steps} + i]" for i in range(method.stages) for e in range(d)]
    _column(source, orders, method, steps, D, solve_again(source, right, factors))
    return "\n".join(source.lines)


def _column(
    source: Source, orders: Sequence[int], method: Tableau, steps: int, k: int, own: list[str]
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
        once = joined([f"{_number(method.b[st])}*{mine[st]}" for st in range(s)])
        total = ["1.0"] if k == last else []
        if k == D:
            gain = joined([f"{_number(method.b[st])}*{a[st]}" for st in range(s)])
            total = [f"(x[{last * REACH} + i] - x[{last * REACH + WIDTH} + i]) + h1*({gain})"]
        source.add(
            f"transfer[{(last * columns + k) * steps} + i] = {joined([*total, f'h1*({once})'])}"
        )
        if orders[j] == 2:
            twice = joined([f"{_number(ba[st])}*{mine[st]}" for st in range(s)])
            total = ["1.0"] if k == state else ["h1"] if k == last else []
            if k == D:
                gain = joined([f"{_number(ba[st])}*{a[st]}" for st in range(s)])
                jump = f"(x[{state * REACH} + i] - x[{state * REACH + WIDTH} + i])"
                total = [f"{jump} + h1*(x[{last * REACH} + i] + h1*({gain}))"]
            source.add(
                f"transfer[{(state * columns + k) * steps} + i] = "
                + joined([*total, f"h2*({twice})"])
            )
        state += orders[j]
    for line in range(s * d):
        source.add(f"transfer[{((D + line) * columns + k) * steps} + i] = {own[line]}")


def update(orders: Sequence[int], stages: int, steps: int) -> str:
    d, D = len(orders), sum(orders)
    columns = D + 1
    source = Source(
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
        source.add(f"d{i} = {joined(terms)}")
        source.add(f"dx[{i * BLOCK} + at + c] = d{i}")
    for line in range(stages * d):
        own = [f"transfer[{((D + line) * columns + k) * steps} + at + c]" for k in range(columns)]
        terms = [own[D]] + [f"{own[k]}*d{k}" for k in range(D)]
        source.add(f"dx[{(D + line) * BLOCK} + at + c] = {joined(terms)}")
    return "\n".join(source.lines)
