"""Small systems with known behaviour, and their discretised problems."""

from __future__ import annotations

import numpy as np

from bayesoleo.model import Condition, Model, Parameter
from bayesoleo.model._kernels import kernels
from bayesoleo.prediction._records import Harmonics
from bayesoleo.solvers._mesh import Mesh
from bayesoleo.solvers._periodic import Boundary
from bayesoleo.solvers._schemes import scheme


def harmonics(**coefficients: complex) -> Harmonics:
    """``harmonics(h0=1.0, h1=2 - 1j)``: complex amplitudes by harmonic order."""
    orders = np.array([int(name[1:]) for name in coefficients])
    values = np.array(list(coefficients.values()), dtype=complex)
    return Harmonics(orders, values, np.zeros(orders.size))


def duffing(**values: float) -> Model:
    parameters = {"mass": 1.0, "damping": 0.3, "stiffness": 1.0, "cubic": 1.0, "quadratic": 0.0}
    return Model(
        "duffing",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={
            name: Parameter(values.get(name, value), sd=1.0) for name, value in parameters.items()
        },
        equations={
            "q": "mass*ddot(q) + damping*dot(q) + quadratic*dot(q)*abs(dot(q))"
            " + stiffness*q + cubic*q**3 - force"
        },
        outputs={"displacement": "q"},
    )


def relaxation() -> Model:
    return Model(
        "relaxation",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={"rate": Parameter(1.0, sd=1.0), "cubic": Parameter(1.0, sd=1.0)},
        equations={"q": "dot(q) + rate*q + cubic*q**3 - force"},
        outputs={"displacement": "q"},
    )


def coupled() -> Model:
    """A second-order dof that heats a first-order one, which stiffens it."""
    return Model(
        "coupled",
        inputs={"force": "N"},
        dofs={"q": "m", "T": "K"},
        parameters={"damping": Parameter(0.4, sd=1.0), "loss": Parameter(0.7, sd=1.0)},
        equations={
            "q": "ddot(q) + damping*dot(q) + (1 + T)*q + 0.5*q**3 - force",
            "T": "dot(T) + loss*T - 0.5*dot(q)**2 - 0.2*q",
        },
        outputs={"displacement": "q"},
    )


def gas_spring(force: str = "force") -> Model:
    """The end-stop oleo of Verbeek (1993), section 4.3.3, whose gas law ends at ``q = 1``."""
    return Model(
        "end stop",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={"stop": Parameter(100.0, fixed=True), "damping": Parameter(1.0, sd=0.1)},
        equations={
            "q": "ddot(q) + damping*dot(q)*abs(dot(q)) + 10*(1/(1 - q))**1.2"
            f" - stop*positive(-q) - {force}"
        },
        outputs={"displacement": "q"},
        admissible=["1 - q"],
    )


def friction_oscillator() -> Model:
    return Model(
        "friction",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={
            "damping": Parameter(0.3, sd=1.0),
            "quadratic": Parameter(0.5, sd=1.0),
            "stiffness": Parameter(1.5, sd=1.0),
            "amplitude": Parameter(0.4, sd=1.0),
            "slope": Parameter(3.0, sd=1.0),
        },
        conditions={"offset": Condition("N", 0.1)},
        equations={
            "q": "ddot(q) + damping*dot(q) + quadratic*dot(q)*abs(dot(q)) + stiffness*q + offset"
            " + amplitude*atan(slope*dot(q)) - force"
        },
        outputs={"displacement": "q"},
    )


def problem(
    model: Model,
    force: Harmonics,
    frequency: float,
    name: str = "radau3",
    n: int = 64,
    backend: str = "numpy",
    mesh: Mesh | None = None,
) -> tuple[Boundary, np.ndarray]:
    """The discretised problem and its constants at their nominal values, shape (1, np)."""
    equations = kernels(model, backend=backend)
    derived = equations.derived
    method = scheme(name, derived.orders, mesh)
    rows = [force.evaluate(method.phases(n), frequency, order) for _, order in derived.inputs]
    nominal = {str(item): value for item, value in model.nominal().items()}
    p = np.array([[nominal[c] for c in derived.constants]])
    return (
        Boundary(
            equations=equations,
            scheme=method,
            period=1.0 / frequency,
            inputs=np.stack(rows),
            conditions=len(derived.admissible),
            active=len(derived.active),
        ),
        p,
    )


def rest(boundary: Boundary, n: int, value: float = 0.0) -> np.ndarray:
    """A start in which the first dof rests at ``value``, shape (1, n, w)."""
    start = np.zeros((1, n, boundary.scheme.width))
    start[:, :, 0] = value
    return start
