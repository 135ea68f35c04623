"""Generated straight-line code for collocation, and the lines that all schemes share.

The unknowns of a step are its first state and the highest derivatives at its stages. Shared are the
solution of small systems without inner loops, and the recursion of chunks side by side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bayesoleo._compiled import BLOCK
from bayesoleo.solvers._elimination import SMALL_PIVOT
from bayesoleo.solvers._mesh import Tableau

#: Chunks of a period that are swept side by side.
WIDTH = 8
#: Distance of rows of unknowns in a block: its own steps, three before and one after.
REACH = BLOCK + 4 * WIDTH
#: At least as many as a state has components: a loop of this length is one vector instruction.
COLUMNS = 8


def rows_before(orders: Sequence[int]) -> list[int]:
    return [sum(orders[:j]) + j for j in range(len(orders))]


class Source:
    """Lines of one function over pointers."""

    def __init__(self, name: str, arguments: str):
        self.lines = [f"def {name}({arguments}):"]
        self.indent = "    "

    def add(self, line: str) -> None:
        self.lines.append(self.indent + line)

    def loop(self, head: str) -> None:
        self.add(head)
        self.indent += "    "


def gather(source: Source, unknowns: int, steps: int, front: int = 0) -> None:
    """Emit the copy of a block's unknowns, and of those that its steps look at, to rows at constant
    distances."""
    source.loop(f"for k in range({unknowns}):")
    for at in range(0, steps + (front + 1) * WIDTH, WIDTH):
        to, begin = f"k*{REACH} + {at}", f"k*row + {at}"
        source.add(f"x[{to}:{to} + {WIDTH}] = now[{begin}:{begin} + {WIDTH}]")
    source.indent = "    "


def scatter(source: Source, unknowns: int) -> None:
    """Emit the copy of a block's step to where the whole period's stands."""
    source.indent = "    "
    source.loop(f"for k in range({unknowns}):")
    source.loop("for t in range(rows):")
    to, begin = f"k*row + t*{WIDTH}", f"k*{BLOCK} + t*{WIDTH}"
    source.add(f"dx[{to}:{to} + {WIDTH}] = block[{begin}:{begin} + {WIDTH}]")


def joined(terms: Sequence[str]) -> str:
    return " + ".join(terms) if terms else "0.0"


@dataclass(frozen=True)
class Factors:
    """Where an elimination keeps what a later right-hand side needs: behind the transfer."""

    first: int
    size: int
    steps: int

    def at(self, i: int, j: int) -> str:
        return f"transfer[{(self.first + i * self.size + j) * self.steps} + i]"


def solve(
    source: Source, matrix: list[list[str]], right: list[list[str]], factors: Factors
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
            source.add(f"r{i}_{j} = (r{i}_{j} - ({joined(done)}))*v{i}")
    return [[f"r{i}_{j}" for j in range(k)] for i in range(m)]


def solve_again(source: Source, right: list[str], factors: Factors) -> list[str]:
    """Emit the solution for another right-hand side."""
    m = len(right)
    for i in range(m):
        done = [f"{factors.at(i, c)}*r{c}" for c in range(i)]
        source.add(f"r{i} = {right[i]} - ({joined(done)})")
    for i in range(m - 1, -1, -1):
        done = [f"{factors.at(i, o)}*r{o}" for o in range(i + 1, m)]
        source.add(f"r{i} = (r{i} - ({joined(done)}))*{factors.at(i, i)}")
    return [f"r{i}" for i in range(m)]


def add_squares(source: Source, e: int, d: int, g: str, terms: Sequence[str]) -> None:
    """Emit the sums of squares of an equation's residual and of its terms."""
    source.add(f"total = {g}*{g}")
    source.add(f"sums[{e * BLOCK} + i] += total")
    for term in terms:
        source.add(f"term = {term}")
        source.add("total += term*term")
    source.add(f"sums[{(d + e) * BLOCK} + i] += total")


def chain(
    new: int, window: int, order: Sequence[int], steps: int, constants_only: bool = False
) -> str:
    """Recursion of the chunks; the history is ``(t, new, D + 1, WIDTH)``, oldest first."""
    past = len(order)
    columns = past + 1
    source = Source("follow" if constants_only else "chain", "transfer, history, rows, width")
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
            source.add(f"{target} = {joined(terms)}")
    return "\n".join(source.lines)


def product(new: int, order: Sequence[int]) -> str:
    """Products of the chunks' matrices, ``(WIDTH + 1, D, COLUMNS)``, from the identity on."""
    D = len(order)
    source = Source("product", "history, products, whole, rest, width")
    source.loop(f"for c in range({WIDTH}):")
    source.add(_end_of_chunk(new, D))
    source.add(f"at = c*{D * COLUMNS}")
    for i in range(D):
        for o in range(D):
            source.add(f"a{i}_{o} = {_entry(order, i, o)}")
    source.loop("for k in range(width):")
    for o in range(D):
        source.add(f"h{o} = products[at + {o * COLUMNS} + k]")
    for i in range(D):
        terms = [f"a{i}_{o}*h{o}" for o in range(D)]
        source.add(f"products[at + {(D + i) * COLUMNS} + k] = {joined(terms)}")
    return "\n".join(source.lines)


def begin(new: int, order: Sequence[int]) -> str:
    """First states of the chunks, ``(D, WIDTH)``: of a closed period, or from nothing.

    What the first solution misses the closure by is solved for once more. An inverse loses as many
    digits as the period multiplies errors by, and the period itself as many again.
    """
    D = len(order)
    source = Source("begin", "history, inverse, start, whole, rest, closed")
    states = range(D)

    def through_chunks(*before: str) -> None:
        source.loop(f"for c in range({WIDTH}):")
        for line in (*before, _end_of_chunk(new, D)):
            source.add(line)
        for i in states:
            terms = [_entry(order, i, D)] + [f"{_entry(order, i, o)}*s{o}" for o in states]
            source.add(f"n{i} = {joined(terms)}")
        for i in states:
            source.add(f"s{i} = n{i}")
        source.indent = source.indent[:-4]

    for i in states:
        source.add(f"s{i} = 0.0")
    source.loop("if closed > 0:")
    through_chunks()
    for i in states:
        source.add(f"x{i} = {joined([f'inverse[{i * D + k}]*s{k}' for k in states])}")
    for i in states:
        source.add(f"s{i} = x{i}")
    through_chunks()
    for i in states:
        source.add(f"e{i} = s{i} - x{i}")
    for i in states:
        source.add(f"s{i} = x{i} + ({joined([f'inverse[{i * D + k}]*e{k}' for k in states])})")
    source.indent = source.indent[:-4]
    through_chunks(*[f"start[{i * WIDTH} + c] = s{i}" for i in states])
    return "\n".join(source.lines)


def _end_of_chunk(new: int, D: int) -> str:
    """Where in the history a chunk's last state begins; ``rest`` chunks are a step longer."""
    row = new * (D + 1) * WIDTH
    return f"base = (whole + (1 if c < rest else 0))*{row} + c"


def _entry(order: Sequence[int], i: int, column: int) -> str:
    """Of the matrix from a chunk's first state to its last, or its constant in the last column."""
    return f"history[base + {(order[i] * (len(order) + 1) + column) * WIDTH}]"


def literal(value: float) -> str:
    return f"({float(value)!r})"


def rows(orders: Sequence[int], method: Tableau, steps: int) -> str:
    d, s, D = len(orders), method.stages, sum(orders)
    aa = method.a @ method.a
    source = Source("rows", "now, x, h, z, row, count")
    gather(source, D + s * d, steps)
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
            once = joined([f"{literal(method.a[i, st])}*a{st}" for st in range(s)])
            twice = joined([f"{literal(aa[i, st])}*a{st}" for st in range(s)])
            point = f"{i * steps} + i"
            if orders[j] == 1:
                source.add(f"z[{row * BLOCK} + {point}] = low + h1*({once})")
            else:
                inner = f"{literal(method.c[i])}*rate + h1*({twice})"
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
                    once = f"{literal(method.a[i, st])}*h1*{names[-2]}"
                    twice = [f"{literal(aa[i, st])}*h2*{names[0]}"] if orders[j] == 2 else []
                    line[st][j] = joined([*own, once, *twice])
                states.append(f"-{names[0]}")
                if orders[j] == 2:
                    states.append(f"-({literal(method.c[i])}*h1*{names[0]} + {names[1]})")
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


def elimination(orders: Sequence[int], method: Tableau, steps: int) -> str:
    m, D = len(orders) * method.stages, sum(orders)
    source = Source("eliminate", "out, x, h, z, sums, transfer, count")
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
    source = Source("substitute", "out, x, h, transfer, count")
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
        once = joined([f"{literal(method.b[st])}*{mine[st]}" for st in range(s)])
        total = ["1.0"] if k == last else []
        if k == D:
            gain = joined([f"{literal(method.b[st])}*{a[st]}" for st in range(s)])
            total = [f"(x[{last * REACH} + i] - x[{last * REACH + WIDTH} + i]) + h1*({gain})"]
        source.add(
            f"transfer[{(last * columns + k) * steps} + i] = {joined([*total, f'h1*({once})'])}"
        )
        if orders[j] == 2:
            twice = joined([f"{literal(ba[st])}*{mine[st]}" for st in range(s)])
            total = ["1.0"] if k == state else ["h1"] if k == last else []
            if k == D:
                gain = joined([f"{literal(ba[st])}*{a[st]}" for st in range(s)])
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
    source = Source("update", "transfer, history, start, block, dx, row, rows, width")
    source.loop("for t in range(rows):")
    source.add(f"base = t*{D * columns * WIDTH}")
    source.add(f"at = t*{WIDTH}")
    source.loop("for c in range(width):")
    for i in range(D):
        now = [f"history[base + {(i * columns + k) * WIDTH} + c]" for k in range(columns)]
        terms = [now[D]] + [f"{now[k]}*start[{k * WIDTH} + c]" for k in range(D)]
        source.add(f"d{i} = {joined(terms)}")
        source.add(f"block[{i * BLOCK} + at + c] = d{i}")
    for line in range(stages * d):
        own = [f"transfer[{((D + line) * columns + k) * steps} + at + c]" for k in range(columns)]
        terms = [own[D]] + [f"{own[k]}*d{k}" for k in range(D)]
        source.add(f"block[{(D + line) * BLOCK} + at + c] = {joined(terms)}")
    scatter(source, D + stages * d)
    return "\n".join(source.lines)
