"""Time per solve, and how it grows with steps, runs, parameter vectors and degrees of freedom."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from cases import BATCH, Case, batch, solve, states
from measuring import best, cpu, error, exponent

from bayesoleo._parallel import thread_map
from bayesoleo.model import Dof, Model, Output, Parameter, driven_by
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Record
from bayesoleo.prediction._simulate import RunPlan, motion, record_of
from bayesoleo.solvers._orbit import Status
from bayesoleo.systems import system

THESIS_STEPS = 800
#: Sizes over which exponents are taken.
STEPS, CAMPAIGNS, VECTORS, DOFS = (
    (400, 800, 1600, 3200),
    (1, 2, 4),
    (16, 32, 64, 128),
    (1, 2, 3, 4, 6, 10),
)


class Batch:
    """All runs of a predictor at vectors around its anchor."""

    def __init__(self, predictor: Predictor, count: int = BATCH):
        self.predictor = predictor
        theta = batch(predictor, count)
        self.constants = [predictor.constants(theta, r) for r in range(len(predictor.runs))]
        self.solves = count * len(predictor.runs)

    def run(self, jobs: int | None = None) -> int:
        """Solve everything; the number of failures."""
        work = zip(self.predictor.runs, self.constants, strict=True)
        found = thread_map(lambda item: np.count_nonzero(solve(*item).status), work, jobs)
        return int(sum(found))


def headline(model: Model, records: Sequence[Record]) -> dict[str, float]:
    """Time per solve of the thesis's scheme and of the default one, on all cores and on one."""
    result: dict[str, float] = {}
    settings = {"": {"steps": THESIS_STEPS, "scheme": "thesis"}, "default_": {}}
    for name, options in settings.items():
        work = Batch(Predictor(model, records, **options))
        failures = work.run()
        result |= {
            f"{name}solve_us": 1e6 * best(work.run, 15) / work.solves,
            f"{name}solve_cpu_us": 1e6 * cpu(lambda work=work: work.run(1), 7) / work.solves,
            f"{name}failures": failures,
        }
    return result


def accuracy(model: Model, cases: Sequence[Case]) -> dict[str, float]:
    """Errors of both schemes' strokes over their amplitudes, the middle one and the worst."""
    result: dict[str, float] = {}
    settings = {"": {"steps": THESIS_STEPS, "scheme": "thesis"}, "default_": {}}
    for name, options in settings.items():
        predictor = Predictor(model, [case.record for case in cases], **options)
        batch(predictor, 1)
        errors = []
        for run, case in zip(predictor.runs, cases, strict=True):
            solution = solve(run, case.p[None])
            good = solution.status[0] == Status.CONVERGED
            stroke = states(run, solution.x[0])[0]
            errors.append(error(stroke, case.exact[0]) if good else np.nan)
        result |= {
            f"{name}error": float(np.median(errors)),
            f"{name}error_worst": float(np.max(errors)),
        }
    return result


def log_density(records: Sequence[Record]) -> dict[str, float]:
    """One vector, all runs, force and pressure at the raw samples, in a batch; all cores."""
    predictor = Predictor(driven_by(system("f16n2d2"), "displacement"), records)
    theta = batch(predictor)
    _, status = predictor.sum_of_squares(theta)
    seconds = best(lambda: predictor.sum_of_squares(theta), 15)
    return {
        "log_density_ms": 1e3 * seconds / len(theta),
        # Vectors for which the gas has no volume left at full stroke have no density.
        "log_density_inadmissible": int(np.count_nonzero(status == Status.INADMISSIBLE)),
        "log_density_failures": int(np.count_nonzero(status > Status.INADMISSIBLE)),
    }


def scaling(model: Model, records: Sequence[Record]) -> dict[str, float]:
    """Exponents of total time, by one thread's CPU time, which other work on the machine does not
    change.

    Runs are more and more copies of the campaign, because its runs differ in what they cost.
    """

    def thesis(of: Sequence[Record], n: int = THESIS_STEPS) -> Predictor:
        return Predictor(model, of, steps=n, scheme="thesis")

    result = {
        "exponent_n": exponent(STEPS, _seconds([Batch(thesis(records[:4], n)) for n in STEPS])),
        "exponent_runs": exponent(
            CAMPAIGNS, _seconds([Batch(thesis([*records] * k), 8) for k in CAMPAIGNS])
        ),
        "exponent_vectors": exponent(
            VECTORS, _seconds([Batch(thesis(records), k) for k in VECTORS])
        ),
    }
    plan = RunPlan("chain", 0.2, {"force": motion(0.1, [0.5, 0.1])})
    chains = [chain_of(d) for d in DOFS]
    work = [Batch(Predictor(chain, [record_of(chain, plan)], jobs=1)) for chain in chains]
    by_dofs = [seconds / BATCH for seconds in _seconds(work)]
    result |= {f"dofs_{d}_us": 1e6 * t for d, t in zip(DOFS, by_dofs, strict=True)}
    return result | {"exponent_dofs": exponent(DOFS, by_dofs)}


def _seconds(batches: Sequence[Batch], rounds: int = 7) -> list[float]:
    """Least CPU time of each batch on one thread; in turns, so that what slows the machine for a
    while slows all of them, and more than once in a turn: a sampler solves the same model again and
    again, with no other one's arrays in the cache."""
    least = [np.inf] * len(batches)
    for _ in range(rounds):
        for k, work in enumerate(batches):
            least[k] = min(least[k], cpu(lambda work=work: work.run(1), 3))
    return least


def chain_of(d: int) -> Model:
    """Masses in a row, each held by a cubic spring and tied to the next."""
    names = [f"q{k}" for k in range(d)]
    equations = {}
    for k, q in enumerate(names):
        terms = {"own": f"ddot({q}) + damping*dot({q}) + {q} + cubic*{q}**3"}
        terms |= {f"tie_{o}": f"tie*({q} - {o})" for o in names[max(k - 1, 0) : k + 2] if o != q}
        equations[q] = terms | ({"excitation": "-force"} if k == 0 else {})
    return Model(
        f"chain{d}",
        inputs={"force": "N"},
        dofs={q: Dof("m") for q in names},
        parameters={
            "damping": Parameter(0.3, sd=0.1),
            "cubic": Parameter(0.7, sd=0.1),
            "tie": Parameter(0.5, sd=0.1),
        },
        equations=equations,
        outputs={"displacement": Output("q0", "m")},
    )
