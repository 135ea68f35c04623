"""Machine code of generated loops.

What the generators of straight-line code write is a small part of Python: assignments, loops over a
range, sums and products of numbers in arrays. Its types are known from the arguments. So it is
translated to LLVM's instructions here, one by one. Numba takes ten seconds for the code of two dofs
and gives the same instructions in the end.
"""

from __future__ import annotations

import ast
from collections.abc import Collection

from bayesoleo._machine_code import number

_FLOAT, _WHOLE = "double", "i64"
#: A product may be added without being rounded first.
_OPERATIONS = {
    ast.Add: ("fadd contract", "add nsw"),
    ast.Sub: ("fsub contract", "sub nsw"),
    ast.Mult: ("fmul contract", "mul nsw"),
    ast.Div: ("fdiv", ""),
}
_COMPARISONS = {
    ast.Gt: ("fcmp ogt", "icmp sgt"),
    ast.Lt: ("fcmp olt", "icmp slt"),
    ast.LtE: ("fcmp ole", "icmp sle"),
}

#: A value's name in the instructions, and its type.
_Value = tuple[str, str]


def instructions(source: str, pointers: Collection[str], returned: str = "void") -> str:
    """LLVM's text of a function for :func:`~bayesoleo._machine_code.address_of`.

    Parameters
    ----------
    source : str
        A function of Python.
    pointers : collection of str
        Arguments that are arrays of numbers; the others are whole numbers.
    returned : str
        Type of what it returns.
    """
    (function,) = ast.parse(source).body
    assert isinstance(function, ast.FunctionDef)
    return _Function(function, pointers).text(returned)


class _Function:
    """One function, translated statement by statement.

    Variables stand in memory; the compiler brings them into registers.
    """

    def __init__(self, function: ast.FunctionDef, pointers: Collection[str]):
        self._function = function
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
                arguments.append(f"ptr %{item.arg}")
            else:
                arguments.append(f"{_WHOLE} %given_{item.arg}")
                self._assign(item.arg, (f"%given_{item.arg}", _WHOLE))
        self._body(self._function.body)
        if returned == "void":
            self._lines.append("ret void")
        head = f"define {returned} @kernel({', '.join(arguments)}) {{"
        return "\n".join([head, "entry:", *self._first, *self._lines, "}", ""])

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
                    iter=ast.Call(func=ast.Name(id="range"), args=[end]),
                    body=body,
                    orelse=[],
                ):
                    self._loop(name, end, body)
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
            if value[1] != _FLOAT:
                raise NotImplementedError(f"a whole number in {ast.unparse(target)}")
            self._lines.append(f"store {_FLOAT} {value[0]}, ptr {self._place(target)}")

    def _assign(self, name: str, value: _Value) -> None:
        if name not in self._variables:
            self._variables[name] = value[1]
            self._first.append(f"%at_{name} = alloca {value[1]}")
        assert self._variables[name] == value[1], name
        self._lines.append(f"store {value[1]} {value[0]}, ptr %at_{name}")

    def _loop(self, name: str, end: ast.expr, body: list[ast.stmt]) -> None:
        self._count += 1
        label = f"loop{self._count}"
        self._assign(name, ("0", _WHOLE))
        self._lines += [f"br label %{label}", f"{label}:"]
        index = ast.Name(id=name, ctx=ast.Load())
        test = self._compare(ast.Lt(), self._value(index), self._value(end))
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
                return self._new(f"load {_FLOAT}, ptr {self._place(expression)}"), _FLOAT
            case ast.BinOp(left=left, op=op, right=right):
                return self._operation(op, self._value(left), self._value(right))
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                name, kind = self._value(operand)
                assert kind == _FLOAT
                return self._new(f"fneg {kind} {name}"), kind
            case ast.Call(func=ast.Name(id="abs"), args=[argument]):
                name, kind = self._value(argument)
                return self._new(f"call {kind} @llvm.fabs.f64({kind} {name})"), kind
            case ast.IfExp(test=test, body=body, orelse=other):
                condition = self._condition(test)
                (one, kind), (two, _) = self._value(body), self._value(other)
                return self._new(f"select i1 {condition}, {kind} {one}, {kind} {two}"), kind
            case _:
                raise NotImplementedError(ast.unparse(expression))

    def _operation(self, op: ast.operator, left: _Value, right: _Value) -> _Value:
        assert left[1] == right[1]
        name = _OPERATIONS[type(op)][left[1] == _WHOLE]
        return self._new(f"{name} {left[1]} {left[0]}, {right[0]}"), left[1]

    def _condition(self, expression: ast.expr) -> str:
        match expression:
            case ast.BoolOp(op=ast.And(), values=[one, other]):
                return self._new(f"and i1 {self._condition(one)}, {self._condition(other)}")
            case ast.Compare(left=left, ops=[op], comparators=[right]):
                return self._compare(op, self._value(left), self._value(right))
            case _:
                raise NotImplementedError(ast.unparse(expression))

    def _compare(self, op: ast.cmpop, left: _Value, right: _Value) -> str:
        assert left[1] == right[1]
        name = _COMPARISONS[type(op)][left[1] == _WHOLE]
        return self._new(f"{name} {left[1]} {left[0]}, {right[0]}")

    def _place(self, target: ast.Subscript) -> str:
        """Pointer to an entry of an array."""
        assert isinstance(target.value, ast.Name)
        index, kind = self._value(target.slice)
        assert kind == _WHOLE
        return self._new(f"getelementptr inbounds double, ptr %{target.value.id}, i64 {index}")

    def _new(self, text: str) -> str:
        self._count += 1
        self._lines.append(f"%v{self._count} = {text}")
        return f"%v{self._count}"
