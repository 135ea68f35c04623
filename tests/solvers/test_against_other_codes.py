"""Periodic solutions against integration to steady state and against the exact answer."""

import numpy as np
import pytest
from periodic_problems import coupled, duffing, friction_oscillator, harmonics, problem, rest
from scipy.integrate import solve_ivp

from bayesoleo.model import Model, Parameter
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import solve_periodic

pytestmark = pytest.mark.reference

FORCE = harmonics(h0=0.1, h1=0.8, h2=0.2 - 0.1j, h5=0.05j)


def duffing_rates(t, y, force):
    return [y[1], force(t) - 0.3 * y[1] - y[0] - y[0] ** 3]


def friction_rates(t, y, force):
    q, v = y
    return [v, force(t) - 0.3 * v - 0.5 * v * abs(v) - 1.5 * q - 0.1 - 0.4 * np.arctan(3.0 * v)]


def coupled_rates(t, y, force):
    q, v, T = y
    return [
        v,
        force(t) - 0.4 * v - (1 + T) * q - 0.5 * q**3,
        0.5 * v**2 + 0.2 * q - 0.7 * T,
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["radau3", "gauss3"])
@pytest.mark.parametrize("integrator", ["DOP853", "LSODA"])
@pytest.mark.parametrize(
    ("model", "rates", "states"),
    [
        (duffing(), duffing_rates, 2),
        (friction_oscillator(), friction_rates, 2),
        (coupled(), coupled_rates, 3),
    ],
    ids=["duffing", "friction", "coupled"],
)
def test_agrees_with_integration_to_steady_state(model, rates, states, integrator, name):
    frequency, n = 0.2, 256

    def force(t):
        return FORCE.evaluate(np.array([frequency * t]), frequency)[0]

    # 40 periods of 5 s: exp(-0.3 * 200 / 2) = 1e-13 is left of the transient.
    end = 40 / frequency
    run = solve_ivp(
        rates,
        (0, end),
        np.zeros(states),
        args=(force,),
        method=integrator,
        rtol=1e-10,
        atol=1e-11,
    )
    boundary, p = problem(model, FORCE, frequency, name, n)
    solution = solve_periodic(boundary, p, rest(boundary, n))
    assert solution.status[0] == Status.CONVERGED
    # The integrator's own error grows to some ten times its tolerance; the kink of |v| costs this
    # code 1e-9 and the smooth systems 1e-10.
    np.testing.assert_allclose(run.y[:, -1], solution.x[0, 0, :states], atol=5e-9)


@pytest.mark.parametrize(
    ("name", "tolerance"), [("radau3", 1e-7), ("gauss3", 1e-9), ("thesis", 0.02)]
)
def test_linear_oscillator_has_the_exact_transfer_function(name, tolerance):
    mass, damping, stiffness, frequency, n = 2.0, 0.8, 30.0, 0.3, 512
    rng = np.random.default_rng(1)
    force = harmonics(**{f"h{k}": complex(*rng.standard_normal(2)) for k in range(1, 12)})
    model = Model(
        "linear",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={"damping": Parameter(damping, sd=1.0)},
        equations={"q": f"{mass}*ddot(q) + damping*dot(q) + {stiffness}*q - force"},
        outputs={"displacement": "q"},
    )
    rate = 2j * np.pi * frequency * force.orders
    transfer = 1 / (mass * rate**2 + damping * rate + stiffness)
    answer = harmonics(
        **{f"h{k}": c for k, c in zip(force.orders, transfer * force.coefficients, strict=True)}
    )
    boundary, p = problem(model, force, frequency, name, n)
    solution = solve_periodic(boundary, p, rest(boundary, n))
    exact = answer.evaluate(np.arange(n) / n, frequency)
    assert solution.iterations[0] <= 3
    error = np.max(np.abs(solution.x[0, :, 0] - exact)) / np.max(np.abs(exact))
    # 46 nodes in a period of the eleventh harmonic: (2 pi/46)**order times a constant below one.
    assert error < tolerance
