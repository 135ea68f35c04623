"""The explicit form of implicit equations, and its derivatives."""

import mpmath
import numpy as np
import pytest
import sympy as sp
from periodic_problems import coupled, duffing, friction_oscillator, gas_spring, harmonics
from scipy.integrate import solve_ivp

from bayesoleo.model import Model, Parameter
from bayesoleo.model._kernels import kernels
from bayesoleo.solvers._state_space import StateSpace

FORCE = harmonics(h0=0.1, h1=0.8, h2=0.2 - 0.1j)
FREQUENCY = 0.2


def state_space(model, force=FORCE, frequency=FREQUENCY, backend="numpy"):
    equations = kernels(model, backend=backend)
    derived = equations.derived

    def inputs(t):
        rows = [force.evaluate(frequency * t, frequency, order) for _, order in derived.inputs]
        return np.array(rows).reshape(len(rows), t.size)

    nominal = {str(item): value for item, value in model.nominal().items()}
    p = np.array([[nominal[name] for name in derived.constants]])
    conditions = len(derived.admissible)
    return StateSpace(equations, derived.orders, inputs, len(derived.active), conditions), p


def implicit():
    """The acceleration enters nonlinearly, and through both equations."""
    return Model(
        "implicit",
        inputs={"force": "N"},
        dofs={"q": "m", "r": "m"},
        parameters={"cubic": Parameter(0.4, sd=1.0), "mixing": Parameter(0.3, sd=1.0)},
        equations={
            "q": "ddot(q) + cubic*ddot(q)**3 + mixing*dot(r) + q - force",
            "r": "dot(r) + mixing*ddot(q) + r*dot(q)",
        },
        outputs={"displacement": "q"},
    )


def test_the_state_solves_the_equations():
    space, p = state_space(implicit())
    rng = np.random.default_rng(0)
    many = np.repeat(p, 3, axis=0) * (1 + 0.1 * rng.standard_normal((3, p.shape[1])))
    t, s = rng.uniform(0, 5, 7), rng.standard_normal((3, 3, 7))
    rates, ok = space.rates(t, s, many)
    assert ok.all()
    force = FORCE.evaluate(FREQUENCY * t, FREQUENCY)
    for lane, (cubic, mixing) in enumerate(many):
        q, v, r = s[lane]
        _, a, w = rates[lane]
        np.testing.assert_array_equal(rates[lane, 0], v)
        np.testing.assert_allclose(a + cubic * a**3 + mixing * w + q - force, 0, atol=1e-13)
        np.testing.assert_allclose(w + mixing * a + r * v, 0, atol=1e-13)


@pytest.mark.parametrize(
    "model", [duffing(quadratic=0.4), friction_oscillator(), coupled(), implicit()]
)
def test_derivatives_against_high_precision_differences(model):
    """The equations again with 40 digits, from the model's own text, solved by another code."""
    space, p = state_space(model)
    derived = space.equations.derived
    s, t = np.array([0.3, -0.7, 0.2])[: space.size], 1.3
    answer = space.linearise(np.array([t]), s[None, :, None], p)
    assert answer.ok.all()
    force = float(FORCE.evaluate(np.array([FREQUENCY * t]), FREQUENCY)[0])
    symbols = [sp.Symbol(name, real=True) for name in ("force", *derived.constants)]
    g = sp.lambdify([list(derived.states), symbols], list(derived.residual), "mpmath")

    def rates(state, constants):
        def equations(*top):
            z, tops, states = [], iter(top), iter(state)
            for order in derived.orders:
                z += [next(states) for _ in range(order)] + [next(tops)]
            return g(z, [mpmath.mpf(force), *constants])

        found = mpmath.findroot(equations, [0] * len(derived.orders), tol=1e-60)
        top, result = list(found), []
        for j, order in enumerate(derived.orders):
            at = sum(derived.orders[:j])
            result += [*(state[at + 1 : at + order]), top[j]]
        return result

    with mpmath.workdps(40):
        small = mpmath.mpf(10) ** -12
        state, constants = [mpmath.mpf(float(x)) for x in s], [mpmath.mpf(float(x)) for x in p[0]]
        for table, point in ((answer.by_state, 0), (answer.by_parameter, 1)):
            for k in range(table.shape[2]):
                ends = []
                for sign in (1, -1):
                    moved = [list(state), list(constants)]
                    moved[point][k] += sign * small
                    ends.append(rates(*moved))
                exact = [float((a - b) / (2 * small)) for a, b in zip(*ends, strict=True)]
                np.testing.assert_allclose(table[0, :, k, 0], exact, atol=1e-13)


@pytest.mark.slow
@pytest.mark.reference
def test_the_variational_form_integrates_to_differences_of_solutions():
    space, p = state_space(coupled())
    start, s_theta = np.array([0.3, 0.1, -0.2]), np.array([[0.0, 1.0], [0.5, 0.0], [0.0, 0.0]])
    tight = {"rtol": 1e-11, "atol": 1e-12, "method": "DOP853"}
    whole = solve_ivp(
        space.variational(p[0]), (0, 5), space.variational_start(start, s_theta), **tight
    )
    table = whole.y[:, -1].reshape(3, 6)

    def end(s, constants):
        return solve_ivp(space.right_side(constants), (0, 5), s, **tight).y[:, -1]

    # The error of a central difference is the step squared; of the ends, 1e-11 over the step.
    step = 1e-4
    np.testing.assert_allclose(table[:, 0], end(start, p[0]), atol=1e-9)
    for k in range(3):
        move = step * np.eye(3)[k]
        difference = (end(start + move, p[0]) - end(start - move, p[0])) / (2 * step)
        np.testing.assert_allclose(table[:, 1 + k], difference, atol=1e-6)
    for k in range(2):
        move, moved = step * np.eye(2)[k], step * s_theta[:, k]
        ends = [end(start + sign * moved, p[0] + sign * move) for sign in (1, -1)]
        np.testing.assert_allclose(table[:, 4 + k], (ends[0] - ends[1]) / (2 * step), atol=1e-6)


def test_where_there_are_no_rates():
    """Singular equations and states outside the region are said to be so, not raised."""
    space, p = state_space(gas_spring())
    s = np.array([[[0.5, 1.5], [0.0, 0.0]]])
    t = np.zeros(2)
    assert space.admissible(t, s, p).tolist() == [[True, False]]
    rates, ok = space.rates(t, s, p)
    assert ok.tolist() == [[True, False]]
    assert np.isnan(rates[0, :, 1]).all()
    massless = Model(
        "massless",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={"mass": Parameter(0.0, sd=1.0)},
        equations={"q": "mass*ddot(q) + dot(q) + q - force"},
        outputs={"displacement": "q"},
    )
    space, p = state_space(massless)
    answer = space.linearise(np.zeros(1), np.zeros((1, 2, 1)), p)
    assert not answer.ok.any()
    assert np.isnan(answer.by_state).all()
