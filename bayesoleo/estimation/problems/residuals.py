"""Problems that give residuals sample by sample, for error models that look at their order."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from bayesoleo._types import Array, Float, Int, Integers
from bayesoleo.estimation.problems.problem import Problem


@dataclass(frozen=True)
class RunSamples:
    """When the samples of a run were taken.

    Parameters
    ----------
    time : ndarray, shape (n,)
        Ascending; in seconds, or in the unit of a regression's abscissa.
    frequency : float or None
        Of the motion that repeats itself, in cycles per unit of ``time``; None for a run that does
        not.
    origin : float
        Cycles from the crest of what drives the run to the first sample.
    """

    time: Float[Array, " samples"]
    frequency: float | None
    origin: float = 0.0

    @property
    def phase(self) -> Array:
        """Cycles since the first sample, shape (n,).

        A run that does not repeat itself goes through half a cycle, so that a periodic function of
        phase can end elsewhere than it began.
        """
        since = self.time - self.time[0]
        if self.frequency is not None:
            return np.asarray(self.frequency * since)
        return np.asarray(0.5 * since / since[-1]) if since[-1] > 0 else since


@runtime_checkable
class ResidualProblem(Problem, Protocol):
    """A problem that gives its residuals."""

    @property
    def samples(self) -> tuple[RunSamples, ...]:
        """When the samples of each run were taken, length N."""

    def residuals(
        self, theta: Float[Array, "vectors unknowns"], run: int
    ) -> tuple[Float[Array, "vectors outputs samples"], Int[Integers, " vectors"]]:
        """Residuals (L, s, n) of one run at vectors (L, l), and statuses (L,).

        Each depends on its own vector alone, bit for bit.
        """
