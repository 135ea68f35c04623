"""Certified regressions beside lmfit and SciPy, the joint estimate of a campaign, replications.

Run as ``python tests/benchmarks/estimate.py [--json] [--table] [--optimisers]``. The data are found
through ``BAYESOLEO_DATA``; lmfit comes with the group ``bench``. A set counts if all its parameters
and all their standard deviations agree with the certified ones to six digits, for everybody alike.
Everybody has the same exact derivatives where the settings say so, and tolerances near rounding; of
each package its best settings count. Times are CPU time of this machine now, but for ``_s`` of a
joint estimate, which is wall time on all cores. Of a joint estimate the least of five is told.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from bayesoleo._workflow.settings import Settings
from bayesoleo._workflow.task import prepare, reduce
from bayesoleo.data import dataset_folder
from bayesoleo.discovery._fit import RESOLUTION
from bayesoleo.estimation import FunctionProblem, estimate, estimate_many, polish
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.model._priors import Normal
from bayesoleo.prediction._mesh_steps import first_steps
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.systems import system

sys.path.insert(0, str(Path(__file__).parents[1] / "estimation"))
from nist_models import FUNCTIONS, Certified, complex_step, read
from optimisers import table as optimiser_table

DIGITS = 6
FINE = 1e-15
REPEATS = 5
#: Truth of the simulated campaign over the nominal values, where the data identify it.
TRUTH = {"piston_area": -0.020, "solubility": 0.118, "heat_conduction": 0.304}
Found = tuple[np.ndarray, np.ndarray]
Fit = Callable[[Callable, Certified, np.ndarray], Found]


def ours(method: object = None, exact: bool = False, **options: object) -> Fit:
    """Parameters and standard deviations by this package, with weak priors about the start."""

    def fit(function: Callable, data: Certified, start: np.ndarray) -> Found:
        jacobian = complex_step(function) if exact else None
        priors = [Normal(value, 1e3 * abs(value)) for value in start]
        problem = FunctionProblem(function, data.x, data.y, priors, jacobian=jacobian)
        chosen = {} if method is None else {"method": method}
        point = estimate(problem, bias_corrected=True, **chosen, **options)
        return point.theta, np.sqrt(np.diag(point.covariance_likelihood))

    return fit


def lmfit_fit(exact: bool = False, **options: object) -> Fit:
    """The same by lmfit."""
    import lmfit

    def fit(function: Callable, data: Certified, start: np.ndarray) -> Found:
        names = [f"b{k}" for k in range(len(start))]
        parameters = lmfit.Parameters()
        for name, value in zip(names, start, strict=True):
            parameters.add(name, value)

        def vector(p: lmfit.Parameters) -> np.ndarray:
            return np.array([p[name].value for name in names])

        jacobian = complex_step(function)
        if exact:
            key = "jac" if options.get("method") == "least_squares" else "Dfun"
            options[key] = lambda p: jacobian(data.x, vector(p))
        found = lmfit.minimize(
            lambda p: function(data.x, vector(p)) - data.y, parameters, **options
        )
        sd = [found.params[name].stderr for name in names]
        return vector(found.params), np.array(sd, dtype=float)

    return fit


def scipy_fit(exact: bool = False, **options: object) -> Fit:
    """The same by SciPy's curve_fit."""
    from scipy.optimize import curve_fit

    def fit(function: Callable, data: Certified, start: np.ndarray) -> Found:
        jacobian = complex_step(function)
        extra = {"jac": lambda x, *b: jacobian(x, np.array(b))} if exact else {}
        theta, covariance = curve_fit(
            lambda x, *b: function(x, np.array(b)), data.x, data.y, start, **options, **extra
        )
        return theta, np.sqrt(np.diag(covariance))

    return fit


def contestants() -> dict[str, Fit]:
    """Whoever takes part: each as it comes, and each as good as its settings make it."""
    tight = {"xtol": FINE, "ftol": FINE, "gtol": FINE}
    fine = {"exact": True, "tolerance": 1e-10, "max_iterations": 1000}
    return {
        "bayesoleo, default": ours(),
        "bayesoleo, MBE": ours("mbe", **fine),
        "bayesoleo, LM": ours("levenberg-marquardt", **fine),
        "lmfit, default": lmfit_fit(),
        "lmfit, leastsq": lmfit_fit(True, max_nfev=100_000, **tight),
        "lmfit, trf": lmfit_fit(
            True, method="least_squares", max_nfev=10_000, x_scale="jac", **tight
        ),
        "scipy, default": scipy_fit(),
        "scipy, lm": scipy_fit(True, maxfev=100_000, **tight),
        "scipy, trf": scipy_fit(True, method="trf", max_nfev=10_000, x_scale="jac", **tight),
    }


def digits(values: np.ndarray, certified: np.ndarray) -> float:
    """Agreed digits of the worst of them; zero where there are none."""
    with np.errstate(all="ignore"):
        error = np.max(np.abs(np.asarray(values, dtype=float) - certified) / np.abs(certified))
    return float(np.clip(-np.log10(max(error, 1e-16)), 0, 16)) if np.isfinite(error) else 0.0


def nist() -> tuple[dict[str, dict[str, float]], dict[str, float]]:
    """Digits by contestant and set, and CPU seconds by contestant."""
    folder = dataset_folder("nist")
    table, seconds = {}, {}
    for who, fit in contestants().items():
        begin, row = time.process_time(), {}
        for name, function in FUNCTIONS.items():
            data = read(folder / f"{name}.dat")
            if not who.startswith("bayesoleo"):  # the others compute in double precision only
                data = Certified(data.x.astype(float), data.y.astype(float), *_rest(data))
            for start in (0, 1):
                row[f"{name} {start + 1}"] = _attempt(fit, function, data, start)
        table[who], seconds[who] = row, time.process_time() - begin
    return table, seconds


def missed(table: dict[str, dict[str, float]]) -> int:
    """Fits that another package gets, and ours by default settings or by LM does not."""
    ours = [row for who, row in table.items() if who in ("bayesoleo, default", "bayesoleo, LM")]
    others = [row for who, row in table.items() if not who.startswith("bayesoleo")]
    return sum(
        any(row[name] >= DIGITS for row in others) and any(row[name] < DIGITS for row in ours)
        for name in ours[0]
    )


def _rest(data: Certified) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return data.starts, data.theta, data.sd


def _attempt(fit: Fit, function: Callable, data: Certified, start: int) -> float:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            theta, sd = fit(function, data, data.starts[start].copy())
        except Exception:
            return 0.0
    return min(digits(theta, data.theta), digits(sd, data.sd))


def joint(drive: str) -> dict[str, float]:
    """All runs of ``shaker-plain`` at once from the nominal start, compiled before."""
    reduced = reduce(dataset_folder("shaker-plain"))
    task = prepare(reduced, system("f16n2d2"), Settings(drive=drive))
    model = task.assembly.model()
    steps = first_steps(model, reduced.records)
    walls, cpus = [], []
    for _ in range(REPEATS):  # the first time compiles; the least is that of an undisturbed machine
        problem = CampaignProblem(Predictor(model, reduced.records, steps=steps))
        wall, cpu = time.perf_counter(), time.process_time()
        robust = estimate(problem, "mbe", resolution=RESOLUTION)
        mode = polish(problem, robust, resolution=RESOLUTION)
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    nominal = {name: item.value for name, item in model.parameters.items()}
    worst = max(abs(mode[n] / (nominal[n] * (1 + change)) - 1) for n, change in TRUTH.items())
    return {
        "s": min(walls),
        "cpu_s": min(cpus),
        "evaluations": robust.evaluations + mode.evaluations,
        "converged": bool(robust.status.ok and mode.status.ok),
        "largest_error_pct": 100 * worst,
    }


def replications(count: int = 10_000) -> float:
    """Gas-spring estimates a second of CPU time."""
    position, rng = np.linspace(0.0, 0.9, 100), np.random.default_rng(0)
    forces = (1 - position) ** -1.2 + rng.normal(0.0, 0.005 * 10**1.2, (count, 100))
    problem = FunctionProblem(
        lambda x, t: 0.95 * (1 - x) ** -t[0], position, forces[0], [Normal(1.0, 0.1)]
    )
    begin = time.process_time()
    found = estimate_many(problem, forces)
    assert found.ok.all()
    return count / (time.process_time() - begin)


def main() -> None:
    """Measure, and print as asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--table", action="store_true", help="print digits side by side")
    parser.add_argument(
        "--optimisers", action="store_true", help="compare SciPy's optimisers instead"
    )
    options = parser.parse_args()
    if options.optimisers:
        print(optimiser_table())
        return
    table, seconds = nist()
    counts = {who: sum(d >= DIGITS for d in row.values()) for who, row in table.items()}

    def best(prefix: str) -> int:
        return max(count for who, count in counts.items() if who.startswith(prefix))

    shown = {
        "nist_sets_6_digits": best("bayesoleo"),
        "lmfit_sets_6_digits": best("lmfit"),
        "scipy_sets_6_digits": best("scipy"),
        "nist_default_sets_6_digits": counts["bayesoleo, default"],
        "nist_sets_only_others_get": missed(table),
        **{f"nist_{who.replace(', ', '_').replace(' ', '_')}": n for who, n in counts.items()},
    }
    for drive, name in (("displacement", "joint_estimate"), ("model", "joint_estimate_by_force")):
        shown |= {f"{name}_{key}": value for key, value in joint(drive).items()}
    shown["gas_spring_replications_per_s"] = replications()
    if options.table:
        print("| set, start | " + " | ".join(table) + " |")
        print("|---" * (len(table) + 1) + "|")
        for name in next(iter(table.values())):
            print(f"| {name} | " + " | ".join(f"{row[name]:.1f}" for row in table.values()) + " |")
        print("| ≥ 6 digits | " + " | ".join(map(str, counts.values())) + " |")
        print("| CPU s | " + " | ".join(f"{value:.1f}" for value in seconds.values()) + " |")
    if options.json or not options.table:
        print(json.dumps(shown, indent=1))


if __name__ == "__main__":
    main()
