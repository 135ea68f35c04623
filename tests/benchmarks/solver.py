"""Speed and accuracy of the periodic solver, as ratios taken in one run.

Run as ``python tests/benchmarks/solver.py [--json]``. The campaign is found through
``BAYESOLEO_DATA``. ``solve_us`` and ``log_density_ms`` are wall time with all cores, best of
several repetitions; what fails counts beside it in ``failures``.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from bayesoleo.data import dataset_folder, load_campaign, reduce_campaign
from bayesoleo.model import driven_by
from bayesoleo.parallel import available_cores, thread_map
from bayesoleo.prediction.predictor import Predictor
from bayesoleo.solvers.periodic import solve_periodic
from bayesoleo.solvers.state_space import StateSpace
from bayesoleo.systems import system

#: Parameter vectors in a batch, and their relative distance from the anchor.
BATCH, SPREAD = 32, 0.01


def best(function: Callable[[], object], repetitions: int = 7) -> float:
    """Shortest wall time of several repetitions, s."""
    times = []
    for _ in range(repetitions):
        begin = time.perf_counter()
        function()
        times.append(time.perf_counter() - begin)
    return min(times)


def batch(predictor: Predictor, count: int = BATCH) -> np.ndarray:
    """Parameter vectors around the anchor at the nominal one, shape (count, l)."""
    nominal = predictor.layout.start(predictor.model)
    predictor.set_anchor(nominal)
    noise = np.random.default_rng(1993).standard_normal((count, nominal.size))
    return nominal * (1.0 + SPREAD * noise)


def solves(predictor: Predictor, theta: np.ndarray, runs: int | None = None) -> tuple[float, int]:
    """Time of a solve, s, and number of failures, over runs and vectors from the anchors."""
    chosen = range(len(predictor.runs))[:runs]
    constants = [predictor.constants(theta, r) for r in chosen]
    failed = np.zeros(len(chosen), dtype=int)

    def one(r: int) -> None:
        run, p = predictor.runs[r], constants[r]
        start = run.anchor.predict(p[:, run.active] - run.anchor.p[run.active])
        failed[r] = np.count_nonzero(solve_periodic(run.boundary, p, start).status)

    seconds = best(lambda: thread_map(one, chosen))
    return seconds / (len(chosen) * len(theta)), int(failed.sum())


def exponent(sizes: list[int], seconds: list[float]) -> float:
    """Slope of total time against size on logarithmic scales."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def scaling(records: list, model) -> dict[str, float]:
    """Exponents of time in steps, runs and parameter vectors."""
    by_steps, sizes = [], [400, 800, 1600, 3200]
    for n in sizes:
        predictor = Predictor(model, records[:4], steps=n, scheme="thesis")
        by_steps.append(solves(predictor, batch(predictor))[0])
    predictor = Predictor(model, records, steps=800, scheme="thesis")
    theta = batch(predictor, 128)
    runs, vectors = [2, 4, 8, 14], [16, 32, 64, 128]
    return {
        "exponent_n": exponent(sizes, by_steps),
        "exponent_runs": exponent(runs, [r * solves(predictor, theta[:32], r)[0] for r in runs]),
        "exponent_vectors": exponent(
            vectors, [v * solves(predictor, theta[:v])[0] for v in vectors]
        ),
    }


def integrated(predictor: Predictor, r: int) -> float:
    """Seconds in which LSODA settles on a run's orbit, from rest, until it repeats to 1e-6."""
    run = predictor.runs[r]
    harmonics = run.record.harmonics
    rows = run.kernels.derived.inputs

    def inputs(t: np.ndarray) -> np.ndarray:
        phase = np.atleast_1d(t) / run.period
        return np.stack([harmonics[name].evaluate(phase, 1 / run.period, k) for name, k in rows])

    p = predictor.constants(predictor.layout.start(predictor.model)[None], r)[0]
    derived = run.kernels.derived
    space = StateSpace(run.kernels, derived.orders, inputs, len(derived.active))
    rates = space.right_side(p)
    start = run.guess(p)[0, 0]
    orders = derived.orders
    s = start[: sum(orders)].copy()  # the default scheme's unknowns begin with the state
    begin = time.perf_counter()
    for period in range(60):
        span = (period * run.period, (period + 1) * run.period)
        end = solve_ivp(rates, span, s, method="LSODA", rtol=1e-6, atol=1e-9).y[:, -1]
        change = np.max(np.abs(end - s) / np.maximum(np.abs(end), 1e-3))
        s = end
        if change < 1e-6:
            break
    return time.perf_counter() - begin


NEW_MODEL = """
import json, sys, time
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction.simulate import RunPlan, motion, simulate_run
begin = time.perf_counter()
model = Model("new", inputs={"force": "N"}, dofs={"q": Dof("m")},
    parameters={"damping": Parameter(0.3, sd=0.1), "cubic": Parameter(0.7, sd=0.1)},
    equations={"q": {"all": "ddot(q) + damping*dot(q) + q + cubic*q**3 - force"}},
    outputs={"displacement": Output("q", "m")})
simulate_run(model, RunPlan("a", 0.2, {"force": motion(0.1, [1.0])}), backend="numba")
print(time.perf_counter() - begin)
"""


def new_model() -> dict[str, float]:
    """Declaration to first solve in two processes with one cache, and the import."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"BAYESOLEO_CACHE": folder}

        def run(code: str) -> float:
            command = [sys.executable, "-c", code]
            done = subprocess.run(
                command, env=environment, check=True, capture_output=True, text=True
            )
            return float(done.stdout.splitlines()[-1])

        first, second = run(NEW_MODEL), run(NEW_MODEL)
    imports = "import time; t = time.perf_counter(); import bayesoleo"
    imports += "; print(time.perf_counter() - t)"
    return {"new_model_s": first, "new_model_cached_s": second, "import_s": run(imports)}


def measure() -> dict[str, float]:
    """All figures."""
    records = list(reduce_campaign(load_campaign(dataset_folder("shaker-plain"))).records)
    model = system("f16n2d1")
    result: dict[str, float] = {"cores": available_cores()}
    predictor = Predictor(model, records, steps=800, scheme="thesis")
    seconds, failures = solves(predictor, batch(predictor))
    result |= {"solve_us": seconds * 1e6, "failures": failures}
    default = Predictor(model, records, steps=256)
    seconds, failures = solves(default, batch(default))
    result |= {"default_solve_us": seconds * 1e6, "default_failures": failures}
    driven = Predictor(driven_by(system("f16n2d2"), "displacement"), records, steps=256)
    theta = batch(driven)
    total = best(lambda: driven.sum_of_squares(theta))
    result["log_density_ms"] = total / len(theta) * 1e3
    result |= scaling(records, model)
    result["lsoda_ratio"] = integrated(default, 3) / (result["solve_us"] * 1e-6)
    return result | new_model()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="one flat object")
    result = measure() if parser.parse_args().json else None
    if result is not None:
        print(json.dumps(result))
        return
    for key, value in measure().items():
        print(f"{key:22s} {value:.4g}")


if __name__ == "__main__":
    main()
