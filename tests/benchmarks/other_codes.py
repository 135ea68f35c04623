"""SciPy on the oleo's runs: LSODA until the motion repeats, and ``solve_bvp``."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from cases import Case
from explicit import Compiled, Explicit, compiled, dense
from measuring import PHASES, Array, error
from scipy.integrate import solve_bvp, solve_ivp

from bayesoleo.model import Model

#: Absolute tolerances are a part of the relative one, over the states' sizes: that one rules.
RELATIVE, ABSOLUTE = 1e-6, 1e-9
MOST_PERIODS = 200
#: LSODA three times: its right-hand side with NumPy's functions, as SciPy's examples have it; with
#: those of ``math`` on Python's numbers, three times as fast; and compiled.
NAMES = ("lsoda", "lsoda_python", "lsoda_compiled", "bvp")
#: First mesh of ``solve_bvp``, as fine as the discretisation's; and where it may give up.
NODES, MOST_NODES = 801, 100_000


def measure(model: Model, cases: list[Case]) -> dict[str, float]:
    """Mean CPU time a solve, errors of the stroke over its amplitude, and failures."""
    explicit = Explicit.of(model)
    bind = compiled(explicit)
    rows: dict[str, list[tuple[float, float]]] = {name: [] for name in NAMES}
    for case in cases:
        force, frequency = case.record.harmonics["force"], case.record.frequency
        fast = bind(case.p, force, frequency)
        fast.rates(0.0, case.scale)  # compiles
        rows["lsoda"].append(integrated(case, of_arrays(explicit, case)))
        rows["lsoda_python"].append(integrated(case, of_numbers(explicit, case)))
        rows["lsoda_compiled"].append(integrated(case, fast.rates))
        rows["bvp"].append(boundary_value(case, fast))
    result: dict[str, float] = {}
    for name, row in rows.items():
        seconds, errors = np.array(row).T
        good = np.isfinite(errors)
        result |= {
            f"{name}_ms": 1e3 * float(seconds.mean()),
            f"{name}_error": float(np.median(errors[good])),
            f"{name}_error_worst": float(errors[good].max()),
            f"{name}_failures": int((~good).sum()),
        }
    return result


def of_arrays(explicit: Explicit, case: Case) -> Callable[[float, Array], Array]:
    """The right-hand side with NumPy's functions, arrays in and out."""
    function, force = explicit.function("numpy"), _force_of(case)
    return lambda t, s: np.array(function(*s, force(t), *case.p))


def of_numbers(explicit: Explicit, case: Case) -> Callable[[float, Array], list[float]]:
    """The right-hand side on Python's own numbers."""
    function, force, p = explicit.function("math"), _force_of(case), case.p.tolist()
    return lambda t, s: function(*s.tolist(), force(t), *p)


def _force_of(case: Case) -> Callable[[float], float]:
    coefficients = dense(case.record.harmonics["force"])
    orders = np.flatnonzero(coefficients)
    turns, coefficients = 2j * np.pi * case.record.frequency * orders, coefficients[orders]
    return lambda t: float(np.dot(np.exp(turns * t), coefficients).real)


def integrated(case: Case, rates: Callable) -> tuple[float, float]:
    """Seconds until the state repeats to 1e-6 of its sizes, and the error then."""
    period, scale = case.run.period, case.scale
    options = {"method": "LSODA", "rtol": RELATIVE, "atol": ABSOLUTE * scale}
    s = case.begin(np.zeros(1))[:, 0]
    begin, repeats = time.thread_time(), False
    for k in range(MOST_PERIODS):
        end = solve_ivp(rates, (k * period, (k + 1) * period), s, **options).y[:, -1]
        repeats = bool(np.max(np.abs(end - s) / scale) < RELATIVE)
        s = end
        if repeats:
            break
    seconds = time.thread_time() - begin
    if not repeats:
        return seconds, np.nan
    t = (k + 1 + PHASES) * period
    last = solve_ivp(rates, (t[0], (k + 2) * period), s, t_eval=t, **options).y
    return seconds, error(last[0], case.exact[0])


def boundary_value(case: Case, fast: Compiled) -> tuple[float, float]:
    """Seconds of ``solve_bvp`` with exact derivatives and its default tolerance, and its error."""
    period, scale = case.run.period, case.scale[:, None]
    phases = np.linspace(0.0, 1.0, NODES)
    y = case.begin(phases) / scale
    identity = np.eye(scale.size)

    def rates(t: Array, y: Array) -> Array:
        return period * fast.many(t * period, y * scale) / scale

    def slopes(t: Array, y: Array) -> Array:
        sizes = scale.ravel()
        slope = fast.jacobian_many(t * period, y * scale)
        return period * slope * sizes[None, :, None] / sizes[:, None, None]

    def closure(a: Array, b: Array) -> Array:
        return a - b

    def closure_slopes(a: Array, b: Array) -> tuple[Array, Array]:
        return identity, -identity

    rates(phases[:2], y[:, :2]), slopes(phases[:2], y[:, :2])  # compiles
    begin = time.thread_time()
    found = solve_bvp(
        rates, closure, phases, y, fun_jac=slopes, bc_jac=closure_slopes, max_nodes=MOST_NODES
    )
    seconds = time.thread_time() - begin
    if found.status != 0:
        return seconds, np.nan
    return seconds, error(found.sol(PHASES)[0] * case.scale[0], case.exact[0])
