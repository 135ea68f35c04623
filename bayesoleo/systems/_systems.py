"""The built-in systems by name, the small ones among them, and equations as text and LaTeX.

Springs, dampers, oscillators, a limit cycle and strange attractors: each is the smallest system
that shows one idea. The description of a model also lists its parameters with units and priors.
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
from bayesoleo.model._parameters import Dof, Output, Parameter
from bayesoleo.systems import _oleo as oleo

_LINEAR = {
    "inertia": "mass*ddot(position)",
    "damping": "damping*dot(position)",
    "stiffness": "stiffness*position",
    "excitation": "-force",
}


def gas_spring() -> Model:
    r"""Ideal gas spring, :math:`y = (1/(1-x))^\theta` (Verbeek 1993, section 3.4.2); no dof.

    The truth of the example is :math:`\theta = 1.2`, its start 1.0 with a prior of 10 %.
    """
    return Model(
        name="gas_spring",
        description="Ideal gas spring, dimensionless: pressure ratio against compression.",
        inputs={"compression": ""},
        parameters={"exponent": Parameter(1.0, "", relative_sd=0.1, latex="\\theta")},
        outputs={"pressure_ratio": Output({"gas": "(1/(1 - compression))**exponent"}, "")},
        admissible=["1 - compression"],
    )


def viscous_damper() -> Model:
    """Force law of a damper: proportional to velocity, with an offset of each run's own."""
    return Model(
        name="viscous_damper",
        description="Viscous damper with a force offset by run, driven by displacement.",
        inputs={"displacement": "m"},
        parameters={
            "damping": Parameter(1000.0, "N*s/m", relative_sd=1.0, latex="c"),
            "force_offset": Parameter(
                0.0, "N", sd=1000.0, by_run=True, latex="F_0", description="preload and sensor"
            ),
        },
        outputs={
            "force": Output({"damping": "damping*dot(displacement)", "offset": "force_offset"}, "N")
        },
    )


def _oscillator() -> dict[str, Parameter]:
    return {
        "mass": Parameter(1.0, "kg", fixed=True, latex="m"),
        "damping": Parameter(0.5, "N*s/m", relative_sd=0.5, latex="c"),
        "stiffness": Parameter(100.0, "N/m", relative_sd=0.3, latex="k"),
    }


def linear_oscillator() -> Model:
    """Mass, damper and spring, driven by a force."""
    return Model(
        name="linear_oscillator",
        description="Linear oscillator driven by force.",
        inputs={"force": "N"},
        dofs={"position": Dof("m")},
        parameters=_oscillator(),
        equations={"position": _LINEAR},
        outputs={"displacement": Output({"position": "position"}, "m")},
    )


def duffing() -> Model:
    """The linear oscillator with a cubic spring (Duffing 1918)."""
    cubic = Parameter(1.0e4, "N/m**3", relative_sd=0.5, latex="k_3")
    return Model(
        name="duffing",
        description="Duffing oscillator driven by force.",
        inputs={"force": "N"},
        dofs={"position": Dof("m")},
        parameters=_oscillator() | {"cubic_spring": cubic},
        equations={"position": _LINEAR | {"cubic": "cubic_spring*position**3"}},
        outputs={"displacement": Output({"position": "position"}, "m")},
    )


def end_stop() -> Model:
    r"""Oleo-like oscillator with an end stop (Verbeek 1993, section 4.3.3).

    :math:`\ddot q + \dot q|\dot q| + 10 (1/(1-q))^{1.2} + k(q) q - F = 0` with
    :math:`k = \theta` for :math:`q < 0`, else 0. The thesis forces it by
    :math:`F = 23 + 20 \cos 2 \pi t`.
    """

    def number(value: float, unit: str, latex: str) -> Parameter:
        return Parameter(value, unit, fixed=True, latex=latex)

    return Model(
        name="end_stop",
        description="Gas spring with an end stop at zero, driven by force.",
        inputs={"force": "N"},
        dofs={"stroke": Dof("m", guess=0.5)},
        parameters={
            "mass": number(1.0, "kg", "m"),
            "orifice_damping": number(1.0, "kg/m", "c_2"),
            "gas_force": number(10.0, "N", "F_g"),
            "full_stroke": number(1.0, "m", "L"),
            "gas_exponent": number(1.2, "", "n"),
            "stop_stiffness": Parameter(
                100.0, "N/m", relative_sd=0.5, bounds=(0.0, 1e12), latex="\\theta"
            ),
        },
        equations={
            "stroke": {
                "inertia": "mass*ddot(stroke)",
                "damping": "orifice_damping*dot(stroke)*abs(dot(stroke))",
                "gas_spring": "gas_force*(1/(1 - stroke/full_stroke))**gas_exponent",
                "end_stop": "stop_stiffness*min(stroke, 0)",
                "excitation": "-force",
            }
        },
        outputs={"displacement": Output({"stroke": "stroke"}, "m")},
        admissible=["1 - stroke/full_stroke"],
    )


def van_der_pol() -> Model:
    """Van der Pol's oscillator (1926), with an input so that it can be entrained."""
    return Model(
        name="van_der_pol",
        description="Van der Pol oscillator, dimensionless, forced.",
        inputs={"excitation": ""},
        dofs={"position": Dof("")},
        parameters={"nonlinearity": Parameter(1.0, "", relative_sd=0.3, latex="\\mu")},
        equations={
            "position": {
                "inertia": "ddot(position)",
                "damping": "-nonlinearity*(1 - position**2)*dot(position)",
                "stiffness": "position",
                "excitation": "-excitation",
            }
        },
        outputs={"displacement": Output({"position": "position"}, "")},
    )


def lorenz() -> Model:
    """Lorenz (1963); sigma = 10, rho = 28, beta = 8/3 (Verbeek 1993, section 4.4)."""
    return Model(
        name="lorenz",
        description="Lorenz system, all three states observed.",
        dofs={"x": Dof("", 1.0), "y": Dof("", 1.0), "z": Dof("", 20.0)},
        parameters={
            "sigma": Parameter(10.0, "", relative_sd=0.3, latex="\\sigma"),
            "rho": Parameter(28.0, "", relative_sd=0.3, latex="\\rho"),
            "beta": Parameter(8 / 3, "", relative_sd=0.3, latex="\\beta"),
        },
        equations={
            "x": {"rate": "dot(x)", "mixing": "-sigma*(y - x)"},
            "y": {"rate": "dot(y)", "drive": "-x*(rho - z)", "decay": "y"},
            "z": {"rate": "dot(z)", "product": "-x*y", "decay": "beta*z"},
        },
        outputs={name: Output({name: name}, "") for name in ("x", "y", "z")},
    )


def rossler() -> Model:
    """Rössler (1976); a = b = 0.2, c = 5.7 (Verbeek 1993, section 4.4)."""
    return Model(
        name="rossler",
        description="Rössler system, all three states observed.",
        dofs={"x": Dof("", 1.0), "y": Dof("", 1.0), "z": Dof("", 0.0)},
        parameters={
            "a": Parameter(0.2, "", relative_sd=0.3),
            "b": Parameter(0.2, "", relative_sd=0.3),
            "c": Parameter(5.7, "", relative_sd=0.3),
        },
        equations={
            "x": {"rate": "dot(x)", "coupling": "y + z"},
            "y": {"rate": "dot(y)", "coupling": "-x", "growth": "-a*y"},
            "z": {"rate": "dot(z)", "source": "-b", "fold": "-z*(x - c)"},
        },
        outputs={name: Output({name: name}, "") for name in ("x", "y", "z")},
    )


#: Splines that a formula shows one by one.
MOST_SPLINES = 4

_SYSTEMS: dict[str, Callable[[], Model]] = {
    "gas_spring": gas_spring,
    "viscous_damper": viscous_damper,
    "linear_oscillator": linear_oscillator,
    "duffing": duffing,
    "end_stop": end_stop,
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
    "van_der_pol": van_der_pol,
    "lorenz": lorenz,
    "rossler": rossler,
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
