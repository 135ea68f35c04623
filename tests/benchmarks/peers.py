"""Peers that can express the periodic problem: CasADi's collocation and Diffrax's integration.

CasADi gets the very equations that the default scheme solves, stages, mesh, start and all, compiled
from C, with a sparse factorisation, a batch of runs' vectors over all cores: what it finds agrees
to round-off, so that times are at equal error. Diffrax gets an implicit integrator, compiled,
vectorised over vectors and differentiated for Newton's method on the state that returns to itself;
its tolerance is LSODA's. Both come with the group ``bench``; the figures of one that is not
installed are left out.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from cases import Case, batch, solve, start, states
from explicit import Explicit
from measuring import PHASES, Array, cpu, error

from bayesoleo._parallel import available_cores
from bayesoleo.model import Model
from bayesoleo.prediction._periodic_run import RunPredictor
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._orbit import Status

#: Vectors of a batch: as many as the figures need, for the peers are slow.
CASADI_BATCH, DIFFRAX_BATCH = 8, 4
#: Newton's method ends at a residual, CasADi, or a step, Diffrax, over the states' sizes.
RESIDUAL, STEP = 1e-10, 1e-6
#: Strokes of the same equations that differ by more are of different solutions.
SAME = 1e-6
TOLERANCE = 1e-6
MOST_STEPS, MOST_ITERATIONS = 20_000, 12


def measure(model: Model, cases: Sequence[Case], *, diffrax: bool = True) -> dict[str, float]:
    """CPU milliseconds a solve, their ratio to the default scheme's on the same vectors just after,
    agreement or error, and failures, of each peer that is installed."""
    result: dict[str, float] = {}
    if importlib.util.find_spec("casadi"):
        result |= with_casadi(model, cases)
    if diffrax and importlib.util.find_spec("diffrax"):
        result |= with_diffrax(model, cases[len(cases) // 4])
    return result


# -- CasADi ----------------------------------------------------------------------------------------


def with_casadi(
    model: Model, cases: Sequence[Case], vectors: int = CASADI_BATCH
) -> dict[str, float]:
    """The default scheme's own equations by CasADi's Newton method."""
    predictor = Predictor(model, [case.record for case in cases], steps=cases[0].run.steps)
    theta = batch(predictor, vectors)
    scale = np.max([case.scale for case in cases], axis=0)
    explicit, scheme = Explicit.of(model), predictor.runs[0].scheme
    assert isinstance(scheme, Collocation)
    root = _casadi_root(explicit, scheme, predictor.steps, scale)
    many = root.map(vectors, "thread", available_cores())
    seconds, own, gap, failures = 0.0, 0.0, 0.0, 0
    for r, run in enumerate(predictor.runs):
        p = predictor.constants(theta, r)
        z, given = _casadi_arguments(run, p, scale)
        seconds += cpu(lambda z=z, given=given: many(z, given), 3)
        own += cpu(lambda run=run, p=p: solve(run, p), 3)
        found = np.array(many(z, given)).reshape(predictor.steps, -1, vectors)[:, 0] * scale[0]
        ours = solve(run, p)
        assert np.all(ours.status == Status.CONVERGED)
        strokes = ours.x[:, :, 0].T
        apart = np.abs(found - strokes).max(axis=0) / (np.ptp(strokes, axis=0) / 2)
        failures += int(np.count_nonzero(~(apart < SAME)))
        gap = max(gap, float(apart[apart < SAME].max(initial=0.0)))
    solves = vectors * len(cases)
    return {
        "casadi_ms": 1e3 * seconds / solves,
        "casadi_ratio": seconds / own,
        "casadi_gap": gap,
        "casadi_failures": failures,
    }


def _casadi_root(explicit: Explicit, scheme: Collocation, n: int, scale: Array) -> Any:
    """A root finder over states and stage rates, scaled, of all steps; given constants, the force
    at the stages, and the step.
    """
    import casadi as ca

    table = [{"atan": ca.atan, "Abs": ca.fabs, "abs": ca.fabs}, "math"]
    function = explicit.function(table)
    a, b = scheme.method.a, scheme.method.b
    D, s, constants = scale.size, scheme.method.stages, len(explicit.constants)
    first, rate, after = ca.SX.sym("first", D), ca.SX.sym("rate", D, s), ca.SX.sym("after", D)
    u, p, h = ca.SX.sym("u", s), ca.SX.sym("p", constants), ca.SX.sym("h")
    left = []
    for i in range(s):
        y = (first + h * sum(a[i, j] * rate[:, j] for j in range(s))) * scale
        values = function(*ca.vertsplit(y), u[i], *ca.vertsplit(p))
        left.append(rate[:, i] - ca.vertcat(*values) / scale)
    left.append(after - first - h * sum(b[j] * rate[:, j] for j in range(s)))
    options = {"cse": True, "jit": True, "compiler": "shell"}
    options["jit_options"] = {"flags": ["-O3", "-march=native"]}
    step = ca.Function("step", [first, rate, after, u, p, h], [ca.vertcat(*left)], options)
    z = ca.MX.sym("z", D * (1 + s), n)
    given_p, given_u = ca.MX.sym("P", constants), ca.MX.sym("U", s, n)
    given_h = ca.MX.sym("H")
    states_, rates = z[:D, :], z[D:, :].reshape((D, s * n))
    next_states = ca.horzcat(states_[:, 1:], states_[:, :1])
    equations = step.map(n)(
        states_, rates, next_states, given_u, ca.repmat(given_p, 1, n), ca.repmat(given_h, 1, n)
    )
    given = ca.vertcat(given_p, ca.vec(given_u), given_h)
    residual = ca.Function("residual", [ca.vec(z), given], [ca.vec(equations)])
    chosen = {"linear_solver": "qr", "abstol": RESIDUAL, "error_on_fail": False}
    return ca.rootfinder("root", "newton", residual, chosen)


def _casadi_arguments(run: RunPredictor, p: Array, scale: Array) -> tuple[Array, Array]:
    """Unknowns and what is given, a column each vector, of the common start."""
    x, n, lanes = start(run, p), run.steps, np.arange(p.shape[0])
    D, d = scale.size, len(run.scheme.orders)
    rows = np.zeros((p.shape[0], D + d, run.boundary.inputs.shape[1]))
    run.scheme.rows(x, lanes, run.boundary.step(n), rows)
    first = np.cumsum([0, *(order + 1 for order in run.scheme.orders)])
    kept = [first[j] + k + 1 for j, o in enumerate(run.scheme.orders) for k in range(o)]
    stages = rows.shape[2] // n
    rates = rows[:, kept].reshape(p.shape[0], D, n, stages) / scale[:, None, None]
    rates = rates.transpose(0, 2, 3, 1).reshape(p.shape[0], n, -1)
    z = np.concatenate([x[:, :, :D] / scale, rates], axis=2).reshape(p.shape[0], -1)
    force = run.boundary.inputs[0]
    given = [np.concatenate([row, force, [run.boundary.step(n)]]) for row in p]
    return z.T, np.array(given).T


# -- Diffrax ---------------------------------------------------------------------------------------


def with_diffrax(model: Model, case: Case, vectors: int = DIFFRAX_BATCH) -> dict[str, float]:
    """Newton's method on the time map of one run by an implicit Runge-Kutta integrator."""
    import jax

    jax.config.update("jax_enable_x64", True)
    predictor = Predictor(model, [case.record])
    run = predictor.runs[0]
    theta = batch(predictor, vectors)
    p = predictor.constants(theta, 0)
    begin = [states(run, x, np.zeros(1))[:, 0] for x in start(run, p)] / case.scale
    newton, along = _diffrax_shooting(Explicit.of(model), case)
    many = jax.jit(jax.vmap(newton))
    y, steps = (np.array(item) for item in many(begin, p))  # compiles
    seconds = cpu(lambda: jax.block_until_ready(many(begin, p)), 2)
    own = cpu(lambda: solve(run, p), 7)
    stroke = np.array(jax.jit(along)(y[0], p[0]))[:, 0] * case.scale[0]
    return {
        "diffrax_ms": 1e3 * seconds / vectors,
        "diffrax_ratio": seconds / own,
        "diffrax_error": error(stroke, case.exact[0]),
        "diffrax_failures": int(np.count_nonzero(~(steps < STEP))),
    }


def _diffrax_shooting(explicit: Explicit, case: Case) -> tuple[Callable, Callable]:
    """``newton(start, p)``: the closed motion's start and the last step; and states along it."""
    import diffrax
    import jax
    import jax.numpy as jnp

    function, scale = explicit.function("jax"), jnp.array(case.scale)
    force, period = case.record.harmonics["force"], case.run.period
    turns = jnp.array(2 * np.pi / period * force.orders)
    real, imaginary = jnp.array(force.coefficients.real), jnp.array(force.coefficients.imag)

    def field(t, y, p):
        u = jnp.sum(real * jnp.cos(turns * t) - imaginary * jnp.sin(turns * t))
        return jnp.stack(function(*(y * scale), u, *p)) / scale

    def flow(y, p, saved):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(field), diffrax.Kvaerno5(), 0.0, period, period / 1000, y, args=p,
            stepsize_controller=diffrax.PIDController(rtol=TOLERANCE, atol=TOLERANCE),
            max_steps=MOST_STEPS, adjoint=diffrax.ForwardMode(), saveat=saved, throw=False,
        ).ys  # fmt: skip

    def returned(y, p):
        end = flow(y, p, diffrax.SaveAt(t1=True))[0]
        return end, end

    slope = jax.jacfwd(returned, has_aux=True)

    def newton(y, p):
        def iterate(carry):
            y, _, k = carry
            monodromy, end = slope(y, p)
            change = jnp.linalg.solve(jnp.eye(y.size) - monodromy, end - y)
            return y + change, jnp.max(jnp.abs(change)), k + 1

        def going(carry):
            return (carry[1] > STEP) & (carry[2] < MOST_ITERATIONS)

        return jax.lax.while_loop(going, iterate, (y, jnp.inf, 0))[:2]

    return newton, lambda y, p: flow(y, p, diffrax.SaveAt(ts=jnp.array(PHASES * period)))
