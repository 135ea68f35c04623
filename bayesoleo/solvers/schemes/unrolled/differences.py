"""Source for backward differences: the unknowns are the dofs at the nodes, the state those of past
nodes.
"""

from __future__ import annotations

from collections.abc import Sequence

from bayesoleo.compiled import BLOCK
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


def past_nodes(orders: Sequence[int]) -> list[tuple[int, int]]:
    """How many nodes back, and which dof: three for one of second order, two for one of first."""
    return [(past, j) for past in (1, 2, 3) for j in range(len(orders)) if past <= orders[j] + 1]


def rows(orders: Sequence[int], first: Sequence[float], second: Sequence[float]) -> str:
    nz = sum(orders) + len(orders)
    source = Source(
        "rows",
        "x, h, z, count",
        {"x": len(orders) * REACH, "h": BLOCK, "z": nz * BLOCK},
    )
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
    source = Source(
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
    source = Source(
        "substitute",
        "out, x, h, transfer, count",
        {"out": d * BLOCK, "transfer": (d * columns + d * d) * steps},
    )
    source.loop("for i in range(count):")
    solution = solve_again(source, [f"-out[{e * BLOCK} + i]" for e in range(d)], factors)
    for e in range(d):
        source.add(f"transfer[{(e * columns + columns - 1) * steps} + i] = {solution[e]}")
    return "\n".join(source.lines)


def update(orders: Sequence[int]) -> str:
    d, past = len(orders), len(past_nodes(orders))
    columns, window = past + 1, 3 * d
    source = Source(
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
        source.add(f"d{j} = {joined(terms)}")
    for j in range(d):
        source.add(f"dx[{j * BLOCK} + at + c] = d{j}")
    return "\n".join(source.lines)
