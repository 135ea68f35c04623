"""Generated loops for collocation of many dofs, with vectors over the chunks of a period.

Straight-line code for a step grows as the cube of its unknowns. Here the lines do not grow with the
dofs: loops go over them, and each number of a loop is a vector of the same step in all chunks. The
stages of a dof are one block of the matrix, and blocks are eliminated in the registers. Equations
of most systems couple few dofs with each other; a block in which all numbers are zero is passed by,
at run time, since code is made for a scheme and the orders of the dofs alone. It is neither written
nor read, but where an elimination fills it. Nothing but zeros would be subtracted, so the result is
the same to the last bit.

A row of steps keeps, one behind the other: the stages' equations ``(s d, s d + D + 1)``, with the
factors on the left and on the right what stages owe to the components of the first state and to the
residual; the same of the last state ``(D, D + 1)``; sizes of pivots ``(2, s d)``; numbers that say
which blocks of the factors are not zero ``(d, d)``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from bayesoleo._compiled import BLOCK
from bayesoleo._machine_code import has_wide_registers
from bayesoleo.solvers._elimination import SMALL_PIVOT
from bayesoleo.solvers._mesh import Tableau
from bayesoleo.solvers._unrolled_collocation import REACH, WIDTH, Source, joined, literal

#: Rows and columns of a matrix product whose sums stand in registers at once: of vectors that fill
#: one of 32 registers each, and of vectors that fill two of 16. Sums that find no register are
#: written and read in every step, which takes half as long again. The result is the same to the
#: last bit.
WIDE_TILE, TILE = (2, 4), (3, 2)


@dataclass(frozen=True)
class Run:
    """Neighbouring dofs of one order: which they are, and where their rows and states begin."""

    first: int
    count: int
    order: int
    row: int
    state: int


@dataclass(frozen=True)
class Layout:
    """Places of a row of steps, in vectors; see the module."""

    orders: tuple[int, ...]
    stages: int

    @property
    def d(self) -> int:
        return len(self.orders)

    @property
    def state(self) -> int:
        return sum(self.orders)

    @property
    def own(self) -> int:
        """Unknowns of the stages."""
        return self.stages * self.d

    @property
    def width(self) -> int:
        """Of a row of the stages' equations."""
        return self.own + self.state + 1

    @property
    def ends(self) -> int:
        """Where the last states' rows begin."""
        return self.own * self.width

    @property
    def sizes(self) -> int:
        """Where the sizes of pivots begin."""
        return self.ends + self.state * (self.state + 1)

    @property
    def flags(self) -> int:
        """Where it is said which blocks are not zero."""
        return self.sizes + 2 * self.own

    @property
    def total(self) -> int:
        return self.flags - -(self.d**2) // WIDTH

    @property
    def runs(self) -> list[Run]:
        found, first, row, state = [], 0, 0, 0
        for order, dofs in groupby(self.orders):
            count = len(list(dofs))
            found.append(Run(first, count, order, row, state))
            first, row, state = first + count, row + count * (order + 1), state + count * order
        return found


def vector(array: str, at: str) -> str:
    """So many numbers as there are chunks."""
    return f"{array}[{at}:{at} + {WIDTH}]"


def entry(line: str, column: str, width: int) -> str:
    """An entry of a matrix of vectors behind ``base``."""
    return vector("transfer", f"base + (({line})*{width} + {column})*{WIDTH}")


class _Rows(Source):
    """Lines of one function, with loops that end, for rows of steps of one layout."""

    def __init__(self, name: str, arguments: str, layout: Layout):
        super().__init__(name, arguments)
        self.layout = layout

    def end(self, loops: int = 1) -> None:
        self.indent = self.indent[: -4 * loops]

    def rows(self, count: str) -> None:
        """Begin a loop over the rows of a block."""
        self.loop(f"for t in range({count}):")
        self.add(f"at = t*{WIDTH}")
        self.add(f"base = t*{self.layout.total * WIDTH}")

    def own(self, line: str, column: str) -> str:
        """An entry of the stages' equations."""
        return entry(line, column, self.layout.width)

    def last(self, line: str, column: str) -> str:
        """An entry of the last state."""
        start = f"base + {self.layout.ends * WIDTH}"
        return vector(
            "transfer", f"{start} + (({line})*{self.layout.state + 1} + {column})*{WIDTH}"
        )

    def size(self, line: str, which: int = 0) -> str:
        """Sum of the sizes of what makes a pivot, and the size that it began with."""
        start = f"base + {(self.layout.sizes + which * self.layout.own) * WIDTH}"
        return vector("transfer", f"{start} + ({line})*{WIDTH}")

    def flag(self, line: str, column: str) -> str:
        """Whether a block of the factors is not zero."""
        return f"transfer[base + {self.layout.flags * WIDTH} + {line}*{self.layout.d} + {column}]"

    def where(self, line: str, column: str) -> None:
        """Begin what is done only where a block is not zero."""
        self.loop(f"if {self.flag(line, column)} != 0.0:")


def elimination(orders: Sequence[int], method: Tableau, steps: int) -> str:
    """Stages from the first state, and the last state from it: ``eliminate`` of a program."""
    layout = Layout(tuple(orders), method.stages)
    source = _Rows("eliminate", "out, x, h, z, sums, transfer, count", layout)
    source.add("failed = 0")
    source.rows(f"count//{WIDTH}")
    source.add(f"h1 = {vector('h', 'at')}")
    source.add("h2 = h1*h1")
    _assemble(source, method, steps)
    _factorise(source)
    _back(source, layout.own)
    _ends(source, method, 0)
    source.end()
    source.add("return failed")
    return "\n".join(source.lines)


def substitution(orders: Sequence[int], method: Tableau, steps: int) -> str:
    """The same for another residual, by the last elimination: ``substitute`` of a program."""
    layout = Layout(tuple(orders), method.stages)
    s, constant = method.stages, layout.width - 1
    source = _Rows("substitute", "out, x, h, transfer, count", layout)
    source.rows(f"count//{WIDTH}")
    source.add(f"h1 = {vector('h', 'at')}")
    source.add("h2 = h1*h1")
    source.loop(f"for e in range({layout.d}):")
    for q in range(s):
        source.add(f"x{q} = -{vector('out', f'e*{BLOCK} + {q * steps} + at')}")
    source.loop("for c in range(e):")
    source.where("e", "c")
    _block(source, "e", "c")
    for p in range(s):
        source.add(f"r{p} = {source.own(f'c*{s} + {p}', str(constant))}")
    for q in range(s):
        for p in range(s):
            source.add(f"x{q} = x{q} - b{q}_{p}*r{p}")
    source.end(2)
    for q in range(s):
        for p in range(q):
            source.add(f"x{q} = x{q} - {source.own(f'e*{s} + {q}', f'e*{s} + {p}')}*x{p}")
    for q in range(s):
        source.add(f"{source.own(f'e*{s} + {q}', str(constant))} = x{q}")
    source.end()
    _back(source, constant)
    _ends(source, method, layout.state)
    return "\n".join(source.lines)


def _assemble(source: _Rows, method: Tableau, steps: int) -> None:
    """Emit the equations of the stages, the stages of a dof next to each other, and sums of squares
    of their residuals and of their terms."""
    layout, s = source.layout, method.stages
    stages = range(s)
    source.loop(f"for e in range({layout.d}):")
    for i in stages:
        source.add(f"l{i} = {vector('out', f'e*{BLOCK} + {i * steps} + at')}")
        source.add(f"t{i} = l{i}*l{i}")
        # A pivot is looked at whether it is zero or not.
        for k in stages:
            source.add(f"{source.own(f'e*{s} + {i}', f'e*{s} + {k}')} = 0.0")
    _add_to(source, "e", stages)
    for run in layout.runs:
        source.loop(f"for j in range({run.count}):")
        _assemble_block(source, run, method, steps)
        source.end()
    source.add(f"{source.flag('e', 'e')} = 1.0")
    _add_to(source, f"{layout.d} + e", stages)
    for i in stages:
        source.add(f"{source.own(f'e*{s} + {i}', str(layout.width - 1))} = -l{i}")
        source.add(f"size = abs({source.own(f'e*{s} + {i}', f'e*{s} + {i}')})")
        source.add(f"{source.size(f'e*{s} + {i}')} = size")
        source.add(f"{source.size(f'e*{s} + {i}', 1)} = size")
    source.end()


def _assemble_block(source: _Rows, run: Run, method: Tableau, steps: int) -> None:
    """Emit how the stages of equation ``e`` depend on those of dof ``j`` of a run, and on its first
    state. Where they do not, only the latter is written."""
    layout, s = source.layout, method.stages
    nz, aa, stages = layout.state + layout.d, method.a @ method.a, range(s)
    derivatives = [(i, k) for i in stages for k in range(run.order + 1)]
    for i, k in derivatives:
        row = f"{layout.d} + e*{nz} + {run.row + k} + j*{run.order + 1}"
        source.add(f"g{i}_{k} = {vector('out', f'({row})*{BLOCK} + {i * steps} + at')}")
    for i in stages:
        line, column = f"e*{s} + {i}", f"{layout.own + run.state} + j*{run.order}"
        source.add(f"{source.own(line, column)} = -g{i}_0")
        if run.order == 2:
            slope = f"-({literal(method.c[i])}*h1*g{i}_0 + g{i}_1)"
            source.add(f"{source.own(line, f'{column} + 1')} = {slope}")
    flag = source.flag("e", f"({run.first} + j)")
    source.add(f"{flag} = 0.0")
    source.loop(f"if any({joined([f'abs(g{i}_{k})' for i, k in derivatives])} != 0.0):")
    source.add(f"{flag} = 1.0")
    for i, k in derivatives:
        place = f"({run.row} + j*{run.order + 1} + {k})*{BLOCK} + {i * steps} + at"
        source.add(f"term = g{i}_{k}*{vector('z', place)}")
        source.add(f"t{i} = t{i} + term*term")
    for i in stages:
        source.add(f"once = h1*g{i}_{run.order - 1}")
        if run.order == 2:
            source.add(f"twice = h2*g{i}_0")
        for st in stages:
            terms = [f"{literal(method.a[i, st])}*once"]
            terms += [f"{literal(aa[i, st])}*twice"] if run.order == 2 else []
            terms += [f"g{i}_{run.order}"] if st == i else []
            column = f"({run.first} + j)*{s} + {st}"
            source.add(f"{source.own(f'e*{s} + {i}', column)} = {joined(terms)}")
    source.end()


def _add_to(source: _Rows, row: str, stages: Sequence[int]) -> None:
    place = vector("sums", f"({row})*{BLOCK} + at")
    source.add(f"{place} = {place} + ({joined([f't{i}' for i in stages])})")


def _factorise(source: _Rows) -> None:
    """Emit elimination without exchange of rows, counting pivots that ask for one.

    The tests of pivots are those of straight-line code.
    """
    layout, s = source.layout, source.layout.stages
    source.loop(f"for c in range({layout.d}):")
    for q in range(s):
        for p in range(s):
            source.add(f"m{q}_{p} = {source.own(f'c*{s} + {q}', f'c*{s} + {p}')}")
        source.add(f"s{q} = {source.size(f'c*{s} + {q}')}")
    for p in range(s):
        source.add(f"size = {SMALL_PIVOT!r}*s{p}")
        fine = f"all(abs(m{p}_{p}) > size) and all(size <= {source.size(f'c*{s} + {p}', 1)})"
        source.add(f"failed += 0 if {fine} else 1")
        source.add(f"v{p} = 1.0/m{p}_{p}")
        source.add(f"{source.own(f'c*{s} + {p}', f'c*{s} + {p}')} = v{p}")
        for q in range(p + 1, s):
            source.add(f"f{q}_{p} = m{q}_{p}*v{p}")
            source.add(f"{source.own(f'c*{s} + {q}', f'c*{s} + {p}')} = f{q}_{p}")
            for o in range(p + 1, s):
                source.add(f"g = f{q}_{p}*m{p}_{o}")
                source.add(f"m{q}_{o} = m{q}_{o} - g")
                if o == q:
                    source.add(f"s{q} = s{q} + abs(g)")
                source.add(f"{source.own(f'c*{s} + {q}', f'c*{s} + {o}')} = m{q}_{o}")
    source.loop(f"for j in range(c + 1, {layout.d}):")
    source.where("c", "j")
    _within(source, f"j*{s}", f"(j + 1)*{s}")
    source.end(2)
    _within(source, str(layout.own), str(layout.width))
    source.loop(f"for e in range(c + 1, {layout.d}):")
    source.where("e", "c")
    _block(source, "e", "c")
    for q in range(s):
        for p in range(s):
            terms = [f"b{q}_{o}*m{o}_{p}" for o in range(p)]
            left = f"b{q}_{p}" if not terms else f"(b{q}_{p} - ({joined(terms)}))"
            source.add(f"b{q}_{p} = {left}*v{p}")
            source.add(f"{source.own(f'e*{s} + {q}', f'c*{s} + {p}')} = b{q}_{p}")
    source.where("c", "e")
    for q in range(s):
        source.add(f"size = {source.size(f'e*{s} + {q}')}")
        for p in range(s):
            above = source.own(f"c*{s} + {p}", f"e*{s} + {q}")
            source.add(f"size = size + abs(b{q}_{p}*{above})")
        # Within a dof's own block what its stages take from each other comes later.
        source.add(f"{source.size(f'e*{s} + {q}')} = size")
    source.end()
    source.loop(f"for j in range(c + 1, {layout.d}):")
    source.where("c", "j")
    source.loop(f"if {source.flag('e', 'j')} < 1.0:")
    for q in range(s):
        for p in range(s):
            source.add(f"{source.own(f'e*{s} + {q}', f'j*{s} + {p}')} = 0.0")
    source.add(f"{source.flag('e', 'j')} = 1.0")
    source.end()
    _subtract(source, "e", "c", f"j*{s}", f"(j + 1)*{s}")
    source.end(2)
    _subtract(source, "e", "c", str(layout.own), str(layout.width))
    source.end(3)


def _within(source: _Rows, first: str, end: str) -> None:
    """Subtract from the lines of a dof what the stages before them have in the same columns."""
    s = source.layout.stages
    source.loop(f"for k in range({first}, {end}):")
    for q in range(s):
        source.add(f"r{q} = {source.own(f'c*{s} + {q}', 'k')}")
        for p in range(q):
            source.add(f"r{q} = r{q} - f{q}_{p}*r{p}")
        if q:
            source.add(f"{source.own(f'c*{s} + {q}', 'k')} = r{q}")
    source.end()


def _block(source: _Rows, line: str, column: str) -> None:
    """Load a block into ``b``."""
    s = source.layout.stages
    for q in range(s):
        for p in range(s):
            source.add(f"b{q}_{p} = {source.own(f'{line}*{s} + {q}', f'{column}*{s} + {p}')}")


def _subtract(source: _Rows, line: str, other: str, first: str, end: str) -> None:
    """Subtract the block ``b`` times the rows of another dof from those of one dof."""
    s = source.layout.stages
    source.loop(f"for k in range({first}, {end}):")
    for p in range(s):
        source.add(f"r{p} = {source.own(f'{other}*{s} + {p}', 'k')}")
    for q in range(s):
        source.add(f"y = {source.own(f'{line}*{s} + {q}', 'k')}")
        for p in range(s):
            source.add(f"y = y - b{q}_{p}*r{p}")
        source.add(f"{source.own(f'{line}*{s} + {q}', 'k')} = y")
    source.end()


def _back(source: _Rows, first: int) -> None:
    """Emit back substitution of the right-hand sides from one column on."""
    layout, s = source.layout, source.layout.stages
    source.loop(f"for backwards in range({layout.d}):")
    source.add(f"e = {layout.d - 1} - backwards")
    source.loop(f"for c in range(e + 1, {layout.d}):")
    source.where("e", "c")
    _block(source, "e", "c")
    _subtract(source, "e", "c", str(first), str(layout.width))
    source.end(2)
    for q in range(s):
        for p in range(q, s):
            source.add(f"m{q}_{p} = {source.own(f'e*{s} + {q}', f'e*{s} + {p}')}")
    source.loop(f"for k in range({first}, {layout.width}):")
    for q in range(s - 1, -1, -1):
        source.add(f"r{q} = {source.own(f'e*{s} + {q}', 'k')}")
        for p in range(s - 1, q, -1):
            source.add(f"r{q} = r{q} - m{q}_{p}*r{p}")
        source.add(f"r{q} = r{q}*m{q}_{q}")
        source.add(f"{source.own(f'e*{s} + {q}', 'k')} = r{q}")
    source.end(2)


def _ends(source: _Rows, method: Tableau, first: int) -> None:
    """Emit the last state's columns from one on; the last is what the residual adds to it, with
    the jump to the next step's first state."""
    layout, s, ba = source.layout, method.stages, method.b @ method.a
    D, d = layout.state, layout.d
    for run in layout.runs:
        source.loop(f"for j in range({run.count}):")
        source.add(f"state = {run.state} + j*{run.order}")
        last = "state" if run.order == 1 else "state + 1"
        source.loop(f"for k in range({first}, {D + 1}):")
        for st in range(s):
            source.add(
                f"r{st} = {source.own(f'({run.first} + j)*{s} + {st}', f'{layout.own} + k')}"
            )
        once = joined([f"{literal(method.b[st])}*r{st}" for st in range(s)])
        source.add(f"{source.last(last, 'k')} = h1*({once})")
        if run.order == 2:
            twice = joined([f"{literal(ba[st])}*r{st}" for st in range(s)])
            source.add(f"{source.last('state', 'k')} = h2*({twice})")
        source.end()
        for st in range(s):
            place = f"({D + st * d + run.first} + j)*{REACH} + at"
            source.add(f"a{st} = {vector('x', place)}")
        now, following = (vector("x", f"({last})*{REACH} + {k} + at") for k in (0, WIDTH))
        gain = joined([f"{literal(method.b[st])}*a{st}" for st in range(s)])
        source.add(f"speed = {now}")
        end = source.last(last, str(D))
        source.add(f"{end} = {end} + (speed - {following} + h1*({gain}))")
        if first == 0:
            source.add(f"{source.last(last, last)} = {source.last(last, last)} + 1.0")
        if run.order == 2:
            now, following = (vector("x", f"state*{REACH} + {k} + at") for k in (0, WIDTH))
            gain = joined([f"{literal(ba[st])}*a{st}" for st in range(s)])
            end = source.last("state", str(D))
            source.add(f"{end} = {end} + ({now} - {following} + h1*(speed + h1*({gain})))")
            if first == 0:
                for column, one in (("state", "1.0"), ("state + 1", "h1")):
                    place = source.last("state", column)
                    source.add(f"{place} = {place} + {one}")
        source.end()


def _past(D: int, i: str, k: str, later: int = 0) -> str:
    """A component of the recursion's history, or of the row after."""
    row = f"before + {later * D * (D + 1) * WIDTH}" if later else "before"
    return vector("history", f"{row} + (({i})*{D + 1} + {k})*{WIDTH}")


def chain(orders: Sequence[int], stages: int, *, constants_only: bool = False) -> str:
    """Recursion of the chunks; the history is ``(t, D, D + 1, WIDTH)``."""
    layout = Layout(tuple(orders), stages)
    D = layout.state
    name = "follow" if constants_only else "chain"
    source = _Rows(name, "transfer, history, rows, width", layout)
    source.rows("rows")
    source.add(f"before = t*{D * (D + 1) * WIDTH}")
    tile = WIDE_TILE if has_wide_registers() else TILE
    high, wide = (4, 1) if constants_only else tile
    lines, columns = _tiles(D, high), [(D, 1, 1)] if constants_only else _tiles(D + 1, wide)
    for i0, i_count, rows in lines:
        source.loop(f"for i in range({i_count}):")
        for k0, k_count, across in columns:
            source.loop(f"for k in range({k_count}):")
            _tile(source, D, (i0, rows), (k0, across))
            source.end()
        for q in range(rows):
            line = f"{i0} + i*{rows} + {q}"
            place = _past(D, line, str(D), 1)
            source.add(f"{place} = {place} + {source.last(line, str(D))}")
        source.end()
    return "\n".join(source.lines)


def _tiles(size: int, tile: int) -> list[tuple[int, int, int]]:
    """Where tiles of one size begin, how many they are, and their size."""
    whole, rest = divmod(size, tile)
    found = [(0, whole, tile)] if whole else []
    return [*found, (whole * tile, 1, rest)] if rest else found


def _tile(source: _Rows, D: int, lines: tuple[int, int], columns: tuple[int, int]) -> None:
    """Emit a tile of the product of a step's matrix and the history."""
    (i0, rows), (k0, across) = lines, columns
    line = [f"{i0} + i*{rows} + {q}" for q in range(rows)]
    column = [f"{k0} + k*{across} + {p}" for p in range(across)]
    tile = [(q, p) for q in range(rows) for p in range(across)]

    def factors(o: str) -> None:
        for q in range(rows):
            source.add(f"a{q} = {source.last(line[q], o)}")
        for p in range(across):
            source.add(f"h{p} = {_past(D, o, column[p])}")

    factors("0")
    for q, p in tile:
        source.add(f"c{q}_{p} = a{q}*h{p}")
    source.loop(f"for o in range(1, {D}):")
    factors("o")
    for q, p in tile:
        source.add(f"c{q}_{p} = c{q}_{p} + a{q}*h{p}")
    source.end()
    for q, p in tile:
        source.add(f"{_past(D, line[q], column[p], 1)} = c{q}_{p}")


def columns_of(D: int) -> int:
    """Columns of the chunks' products: whole vectors."""
    return -(-D // WIDTH) * WIDTH


def product(D: int) -> str:
    """Products of the chunks' matrices, ``(WIDTH + 1, D, columns)``, from the identity on."""
    columns = columns_of(D)
    source = Source("product", "history, products, whole, rest, width")
    source.loop(f"for c in range({WIDTH}):")
    source.add(_end_of_chunk(D))
    source.add(f"at = c*{D * columns}")
    source.loop(f"for i in range({D}):")
    blocks = range(0, columns, WIDTH)
    for k in blocks:
        source.add(f"y{k} = 0.0*{vector('products', f'at + {k}')}")
    source.loop(f"for o in range({D}):")
    source.add(f"a = {_last_of_chunk(D, 'i', 'o')}")
    for k in blocks:
        source.add(f"y{k} = y{k} + a*{vector('products', f'at + o*{columns} + {k}')}")
    source.indent = source.indent[:-4]
    for k in blocks:
        source.add(f"{vector('products', f'at + ({D} + i)*{columns} + {k}')} = y{k}")
    return "\n".join(source.lines)


def begin(D: int) -> str:
    """First states of the chunks, ``(D, WIDTH)``: of a closed period, or from nothing.

    What the first solution misses the closure by is solved for once more, as in straight-line code.
    """
    source = Source("begin", "history, inverse, start, whole, rest, closed")

    def outer(*heads: str) -> None:
        source.indent = "    "
        for head in heads:
            source.loop(head)

    def states(closed: bool, chunks: int) -> None:
        """Through so many chunks; that after the last replaces the first."""
        outer(*(["if closed > 0:"] if closed else []), f"for c in range({chunks}):")
        source.add(_end_of_chunk(D))
        source.add(f"after = c + 1 if c < {WIDTH - 1} else 0")
        source.loop(f"for i in range({D}):")
        source.add(f"y = {_last_of_chunk(D, 'i', str(D))}")
        source.loop(f"for o in range({D}):")
        source.add(f"y += {_last_of_chunk(D, 'i', 'o')}*start[o*{WIDTH} + c]")
        source.indent = source.indent[:-4]
        source.add(f"start[i*{WIDTH} + after] = y")

    outer(f"for i in range({D}):")
    source.add(f"start[i*{WIDTH}] = 0.0")
    states(closed=True, chunks=WIDTH)
    outer("if closed > 0:", f"for i in range({D}):")
    source.add("y = 0.0")
    source.loop(f"for k in range({D}):")
    source.add(f"y += inverse[i*{D} + k]*start[k*{WIDTH}]")
    source.indent = source.indent[:-4]
    source.add(f"start[i*{WIDTH} + 1] = y")
    outer("if closed > 0:", f"for i in range({D}):")
    source.add(f"start[i*{WIDTH}] = start[i*{WIDTH} + 1]")
    states(closed=True, chunks=WIDTH - 1)
    outer("if closed > 0:", f"for c in range({WIDTH - 1}, {WIDTH}):")
    source.add(_end_of_chunk(D))
    source.loop(f"for i in range({D}):")
    source.add(f"y = {_last_of_chunk(D, 'i', str(D))} - start[i*{WIDTH}]")
    source.loop(f"for o in range({D}):")
    source.add(f"y += {_last_of_chunk(D, 'i', 'o')}*start[o*{WIDTH} + c]")
    source.indent = source.indent[:-4]
    source.add(f"start[i*{WIDTH} + 1] = y")
    outer("if closed > 0:", f"for i in range({D}):")
    source.add(f"y = start[i*{WIDTH}]")
    source.loop(f"for k in range({D}):")
    source.add(f"y += inverse[i*{D} + k]*start[k*{WIDTH} + 1]")
    source.indent = source.indent[:-4]
    source.add(f"start[i*{WIDTH}] = y")
    states(closed=False, chunks=WIDTH - 1)
    return "\n".join(source.lines)


def _end_of_chunk(D: int) -> str:
    """Where in the history a chunk's last state begins; ``rest`` chunks are a step longer."""
    return f"base = (whole + (1 if c < rest else 0))*{D * (D + 1) * WIDTH} + c"


def _last_of_chunk(D: int, i: str, column: str) -> str:
    """Of the matrix from a chunk's first state to its last, or its constant."""
    return f"history[base + ({i}*{D + 1} + {column})*{WIDTH}]"


def update(orders: Sequence[int], stages: int) -> str:
    """The Newton step from the chunks' first states."""
    layout = Layout(tuple(orders), stages)
    d, D = layout.d, layout.state
    source = _Rows("update", "transfer, history, start, block, dx, row, rows, width", layout)
    source.rows("rows")
    source.add(f"before = t*{D * (D + 1) * WIDTH}")
    for i0, count, rows in _tiles(D, 4):
        source.loop(f"for i in range({count}):")
        for q in range(rows):
            source.add(f"y{q} = {_past(D, f'{i0} + i*{rows} + {q}', str(D))}")
        source.loop(f"for k in range({D}):")
        source.add(f"r = {vector('start', f'k*{WIDTH}')}")
        for q in range(rows):
            source.add(f"y{q} = y{q} + {_past(D, f'{i0} + i*{rows} + {q}', 'k')}*r")
        source.end()
        for q in range(rows):
            source.add(f"{vector('dx', f'({i0} + i*{rows} + {q})*row + at')} = y{q}")
        source.end()
    source.loop(f"for j in range({d}):")
    for st in range(stages):
        source.add(f"y{st} = {source.own(f'j*{stages} + {st}', str(layout.width - 1))}")
    source.loop(f"for k in range({D}):")
    source.add(f"r = {vector('dx', 'k*row + at')}")
    for st in range(stages):
        slope = source.own(f"j*{stages} + {st}", f"{layout.own} + k")
        source.add(f"y{st} = y{st} + {slope}*r")
    source.end()
    for st in range(stages):
        source.add(f"{vector('dx', f'({D + st * d} + j)*row + at')} = y{st}")
    return "\n".join(source.lines)
