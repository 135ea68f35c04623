"""A model over transient records as multiple shooting sees it: runs, unknowns, variances."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.model import Model, Prior
from bayesoleo.model.kernels import kernels
from bayesoleo.prediction.layout import Layout
from bayesoleo.prediction.records import Record
from bayesoleo.prediction.segmented import SegmentedRun


@dataclass(frozen=True, eq=False)
class ShootingProblem:
    """A model over transient records, each with a mesh of its own.

    Parameters
    ----------
    runs : tuple of SegmentedRun
    layout : Layout
        Of the unknowns over the runs.
    priors : tuple of Prior
    outputs : tuple of str
        Those that any record has.
    steps_per_interval : tuple of int
        How many steps of each run's mesh lie between shooting nodes.
    """

    runs: tuple[SegmentedRun, ...]
    layout: Layout
    priors: tuple[Prior, ...]
    outputs: tuple[str, ...]
    steps_per_interval: tuple[int, ...]

    @classmethod
    def of(
        cls,
        model: Model,
        records: Sequence[Record],
        steps: Sequence[int],
        interval: float,
        scheme: str,
        backend: str,
    ) -> ShootingProblem:
        """Cut records into steps, and these into intervals of at least a length in seconds."""
        layout = Layout.of(model, [record.label for record in records])
        compiled = kernels(model, layout.active, backend)
        runs = tuple(
            SegmentedRun(model, compiled, record, n, scheme)
            for record, n in zip(records, steps, strict=True)
        )
        measured = {name for run in runs for name in run.outputs}
        lengths = [interval / run.segments.length for run in runs]
        return cls(
            runs,
            layout,
            layout.priors(model),
            tuple(name for name in compiled.derived.outputs if name in measured),
            tuple(
                int(np.clip(np.ceil(length - 1e-9), 1, n))
                for length, n in zip(lengths, steps, strict=True)
            ),
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Of the unknowns."""
        return self.layout.names

    @property
    def nuisances(self) -> frozenset[str]:
        """Unknowns whose prior is a measurement."""
        parameters = self.runs[0].model.parameters
        owners = zip(self.layout.names, self.layout.parameters, strict=True)
        return frozenset(name for name, owner in owners if parameters[owner].measured)

    @property
    def counts(self) -> NDArray[np.int64]:
        """Number of samples of each output, shape (s,)."""
        return np.array(
            [
                sum(run.time.size for run in self.runs if name in run.outputs)
                for name in self.outputs
            ]
        )

    @property
    def unknowns(self) -> int:
        """Number of parameters and initial states."""
        return len(self.names) + sum(run.state_size for run in self.runs)

    def constants(self, theta: Array, r: int) -> Array:
        """Constants of a run, shape (np,)."""
        run = self.runs[r]
        p = run.base_constants()
        places = [run.kernels.derived.constants.index(name) for name in self.layout.active]
        p[places] = theta[self.layout.columns[r]]
        return p

    def places(self, run: SegmentedRun) -> list[int]:
        """Which outputs a run has."""
        return [self.outputs.index(name) for name in run.outputs]

    def between_intervals(self, r: int) -> NDArray[np.bool_]:
        """Which of a run's inner nodes are shooting nodes, shape (n - 1,)."""
        return cast(
            NDArray[np.bool_],
            np.arange(1, self.runs[r].segments.steps) % self.steps_per_interval[r] == 0,
        )

    def sums(self, theta: Array, x: Sequence[Array]) -> Array:
        """Sums of squared residuals of each output, shape (s,)."""
        total = np.zeros(len(self.outputs))
        for r, run in enumerate(self.runs):
            residual = run.measured - run.predict(x[r], self.constants(theta, r))
            total[self.places(run)] += np.sum(residual**2, axis=1)
        return total

    def staged(self, sums: Array) -> Array:
        """Variances, shape (s,), with the unknowns' share of the samples taken off (Verbeek 1993,
        eq. 3.18, the initial states counted).
        """
        degrees = self.counts - self.unknowns / len(self.outputs)
        return np.asarray(np.maximum(sums, np.finfo(float).tiny) / np.maximum(degrees, 1.0))

    def first_variance(self) -> Array:
        """Variances, shape (s,), that the records suggest before any fit."""
        found: dict[str, list[float]] = {name: [] for name in self.outputs}
        for run in self.runs:
            for name, sd in zip(run.outputs, run.noise(), strict=True):
                found[name].append(sd**2)
        return np.array([np.mean(found[name]) for name in self.outputs])
