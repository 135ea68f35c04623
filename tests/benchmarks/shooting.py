"""Time of shooting over time of discretisation at equal error, on the oleo driven by force.

Run as ``python tests/benchmarks/shooting.py [--json]``. Both solve one run for one parameter
vector: from the model's own static guess (cold), and from the solution of parameters one per cent
away with its derivatives (warm). Each uses the coarsest setting whose stroke is within the target,
in parts of its amplitude, of a reference that a far tighter tolerance gave. CPU time, the best of
several.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable

import numpy as np

from bayesoleo.model import Model
from bayesoleo.model._kernels import kernels
from bayesoleo.prediction._inputs import dynamics_of
from bayesoleo.prediction._periodic_run import RunPredictor
from bayesoleo.prediction._simulate import RunPlan, motion, record_of
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._periodic import sensitivities, solve_from_guess, solve_periodic
from bayesoleo.solvers._schemes import DEFAULT_SCHEME
from bayesoleo.solvers._shooting import Shot, solve_shooting
from bayesoleo.systems import system

#: Errors over the amplitude of the stroke at which times are compared.
TARGETS = (1e-5, 1e-8)
TOLERANCES = 10.0 ** -np.arange(2.0, 12.1, 0.5)
STEPS = [round(32 * 2 ** (k / 2)) for k in range(21)]
PHASES = np.arange(997) / 997
PLAN = RunPlan("force", 0.5, {"force": motion(2600.0, [1200.0, 150.0])})


def oleo(friction: bool) -> Model:
    """``f16n2d1`` with its friction, or without: smooth but for ``|q'|``."""
    model = system("f16n2d1")
    none = {"friction_base": 0.0, "friction_per_pressure": 0.0}
    return model if friction else model.with_values(none)


class Shooting:
    """One run by shooting; settings are tolerances."""

    def __init__(self, model: Model, predictor: RunPredictor):
        self.dynamics = dynamics_of(model, predictor.record)
        self.period, self.active = predictor.period, predictor.active
        x = predictor.guess(predictor.base_constants())
        self.guess = np.ascontiguousarray(x[0, 0, : self.dynamics.size])

    def cold(self, p: np.ndarray, tolerance: float) -> Shot:
        return solve_shooting(self.dynamics, p, self.period, self.guess, tolerance=tolerance)

    def neighbour(self, p: np.ndarray, tolerance: float) -> tuple[Shot, np.ndarray]:
        shot = solve_shooting(
            self.dynamics, p, self.period, self.guess, tolerance=tolerance, sensitivities=True
        )
        return shot, p

    def warm(self, p: np.ndarray, tolerance: float, near: tuple[Shot, np.ndarray]) -> Shot:
        shot, at = near
        start = shot.start + shot.start_theta @ (p - at)[self.active]
        return solve_shooting(self.dynamics, p, self.period, start, tolerance=tolerance, near=shot)

    def stroke(self, shot: Shot) -> np.ndarray | None:
        return shot.sample(PHASES)[0] if shot.status.ok else None


class Discretisation:
    """The same by collocation on an equidistant mesh; settings are numbers of steps."""

    def __init__(self, model: Model, scheme: str = DEFAULT_SCHEME):
        self.model, self.scheme = model, scheme
        self.record = record_of(model, PLAN)
        self.known: dict[int, RunPredictor] = {}

    def at(self, n: int) -> RunPredictor:
        if n not in self.known:
            self.known[n] = RunPredictor(
                self.model, kernels(self.model), self.record, n, self.scheme
            )
        return self.known[n]

    def cold(self, p: np.ndarray, n: int):
        return solve_from_guess(self.at(n).boundary, p[None], self.at(n).guess(p))

    def neighbour(self, p: np.ndarray, n: int):
        solution = self.cold(p, n)
        _, x_p, _ = sensitivities(self.at(n).boundary, p[None], solution)
        return solution.x, x_p, p

    def warm(self, p: np.ndarray, n: int, near: tuple):
        x, x_p, at = near
        start = x + x_p @ (p - at)[self.at(n).active]
        return solve_periodic(self.at(n).boundary, p[None], start)

    def stroke(self, solution) -> np.ndarray | None:
        if solution.status[0] != Status.CONVERGED:
            return None
        n, boundary = solution.x.shape[1], self.at(solution.x.shape[1]).boundary
        plan = boundary.scheme.plan(PHASES, n)
        return boundary.scheme.sample(solution.x[..., None], plan, boundary.step(n))[0, 0, 0]


def cpu(work: Callable[[], object], repeats: int = 7) -> float:
    """Least CPU time of a call, s."""
    times = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return min(times)


def coarsest(solver, settings, p, exact, target) -> tuple[float, float]:
    """The first setting whose error is below the target, and its error."""
    for setting in settings:
        stroke = solver.stroke(solver.cold(p, setting))
        if stroke is not None:
            error = float(np.max(np.abs(stroke - exact)) / (np.ptp(exact) / 2))
            if error <= target:
                return setting, error
    return float("nan"), float("nan")


def compare(friction: bool) -> dict[str, float]:
    """Times and errors of both solvers for one model."""
    model = oleo(friction)
    discretisation = Discretisation(model)
    predictor = discretisation.at(STEPS[0])
    shooting = Shooting(model, predictor)
    p = predictor.base_constants()
    moved = p.copy()
    moved[predictor.active] *= 1.01
    exact = shooting.stroke(shooting.cold(p, 1e-13))
    assert exact is not None
    result = {}
    solvers = {"shooting": (shooting, TOLERANCES), "discretisation": (discretisation, STEPS)}
    for target in TARGETS:
        for name, (solver, settings) in solvers.items():
            key = f"{name}_{target:.0e}".replace("e-0", "e-")
            setting, error = coarsest(solver, settings, p, exact, target)
            result[f"{key}_setting"], result[f"{key}_error"] = float(setting), error
            result[f"{key}_cold_ms"] = 1e3 * cpu(lambda s=solver, a=setting: s.cold(p, a))
            near = solver.neighbour(moved, setting)
            warm = cpu(lambda s=solver, a=setting, b=near: s.warm(p, a, b))
            result[f"{key}_warm_ms"] = 1e3 * warm
    return result


def measure() -> dict[str, float]:
    """All figures in one flat dictionary; ``shooting_ratio`` is the worst one without friction.

    Ratios are of CPU times at equal error: above one, discretisation is faster.
    """
    result: dict[str, float] = {}
    for friction in (False, True):
        name = "friction" if friction else "smooth"
        table = compare(friction)
        result |= {f"{name}_{key}": value for key, value in table.items()}
        for target in TARGETS:
            label = f"{target:.0e}".replace("e-0", "e-")
            for start in ("cold", "warm"):
                both = [table[f"{s}_{label}_{start}_ms"] for s in ("shooting", "discretisation")]
                result[f"{name}_shooting_ratio_{label}_{start}"] = both[0] / both[1]
    ratios = [value for key, value in result.items() if "smooth_shooting_ratio" in key]
    result["shooting_ratio"] = max(ratios)
    return result


def main() -> None:
    """Print all figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    result = measure()
    if options.json:
        print(json.dumps(result))
        return
    for key, value in result.items():
        print(f"{key:45s} {value:.4g}")


if __name__ == "__main__":
    main()
