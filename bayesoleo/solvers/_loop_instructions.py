"""Machine code of generated loops.

What the generators of straight-line code write is a small part of Python: assignments, loops over a
range, sums and products of numbers in arrays. Its types are known from the arguments. So it is
translated to LLVM's instructions here, one by one. Numba takes ten seconds for the code of two dofs
and gives the same instructions in the end.

A slice of :data:`WIDE` numbers is one vector, and what is computed from it one instruction. Loops
within loops need this: the compiler turns only innermost loops into vector instructions by itself.
"""

from __future__ import annotations

import ast
from collections.abc import Collection

from bayesoleo._machine_code import number

#: Numbers in a vector: eight fill a register of AVX-512, and two of AVX2.
WIDE = 8
_FLOAT, _WHOLE = "double", "i64"
_VECTOR = f"<{WIDE} x {_FLOAT}>"
#: Truth of one comparison, and of those of a vector.
_TRUE, _TRUTHS = "i1", f"<{WIDE} x i1>"
#: What vectors need beyond the library.
_DECLARED = f"""declare {_VECTOR} @llvm.fabs.v{WIDE}f64({_VECTOR})
declare i1 @llvm.vector.reduce.or.v{WIDE}i1({_TRUTHS})
declare i1 @llvm.vector.reduce.and.v{WIDE}i1({_TRUTHS})
"""
#: A product may be added without being rounded first.
_OPERATIONS = {
    ast.Add: ("fadd contract", "add nsw"),
    ast.Sub: ("fsub contract", "sub nsw"),
    ast.Mult: ("fmul contract", "mul nsw"),
    ast.Div: ("fdiv", ""),
    ast.FloorDiv: ("", "sdiv"),
}
_COMPARISONS = {
    ast.Gt: ("fcmp ogt", "icmp sgt"),
    ast.Lt: ("fcmp olt", "icmp slt"),
    ast.LtE: ("fcmp ole", "icmp sle"),
    ast.NotEq: ("fcmp une", "icmp ne"),
}

#: A value's name in the instructions, and its type.
_Value = tuple[str, str]


def instructions(
    source: str, pointers: Collection[str], returned: str = "void", *, apart: bool = False
) -> str:
    """LLVM's text of a function for :func:`~bayesoleo._machine_code.address_of`.

    Parameters
    ----------
    source : str
        A function of Python.
    pointers : collection of str
        Arguments that are arrays of numbers; the others are whole numbers.
    returned : str
        Type of what it returns.
    apart : bool
        Tell the compiler that no two of the arrays overlap. It need not ask before each loop, and
        may read ahead of what is written.
    """
    (function,) = ast.parse(source).body
    assert isinstance(function, ast.FunctionDef)
    return _Function(function, pointers, apart).text(returned)


class _Function:
    """One function, translated statement by statement.

    Variables stand in memory; the compiler brings them into registers.
    """

    def __init__(self, function: ast.FunctionDef, pointers: Collection[str], apart: bool):
        self._function, self._array = function, "ptr noalias" if apart else "ptr"
        self._pointers = set(pointers)
        self._variables: dict[str, str] = {}
        self._first: list[str] = []
        self._lines: list[str] = []
        self._count = 0

    def text(self, returned: str) -> str:
        """All of it."""
        arguments = []
        for item in self._function.args.args:
            if item.arg in self._pointers:
                arguments.append(f"{self._array} %{item.arg}")
            else:
                arguments.append(f"{_WHOLE} %given_{item.arg}")
                self._assign(item.arg, (f"%given_{item.arg}", _WHOLE))
        self._body(self._function.body)
        if returned == "void":
            self._lines.append("ret void")
        head = f"define {returned} @kernel({', '.join(arguments)}) {{"
        text = "\n".join([head, "entry:", *self._first, *self._lines, "}", ""])
        return _DECLARED + text if _VECTOR in text else text

    # -- statements -----------------------------------------------------------------------

    def _body(self, statements: list[ast.stmt]) -> None:
        for statement in statements:
            match statement:
                case ast.Assign(targets=[target], value=value):
                    self._store(target, self._value(value))
                case ast.AugAssign(target=target, op=op, value=value):
                    changed = self._operation(op, self._value(target), self._value(value))
                    self._store(target, changed)
                case ast.For(
                    target=ast.Name(id=name),
                    iter=ast.Call(func=ast.Name(id="range"), args=[*first, end]),
                    body=body,
                    orelse=[],
                ) if len(first) < 2:
                    self._loop(name, first, end, body)
                case ast.If(test=test, body=body, orelse=[]):
                    self._if(test, body)
                case ast.Return(value=ast.expr() as value):
                    name, kind = self._value(value)
                    self._lines.append(f"ret {kind} {name}")
                case _:
                    raise NotImplementedError(ast.unparse(statement))

    def _store(self, target: ast.expr, value: _Value) -> None:
        if isinstance(target, ast.Name):
            self._assign(target.id, value)
        else:
            assert isinstance(target, ast.Subscript)
            if value[1] == _WHOLE:
                raise NotImplementedError(f"a whole number in {ast.unparse(target)}")
            place, kind = self._place(target)
            if value[1] != kind:
                value = self._alike(value, (place, kind))[0]
            self._lines.append(f"store {kind} {value[0]}, ptr {place}, align 8")

    def _assign(self, name: str, value: _Value) -> None:
        if name not in self._variables:
            self._variables[name] = value[1]
            self._first.append(f"%at_{name} = alloca {value[1]}")
        assert self._variables[name] == value[1], name
        self._lines.append(f"store {value[1]} {value[0]}, ptr %at_{name}")

    def _loop(self, name: str, first: list[ast.expr], end: ast.expr, body: list[ast.stmt]) -> None:
        self._count += 1
        label = f"loop{self._count}"
        self._assign(name, self._value(first[0]) if first else ("0", _WHOLE))
        self._lines += [f"br label %{label}", f"{label}:"]
        index = ast.Name(id=name, ctx=ast.Load())
        test, _ = self._compare(ast.Lt(), self._value(index), self._value(end))
        self._lines += [f"br i1 {test}, label %{label}_in, label %{label}_end", f"{label}_in:"]
        self._body(body)
        self._assign(name, self._operation(ast.Add(), self._value(index), ("1", _WHOLE)))
        self._lines += [f"br label %{label}", f"{label}_end:"]

    def _if(self, test: ast.expr, body: list[ast.stmt]) -> None:
        self._count += 1
        label = f"if{self._count}"
        condition = self._condition(test)
        self._lines += [f"br i1 {condition}, label %{label}, label %{label}_end", f"{label}:"]
        self._body(body)
        self._lines += [f"br label %{label}_end", f"{label}_end:"]

    # -- expressions ----------------------------------------------------------------------

    def _value(self, expression: ast.expr) -> _Value:
        match expression:
            case ast.Constant(value=float(value)):
                return number(value), _FLOAT
            case ast.Constant(value=int(value)) if not isinstance(value, bool):
                return str(value), _WHOLE
            case ast.Name(id=name):
                kind = self._variables[name]
                return self._new(f"load {kind}, ptr %at_{name}"), kind
            case ast.Subscript():
                place, kind = self._place(expression)
                return self._new(f"load {kind}, ptr {place}, align 8"), kind
            case ast.BinOp(left=left, op=op, right=right):
                return self._operation(op, self._value(left), self._value(right))
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                name, kind = self._value(operand)
                assert kind != _WHOLE
                return self._new(f"fneg {kind} {name}"), kind
            case ast.Call(func=ast.Name(id="abs"), args=[argument]):
                name, kind = self._value(argument)
                which = f"v{WIDE}f64" if kind == _VECTOR else "f64"
                return self._new(f"call {kind} @llvm.fabs.{which}({kind} {name})"), kind
            case ast.IfExp(test=test, body=body, orelse=other):
                condition = self._condition(test)
                (one, kind), (two, _) = self._value(body), self._value(other)
                return self._new(f"select i1 {condition}, {kind} {one}, {kind} {two}"), kind
            case _:
                raise NotImplementedError(ast.unparse(expression))

    def _operation(self, op: ast.operator, left: _Value, right: _Value) -> _Value:
        left, right = self._alike(left, right)
        name = _OPERATIONS[type(op)][left[1] == _WHOLE]
        return self._new(f"{name} {left[1]} {left[0]}, {right[0]}"), left[1]

    def _condition(self, expression: ast.expr) -> str:
        match expression:
            case ast.BoolOp(op=ast.And(), values=[one, other]):
                return self._new(f"and i1 {self._condition(one)}, {self._condition(other)}")
            case ast.Compare(left=left, ops=[op], comparators=[right]):
                name, kind = self._compare(op, self._value(left), self._value(right))
                assert kind == _TRUE
                return name
            case ast.Call(
                func=ast.Name(id=("any" | "all") as which),
                args=[ast.Compare(left=left, ops=[op], comparators=[right])],
            ):
                name, kind = self._compare(op, self._value(left), self._value(right))
                assert kind == _TRUTHS
                how = f"{'or' if which == 'any' else 'and'}.v{WIDE}i1"
                return self._new(f"call i1 @llvm.vector.reduce.{how}({kind} {name})")
            case _:
                raise NotImplementedError(ast.unparse(expression))

    def _compare(self, op: ast.cmpop, left: _Value, right: _Value) -> _Value:
        left, right = self._alike(left, right)
        name = _COMPARISONS[type(op)][left[1] == _WHOLE]
        kind = _TRUTHS if left[1] == _VECTOR else _TRUE
        return self._new(f"{name} {left[1]} {left[0]}, {right[0]}"), kind

    def _alike(self, left: _Value, right: _Value) -> tuple[_Value, _Value]:
        """Two values of one type: a number beside a vector is repeated."""
        if {left[1], right[1]} == {_FLOAT, _VECTOR}:
            left, right = self._widened(left), self._widened(right)
        assert left[1] == right[1]
        return left, right

    def _widened(self, value: _Value) -> _Value:
        if value[1] == _VECTOR:
            return value
        first = self._new(f"insertelement {_VECTOR} poison, {_FLOAT} {value[0]}, i64 0")
        repeated = f"{_VECTOR} {first}, {_VECTOR} poison, <{WIDE} x i32> zeroinitializer"
        return self._new(f"shufflevector {repeated}"), _VECTOR

    def _place(self, target: ast.Subscript) -> _Value:
        """Pointer to an entry of an array, or to a vector of them, and which of the two."""
        assert isinstance(target.value, ast.Name)
        match target.slice:
            case ast.Slice(
                lower=ast.expr() as first,
                upper=ast.BinOp(left=again, op=ast.Add(), right=ast.Constant(value=8)),
                step=None,
            ) if ast.dump(first) == ast.dump(again):
                at, kind = first, _VECTOR
            case ast.Slice():
                raise NotImplementedError(ast.unparse(target))
            case at:
                kind = _FLOAT
        index, whole = self._value(at)
        assert whole == _WHOLE
        start = f"ptr %{target.value.id}"
        return self._new(f"getelementptr inbounds double, {start}, i64 {index}"), kind

    def _new(self, text: str) -> str:
        self._count += 1
        self._lines.append(f"%v{self._count} = {text}")
        return f"%v{self._count}"
