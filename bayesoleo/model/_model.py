"""Declaration of a model: named terms and definitions in one immutable value.

Declared units are all read and must be SI, because nothing in a model is converted. A declared name
that is not used is reported, because most are typing errors.
"""

from __future__ import annotations

import cmath
import hashlib
import keyword
import math
import re
from collections.abc import Hashable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import sympy as sp

from bayesoleo._schema import reserved
from bayesoleo._units import Unit, in_si, parse_unit
from bayesoleo.errors import InputError, ModelError
from bayesoleo.model._expressions import (
    derivative_symbol,
    parse,
    split_derivative,
    symbol,
    with_symbol_as,
)
from bayesoleo.model._parameters import Condition, Coordinate, Dof, Output, Parameter, check_start
from bayesoleo.model._partial_derivatives import symbols_of
from bayesoleo.model._velocity_dofs import Declared, VelocityDofs, velocity_dofs

type Text = str | float | sp.Expr
type Terms = Mapping[str, sp.Expr]


@lru_cache(maxsize=5_000)
def _slope(term: sp.Expr, moving: sp.Symbol, numbers: frozenset[tuple[sp.Symbol, float]]) -> float:
    """Change of a term with a motion, at a state that is off every zero; zero if it has none, or is
    not real there. Models of a search share most of their terms."""
    known = dict(numbers)
    others = {item: known.get(item, 0.5) for item in term.free_symbols if item != moving}
    try:
        low, high = (complex(term.subs(others).subs(moving, value)) for value in (0.25, 0.75))
    except (TypeError, ValueError):  # the larger of numbers of which one is not real
        return 0.0
    change = high - low
    return change.real if cmath.isfinite(change) and change.imag == 0 else 0.0


@lru_cache(maxsize=20_000)
def _without_definitions(term: sp.Expr, table: tuple[tuple[sp.Symbol, sp.Expr], ...]) -> sp.Expr:
    """A term with the names of definitions replaced by what stands behind them. Models of a search
    share most of their terms and definitions."""
    # One pass is enough for names declared in order; an effect may refer to a later one.
    for _ in range(len(table)):
        for item, body in reversed(table):
            term = with_symbol_as(term, item, body)
        if symbols_of(term).isdisjoint(item for item, _ in table):
            break
    return term


@dataclass(frozen=True)
class Model:
    """Equations of motion and outputs as sums of named terms.

    Implements ``g(q, q', q'', x, theta) = 0`` with ``y = f(q, q', q'', x, theta)`` (Verbeek 1993,
    eqs. 2.1-2.3). Expressions are text over declared names, written as in
    Python; ``dot(q)`` and ``ddot(q)`` are time derivatives of dofs *and* inputs.

    Parameters
    ----------
    name : str
        Short name, for reports.
    outputs : mapping of str to Output, text or mapping
        What is measured and predicted; the key is the channel's name.
    inputs : mapping of str to str
        Channels that drive the model, with their SI unit.
    dofs : mapping of str to Dof or str
        Degrees of freedom; text is the unit. The order of each follows from its equation.
    equations : mapping of str to text or mapping of str to text
        For each dof the terms whose sum is zero: named, or one expression whose summands are then
        numbered.
    parameters : mapping of str to Parameter
        Constants, estimated or fixed.
    conditions : mapping of str to Condition or str
        Known constants of a run; text is the unit.
    definitions : mapping of str to text
        Named intermediate expressions, each in terms of names declared before it.
    admissible : sequence of text
        Expressions that must stay positive, e.g. a gas volume.
    description : str
        One sentence.

    Raises
    ------
    ModelError
        If a name is unknown, declared twice or not usable, a dof lacks its equation, or nothing is
        measured.

    Examples
    --------
    >>> model = Model(
    ...     "linear oscillator",
    ...     inputs={"force": "N"},
    ...     dofs={"position": "m"},
    ...     parameters={
    ...         "mass": Parameter(1.0, "kg", fixed=True),
    ...         "damping": Parameter(0.5, "N*s/m", sd=0.2),
    ...         "stiffness": Parameter(100.0, "N/m", sd=30.0),
    ...     },
    ...     equations={
    ...         "position": "mass*ddot(position) + damping*dot(position)"
    ...         " + stiffness*position - force"
    ...     },
    ...     outputs={"displacement": Output("position", "m")},
    ... )
    >>> model.order("position")
    2
    """

    name: str
    outputs: Mapping[str, Output]
    inputs: Mapping[str, str] = field(default_factory=dict)
    dofs: Mapping[str, Dof] = field(default_factory=dict)
    equations: Mapping[str, Terms] = field(default_factory=dict)
    parameters: Mapping[str, Parameter] = field(default_factory=dict)
    conditions: Mapping[str, Condition] = field(default_factory=dict)
    definitions: Mapping[str, sp.Expr] = field(default_factory=dict)
    admissible: Sequence[sp.Expr] = ()
    description: str = ""

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "dofs", {k: v if isinstance(v, Dof) else Dof(v) for k, v in self.dofs.items()})
        put(
            self,
            "conditions",
            {
                k: v if isinstance(v, Condition) else Condition(v)
                for k, v in self.conditions.items()
            },
        )
        self._check_names()
        check_units(self)
        put(self, "definitions", self._parse_definitions())
        put(self, "equations", self._parse_equations())
        put(self, "outputs", self._parse_outputs())
        put(
            self,
            "admissible",
            tuple(self._parse(text, "admissible region") for text in self.admissible),
        )

    # -- declaration ----------------------------------------------------------------------

    def _check_names(self) -> None:
        seen: dict[str, str] = {}
        kinds = {
            "input": self.inputs,
            "dof": self.dofs,
            "parameter": self.parameters,
            "condition": self.conditions,
            "definition": self.definitions,
        }
        for kind, names in {**kinds, "output": self.outputs}.items():
            for name in names:
                if reserved(kind, name):
                    raise ModelError(
                        f"model {self.name!r}: {kind} {name!r} has a name that results use for"
                        " something else",
                        hint=f"rename it, for example own_{name}",
                    )
        for kind, names in kinds.items():
            for name in names:
                word = keyword.iskeyword(name) or name in ("time", "pi", "dot", "ddot")
                if word or not name.isidentifier():
                    raise ModelError(
                        f"{kind} {name!r} is not usable as a name",
                        hint="reserved; add a letter or an underscore"
                        if word
                        else "write letters, digits and underscores",
                    )
                if name in seen:
                    raise ModelError(f"{name!r} is both {seen[name]} and {kind}", hint="rename one")
                seen[name] = kind
        for name, parameter in self.parameters.items():
            if not isinstance(parameter, Parameter):
                raise ModelError(
                    f"parameter {name!r} is not a Parameter",
                    value=parameter,
                    hint='write Parameter(1.0, "kg", sd=0.1)',
                )
            check_start(name, parameter)

    @property
    def _dynamic(self) -> tuple[str, ...]:
        return (*self.dofs, *self.inputs)

    def _known(self) -> dict[str, sp.Expr]:
        names = (*self.inputs, *self.dofs, *self.parameters, *self.conditions)
        return {name: symbol(name) for name in names}

    def _parse(self, text: Text, where: str) -> sp.Expr:
        if isinstance(text, sp.Expr):
            return text
        known = self._known() | {name: symbol(name) for name in self.definitions}
        where = f"model {self.name!r}, {where}"
        return parse(text, known, self._dynamic, where, self._whole(self.definitions))

    def _whole(self, definitions: Mapping[str, sp.Expr]) -> dict[str, sp.Expr]:
        """What stands behind the names of definitions: a time derivative needs that."""
        whole: dict[str, sp.Expr] = {}
        for name, body in definitions.items():
            whole[name] = body.xreplace({symbol(other): item for other, item in whole.items()})
        return whole

    def _parse_definitions(self) -> dict[str, sp.Expr]:
        known, parsed = self._known(), dict[str, sp.Expr]()
        for name, text in self.definitions.items():
            where = f"model {self.name!r}, definition {name!r}"
            whole = {} if isinstance(text, sp.Expr) else self._whole(parsed)
            parsed[name] = parse(text, known, self._dynamic, where, whole)
            known[name] = symbol(name)
        return parsed

    def _named(self, terms: Text | Mapping[str, Text], where: str) -> dict[str, sp.Expr]:
        if isinstance(terms, Mapping):
            return {
                name: self._parse(text, f"{where}, term {name!r}") for name, text in terms.items()
            }
        summands = sp.Add.make_args(self._parse(terms, where))
        return {f"term {number}": item for number, item in enumerate(summands, 1)}

    def _parse_equations(self) -> dict[str, Terms]:
        if set(self.equations) != set(self.dofs):
            odd = sorted(set(self.equations) ^ set(self.dofs))
            raise ModelError(
                f"model {self.name!r}: dofs and equations do not match at {', '.join(odd)}",
                hint="give every dof one equation under its name",
            )
        return {name: self._named(self.equations[name], f"equation {name!r}") for name in self.dofs}

    def _parse_outputs(self) -> dict[str, Output]:
        if not self.outputs:
            raise ModelError(
                f"model {self.name!r}: no outputs",
                hint='write outputs={"channel": Output("q", "m")}',
            )
        parsed = {}
        for name, output in self.outputs.items():
            declared = output if isinstance(output, Output) else Output(output)
            if name in self.inputs:
                raise ModelError(
                    f"model {self.name!r}: {name!r} is both input and output", hint="rename one"
                )
            parsed[name] = replace(declared, terms=self._named(declared.terms, f"output {name!r}"))
        return parsed

    # -- reading --------------------------------------------------------------------------

    def expand(self, expression: sp.Expr) -> sp.Expr:
        """Replace the names of definitions by what stands behind them."""
        table = tuple((symbol(name), body) for name, body in self.definitions.items())
        if not table:
            return expression
        terms = [_without_definitions(term, table) for term in sp.Add.make_args(expression)]
        return terms[0] if len(terms) == 1 else sp.Add(*terms)

    @cached_property
    def _expanded(self) -> dict[tuple[str, str], sp.Expr]:
        """Equations and outputs that were asked for before."""
        return {}

    def equation(self, dof: str) -> sp.Expr:
        """Left-hand side of a dof's equation, definitions expanded."""
        key = "equation", dof
        if key not in self._expanded:
            self._expanded[key] = self.expand(sp.Add(*self.equations[dof].values()))
        return self._expanded[key]

    def output(self, name: str) -> sp.Expr:
        """Expression of an output, definitions expanded."""
        key = "output", name
        if key not in self._expanded:
            self._expanded[key] = self.expand(sp.Add(*self.output_terms(name).values()))
        return self._expanded[key]

    def output_terms(self, name: str) -> Terms:
        """Named terms of an output."""
        terms = self.outputs[name].terms
        assert isinstance(terms, Mapping)  # made so on construction
        return terms

    def order(self, dof: str) -> int:
        """Order of a dof: of its highest derivative in equations and outputs, at least one."""
        return self._orders.get(dof, 1)

    @cached_property
    def _orders(self) -> dict[str, int]:
        """Order of the highest derivative of every quantity that has one."""
        everything = [self.equation(name) for name in self.dofs]
        everything += [self.output(name) for name in self.outputs]
        found: dict[str, int] = {}
        for item in frozenset().union(*map(symbols_of, everything)):
            name, order = split_derivative(item)
            found[name] = max(1, order, found.get(name, 1))
        return found

    def estimated(self) -> tuple[str, ...]:
        """Names of the unknowns: parameters that are not fixed, and constants known to a
        tolerance."""
        held = {name for name, item in self.parameters.items() if item.fixed and item.prior is None}
        return tuple(name for name in self.parameters if name not in held)

    def uncertain(self) -> tuple[str, ...]:
        """Names of the constants known to a tolerance: fixed, with a prior."""
        return tuple(name for name, item in self.parameters.items() if item.toleranced)

    def nominal(self) -> dict[sp.Symbol, float]:
        """Values of parameters and of conditions that have a default, for substitution."""
        values = {symbol(name): parameter.value for name, parameter in self.parameters.items()}
        defaults = {
            name: item.default for name, item in self.conditions.items() if item.default is not None
        }
        return values | {symbol(name): value for name, value in defaults.items()}

    def coordinates(self) -> tuple[Coordinate, ...]:
        """Every place where a force-like effect can act.

        These are the equations of dofs of second order, and the outputs that depend on an input (a
        force law), and the equations of dofs of first order: those in a unit of velocity with that
        velocity, the others without one. A dof whose rate another dof is has no place of its own.
        """
        return self._coordinates

    @cached_property
    def _coordinates(self) -> tuple[Coordinate, ...]:
        places = []
        for dof in self.dofs:
            if dof in self._velocity_dofs.positions:
                continue
            top = derivative_symbol(dof, self.order(dof))
            leading = sp.diff(self.equation(dof), top).subs(self.nominal())
            sign = -1 if leading.is_number and leading < 0 else 1
            places.append(self._at(dof, sign))
        for output in self.outputs:
            names = {split_derivative(item)[0] for item in self.output(output).free_symbols}
            for name in self.inputs:
                if name in names:
                    velocity, sign = derivative_symbol(name, 1), self._sense(output, name)
                    places.append(
                        Coordinate(name, symbol(name), velocity, "output", output, sign, name)
                    )
        return tuple(places)

    def _at(self, dof: str, sign: int) -> Coordinate:
        """The place of a dof's equation."""
        if dof in self._velocity_dofs.velocities:
            name = self._velocity_dofs.position_of(dof)
            position = None if name is None else symbol(name)
            return Coordinate(
                dof, position, symbol(dof), "equation", dof, sign, name or dof, order=0
            )
        velocity = derivative_symbol(dof, 1) if self.order(dof) == 2 else None
        return Coordinate(dof, symbol(dof), velocity, "equation", dof, sign, dof)

    @cached_property
    def _velocity_dofs(self) -> VelocityDofs:
        """The velocities among the dofs of first order, and their positions."""
        quantities = self.dofs, self.parameters, self.conditions
        units = {name: item.unit for items in quantities for name, item in items.items()}
        return velocity_dofs(
            Declared(
                {dof: self.equation(dof) for dof in self.dofs},
                {dof: self.order(dof) for dof in self.dofs},
                {**self.inputs, **units},
                tuple(self.inputs),
            )
        )

    def _sense(self, output: str, name: str) -> int:
        """Sign with which an output shows what resists a motion: -1 if it is the force on the other
        body. What damps decides, without it what springs back; +1 where terms disagree."""
        terms, numbers = map(self.expand, self.output_terms(output).values()), self.nominal()
        known = [
            (term, frozenset((item, numbers[item]) for item in term.free_symbols & numbers.keys()))
            for term in terms
        ]
        for moving in (derivative_symbol(name, 1), symbol(name)):
            values = [_slope(term, moving, given) for term, given in known if term.has(moving)]
            found = {math.copysign(1.0, value) for value in values if value}
            if found:
                return -1 if found == {-1.0} else 1
        return 1

    def digest(self) -> str:
        """SHA-256 of what the model says; equal for models that say the same in the same words."""
        return hashlib.sha256(repr(self).encode()).hexdigest()

    @cached_property
    def structure(self) -> Hashable:
        """The statement of the model without the values and priors of its parameters.

        Models of equal structure have the same equations, and so the same compiled code.
        """

        def pairs(items: Mapping[str, Hashable]) -> Hashable:
            return tuple(items.items())

        return (
            (self.name, self.description, tuple(self.parameters), tuple(self.admissible)),
            pairs(self.inputs),
            pairs(self.dofs),
            pairs(self.conditions),
            pairs(self.definitions),
            pairs({dof: pairs(terms) for dof, terms in self.equations.items()}),
            pairs({n: (o.unit, o.description) for n, o in self.outputs.items()}),
            pairs({name: pairs(self.output_terms(name)) for name in self.outputs}),
        )

    # -- changing: what effects are made of -----------------------------------------------

    def with_parameters(self, **parameters: Parameter) -> Model:
        """Add parameters, or replace those of the same name."""
        other = copy(self)  # expressions stay, and what was found out about them
        object.__setattr__(other, "parameters", {**self.parameters, **parameters})
        known = self.parameters
        if any(name in known and known[name].value != p.value for name, p in parameters.items()):
            other.__dict__.pop("_coordinates", None)  # their signs follow nominal values
        if any(name in known and known[name].unit != p.unit for name, p in parameters.items()):
            for found in ("_coordinates", "_velocity_dofs"):  # units tell a body from a filter
                other.__dict__.pop(found, None)
        if not self.parameters.keys() >= parameters.keys():
            other.__dict__.pop("structure", None)
        other._check_names()
        if any(name not in known or known[name].unit != p.unit for name, p in parameters.items()):
            check_units(other)
        return other

    def with_term(self, kind: str, target: str, name: str, expression: Text) -> Model:
        """Add a named term to a balance, or replace the one of that name.

        ``kind`` says where the balance stands: ``equation`` or ``output``.
        """
        if kind == "equation":
            terms = {**self.equations[target], name: expression}
            return replace(self, equations={**self.equations, target: terms})
        output = replace(
            self.outputs[target], terms={**self.output_terms(target), name: expression}
        )
        return replace(self, outputs={**self.outputs, target: output})

    def with_definition(self, name: str, expression: Text) -> Model:
        """Add a definition, or redefine the one of that name in place."""
        return replace(self, definitions={**self.definitions, name: expression})

    def with_dof(self, name: str, dof: Dof, equation: Mapping[str, Text]) -> Model:
        """Add a degree of freedom with its equation."""
        return replace(
            self, dofs={**self.dofs, name: dof}, equations={**self.equations, name: equation}
        )

    def with_values(self, values: Mapping[str, float]) -> Model:
        """Set nominal values of parameters; priors stay."""
        changed = {
            name: replace(self.parameters[name], value=value) for name, value in values.items()
        }
        return self.with_parameters(**changed)

    def fixing(self, *names: str) -> Model:
        """Fix parameters at their nominal values, exactly: their priors are dropped."""
        return self.with_parameters(
            **{name: replace(self.parameters[name], fixed=True, prior=None) for name in names}
        )

    def freeing(self, *names: str) -> Model:
        """Take constants known to a tolerance for ordinary unknowns: MBE forgets their priors."""
        return self.with_parameters(
            **{name: replace(self.parameters[name], fixed=False) for name in names}
        )


def velocities_of(model: Model) -> VelocityDofs:
    """The velocities among a model's dofs of first order, and their positions.

    Parameters
    ----------
    model : Model
    """
    return model._velocity_dofs


def check_units(model: Model) -> None:
    """Refuse units that are not known, and those that would have to be converted.

    Parameters
    ----------
    model : Model

    Raises
    ------
    ModelError
        With the unit in which to write the value.
    """
    for kind, name, text, value in _declared(model):
        where = f"model {model.name!r}: {kind} {name!r}"
        try:
            unit = parse_unit(text)
        except InputError as error:
            raise ModelError(
                f"{where} has a unit that is not known", value=text, hint=error.hint
            ) from error
        if unit.factor != 1.0 or unit.shift != 0.0:
            raise ModelError(
                f"{where} is in {text}, but the numbers of a model are in SI",
                value=text,
                hint=_in_si(unit, value),
            )


def _declared(model: Model) -> Iterator[tuple[str, str, str, float | None]]:
    """Kind, name, unit and value of all that has a unit."""
    for name, unit in model.inputs.items():
        yield "input", name, unit, None
    for name, dof in model.dofs.items():
        yield "dof", name, dof.unit, None
    for name, condition in model.conditions.items():
        yield "condition", name, condition.unit, condition.default
    for name, output in model.outputs.items():
        yield "output", name, getattr(output, "unit", ""), None
    for name, parameter in model.parameters.items():
        yield "parameter", name, parameter.unit, parameter.value


def _in_si(unit: Unit, value: float | None) -> str:
    """The remedy, as a hint."""
    wanted = in_si(unit.name)
    if value is None:
        return f"declare it in {wanted}"
    converted = float(unit.to_si(value))
    if unit.shift:
        return f"write {converted:.10g} in {wanted}; differences keep their size"
    more = f", and its sd and bounds times {unit.factor:.10g} (relative_sd stays)" if value else ""
    return f"write {converted:.10g} in {wanted}{more}"


def unused(model: Model) -> dict[str, str]:
    """Names that a model declares and does not use.

    A definition counts as a use even where no equation needs it: it is a quantity that effects may
    act on.

    Parameters
    ----------
    model : Model
        As declared.

    Returns
    -------
    dict of str to str
        Kind of each such name: ``input``, ``parameter`` or ``condition``.

    Examples
    --------
    >>> from bayesoleo.model import Output, Parameter
    >>> spring = Model(
    ...     "spring",
    ...     inputs={"stroke": "m"},
    ...     parameters={"k": Parameter(1.0, sd=0.1), "mass": Parameter(2.0, "kg", fixed=True)},
    ...     outputs={"force": Output("k*stroke", "N")},
    ... )
    >>> unused(spring)
    {'mass': 'parameter'}
    """
    kinds = {
        "input": model.inputs,
        "parameter": model.parameters,
        "condition": model.conditions,
    }
    words = _words(model)
    return {name: kind for kind, names in kinds.items() for name in names if name not in words}


def _words(model: Model) -> set[str]:
    """Every name in an equation, output, definition, bound, guess or start."""
    expressions = [*model.definitions.values(), *model.admissible]
    for terms in model.equations.values():
        expressions += terms.values()
    for output in model.outputs:
        expressions += model.output_terms(output).values()
    found = {
        split_derivative(item)[0] for expression in expressions for item in expression.free_symbols
    }
    for dof in model.dofs.values():
        text = f"{dof.guess} {dof.initial} {dof.initial_rate}"
        found |= set(re.findall(r"[^\W\d]\w*", text))
    return found
