"""A transient with sensitivities to six parameters: the package against CVODES.

An oscillator with cubic stiffness and damping starts from rest under a sum of sines that both sides
know exactly. CVODES integrates the equations together with those of their sensitivities through
CasADi, compiled where there is a compiler, which is faster than CasADi's own forward sensitivities.
Its time is taken where its error is that of the package. The errors are those of the output and of
its sensitivities, each over its largest value, against DOP853 of SciPy at a tolerance of 1e-13. The
package has solved the run once before, at parameters some per cent away, as while it samples.
``transient_ratio`` is the package's time over that of CVODES for one vector of parameters, and
``transient_batch_ratio`` for each of a batch: below one the package is faster. Run as
``python tests/benchmarks/transients.py --json``.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

sys.path.insert(0, str(Path(__file__).resolve().parent))
from measuring import Array, cpu, time_at

from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Harmonics, Record

NAMES = ("gain", "damping", "stiffness", "cubic", "drag", "offset")
VALUES = np.array([1.0, 0.6, 100.0, 40.0, 0.05, 0.3])
#: Frequencies, Hz, amplitudes and phases of the input over ten seconds.
FREQUENCIES = np.array([0.7, 1.3, 2.1])
AMPLITUDES, PHASES = np.array([40.0, 25.0, 15.0]), np.array([0.3, 1.9, 4.0])
LENGTH, SAMPLES, BATCH = 10.0, 1001, 32
TOLERANCES = (1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)


def force(time: Array) -> Array:
    """The input at times in s."""
    turn = 2 * np.pi * np.multiply.outer(time, FREQUENCIES) + PHASES
    return np.asarray(np.sin(turn) @ AMPLITUDES)


def model() -> Model:
    """The oscillator; all six parameters are estimated."""
    return Model(
        "duffing",
        inputs={"u": "1"},
        dofs={"q": Dof("", initial="0")},
        parameters={n: Parameter(v, sd=0.1 * v) for n, v in zip(NAMES, VALUES, strict=True)},
        equations={
            "q": "ddot(q) + damping*dot(q) + drag*dot(q)**3 + stiffness*q + cubic*q**3"
            " + offset - gain*u"
        },
        outputs={"y": Output("q", "")},
    )


def vectors(count: int = BATCH) -> Array:
    """Parameter vectors within a per cent of each other, shape (count, 6)."""
    noise = np.random.default_rng(7).standard_normal((count, VALUES.size))
    return VALUES * (1.0 + 0.01 * noise)


def times() -> Array:
    """Times of the samples, s."""
    return np.linspace(0.0, LENGTH, SAMPLES)


def exact(p: Array) -> tuple[Array, Array]:
    """Output (N,) and its sensitivities (N, 6), by the equations and their derivatives."""

    def rates(t: float, s: Array) -> Array:
        x, v = s[:2]
        g, c, k, k3, d, f = p
        by = s[2:].reshape(2, 6)
        now = float(force(np.array([t]))[0])
        fall = g * now - c * v - d * v**3 - k * x - k3 * x**3 - f
        own = np.array([now, -v, -x, -(x**3), -(v**3), -1.0])
        more = own - (c + 3 * d * v**2) * by[1] - (k + 3 * k3 * x**2) * by[0]
        return np.concatenate([[v, fall], by[1], more])

    found = solve_ivp(rates, (0.0, LENGTH), np.zeros(14), "DOP853", times(), rtol=1e-13, atol=1e-15)
    return found.y[0], found.y[2:8].T


def error_of(found: tuple[Array, Array], true: tuple[Array, Array]) -> float:
    """The larger of the errors of the output and of its sensitivities, each over its size."""
    output = np.max(np.abs(found[0] - true[0])) / np.max(np.abs(true[0]))
    scale = np.max(np.abs(true[1]), axis=0)
    return float(max(output, np.max(np.abs(found[1] - true[1]) / scale)))


def ours() -> tuple[Callable[[Array], Any], Callable[[Any, int], tuple[Array, Array]]]:
    """Solves a batch (L, 6), and gives output and sensitivities of one of them."""
    time = times()
    length = 2 * np.pi * FREQUENCIES * LENGTH
    orders = np.round(length / (2 * np.pi)).astype(int)
    known = Harmonics(orders, -1j * AMPLITUDES * np.exp(1j * PHASES), np.zeros(orders.size))
    samples = {"u": force(time), "y": np.zeros(time.size)}
    record = Record(
        "a", "", "fit", "transient", np.nan, np.nan, 0, time, samples, {},
        dict.fromkeys(samples, 0.0), smoothed={"u": known},
    )  # fmt: skip
    predictor = Predictor(model(), [record], jobs=1)
    predictor.set_anchor(VALUES)
    (run,) = predictor.runs

    def solve(p: Array) -> Any:
        return run.predict(predictor.constants(p, 0), derivatives=True)

    def of(found: Any, k: int) -> tuple[Array, Array]:
        assert found.status[k] == 0
        return found.y[k, 0], found.y_p[k, 0].T

    return solve, of


def with_cvodes(tolerance: float) -> Callable[[Array], tuple[Array, Array]]:
    """Solves for parameters (6,): output and sensitivities by forward integration."""
    import casadi as ca

    x, p, t = ca.SX.sym("x", 2), ca.SX.sym("p", 6), ca.SX.sym("t")
    now = sum(
        a * ca.sin(2 * np.pi * f * t + q)
        for f, a, q in zip(FREQUENCIES, AMPLITUDES, PHASES, strict=True)
    )
    fall = p[0] * now - p[1] * x[1] - p[4] * x[1] ** 3 - p[2] * x[0] - p[3] * x[0] ** 3 - p[5]
    rates, by = ca.vertcat(x[1], fall), ca.SX.sym("by", 2, 6)
    more = ca.jacobian(rates, x) @ by + ca.jacobian(rates, p)
    whole = {
        "x": ca.vertcat(x, ca.vec(by)),
        "p": p,
        "t": t,
        "ode": ca.vertcat(rates, ca.vec(more)),
    }
    options = {"reltol": tolerance, "abstol": tolerance * 1e-2, "max_num_steps": 1_000_000}
    if shutil.which("gcc"):
        options |= {"jit": True, "compiler": "shell", "jit_options": {"flags": ["-O2"]}}
    integrator = ca.integrator("run", "cvodes", whole, 0.0, list(times()[1:]), options)
    zero = np.zeros(14)

    def solve(values: Array) -> tuple[Array, Array]:
        found = np.asarray(integrator(x0=zero, p=values)["xf"])
        found = np.concatenate([zero[:, None], found], axis=1)
        return found[0], found[2::2].T

    return solve


def figures() -> dict[str, float]:
    """CPU times per vector and errors of both, and the ratio at equal error."""
    p = vectors()
    truth = exact(p[0])
    solve, of = ours()
    found = solve(p)
    own_error = error_of(of(found, 0), truth)
    one = cpu(lambda: solve(p[:1]))
    many = cpu(lambda: solve(p)) / len(p)
    table = {
        "transient_error": own_error,
        "transient_ms": 1e3 * one,
        "transient_batch_ms": 1e3 * many,
    }
    if importlib.util.find_spec("casadi") is None:
        print("casadi is not installed: no transient_ratio", file=sys.stderr)
        return table
    errors, seconds = [], []
    for tolerance in TOLERANCES:
        peer = with_cvodes(tolerance)
        errors.append(error_of(peer(p[0]), truth))
        seconds.append(cpu(lambda peer=peer: peer(p[0]), 3))
    table |= {
        f"cvodes_{t:.0e}_{what}": value
        for t, e, s in zip(TOLERANCES, errors, seconds, strict=True)
        for what, value in (("error", e), ("ms", 1e3 * s))
    }
    at = time_at(own_error, errors, seconds)
    return table | {
        "cvodes_ms": 1e3 * at,
        "transient_ratio": one / at,
        "transient_batch_ratio": many / at,
    }


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", action="store_true", help="one flat object")
    given = parser.parse_args()
    table = figures()
    if given.json:
        print(json.dumps(table))
        return
    for key, value in table.items():
        print(f"{key:28} {value:.4g}")


if __name__ == "__main__":
    main()
