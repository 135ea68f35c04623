"""Springs, dampers, oscillators, a limit cycle and strange attractors.

Each is the smallest system that shows one idea.
"""

from __future__ import annotations

from bayesoleo.model._model import Model
from bayesoleo.model._parameters import Dof, Output, Parameter

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
