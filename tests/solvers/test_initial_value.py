"""Integration in compiled steps: order, other codes, derivatives, switches, failures with names."""

import numpy as np
import pytest
from periodic_problems import coupled, duffing, gas_spring, harmonics
from scipy.integrate import solve_ivp
from test_state_space import state_space

from bayesoleo.errors import InputError
from bayesoleo.model import Model, Parameter
from bayesoleo.model._derivatives import analytic_pieces
from bayesoleo.model._kernels import kernels
from bayesoleo.solvers import _march as loop
from bayesoleo.solvers._initial_value import Dynamics, solve_initial_value
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._radau_step import radau_method
from bayesoleo.solvers._switching import InputSignal, evaluate, periodic_signal
from bayesoleo.systems import system

FORCE = harmonics(h0=0.1, h1=0.8, h2=0.2 - 0.1j)
FREQUENCY = 0.2


def dynamics(model, force=FORCE, frequency=FREQUENCY):
    pieces = analytic_pieces(model)
    functions = kernels(pieces.model)
    derived = functions.derived
    table = np.zeros((len(derived.inputs), 1 + int(force.orders.max())), dtype=complex)
    for row, (_, order) in zip(table, derived.inputs, strict=True):
        row[force.orders] = (2j * np.pi * frequency * force.orders) ** order * force.coefficients
    signal = periodic_signal(frequency, table.real, -table.imag)
    counts = len(derived.active), len(derived.admissible), pieces.switches
    nominal = {str(item): value for item, value in model.nominal().items()}
    names = derived.constants[: len(derived.constants) - pieces.switches]
    p = np.array([nominal[name] for name in names])
    return Dynamics(functions, derived.orders, signal, *counts), p


def brake():
    """Dry friction that jumps, in a motion that passes through zero velocity without sticking."""
    return Model(
        "brake",
        inputs={"force": "N"},
        dofs={"q": "m"},
        parameters={"friction": Parameter(0.2, sd=1.0), "stiffness": Parameter(2.0, sd=1.0)},
        equations={"q": "ddot(q) + friction*sign(dot(q)) + stiffness*q - force"},
        outputs={"displacement": "q"},
    )


def test_signals():
    t = np.linspace(-1, 7, 40)
    signal = dynamics(duffing())[0].signal
    expected = FORCE.evaluate(FREQUENCY * t, FREQUENCY)
    np.testing.assert_allclose(evaluate(signal, t)[0], expected, atol=1e-14)
    pieces = np.array([[[1.0, 2.0, 0.0, 0.0]], [[3.0, 0.0, 1.0, -1.0]]])
    none = np.zeros((1, 0))
    cubics = InputSignal(0.0, none, none.copy(), np.array([0.0, 1.0, 3.0]), pieces)
    cubic = evaluate(cubics, np.array([0.5, 2.5, 4.0]))
    np.testing.assert_allclose(cubic[0], [2.0, 3 + 1.5**2 - 1.5**3, 3 + 9.0 - 27.0])


@pytest.mark.parametrize(("stages", "coarse"), [(3, 40), (5, 8)])
def test_order(stages, coarse):
    """Radau IIA with s stages is of order 2 s - 1 (Hairer and Wanner 1996, section IV.5)."""
    field, p = dynamics(coupled())
    start = np.array([0.3, -0.2, 0.1])
    reference = solve_initial_value(
        field, p, start, np.array([0.0, 5.0]), tolerance=1e-13, stages=5
    ).states[-1]
    errors = []
    for n in (coarse, 2 * coarse):
        path = solve_initial_value(
            field, p, start, np.linspace(0, 5, n + 1), adaptive=False, tolerance=1.0, stages=stages
        )
        assert path.status.ok
        errors.append(np.abs(path.states[-1] - reference).max())
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2 * stages - 1, abs=0.5)


@pytest.mark.reference
@pytest.mark.parametrize("stages", [3, 5])
def test_lorenz_against_another_code(stages):
    model = system("lorenz")
    functions = kernels(model)
    signal = periodic_signal(1.0, np.zeros((0, 1)), np.zeros((0, 1)))
    field = Dynamics(functions, functions.derived.orders, signal, 3)
    p, start = np.array([10.0, 28.0, 8 / 3]), np.array([1.0, 2.0, 20.0])
    path = solve_initial_value(
        field, p, start, np.array([0.0, 2.0]), tolerance=1e-11, stages=stages
    )

    def lorenz(t, y):
        return [10 * (y[1] - y[0]), y[0] * (28 - y[2]) - y[1], y[0] * y[1] - 8 / 3 * y[2]]

    times = np.linspace(0, 2, 31)
    other = solve_ivp(lorenz, (0, 2), start, t_eval=times, method="LSODA", rtol=1e-12, atol=1e-12)
    # Errors of 1e-12 grow by exp(0.9 * 2) times the swings of the attractor, of size 30.
    np.testing.assert_allclose(path.sample(times)[[0, 2, 4]], other.y, atol=3e-8)


def test_derivatives_are_those_of_the_numbers_computed():
    """On given steps: differences err by the step squared and round-off over the step."""
    field, p = dynamics(coupled())
    start, times = np.array([0.3, -0.2, 0.1]), np.linspace(0, 5, 13)
    columns = np.concatenate([np.eye(3), np.zeros((3, 2))], axis=1)

    def end(s, constants):
        return solve_initial_value(
            field, constants, s, times, adaptive=False, tolerance=1.0
        ).states[-1]

    path = solve_initial_value(
        field, p, start, times, adaptive=False, tolerance=1.0, columns=columns, by_parameter=True,
        dense=True,
    )  # fmt: skip
    small = 1e-5
    for k in range(5):
        s, constants = small * np.eye(5)[k, :3], small * np.eye(5)[k, 3:]
        difference = end(start + s, p + constants) - end(start - s, p - constants)
        np.testing.assert_allclose(
            path.derivatives[:, k], difference / (2 * small), rtol=1e-8, atol=2e-9
        )
    rows = path.sample_derivatives(path.times)[[0, 1, 3], :, -1]
    np.testing.assert_allclose(rows, path.derivatives, atol=1e-13)


def test_derivatives_jump_where_the_friction_does():
    field, p = dynamics(brake())
    assert field.switches == 1
    start, times = np.array([0.1, 0.8]), np.array([0.0, 6.0])
    columns = np.concatenate([np.eye(2), np.zeros((2, 2))], axis=1)
    tight = {"tolerance": 1e-12, "stages": 5}
    path = solve_initial_value(field, p, start, times, columns=columns, by_parameter=True, **tight)
    assert path.status.ok
    assert path.switched.sum() >= 2, "the motion reverses"
    small = 1e-5
    for k in range(4):
        s, constants = small * np.eye(4)[k, :2], small * np.eye(4)[k, 2:]
        ends = [
            solve_initial_value(field, p + z * constants, start + z * s, times, **tight).states[-1]
            for z in (1, -1)
        ]
        # Without the jump derivatives are wrong by a tenth.
        np.testing.assert_allclose(
            path.derivatives[:, k], (ends[0] - ends[1]) / (2 * small), atol=1e-6
        )


@pytest.mark.reference
def test_kinks_are_stepped_to():
    """A quadratic damper against another code's small steps."""
    field, p = dynamics(duffing(quadratic=0.6))
    path = solve_initial_value(
        field, p, np.array([0.5, 1.0]), np.array([0.0, 5.0]), tolerance=1e-11, stages=5
    )
    space, constants = state_space(duffing(quadratic=0.6))
    other = solve_ivp(
        space.right_side(constants[0]), (0, 5), [0.5, 1.0], method="DOP853", rtol=1e-11, atol=1e-12
    )
    np.testing.assert_allclose(path.states[-1], other.y[:, -1], atol=1e-8)
    assert np.abs(path.states[1:][path.switched, 1]).max() < 1e-12


def test_failures_have_names():
    field, p = dynamics(gas_spring(), harmonics(h0=23.0, h1=20.0), 1.0)
    outside = solve_initial_value(field, p, np.array([1.2, 0.0]), np.array([0.0, 1.0]))
    assert outside.status is Status.INADMISSIBLE
    coarse = solve_initial_value(
        field, p, np.array([0.5, 0.0]), np.linspace(0, 1, 3), adaptive=False
    )
    assert coarse.coarse
    with pytest.raises(InputError, match=r"no such method.*use 3 or 5"):
        solve_initial_value(field, p, np.array([0.5, 0.0]), np.array([0.0, 1.0]), stages=4)
    with pytest.raises(InputError, match=r"start does not fit.*give 2 numbers"):
        solve_initial_value(field, p, np.zeros(3), np.array([0.0, 1.0]))
    with pytest.raises(InputError, match=r"times must rise"):
        solve_initial_value(field, p, np.zeros(2), np.array([1.0, 0.0]))


@pytest.mark.parametrize("stages", [3, 5])
def test_the_local_error_vanishes_where_both_quadratures_are_exact(stages):
    """Hairer and Wanner (1996), eq. IV.8.19: for polynomials of a lower degree than the stages."""
    method = radau_method(stages)
    for power in range(stages):
        at_start = method.gamma * (power == 0)
        assert at_start + method.error @ method.c**power == pytest.approx(0.0, abs=1e-13)
    assert abs(method.error @ method.c**stages) > 1e-4, "the next power shows"


def paced(size, last, h=0.1, last_h=0.1, stages=3):
    """Length of the next step after one of length ``h`` whose error over tolerance is ``size``."""
    pace = np.zeros(5)
    pace[loop.LAST_ERROR], pace[loop.LAST_LENGTH] = last, last_h
    getattr(loop.next_length, "py_func", loop.next_length)(pace, size, h, stages)
    return pace[loop.LENGTH] / h


def test_the_next_step_has_the_error_asked_for():
    """An error that goes with the fourth power of the step, its coefficient constant or growing."""
    for size in (0.2, 0.05, 1e-3):
        factor = paced(size, size)
        assert size * factor**4 == pytest.approx(0.9**4, rel=1e-9)
    # From step to step the coefficient grew threefold, and is foreseen to grow so once more.
    assert 0.3 * 3.0 * paced(0.3, 0.1) ** 4 == pytest.approx(0.9**4, rel=1e-9)
    # Where it shrinks the present one is counted with: the step is none too long.
    assert paced(0.1, 0.3) == pytest.approx(paced(0.1, 0.1), rel=1e-9)
