"""Predict one periodic run by any solver but collocation on equal steps.

The motion is sampled at the raw samples as the solver has it. It is also put on the run's mesh of
equal steps, with its derivatives: that is the anchor from which later solutions start, and what
scores and the response to input noise are made of.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.model import Model
from bayesoleo.model.kernels import Kernels
from bayesoleo.prediction.anchor import Anchor
from bayesoleo.prediction.guess import Motion, guess_rows
from bayesoleo.prediction.inputs import RowCache, highest_derivatives, signal_of
from bayesoleo.prediction.records import Harmonics, Record
from bayesoleo.prediction.run import RunPredictor, Samples
from bayesoleo.prediction.solver import PeriodicMotion, PeriodicSolver, check_solver
from bayesoleo.prediction.stability import unstable_of
from bayesoleo.solvers.adaptive.error_estimate import ErrorEstimate
from bayesoleo.solvers.periodic.solve import Solution
from bayesoleo.solvers.status import Status


class SolvedRun(RunPredictor):
    """One periodic run of one model, solved one parameter vector at a time.

    Parameters
    ----------
    model : Model
        In the drive in which it is solved.
    kernels : Kernels
        Of that model.
    record : Record
        A periodic run.
    steps : int
        Of the mesh on which motions are kept.
    scheme_name : str
        Of the meshes.
    solver : {"adaptive", "shooting", "hybrid", "library"}
        See :func:`~bayesoleo.prediction.orbits.periodic_orbit`.
    backend : {"numba", "numpy"}
        Of the kernels on an adaptive mesh; integrators take compiled ones, since calling NumPy's
        step by step takes minutes.
    known_rows : dict, optional
        Input rows that another model of the same run has computed.
    """

    def __init__(
        self,
        model: Model,
        kernels: Kernels,
        record: Record,
        steps: int,
        scheme_name: str,
        solver: str,
        backend: str = "numba",
        known_rows: RowCache | None = None,
    ):
        check_solver(solver, scheme_name)
        super().__init__(model, kernels, record, steps, scheme_name, known_rows)
        inputs = _as_taken(record, kernels.derived.inputs)
        compiled = backend if solver == "adaptive" else "numba"
        self.solver = PeriodicSolver(
            solver, model, kernels, inputs, scheme_name, steps, backend=compiled
        )

        #: The last anchor that was set here, and its motion.
        self._anchored: tuple[Anchor | None, PeriodicMotion | None] = None, None

    # -- one parameter vector --------------------------------------------------------------

    def motion(self, p: Array, *, derivatives: bool = True) -> PeriodicMotion:
        """The motion at constants ``p (np,)``, a function of these and of the anchor alone."""
        for start in self._starts(p):
            found = self.solver.solve(p, start, derivatives=derivatives, judge=False)
            if found.orbit.status.solved:
                break
        return found

    def error(self) -> ErrorEstimate:
        """Of the anchor's motion."""
        assert self.anchor is not None
        anchor, found = self._anchored
        if found is None or anchor is not self.anchor:  # of another process, or of another run
            found = self.motion(self.anchor.p, derivatives=False)
        return self.solver.judged(found, self.anchor.p)[1]

    def _starts(self, p: Array) -> Iterator[Motion]:
        """Where to start from, the most promising first."""
        if self.anchor is not None:
            change = (p - self.anchor.p)[self.active]
            yield partial(self.rows, self.anchor.predict(change[None])[0])
            if change.any():
                yield partial(self.rows, self.anchor.x)
        constants = dict(zip(self.kernels.derived.constants, p, strict=True))
        yield lambda phase: guess_rows(
            self.model, self.kernels.derived, self.record, constants, phase, self.motions
        )

    def _on_mesh(self, motion: Motion) -> Array:
        """A motion in the unknowns of the run's mesh, ``(n, w)``; of derivatives ``(na, n, w)``."""
        at_nodes, at_points = motion(np.arange(self.steps) / self.steps), motion(self.points)
        if at_nodes.ndim == 2:
            found: Array = self.scheme.from_motion(at_nodes[None], at_points[None])[0]
            return found
        return self.scheme.from_motion(*(np.moveaxis(z, 1, 0) for z in (at_nodes, at_points)))

    def set_anchor(self, p: Array) -> Status:
        """Solve at constants ``p (np,)`` and keep the solution as the start of later ones."""
        return self._anchor_at(p)[1]

    def _anchor_at(self, p: Array) -> tuple[PeriodicMotion | None, Status]:
        if not self.kernels.derived.dofs:
            return None, Status.CONVERGED
        found = self.motion(p)
        status = _usable(found)
        if status.ok:
            x, x_p = self._on_mesh(found.rows), self._on_mesh(found.rows_by_parameter)
            if not np.isfinite(x_p).all():
                return found, Status.SINGULAR
            old, matrix = self.anchor, found.orbit.monodromy
            anchor = Anchor(p.copy(), x, np.ascontiguousarray(x_p), matrix)
            left = old is not None and old.unstable != anchor.unstable
            self.anchor = replace(anchor, jumped=left)
            self._anchored = self.anchor, found
            self.jumps += left
        return found, status

    # -- many ------------------------------------------------------------------------------

    def solve(self, p: Array) -> Solution:
        """Periodic solutions for constants ``p (L, np)`` on the run's mesh."""
        found = [self.motion(row, derivatives=False) for row in p]
        status = np.array([_usable(one).value for one in found], dtype=np.int64)
        x = np.zeros((len(p), self.steps, self.scheme.width))
        for lane in np.flatnonzero(status == Status.CONVERGED.value):
            x[lane] = self._on_mesh(found[lane].rows)
        return Solution(x, status, np.zeros(len(p), dtype=np.int64))

    def predict(self, p: Array, *, derivatives: bool = False) -> Samples:
        """Outputs at the raw samples for constants ``p (L, np)``."""
        if not self.kernels.derived.dofs:
            return super().predict(p, derivatives=derivatives)
        found = [self.motion(row, derivatives=derivatives) for row in p]
        samples = self._sampled(p, found, [_usable(one) for one in found], derivatives)
        left = np.zeros(len(p), dtype=np.bool_)
        if self.anchor is not None and self.watched and samples.monodromy is not None:
            left = (unstable_of(samples.monodromy) != self.anchor.unstable) & (samples.status == 0)
            self.jumps += int(left.sum())
        return replace(samples, jumped=left)

    def evaluate(self, p: Array) -> Samples:
        """Set the anchor at constants ``p (np,)``, and take outputs with derivatives from it."""
        found, status = self._anchor_at(p)
        if found is None:
            return super().predict(p[None], derivatives=True)
        samples = self._sampled(p[None], [found], [status], True)
        jumped = status.ok and self.anchor is not None and self.anchor.jumped
        return replace(samples, jumped=np.array([jumped]))

    def squares(self, p: Array) -> tuple[Array, NDArray[np.int64]]:
        """Sums of squared residuals, shape (L, ny), and statuses, for constants ``p (L, np)``."""
        return self._squares_of_predictions(p)

    def _sampled(
        self, p: Array, found: list[PeriodicMotion], solved: list[Status], derivatives: bool
    ) -> Samples:
        """Outputs of motions at the samples, NaN where there is none."""
        status, phase = np.array([one.value for one in solved], dtype=np.int64), self.record.phase
        nz, na = self.scheme.state_size + len(self.scheme.orders), len(self.active)
        z = np.full((len(p), nz, phase.size), np.nan)
        z_p = np.full((len(p), nz, na, phase.size), np.nan) if derivatives else None
        for lane in np.flatnonzero(status == Status.CONVERGED.value):
            z[lane] = found[lane].rows(phase)
            if z_p is not None:
                z_p[lane] = found[lane].rows_by_parameter(phase)
        samples = self._outputs(p, z, z_p, status, derivatives)
        return replace(samples, monodromy=np.stack([one.orbit.monodromy for one in found]))


def _usable(found: PeriodicMotion) -> Status:
    """Status of a motion as a prediction: one whose error is too large or not known is used all the
    same, as on equal steps, and its error is told with the estimate."""
    status = found.orbit.status
    return Status.CONVERGED if status.solved else status


def _as_taken(record: Record, rows: tuple[tuple[str, int], ...]) -> Record:
    """A record whose harmonics are those that a model takes of each channel: a solver that takes
    fewer derivatives must not see more of them."""
    taken = {
        name: signal_of(record, name, highest)
        for name, highest in highest_derivatives(rows).items()
        if name != "time"
    }
    known = {name: item for name, item in taken.items() if isinstance(item, Harmonics)}
    return replace(record, harmonics={**record.harmonics, **known})
