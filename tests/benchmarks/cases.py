"""The oleo's shaker runs as problems with a known answer, for any solver.

Every case is one run of the campaign, driven by force, for parameters one per cent away from an
anchor, where all solvers start from the same motion. The answer is that of shooting at a tolerance
of 1e-12, another code than the discretisation; both agree as far as they are refined.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from measuring import PHASES, Array

from bayesoleo._parallel import thread_map
from bayesoleo.data import dataset_folder, load_campaign, reduce_campaign
from bayesoleo.model import Model
from bayesoleo.prediction._inputs import dynamics_of
from bayesoleo.prediction._periodic_run import RunPredictor
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Record
from bayesoleo.solvers._periodic import Solution, solve_extrapolated
from bayesoleo.solvers._shooting import solve_shooting

#: Parameter vectors in a batch, and their relative distance from the anchor.
BATCH, SPREAD = 32, 0.01
REFERENCE_TOLERANCE = 1e-12


def campaign() -> list[Record]:
    """The fourteen reduced runs of ``shaker-plain``."""
    return list(reduce_campaign(load_campaign(dataset_folder("shaker-plain"))).records)


def batch(predictor: Predictor, count: int = BATCH) -> Array:
    """Parameter vectors around the anchor at the nominal one, shape (count, l)."""
    nominal = predictor.layout.start(predictor.model)
    predictor.set_anchor(nominal)
    noise = np.random.default_rng(1993).standard_normal((count, nominal.size))
    return nominal * (1.0 + SPREAD * noise)


def start(run: RunPredictor, p: Array) -> Array:
    """Unknowns from which a run's solves at constants ``p (L, np)`` begin, shape (L, n, w)."""
    assert run.anchor is not None
    return run.anchor.predict(p[:, run.active] - run.anchor.p[run.active])


def states(run: RunPredictor, x: Array, phases: Array = PHASES) -> Array:
    """States of a motion ``x (n, w)`` at phases in cycles, shape (D, N)."""
    n = x.shape[0]
    plan = run.scheme.plan(phases, n)
    rows = run.scheme.sample(x[None, ..., None], plan, run.boundary.step(n))[0, :, 0]
    first = np.cumsum([0, *(order + 1 for order in run.scheme.orders)])
    return rows[[first[j] + k for j, o in enumerate(run.scheme.orders) for k in range(o)]]


@dataclass(frozen=True)
class Case:
    """One run with parameters, a start and the answer.

    Parameters
    ----------
    run : RunPredictor
        On the default mesh, anchored at nominal parameters.
    p : ndarray, shape (np,)
        Constants.
    x : ndarray, shape (n, w)
        The common start, in that mesh's unknowns.
    exact : ndarray, shape (D, 997)
        States of the answer at :data:`measuring.PHASES`.
    """

    run: RunPredictor
    p: Array
    x: Array
    exact: Array

    @property
    def record(self) -> Record:
        return self.run.record

    @property
    def scale(self) -> Array:
        """Largest size of each state, shape (D,)."""
        return np.abs(self.exact).max(axis=1)

    def begin(self, phases: Array) -> Array:
        """States of the start at phases in cycles, shape (D, N)."""
        return states(self.run, self.x, phases)

    @staticmethod
    def of(model: Model, run: RunPredictor, p: Array) -> Case:
        """Solve a run exactly; ``p (np,)``."""
        x = start(run, p[None])[0]
        dynamics = dynamics_of(model, run.record)
        shot = solve_shooting(
            dynamics, p, run.period, states(run, x, np.zeros(1))[:, 0],
            tolerance=REFERENCE_TOLERANCE,
        )  # fmt: skip
        if not shot.status.ok:
            raise RuntimeError(f"run {run.record.label} has no reference: {shot.status}")
        rows = shot.sample(PHASES)
        first = np.cumsum([0, *(order + 1 for order in dynamics.orders)])
        kept = [first[j] + k for j, o in enumerate(dynamics.orders) for k in range(o)]
        return Case(run, p, x, rows[kept])


def cases(model: Model, records: Sequence[Record]) -> list[Case]:
    """All runs at the first vector of the batch."""
    predictor = Predictor(model, records)
    theta = batch(predictor, 1)
    work = range(len(predictor.runs))
    return thread_map(
        lambda r: Case.of(model, predictor.runs[r], predictor.constants(theta, r)[0]), work
    )


def solve(run: RunPredictor, p: Array) -> Solution:
    """From the run's anchor, as inside a sampler; ``p (L, np)``."""
    assert run.anchor is not None
    change = p[:, run.active] - run.anchor.p[run.active]
    return solve_extrapolated(run.boundary, p, run.anchor.extrapolation, change)
