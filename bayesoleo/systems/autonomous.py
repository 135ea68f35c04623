"""Systems that move by themselves: a limit cycle and two strange attractors."""

from __future__ import annotations

from bayesoleo.model import Dof, Model, Output, Parameter


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
