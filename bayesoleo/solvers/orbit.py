"""A periodic solution as every solver returns it, however it was found."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from bayesoleo._types import Array, Complex, ComplexArray, Float
from bayesoleo.solvers.status import Status


@dataclass(frozen=True, eq=False)
class Orbit:
    """A closed motion of one parameter vector.

    Parameters
    ----------
    phases : ndarray, shape (n,)
        Where the states are, in cycles from 0 to below 1; the first is 0.
    states : ndarray, shape (n, D)
        Value, and velocity of a second-order dof, of each dof in turn; SI.
    period : float
        Seconds.
    monodromy : ndarray, shape (D, D)
        Derivative of the state after a period by the state before; NaN where it is not known.
    status : Status
        How the solver ended; unless it is ``solved`` the states are only where it stopped.
    error : float
        Estimated largest error of a state over that state's swing, or of the time of a kink in
        cycles; NaN where there is no estimate.
    evaluations : int
        How often the equations were evaluated, counted by points in time.
    """

    phases: Float[Array, " points"]
    states: Float[Array, "points states"]
    period: float
    monodromy: Float[Array, "states states"]
    status: Status
    error: float
    evaluations: int

    @cached_property
    def multipliers(self) -> Complex[ComplexArray, " states"]:
        """Floquet multipliers, largest first, shape (D,); NaN where they are not known."""
        return floquet_multipliers(self.monodromy)

    @property
    def stable(self) -> bool:
        """Whether every disturbance dies out: all multipliers inside the unit circle.

        False where they are not known. An autonomous system's own multiplier of one makes it False:
        compare the others.
        """
        return bool(np.all(np.abs(self.multipliers) < 1.0))


def floquet_multipliers(
    monodromy: Float[Array, "states states"],
) -> Complex[ComplexArray, " states"]:
    """Eigenvalues of a monodromy matrix ``(D, D)``, largest first; NaN if it is not finite."""
    if not np.isfinite(monodromy).all():
        return np.full(monodromy.shape[0], complex(np.nan))
    values = np.linalg.eigvals(monodromy).astype(np.complex128)
    return values[np.argsort(-np.abs(values), kind="stable")]
