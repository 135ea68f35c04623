"""Every declared system against answers that others found or that follow from its formula."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

from bayesoleo.model import driven_by
from bayesoleo.model._expressions import derivative_symbol, symbol
from bayesoleo.prediction._branches import follow_branch, limit_cycle
from bayesoleo.prediction._orbits import periodic_orbit
from bayesoleo.prediction._simulate import RunPlan, motion, simulate_run
from bayesoleo.systems import system, systems

#: What this file knows the answers of; the variants of the oleo share theirs.
KNOWN = {
    "gas_spring", "viscous_damper", "linear_oscillator", "duffing", "end_stop", "van_der_pol",
    "lorenz", "rossler",
}  # fmt: skip


def test_every_declared_system_is_here():
    assert {name for name in systems() if not name.startswith("f16n")} == KNOWN


# -- closed forms ----------------------------------------------------------------------------------


def test_gas_spring_is_its_power_law():
    plan = RunPlan("a", 1.0, {"compression": motion(0.4, [0.3])}, periods=1)
    run = simulate_run(system("gas_spring"), plan, {"exponent": 1.2})
    expected = (1 - run.samples["compression"]) ** -1.2
    np.testing.assert_allclose(run.samples["pressure_ratio"], expected, rtol=1e-14)


def test_viscous_damper_dissipates_pi_c_omega_amplitude_squared():
    plan = RunPlan("a", 2.0, {"displacement": motion(0.0, [0.01])}, periods=1)
    run = simulate_run(system("viscous_damper"), plan)
    velocity = -0.01 * 4 * np.pi * np.sin(4 * np.pi * run.time)
    work = np.mean(run.samples["force"] * velocity) / 2.0
    assert work == pytest.approx(np.pi * 1000.0 * 4 * np.pi * 0.01**2, rel=1e-12)


def test_linear_oscillator_answers_by_its_transfer_function():
    plan = RunPlan("a", 1.4, {"force": motion(0.0, [2.0])}, periods=1)
    run = simulate_run(system("linear_oscillator"), plan, steps=128)
    rate = 2 * np.pi * 1.4
    response = 2.0 / (100.0 - rate**2 + 0.5j * rate)
    expected = (response * np.exp(1j * rate * run.time)).real
    np.testing.assert_allclose(run.samples["displacement"], expected, atol=1e-9 * abs(response))


# -- Duffing ---------------------------------------------------------------------------------------


def duffing_map(state: np.ndarray, frequency: float) -> tuple[np.ndarray, np.ndarray]:
    """State after a period of 6 N, and its derivatives, by an integrator of SciPy's."""

    def rates(t, s):
        q, v, a, b, c, d = s
        slope = -100.0 - 3e4 * q**2
        force = 6 * np.cos(2 * np.pi * frequency * t) - 0.5 * v - 100 * q - 1e4 * q**3
        return [v, force, c, d, slope * a - 0.5 * c, slope * b - 0.5 * d]

    way = solve_ivp(
        rates, (0, 1 / frequency), [*state, 1, 0, 0, 1], method="DOP853", rtol=1e-11, atol=1e-12
    )
    return way.y[:2, -1], way.y[2:, -1].reshape(2, 2)


@pytest.fixture(scope="module")
def duffing():
    plan = RunPlan("sweep", 1.0, {"force": motion(0.0, [6.0])})
    return follow_branch(system("duffing"), plan, "frequency", (1.0, 6.0), steps=64)


def test_folds_of_duffing_are_folds_of_the_time_map(duffing):
    folds = duffing.branch.of_kind("fold")
    # To the digits that 64 and 128 steps have in common.
    np.testing.assert_allclose([f.value for f in folds], [5.27255, 2.37196], atol=1e-5)
    for fold in folds:
        end, matrix = duffing_map(fold.x[0, :2], fold.value)
        np.testing.assert_allclose(end, fold.x[0, :2], atol=1e-4)
        # Multipliers split like the root of the distance to the fold, here of 64 steps' error.
        assert np.abs(np.linalg.eigvals(matrix) - 1.0).min() < 5e-3


def test_three_answers_of_duffing_and_which_of_them_last(duffing):
    values = duffing.values
    at = np.flatnonzero(np.diff(np.sign(values - 3.0)))
    assert [duffing.branch.points[k].unstable for k in at] == [0, 1, 0]
    sizes = []
    for k in at:
        state = duffing.branch.points[k].x[0, :2]
        for _ in range(12):  # Newton's method on SciPy's time map, which finds unstable ones too
            end, matrix = duffing_map(state, 3.0)
            state = state + np.linalg.solve(np.eye(2) - matrix, end - state)
        end, matrix = duffing_map(state, 3.0)
        np.testing.assert_allclose(end, state, atol=1e-9)
        sizes.append(np.abs(np.linalg.eigvals(matrix)).max())
    assert [size > 1 for size in sizes] == [False, True, False]


# -- end stop --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("theta", "first", "least", "fastest"),
    [
        (0.0, (-0.1191663, 4.69243733), -0.64326, 5.15685),
        (100.0, (0.78113832, 3.26503319), -0.21221, 3.97784),
        (2500.0, (0.83680069, 0.77678702), -0.04372, 2.71456),
    ],
)
def test_end_stop_moves_as_in_the_thesis(theta, first, least, fastest):
    """Verbeek (1993), section 4.3.3; digits from 60 periods of LSODA at rtol 1e-9."""
    plan = RunPlan("a", 1.0, {"force": motion(23.0, [20.0])})
    stiffness = {"stop_stiffness": theta}
    answer = periodic_orbit(
        system("end_stop"), plan, stiffness, "adaptive", tolerance=1e-7, backend="numpy"
    )
    np.testing.assert_allclose(answer.orbits[0].states[0], first, atol=1e-6)
    phase = np.linspace(0.0, 1.0, 20001)
    assert answer.dof("stroke", phase).min() == pytest.approx(least, abs=6e-6)
    speed = np.abs(answer.dof("stroke", phase, 1)).max()
    assert speed == pytest.approx(fastest, abs=6e-6)


# -- van der Pol -----------------------------------------------------------------------------------


# Andersen and Geer (1982, SIAM J. Applied Mathematics 42) for 1; an explicit integrator of order
# eight at rtol 2.5e-14 gives the same ten digits there, and the others.
@pytest.mark.parametrize(
    ("mu", "period"),
    [
        pytest.param(0.1, 6.2871112723, marks=pytest.mark.slow),
        (1.0, 6.6632868593),
        pytest.param(2.0, 7.6298744797, marks=pytest.mark.slow),
        pytest.param(3.0, 8.8590954997, marks=pytest.mark.slow),
        pytest.param(5.0, 11.6122306677, marks=pytest.mark.slow),
        pytest.param(10.0, 19.0783695669, marks=pytest.mark.slow),
    ],
)
def test_period_and_multiplier_of_van_der_pol(mu, period):
    steps = 256 if mu <= 2 else 1024 if mu <= 5 else 3072
    settle = 120.0 if mu < 1 else 60.0
    cycle = limit_cycle(
        system("van_der_pol"), {"position": 2.0}, settle, {"nonlinearity": mu}, steps=steps
    )
    assert cycle.orbit.period == pytest.approx(period, rel=2e-8)
    assert cycle.own == pytest.approx(1.0, abs=1e-5)
    # Liouville: the other multiplier is exp of the divergence's integral over the cycle.
    q = cycle.orbit.states[:, 0]
    other = np.prod(cycle.orbit.multipliers).real
    if mu <= 2:  # for larger ones it is below the round-off of the first
        divergence = cycle.orbit.period * np.mean(mu * (1 - q**2))
        assert other == pytest.approx(np.exp(divergence), rel=1e-4)
    assert cycle.stable


# -- strange attractors ----------------------------------------------------------------------------


def field(name: str) -> tuple[sp.Matrix, list[sp.Symbol], dict]:
    """Rates of a declared first-order system as formulas."""
    model = system(name)
    dofs = [symbol(dof) for dof in model.dofs]
    still = {derivative_symbol(dof, 1): 0 for dof in model.dofs}
    rates = sp.Matrix([-model.equation(dof).subs(still) for dof in model.dofs])
    return rates, dofs, model.nominal()


def fixed_points(name: str) -> list[np.ndarray]:
    """By hand."""
    if name == "lorenz":
        _, rho, beta = LORENZ
        root = np.sqrt(beta * (rho - 1))
        return [np.zeros(3), np.array([root, root, rho - 1]), np.array([-root, -root, rho - 1])]
    a, b, c = ROSSLER
    x = (c + np.array([-1, 1]) * np.sqrt(c**2 - 4 * a * b)) / 2
    return [np.array([v, -v / a, v / a]) for v in x]


LORENZ, ROSSLER = (10.0, 28.0, 8 / 3), (0.2, 0.2, 5.7)
#: Sparrow (1982), The Lorenz Equations; Roessler (1976). To the digits that are usually printed.
EIGENVALUES = {
    "lorenz": [
        [-22.8277, -2.6667, 11.8277],
        [-13.8546, 0.0940 - 10.1945j, 0.0940 + 10.1945j],
        [-13.8546, 0.0940 - 10.1945j, 0.0940 + 10.1945j],
    ],
    "rossler": [
        [-5.6870, 0.0970 - 0.9952j, 0.0970 + 0.9952j],
        [-4.596e-6 - 5.4280j, -4.596e-6 + 5.4280j, 0.1930],
    ],
}


@pytest.mark.parametrize("name", ["lorenz", "rossler"])
def test_fixed_points_and_their_eigenvalues(name):
    rates, dofs, values = field(name)
    value = sp.lambdify(dofs, list(rates.subs(values)))
    matrix = sp.lambdify(dofs, rates.jacobian(dofs).subs(values))
    for point, expected in zip(fixed_points(name), EIGENVALUES[name], strict=True):
        np.testing.assert_allclose(value(*point), 0.0, atol=1e-12)
        found = np.sort_complex(np.linalg.eigvals(matrix(*point)))
        np.testing.assert_allclose(found, expected, atol=6e-5)


def test_lorenz_loses_its_fixed_points_where_hopf_says():
    """``rho = sigma (sigma + beta + 3) / (sigma - beta - 1)``, 24.74 (Lorenz 1963)."""
    sigma, _, beta = LORENZ
    rho = sigma * (sigma + beta + 3) / (sigma - beta - 1)
    rates, dofs, values = field("lorenz")
    values = values | {symbol("rho"): rho}
    root = np.sqrt(beta * (rho - 1))
    matrix = sp.lambdify(dofs, rates.jacobian(dofs).subs(values))(root, root, rho - 1)
    assert np.abs(np.sort_complex(np.linalg.eigvals(matrix))[1:].real).max() < 1e-12


@pytest.mark.parametrize(
    ("name", "start", "period"),
    [
        # Viswanath (2003), Physica D 190: the orbit AB, once round each wing.
        ("lorenz", (-13.763610682134, -19.578751942452, 27.0), 1.558652210716),
        # Once round; the period agrees with integration by order eight at rtol 1e-12.
        ("rossler", (-4.26834953, 5.37547247, 0.02157057), 5.8810884556),
    ],
)
def test_an_unstable_periodic_orbit(name, start, period):
    model = system(name)
    begin = dict(zip(model.dofs, start, strict=True))
    cycle = limit_cycle(model, begin, 0.0, period=1.001 * period, steps=512)
    assert cycle.orbit.period == pytest.approx(period, rel=1e-8)
    assert not cycle.stable
    assert cycle.own == pytest.approx(1.0, abs=1e-6)
    # Liouville again: of Lorenz's system the divergence is a constant.
    if name == "lorenz":
        sigma, _, beta = LORENZ
        largest, own, least = np.abs(cycle.orbit.multipliers)
        assert largest * own * least == pytest.approx(
            np.exp(-(sigma + 1 + beta) * period), rel=1e-2
        )


@pytest.mark.slow
@pytest.mark.statistical
@pytest.mark.parametrize(
    ("name", "expected", "length", "step"),
    # Viswanath (1998), thesis, Cornell; Sprott (2003), Chaos and Time-Series Analysis, table A.
    [("lorenz", 0.9056, 100.0, 0.005), ("rossler", 0.0714, 600.0, 0.02)],
)
def test_largest_lyapunov_exponent(name, expected, length, step):
    """Growth of small disturbances along 64 motions, by Runge and Kutta's method of order four."""
    rates, dofs, values = field(name)
    away = [sp.Symbol(f"d{k}") for k in range(3)]
    both = [*rates, *(rates.jacobian(dofs) * sp.Matrix(away))]
    run = sp.lambdify([*dofs, *away], [item.subs(values) for item in both])

    def slope(s):
        return np.array(np.broadcast_arrays(*run(*s)))

    rng = np.random.default_rng(0)
    s = np.concatenate([rng.uniform(-1, 1, (3, 64)) + 1.0, rng.standard_normal((3, 64))])
    growth = np.zeros(64)
    settled = round(50 / step)
    for k in range(settled + round(length / step)):
        a = slope(s)
        b = slope(s + step / 2 * a)
        c = slope(s + step / 2 * b)
        s = s + step / 6 * (a + 2 * b + 2 * c + slope(s + step * c))
        size = np.linalg.norm(s[3:], axis=0)
        s[3:] /= size
        growth += np.log(size) if k >= settled else 0.0
    exponents = growth / length
    error = exponents.std(ddof=1) / 8
    # A finite time biases each by about the logarithm of a starting disturbance over the time.
    assert exponents.mean() == pytest.approx(expected, abs=4 * error + 0.5 / length)
    assert error < 0.05 * expected


# -- oleos -----------------------------------------------------------------------------------------

STROKE = {"displacement": motion(0.13, [0.1])}
CONDITIONS = {"initial_pressure": 4.9e5, "ambient_temperature": 293.0}


def test_mechanical_oleo_is_its_force_law():
    """Verbeek (1993), eqs. 6.1-6.2, term by term from the numbers of table C.1."""
    plan = RunPlan("a", 0.2, STROKE, CONDITIONS, periods=1)
    run = simulate_run(driven_by(system("f16n1d2"), "displacement"), plan)
    rate = 0.4 * np.pi
    q = 0.13 + 0.1 * np.cos(rate * run.time)
    v = -0.1 * rate * np.sin(rate * run.time)
    a = -0.1 * rate**2 * np.cos(rate * run.time)
    pressure = 4.9e5 * (1 - 3484e-6 * q / 9.2e-4) ** -1.1
    friction = (65.0 + 2e-5 * pressure) * np.arctan(3400 * v)
    force = 25 * (a + 9.81) + 2897 * v * np.abs(v) + 3484e-6 * (pressure - 1e5) + friction
    np.testing.assert_allclose(run.samples["pressure"], pressure - 1e5, rtol=1e-10)
    np.testing.assert_allclose(run.samples["force"], force, rtol=1e-10)


@pytest.mark.parametrize(
    ("name", "sign"), [("f16n2d2", -1), ("f16n2d2_thesis", -1), ("f16n2d2_thesis_printed", 1)]
)
def test_amount_of_gas_changes_with_pressure_by_the_declared_sign(name, sign):
    """``dn/dp`` of ``p V = n R T``: gas dissolves as pressure rises, but not as it is printed."""
    model = system(name)
    pressure = sp.lambdify(
        [symbol("stroke"), symbol("temperature")],
        model.expand(symbol("gas_pressure")).subs(model.nominal()),
    )
    strokes = np.array([0.05, 0.15, 0.23])
    p = np.array([pressure(q, 293.0) for q in strokes])
    volume = 9.2e-4 * (1 - 3.787 * strokes)
    amount = p * volume / (8.314 * 293.0)
    np.testing.assert_allclose(np.diff(amount) / np.diff(p), sign * 1.57e-8, rtol=2e-3)


def test_the_printed_sign_is_singular_before_the_stroke_ends():
    """At 253 mm; with the physical sign there is gas up to 264 mm and beyond."""
    ends = {}
    for name in ("f16n2d1_thesis", "f16n2d1_thesis_printed"):
        model = system(name)
        free = model.expand(symbol("free_volume_ratio")).subs(model.nominal())
        ends[name] = float(sp.solve(free.subs({symbol("temperature"): 293.0}), symbol("stroke"))[0])
    assert ends["f16n2d1_thesis_printed"] == pytest.approx(0.2531, abs=1e-4)
    assert ends["f16n2d1_thesis"] > 0.264


def test_heat_given_off_in_a_cycle_is_the_area_of_the_loop():
    """First law over a period of ``f16n2d2``: work on the gas = heat through the wall."""
    plan = RunPlan("a", 0.1, STROKE, CONDITIONS, periods=1, samples_per_period=4000)
    run = simulate_run(driven_by(system("f16n2d2"), "displacement"), plan, steps=512)
    q, p = run.samples["displacement"], run.samples["pressure"] + 1e5
    v = -0.1 * 0.2 * np.pi * np.sin(0.2 * np.pi * run.time)
    theta_6, theta_7 = -3484e-6 / 9.2e-4, 1.57e-8 * 8.314 / 9.2e-4
    theta_5 = 4.9e5 * (1 / 293 + theta_7)
    temperature = p * (1 + theta_6 * q) / (theta_5 - p * theta_7)
    heat = 2.567 * np.mean((1 + theta_6 * q) * (temperature - 293.0))
    work = np.mean(3484e-6 * (p - 1e5) * v)
    assert work > 1.0
    assert heat == pytest.approx(work, rel=1e-6)
