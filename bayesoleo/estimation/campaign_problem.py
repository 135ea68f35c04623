"""A model over reduced runs, as a problem that can be fitted."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bayesoleo.estimation.problem import Evaluation, Misfit
from bayesoleo.model import Prior
from bayesoleo.prediction.predictor import Predictor
from bayesoleo.solvers.status import Status

Array = NDArray[np.float64]


class CampaignProblem:
    """Residuals of all runs of a campaign.

    Parameters
    ----------
    predictor : Predictor
        Model and runs.
    fixed : mapping, optional
        See :meth:`holding`.
    """

    def __init__(
        self, predictor: Predictor, free: NDArray[np.int64] | None = None, full: Array | None = None
    ):
        self.predictor = predictor
        layout = predictor.layout
        self._all_priors = layout.priors(predictor.model)
        self._free = np.arange(len(layout.names)) if free is None else free
        self._full = layout.start(predictor.model) if full is None else full
        self.names = tuple(layout.names[k] for k in self._free)
        self.priors: tuple[Prior, ...] = tuple(self._all_priors[k] for k in self._free)
        self.outputs = predictor.outputs
        self.runs = layout.runs
        self.counts = np.array(
            [[record.time.size] * len(self.outputs) for record in predictor.records]
        )

    def holding(self, values: dict[str, float]) -> CampaignProblem:
        """The same problem with some unknowns held, e.g. the shared ones on a hold-out run."""
        names = self.predictor.layout.names
        full = self._full.copy()
        for name, value in values.items():
            if name in names:
                full[names.index(name)] = value
        free = np.array([k for k, name in enumerate(names) if name not in values], dtype=np.int64)
        return CampaignProblem(self.predictor, free, full)

    @property
    def start(self) -> Array:
        """Nominal values of the unknowns, shape (l,)."""
        return self._full[self._free]

    def full(self, theta: Array) -> Array:
        """All unknowns of the predictor, shape (L, all), from the free ones, shape (L, l)."""
        vectors = np.repeat(self._full[None], theta.shape[0], axis=0)
        vectors[:, self._free] = theta
        return vectors

    def evaluate(self, theta: Array) -> Evaluation:
        """Residuals and sensitivities at one vector, shape (l,).

        Every evaluation re-anchors the solver at ``theta``: an estimate walks, and starts each
        solve where it stands.
        """
        full = self.full(theta[None])[0]
        self.predictor.set_anchor(full)
        runs = self.predictor.predict(full)
        residual: Sequence[Sequence[Array]] = [
            list(record.measured - run.y)
            for record, run in zip(self.predictor.runs, runs, strict=True)
        ]
        outputs = range(len(self.outputs))
        return Evaluation(
            residual=tuple(np.concatenate([r[b] for r in residual]) for b in outputs),
            sensitivity=tuple(
                np.concatenate([run.sensitivity[b][self._free].T for run in runs]) for b in outputs
            ),
            status=max((run.status for run in runs), default=Status.CONVERGED),
        )

    def misfit(self, theta: Array) -> Misfit:
        """Sums of squares at many vectors, shape (L, l), from the frozen anchor."""
        return Misfit(*self.predictor.sum_of_squares(self.full(theta)))

    def freeze(self, theta: Array) -> Status:
        """Fix the anchor that :meth:`misfit` starts from: it then depends on the vector alone."""
        return max(self.predictor.set_anchor(self.full(theta[None])[0]), default=Status.CONVERGED)
