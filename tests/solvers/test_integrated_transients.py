"""A transient's steps, chosen by an integrator, against SciPy's of another order and method."""

from __future__ import annotations

import numpy as np
import pytest
from periodic_problems import friction_oscillator
from scipy.integrate import solve_ivp

from bayesoleo.model import Dof, Model, Parameter
from bayesoleo.model._kernels import kernels
from bayesoleo.solvers._initial_value import Dynamics
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._switching import periodic_signal
from bayesoleo.solvers._transient import TOLERANCE, integrate

TIME = 12.0
FREQUENCY, FORCE = 0.4, 1.5


def dynamics(model, backend="numpy"):
    """Driven by ``FORCE * cos(2 pi FREQUENCY t)``."""
    equations = kernels(model, backend=backend)
    derived = equations.derived
    cosine = np.zeros((len(derived.inputs), 2))
    cosine[:, 1] = FORCE
    assert all(order == 0 for _, order in derived.inputs)
    signal = periodic_signal(FREQUENCY, cosine, np.zeros_like(cosine))
    nominal = {str(item): value for item, value in model.nominal().items()}
    p = np.array([nominal[name] for name in derived.constants])
    size = (len(derived.active), len(derived.admissible))
    return Dynamics(equations, derived.orders, signal, *size), p


def of(equations, parameters, **dofs):
    return Model(
        "one",
        inputs={"force": "N"},
        dofs=dofs,
        parameters={name: Parameter(value, sd=0.1) for name, value in parameters.items()},
        equations=equations,
        outputs={"y": next(iter(dofs))},
    )


def leaving():
    """A tank that fills, and equations that hold below a level of 0.5 only."""
    return Model(
        "leaving",
        inputs={"force": "N"},
        dofs={"x": Dof("m", initial="0")},
        parameters={"rate": Parameter(1.0, sd=0.1)},
        equations={"x": "dot(x) - rate*force**2"},
        outputs={"y": "x"},
        admissible=["0.5 - x"],
    )


OSCILLATOR = of(
    {"x": "ddot(x) + damping*dot(x) + x + cubic*x**3 - force"},
    {"damping": 0.1, "cubic": 0.5},
    x=Dof("m", initial="0"),
)
RELAXING = of({"x": "dot(x) + rate*x*abs(x) - force"}, {"rate": 0.7}, x=Dof("m", initial="0"))


def by_scipy(start, t_end, rates):
    force = lambda t: FORCE * np.cos(2 * np.pi * FREQUENCY * t)  # noqa: E731
    found = solve_ivp(
        lambda t, s: rates(s, force(t)), (0.0, t_end), start, "DOP853", rtol=1e-11, atol=1e-12,
        dense_output=True,
    )  # fmt: skip
    return found.sol


@pytest.mark.parametrize(
    ("model", "start", "rates"),
    [
        (OSCILLATOR, [0.0, 0.0], lambda s, f: [s[1], f - 0.1 * s[1] - s[0] - 0.5 * s[0] ** 3]),
        (RELAXING, [0.0], lambda s, f: [f - 0.7 * s[0] * abs(s[0])]),
        (RELAXING, [20.0], lambda s, f: [f - 0.7 * s[0] * abs(s[0])]),
    ],
    ids=["oscillator from rest", "first order from rest", "first order from far"],
)
def test_the_motion_is_that_of_another_method(model, start, rates):
    system, p = dynamics(model)
    found = integrate(system, p, np.array(start), TIME)
    assert found.status is Status.CONVERGED
    times = np.linspace(0.0, TIME, 401)
    expected = by_scipy(start, TIME, rates)(times)
    rows = found.rows(times)[: len(start)]
    # Local errors of each step add up over some hundred of them.
    np.testing.assert_allclose(rows, expected, atol=100 * TOLERANCE * np.abs(expected).max())
    lengths = np.diff(found.mesh.edges)
    assert found.mesh.edges[0] == 0.0
    assert found.mesh.edges[-1] == 1.0
    assert lengths.max() <= 1 / 64 + 1e-12


def test_steep_friction_is_followed_as_well_as_by_far_shorter_steps():
    model = friction_oscillator().with_values({"slope": 300.0, "amplitude": 1.0})
    system, p = dynamics(model, "numba")
    found, fine = (integrate(system, p, np.zeros(2), TIME, tol) for tol in (TOLERANCE, 1e-10))
    assert found.status is fine.status is Status.CONVERGED
    assert fine.mesh.steps > 2 * found.mesh.steps
    times = np.linspace(0.0, TIME, 801)
    for row in range(2):
        expected = fine.rows(times)[row]
        limit = 100 * TOLERANCE * np.abs(expected).max()
        np.testing.assert_allclose(found.rows(times)[row], expected, atol=limit)


def test_a_motion_that_leaves_the_region_of_its_equations_is_told():
    system, p = dynamics(leaving())
    assert integrate(system, p, np.zeros(1), TIME).status is Status.INADMISSIBLE
    assert integrate(system, p, np.zeros(1), 0.1).status is Status.CONVERGED


def test_equations_without_rates_are_singular():
    model = of({"x": "dot(x)**2*x + x - force"}, {"unused": 1.0}, x=Dof("m", initial="0"))
    system, p = dynamics(model)
    assert integrate(system, p, np.zeros(1), TIME).status is Status.SINGULAR
