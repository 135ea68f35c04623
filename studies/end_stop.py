"""The end stop of Verbeek (1993), section 4.3.3, ever stiffer, by every periodic solver.

Used by the gallery's page; ``python studies/end_stop.py`` prints the table.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo.model import kernels
from bayesoleo.prediction import (
    PeriodicOrbits,
    RunPlan,
    RunPredictor,
    dynamics_of,
    motion,
    periodic_orbit,
    record_of,
)
from bayesoleo.solvers import solve_from_guess, solve_periodic, solve_shooting
from bayesoleo.systems import system

Array = NDArray[np.float64]

PLAN = RunPlan("end stop", 1.0, {"force": motion(23.0, [20.0])})
STIFFNESS = "stop_stiffness"
#: State at t = 0 from sixty periods of LSODA at a relative tolerance of 1e-9.
REFERENCE = {
    100.0: (0.78113832, 3.26503319),
    2500.0: (0.83680069, 0.77678702),
    1e5: (0.82009573, 1.08562218),
    1e8: (0.8157393, 1.211127),
    1e11: (0.8155908, 1.2154198),
}
#: Schemes with equal steps, and how many.
EQUAL = (("thesis", 800), ("thesis", 12_800), ("radau3", 800), ("radau3", 12_800))
NOTHING = np.full(2, np.nan)


@dataclass(frozen=True)
class Found:
    """What a solver found: the first state, NaN if nothing, CPU time in s, steps of a period."""

    state: Array
    seconds: float
    steps: int

    def error(self, stiffness: float) -> Array:
        """Differences of position and velocity from the reference, shape (2,)."""
        return np.abs(self.state - REFERENCE[stiffness])


@dataclass(frozen=True)
class Stop:
    """One stiffness by all solvers; ``given`` are equal steps that start from the answer."""

    stiffness: float
    answer: PeriodicOrbits
    found: dict[str, Found]
    given: dict[str, Found]

    def contact(self) -> Array:
        """Phases at which the stop is touched and left, shape (2,): sign changes of the stroke."""
        mesh = self.answer.motions[0].solution.mesh.edges
        fine = (mesh[:-1, None] + np.diff(mesh)[:, None] * np.arange(40) / 40).ravel()
        touching = self.answer.dof("stroke", fine)[0] < 0.0
        ends = fine[np.flatnonzero(touching[1:] != touching[:-1]) + 1]
        return ends[[0, -1]]


def solve(stiffness: float) -> Stop:
    """By all solvers, each from the model's own static guess."""
    model = system("end_stop")
    begin = time.process_time()
    answer = periodic_orbit(
        model, PLAN, {STIFFNESS: stiffness}, "adaptive", tolerance=1e-6, stiffness=STIFFNESS
    )
    seconds = time.process_time() - begin
    orbit = answer.orbits[0]
    state = orbit.states[0] if orbit.status.ok else NOTHING
    found = {"adaptive": Found(state, seconds, len(orbit.phases)), "shooting": shooting(stiffness)}
    given = {}
    for scheme, n in EQUAL:
        found[f"{scheme} {n}"] = equal_steps(stiffness, scheme, n)
        given[f"{scheme} {n}"] = equal_steps(stiffness, scheme, n, answer)
    return Stop(stiffness, answer, found, given)


def shooting(stiffness: float) -> Found:
    """From the static state."""
    model = system("end_stop").with_values({STIFFNESS: stiffness})
    record = record_of(model, PLAN)
    run = RunPredictor(model, kernels(model), record, 64, "radau3")
    dynamics, p = dynamics_of(model, record), run.base_constants()
    start = np.ascontiguousarray(run.guess(p)[0, 0, : dynamics.size])
    solve_shooting(dynamics, p, run.period, start)  # compiles
    begin = time.process_time()
    shot = solve_shooting(dynamics, p, run.period, start)
    seconds = time.process_time() - begin
    state = shot.start if shot.status.ok else NOTHING
    return Found(state, seconds, shot.trajectory.times.size - 1)


def equal_steps(
    stiffness: float, scheme: str, n: int, answer: PeriodicOrbits | None = None
) -> Found:
    """From the static guess or, given an answer, from that."""
    model = system("end_stop").with_values({STIFFNESS: stiffness})
    run = RunPredictor(model, kernels(model), record_of(model, PLAN), n, scheme)
    p = run.base_constants()
    start = run.guess(p)
    if answer is not None:
        rows = answer.motions[0].rows
        start = run.scheme.from_motion(rows(np.arange(n) / n)[None], rows(run.points)[None])
    begin = time.process_time()
    if answer is None:
        solution = solve_from_guess(run.boundary, p[None], start)
    else:
        solution = solve_periodic(run.boundary, p[None], start)
    seconds = time.process_time() - begin
    if solution.status[0] != 0:
        return Found(NOTHING, seconds, n)
    plan = run.scheme.plan(np.zeros(1), n)
    rows_at = run.scheme.sample(solution.x[..., None], plan, run.boundary.step(n))
    return Found(rows_at[0, :2, 0, 0], seconds, n)


def solve_all() -> list[Stop]:
    """All stiffnesses of the table."""
    return [solve(stiffness) for stiffness in REFERENCE]


def print_states(stops: list[Stop]) -> None:
    """The adaptive mesh and shooting against the reference."""
    print("stiffness      q(0)       q'(0)    |      adaptive mesh      |        shooting")
    print("                                   | Δq(0)  Δq'(0)    steps  | Δq(0)  Δq'(0)    steps")
    for stop in stops:
        cells = []
        for name in ("adaptive", "shooting"):
            found = stop.found[name]
            q, v = found.error(stop.stiffness)
            cells.append(f"{q:.0e}  {v:.0e}  {found.steps:5d} ")
        state = stop.found["adaptive"].state
        left = f"{stop.stiffness:9.6g}  {state[0]:.8f}  {state[1]:.8f}"
        print(f"{left}  | {'   | '.join(cells)}")


def print_equal(stops: list[Stop]) -> None:
    """Largest error of the first state on equal steps, from the guess and from the answer."""
    names = [f"{scheme} {n}" for scheme, n in EQUAL]
    print("from          stiffness" + "".join(f"{name:>15s}" for name in names))
    for label in ("static guess", "the answer"):
        for stop in stops:
            table = stop.found if label == "static guess" else stop.given
            errors = [table[name].error(stop.stiffness).max() for name in names]
            cells = ("failed" if np.isnan(e) else f"{e:.0e}" for e in errors)
            print(f"{label:14s}{stop.stiffness:9.6g}" + "".join(f"{cell:>15s}" for cell in cells))


def print_times(stops: list[Stop]) -> None:
    """CPU milliseconds from the static guess."""
    print("stiffness" + "".join(f"{name:>14s}" for name in stops[0].found))
    for stop in stops:
        cells = [f"{1e3 * found.seconds:.3g}" for found in stop.found.values()]
        print(f"{stop.stiffness:9.6g}" + "".join(f"{cell:>14s}" for cell in cells))


if __name__ == "__main__":
    everything = solve_all()
    for show in (print_states, print_equal, print_times):
        show(everything)
