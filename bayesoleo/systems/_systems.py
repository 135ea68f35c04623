"""The built-in systems by name, and equations as text and LaTeX.

The description of a model also lists its parameters with units and priors.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import sympy as sp
from sympy.printing.latex import LatexPrinter

from bayesoleo.errors import InputError, choose
from bayesoleo.model._expressions import as_text, bspline, split_derivative
from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Parameter
from bayesoleo.systems import _oleo as oleo, _oscillators as oscillators

#: Splines that a formula shows one by one.
MOST_SPLINES = 4

_SYSTEMS: dict[str, Callable[[], Model]] = {
    "gas_spring": oscillators.gas_spring,
    "viscous_damper": oscillators.viscous_damper,
    "linear_oscillator": oscillators.linear_oscillator,
    "duffing": oscillators.duffing,
    "end_stop": oscillators.end_stop,
    "f16n1d1": partial(oleo.mechanical_oleo, 1),
    "f16n1d2": partial(oleo.mechanical_oleo, 2),
    "f16n2d1": partial(oleo.thermomechanical_oleo, 1),
    "f16n2d2": partial(oleo.thermomechanical_oleo, 2),
    "f16n1d1_thesis": partial(oleo.mechanical_oleo_thesis, 1),
    "f16n1d2_thesis": partial(oleo.mechanical_oleo_thesis, 2),
    "f16n2d1_thesis": partial(oleo.thermomechanical_oleo_thesis, 1),
    "f16n2d2_thesis": partial(oleo.thermomechanical_oleo_thesis, 2),
    "f16n2d1_thesis_printed": partial(oleo.thermomechanical_oleo_thesis, 1, printed=True),
    "f16n2d2_thesis_printed": partial(oleo.thermomechanical_oleo_thesis, 2, printed=True),
    "van_der_pol": oscillators.van_der_pol,
    "lorenz": oscillators.lorenz,
    "rossler": oscillators.rossler,
}


def as_latex(expression: sp.Expr, model: Model) -> str:
    """LaTeX of an expression, with the parameters' own symbols and dots for time derivatives."""
    names = {item: _latex_symbol(item, model) for item in expression.free_symbols}
    settings = {"symbol_names": names, "ln_notation": True, "mul_symbol": r" \, "}
    return str(LatexPrinter(settings).doprint(expression))


def _latex_symbol(item: sp.Symbol, model: Model) -> str:
    name, order = split_derivative(item)
    parameter = model.parameters.get(name)
    upright = "\\mathrm{" + name.replace("_", "\\_") + "}"
    base = parameter.latex if parameter is not None and parameter.latex else upright
    return base if order == 0 else f"\\{'d' * order}ot{{{base}}}"


def equations(model: Model) -> dict[str, str]:
    """Definitions, equations and outputs as text, by name."""
    lines = {name: f"{name} = {as_text(body)}" for name, body in model.definitions.items()}
    for name, terms in model.equations.items():
        lines[name] = f"{_sum_text(terms)} = 0"
    for name in model.outputs:
        lines[f"output {name}"] = f"{name} = {_sum_text(model.output_terms(name))}"
    return lines


def equations_latex(model: Model) -> list[str]:
    """The same as a list of LaTeX equations."""

    def total(terms: Mapping[str, sp.Expr]) -> str:
        parts = [as_latex(term, model) for term in terms.values()]
        return " + ".join(parts).replace("+ -", "-")

    def upright(name: str) -> str:
        return "\\mathrm{" + name.replace("_", "\\_") + "}"

    lines = [f"{upright(k)} = {_body(body, model)}" for k, body in model.definitions.items()]
    lines += [f"{total(terms)} = 0" for terms in model.equations.values()]
    lines += [f"{upright(k)} = {total(model.output_terms(k))}" for k in model.outputs]
    return lines


def _body(body: sp.Expr, model: Model) -> str:
    """A definition; of a curve made of many splines only what it follows."""
    splines = body.atoms(bspline)
    if len(splines) <= MOST_SPLINES:
        return as_latex(body, model)
    followed = {item for spline in splines for item in spline.free_symbols}
    names = sorted(_latex_symbol(item, model) for item in followed)
    return rf"\sum_k a_k \, B_k({', '.join(names)})"


def _sum_text(terms: Mapping[str, sp.Expr]) -> str:
    return " + ".join(as_text(term) for term in terms.values()).replace("+ -", "- ")


def describe(model: Model) -> dict[str, Any]:
    """Everything that a model declares, ready for JSON.

    Returns
    -------
    dict
        ``name``, ``description``, ``equations`` (name to text), ``equations_latex`` (list),
        ``inputs``, ``dofs``, ``outputs`` and ``conditions`` (name to unit, or to a mapping with
        ``unit`` and ``default``), ``parameters`` (name to ``value``, ``unit``, ``fixed``,
        ``by_run``, ``prior``, ``description``).
    """
    return {
        "name": model.name,
        "description": model.description,
        "inputs": dict(model.inputs),
        "outputs": {name: output.unit for name, output in model.outputs.items()},
        "dofs": {name: dof.unit for name, dof in model.dofs.items()},
        "conditions": {
            name: {"unit": item.unit, "default": item.default, "description": item.description}
            for name, item in model.conditions.items()
        },
        "parameters": {name: _parameter(item) for name, item in model.parameters.items()},
        "equations": equations(model),
        "equations_latex": equations_latex(model),
    }


def _parameter(item: Parameter) -> dict[str, Any]:
    prior = None
    if item.prior is not None:
        low, high = (value if abs(value) < float("inf") else None for value in item.prior.support)
        prior = {
            "kind": type(item.prior).__name__,
            "mean": item.prior.mean,
            "sd": item.prior.sd,
            "low": low,
            "high": high,
        }
    return {
        "value": item.value,
        "unit": item.unit,
        "fixed": item.fixed,
        "by_run": item.by_run,
        "prior": prior,
        "description": item.description,
    }


def systems() -> tuple[str, ...]:
    """Names of the built-in systems."""
    return tuple(_SYSTEMS)


def system(name: str) -> Model:
    """A built-in system by its name.

    Raises
    ------
    InputError
        If there is none; the message names the closest.
    """
    if name not in _SYSTEMS:
        hint = f"{choose(str(name).lower(), _SYSTEMS, 3)} (or write file.py:object)"
        raise InputError("unknown system", value=name, hint=hint)
    return _SYSTEMS[name]()
