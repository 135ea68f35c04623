"""Problems that give residuals sample by sample, for error models that look at their order."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from bayesoleo._types import Array, Float, Int, Integers
from bayesoleo.error_models.base import RunSamples
from bayesoleo.estimation.problems.problem import Problem


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
