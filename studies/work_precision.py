"""Error against time of every periodic solver, from the same static guess, on two systems.

Used by the gallery's page; ``python studies/work_precision.py`` prints the table. Times are CPU
time of one thread, the best of several, with compiled equations and whatever a solver can prepare
before it sees the parameters done beforehand. The reference is shooting at 1e-13.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo.model import Model, kernels
from bayesoleo.prediction import (
    RunPlan,
    RunPredictor,
    dynamics_of,
    motion,
    periodic_problem,
    record_of,
)
from bayesoleo.solvers import solve_adaptive, solve_from_guess, solve_shooting
from bayesoleo.systems import system

Array = NDArray[np.float64]
Motion = Callable[[Array], Array]

PHASES = np.arange(997) / 997
STEPS = tuple(100 * 2**k for k in range(8))
TOLERANCES = tuple(10.0**-k for k in range(2, 11))
REFERENCE = 1e-13
SCHEMES = ("thesis", "radau2", "radau3", "gauss3")
ADAPTIVE = ("radau3", "gauss3")


@dataclass(frozen=True)
class Measured:
    """One setting of one solver: steps or tolerance, error over the amplitude, CPU time in s; both
    are NaN where it did not converge.
    """

    solver: str
    setting: float
    error: float
    seconds: float


def smooth_oleo() -> tuple[Model, RunPlan]:
    """The thermo-mechanical oleo without friction: smooth but for ``v|v|``."""
    none = {"friction_base": 0.0, "friction_per_pressure": 0.0}
    plan = RunPlan("force", 0.5, {"force": motion(2600.0, [1200.0, 150.0])})
    return system("f16n2d1").with_values(none), plan


def end_stop(stiffness: float = 2500.0) -> tuple[Model, RunPlan]:
    """The end stop, as stiff as Verbeek (1993) could go on equal steps."""
    plan = RunPlan("end stop", 1.0, {"force": motion(23.0, [20.0])})
    return system("end_stop").with_values({"stop_stiffness": stiffness}), plan


SYSTEMS = {"smooth oleo": smooth_oleo, "end stop": end_stop}


class Problem:
    """One model under one plan, ready to be solved by any solver from the model's own guess."""

    def __init__(self, model: Model, plan: RunPlan):
        self.model, self.record = model, record_of(model, plan)
        self.kernels = kernels(model)
        self.at_rest = self.predictor("radau3", 64)
        self.p = self.at_rest.base_constants()
        self.dynamics = dynamics_of(model, self.record)
        self.pieces = periodic_problem(model, self.record, "numba")
        exact = self.shooting(REFERENCE)()
        assert exact is not None
        self.exact = exact(PHASES)[0]

    def predictor(self, scheme: str, n: int) -> RunPredictor:
        return RunPredictor(self.model, self.kernels, self.record, n, scheme)

    def discretisation(self, scheme: str, n: int) -> Callable[[], Motion | None]:
        run = self.predictor(scheme, n)
        guess = run.guess(self.p)

        def solve() -> Motion | None:
            found = solve_from_guess(run.boundary, self.p[None], guess)
            if found.status[0] != 0:
                return None
            x, step = found.x[..., None], run.boundary.step(n)
            return lambda phase: run.scheme.sample(x, run.scheme.plan(phase, n), step)[0, :, 0]

        return solve

    def adaptive(self, method: str, tolerance: float) -> Callable[[], Motion | None]:
        def guess(phase: Array) -> Array:
            run, x = self.at_rest, self.at_rest.guess(self.p)[..., None]
            plan = run.scheme.plan(phase, run.steps)
            return run.scheme.sample(x, plan, run.boundary.step(run.steps))[0, :, 0]

        def solve() -> Motion | None:
            found = solve_adaptive(
                self.pieces, self.p, guess, method=method, tolerance=tolerance
            )  # fmt: skip
            return found.motion if found.orbit.status.solved else None

        return solve

    def shooting(self, tolerance: float) -> Callable[[], Motion | None]:
        state = self.at_rest.guess(self.p)[0, 0, : self.dynamics.size]
        start = np.ascontiguousarray(state)

        def solve() -> Motion | None:
            shot = solve_shooting(
                self.dynamics, self.p, self.at_rest.period, start, tolerance=tolerance
            )
            return shot.sample if shot.status.ok else None

        return solve

    def settings(self) -> list[tuple[str, float, Callable[[], Motion | None]]]:
        """Every solver with every setting."""
        fixed = [(s, float(n), self.discretisation(s, n)) for s in SCHEMES for n in STEPS]
        moving = [(f"adaptive {m}", t, self.adaptive(m, t)) for m in ADAPTIVE for t in TOLERANCES]
        return [*fixed, *moving, *(("shooting", t, self.shooting(t)) for t in TOLERANCES)]

    def measure(self, repetitions: int = 5) -> list[Measured]:
        """All of them."""
        found = []
        for name, setting, solve in self.settings():
            orbit = solve()  # compiles
            if orbit is None:
                found.append(Measured(name, setting, np.nan, np.nan))
                continue
            off = np.max(np.abs(orbit(PHASES)[0] - self.exact)) / (np.ptp(self.exact) / 2)
            found.append(Measured(name, setting, float(off), _least(solve, repetitions)))
        return found


def _least(work: Callable[[], object], repetitions: int) -> float:
    """Least CPU time of several calls; fewer where one takes long."""
    times: list[float] = []
    while len(times) < repetitions and sum(times) < 1.0:
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return min(times)


def measure() -> dict[str, list[Measured]]:
    """Both systems."""
    return {name: Problem(*make()).measure() for name, make in SYSTEMS.items()}


def time_at(rows: list[Measured], solver: str, target: float) -> float:
    """Least time in which a solver reached an error; NaN where it did not."""
    times = [row.seconds for row in rows if row.solver == solver and row.error <= target]
    return min(times, default=float("nan"))


def print_table(found: dict[str, list[Measured]], targets: tuple[float, ...]) -> None:
    """Milliseconds in which each solver reaches each error."""
    for name, rows in found.items():
        print(f"{name:18s}" + "".join(f"{target:>12.0e}" for target in targets))
        for solver in dict.fromkeys(row.solver for row in rows):
            times = [1e3 * time_at(rows, solver, target) for target in targets]
            cells = ("—" if np.isnan(t) else f"{t:.3g} ms" for t in times)
            print(f"  {solver:16s}" + "".join(f"{cell:>12s}" for cell in cells))


if __name__ == "__main__":
    print_table(measure(), (1e-3, 1e-5, 1e-8))
