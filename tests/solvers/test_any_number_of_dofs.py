"""Linear systems of any size and mixed orders against their harmonic responses in closed form."""

from functools import cache

import numpy as np
import pytest
from periodic_problems import harmonics, problem, rest

from bayesoleo.model import Model, Parameter
from bayesoleo.solvers._mesh import tableau
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import sensitivities, solve_periodic
from bayesoleo.solvers._schemes import FIRST, SECOND

FORCE, FREQUENCY = harmonics(h0=0.4, h1=0.8 - 0.3j, h3=0.2 + 0.5j), 0.2


@cache
def system(d: int):
    """Model, orders and coefficients of the derivatives ``(3, d, d)`` and of the force ``(d,)``.

    From two dofs on, some are of first and some of second order. Diagonals outweigh what couples.
    """
    rng = np.random.default_rng(100 + d)
    orders = tuple(int(order) for order in rng.permutation(1 + np.arange(d) % 2))
    tables = 0.2 / d * rng.standard_normal((3, d, d))
    for k, low in enumerate((1.0, 0.6, 1.0)):
        tables[k] += np.diag(low + rng.random(d))
    tables[2, :, np.array(orders) == 1] = 0.0
    load = rng.standard_normal(d)
    dofs = [f"q{j}" for j in range(d)]
    equations = {}
    for e, dof in enumerate(dofs):
        terms = [f"-scale*force*({float(load[e])!r})"]
        for j, name in enumerate(dofs):
            what = (name, f"dot({name})", f"ddot({name})")[: orders[j] + 1]
            terms += [f"({float(tables[k, e, j])!r})*{item}" for k, item in enumerate(what)]
        equations[dof] = " + ".join(terms)
    model = Model(
        f"linear{d}",
        inputs={"force": "N"},
        dofs=dict.fromkeys(dofs, "m"),
        parameters={"scale": Parameter(1.0, sd=1.0)},
        equations=equations,
        outputs={"displacement": "q0"},
    )
    return model, orders, tables, load


def continuous(d: int, k: int) -> np.ndarray:
    """Amplitudes ``(d,)`` of the k-th harmonic of the exact motion."""
    _, _, tables, load = system(d)
    rate = 2j * np.pi * FREQUENCY * k
    return np.linalg.solve(sum(rate**i * table for i, table in enumerate(tables)), load)


def discrete(d: int, k: int, name: str, n: int) -> np.ndarray:
    """The same of a scheme: from node to node everything turns by the harmonic's own angle."""
    _, orders, tables, load = system(d)
    h, turn = 1.0 / FREQUENCY / n, np.exp(2j * np.pi * k / n)
    if name == "thesis":
        back = turn ** -np.arange(4.0)
        rates = (1.0, FIRST @ back / h, SECOND @ back / h**2)
        whole = sum(rate * table for rate, table in zip(rates, tables, strict=True))
        return np.linalg.solve(whole, load)
    method = tableau(name)
    s = method.stages
    # Unknowns of one step: values, rates and stages' highest derivatives of each dof in turn.
    width = 2 + s
    matrix = np.zeros((d * width, d * width), dtype=complex)
    right = np.zeros(d * width, dtype=complex)
    for j, order in enumerate(orders):
        value, rate = np.eye(width)[:2]
        top = np.eye(width)[2:]
        first = j * width
        lines = np.zeros((2, width), dtype=complex)
        if order == 1:
            stages = [value + h * method.a @ top, top, np.zeros_like(top)]
            lines[0] = value + h * method.b @ top - turn * value
            lines[1] = rate  # not there
        else:
            once = h * method.a @ top
            twice = h * h * method.a @ method.a @ top
            stages = [value + h * np.outer(method.c, rate) + twice, rate + once, top]
            lines[0] = value + h * rate + h * h * method.b @ method.a @ top - turn * value
            lines[1] = rate + h * method.b @ top - turn * rate
        matrix[first : first + 2, first : first + width] = lines
        for e in range(d):
            rows = slice(e * width + 2, (e + 1) * width)
            for table, stage in zip(tables, stages, strict=True):
                matrix[rows, first : first + width] += table[e, j] * stage
    for e in range(d):
        right[e * width + 2 : (e + 1) * width] = load[e] * turn**method.c
    return np.linalg.solve(matrix, right)[::width]


def motion(amplitudes, n):
    """Values ``(n, d)`` at the nodes."""
    turns = np.exp(2j * np.pi * np.outer(np.arange(n), FORCE.orders) / n)
    return np.real(turns @ (FORCE.coefficients[:, None] * amplitudes))


def solved(d, name, n, backend="numpy"):
    """Values of the dofs at the nodes ``(n, d)`` and their derivatives by the force's scale."""
    model, orders, _, _ = system(d)
    boundary, p = problem(model, FORCE, FREQUENCY, name, n, backend)
    assert boundary.scheme.orders == orders
    solution = solve_periodic(boundary, p, rest(boundary, n))
    assert solution.status[0] == Status.CONVERGED
    _, by_scale, _ = sensitivities(boundary, p, solution)
    first = np.cumsum([0, *orders])[:-1] if name != "thesis" else np.arange(d)
    return solution.x[0, :, first].T, by_scale[0, :, first, 0].T


@pytest.mark.parametrize("n", [8, 9, 13, 64])
@pytest.mark.parametrize("name", ["radau3", "thesis"])
@pytest.mark.parametrize("d", [1, 2, 3, 4, 5, 6, 7, 8])
def test_any_number_of_dofs_and_steps(d, name, n):
    """To round-off what the scheme's own equations say of each harmonic."""
    values, by_scale = solved(d, name, n)
    exact = motion(np.array([discrete(d, k, name, n) for k in FORCE.orders]), n)
    np.testing.assert_allclose(values, exact, atol=1e-10)
    # A linear answer is its own derivative by the size of the force.
    np.testing.assert_allclose(by_scale, exact, atol=1e-10)


@pytest.mark.parametrize("d", [3, 6])
def test_the_scheme_is_that_of_the_differential_equations(d):
    values, _ = solved(d, "gauss3", 64)
    exact = motion(np.array([continuous(d, k) for k in FORCE.orders]), 64)
    np.testing.assert_allclose(values, exact, atol=1e-6)  # (3 omega h)**6, with rates above 1 too


@pytest.mark.slow
@pytest.mark.parametrize("n", [13, 64])
@pytest.mark.parametrize(
    ("d", "name"), [(3, "radau2"), (3, "radau3"), (5, "gauss3"), (6, "radau3")]
)
def test_compiled_loops_over_dofs_of_mixed_orders(d, name, n):
    values, by_scale = solved(d, name, n, "numba")
    exact = motion(np.array([discrete(d, k, name, n) for k in FORCE.orders]), n)
    np.testing.assert_allclose(values, exact, atol=1e-11)
    np.testing.assert_allclose(by_scale, exact, atol=1e-11)
