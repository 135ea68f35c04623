"""A point estimate: where, how sure, and how it was reached."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesoleo._types import Array, Float, Int, Integers
from bayesoleo.prediction.stability import Stability
from bayesoleo.solvers.status import Status

if TYPE_CHECKING:
    import xarray as xr


#: Notes on estimates whose standard deviations are not what they seem.
EXACT = (
    "{} is fitted to the rounding of its samples: there is no noise to estimate, and standard "
    "deviations mean nothing"
)
SILENT = "the data say nothing of {}"
UNDETERMINED = "the data do not determine {}, at most combinations of these (see principal_axes)"
FROM_PRIOR = ": what is known beyond is the prior's"
KNOWN = "held at the declared value, known to a tolerance that the covariance carries: {}"
NO_SD = ": there is no standard deviation"
_MOST_NAMES = 8


@dataclass(frozen=True, eq=False, repr=False)
class PointEstimate:
    """Result of an estimator.

    Parameters
    ----------
    names : tuple of str, length l
    outputs : tuple of str, length s
    theta : ndarray, shape (l,)
        The estimate, in the parameters' units.
    variance : ndarray, shape (s,)
        Error variances staged at the estimate (Verbeek 1993, eq. 3.17 or 3.18).
    covariance : ndarray, shape (l, l)
        Linearised with the prior's variances, ``[A + diag(w)^-1]^-1``; NaN after a failed start.
        Where the prior is log-normal, ``w`` is that of the logarithm times the squared estimate.
    covariance_likelihood : ndarray, shape (l, l)
        Linearised without the prior, ``A^-1``; NaN for the unknowns that the data do not determine.
    method : str
    status : Status
        ``NO_CONVERGENCE`` also where the steps became small away from the fixed point.
    iterations : int
        Steps taken, with the last, small one.
    halvings : int
        Over all iterations.
    evaluations : int
        Calls of ``problem.evaluate``.
    objective : float
        The method's own objective at the estimate: eq. 2.29 for BE, 2.31 for the others.
    distance : float
        To the method's fixed point by linearisation, in standard deviations; NaN if the steps
        never became small.
    start : ndarray, shape (l,)
    history : ndarray, shape (iterations + 1, l)
    history_variance : ndarray, shape (iterations + 1, s)
    history_objective : ndarray, shape (iterations + 1,)
    history_halvings : ndarray of int, shape (iterations + 1,)
    on_limit : tuple of str
        Unknowns that lie on a limit of their prior's support.
    objective_name : str
        What was maximised, one of :data:`bayesoleo.estimation.OBJECTIVES`.
    error_covariance : ndarray, shape (s, s), optional
        Of the outputs' errors; diagonal unless the objective is of correlated ones.
    failures : mapping of str to int
        Trials on the way that could not be evaluated, by the lower-case name of their
        :class:`~bayesoleo.solvers.status.Status`: steps towards them were halved.
    stability : Stability, optional
        Floquet multipliers of each run's periodic solution at the estimate, and how often one
        jumped to another branch on the way; None where there are no periodic solutions.
    exact : tuple of str
        Outputs that are fitted to the rounding of their samples.
    known : tuple of str
        Unknowns that were held, because the method forgets what was measured of them; their
        uncertainty is carried into the covariance.
    """

    names: tuple[str, ...]
    outputs: tuple[str, ...]
    theta: Float[Array, " unknowns"]
    variance: Float[Array, " outputs"]
    covariance: Float[Array, "unknowns unknowns"]
    covariance_likelihood: Float[Array, "unknowns unknowns"]
    method: str
    status: Status
    iterations: int
    halvings: int
    evaluations: int
    objective: float
    distance: float
    start: Float[Array, " unknowns"]
    history: Float[Array, "iterates unknowns"] = field(repr=False)
    history_variance: Float[Array, "iterates outputs"] = field(repr=False)
    history_objective: Float[Array, " iterates"] = field(repr=False)
    history_halvings: Int[Integers, " iterates"] = field(repr=False)
    on_limit: tuple[str, ...] = ()
    objective_name: str = "diagonal"
    error_covariance: Float[Array, "outputs outputs"] | None = field(default=None, repr=False)
    failures: Mapping[str, int] = field(default_factory=dict)
    stability: Stability | None = field(default=None, repr=False)
    exact: tuple[str, ...] = ()
    known: tuple[str, ...] = ()

    @property
    def sd(self) -> Array:
        """Linearised standard deviations, shape (l,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def branch_jumps(self) -> int:
        """How often a periodic solution jumped to another branch between neighbouring trials."""
        return 0 if self.stability is None else self.stability.branch_jumps

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Unknowns that the data alone do not determine; none after a failed start."""
        open_ones = np.isnan(np.diag(self.covariance_likelihood)) & (len(self.history) > 0)
        pairs = zip(self.names, open_ones, strict=True)
        return tuple(name for name, is_open in pairs if is_open and name not in self.known)

    @property
    def doubts(self) -> list[str]:
        """Where standard deviations are not what they seem."""
        found = [EXACT.format(", ".join(self.exact))] if self.exact else []
        if self.undetermined:
            text = SILENT if len(self.undetermined) == 1 else UNDETERMINED
            text += FROM_PRIOR if np.isfinite(self.sd).all() else NO_SD
            found.append(text.format(_listed(self.undetermined)))
        return found

    @property
    def notes(self) -> list[str]:
        """What to know of an estimate: of its solutions, such as that one is unstable, and of its
        standard deviations."""
        held = [KNOWN.format(_listed(self.known))] if self.known else []
        return [*([] if self.stability is None else self.stability.notes()), *self.doubts, *held]

    def __getitem__(self, name: str) -> float:
        return float(self.theta[self.names.index(name)])

    def following(self, first: PointEstimate | None) -> PointEstimate:
        """The same, with the jumps on the way of the estimate that it was polished from."""
        if first is None or first.stability is None or self.stability is None:
            return self
        jumps = self.stability.jumps + first.stability.jumps
        return replace(self, stability=self.stability.with_jumps(jumps))

    def __str__(self) -> str:
        from bayesoleo.estimation.estimators.table import as_text

        return as_text(self)

    def __repr__(self) -> str:
        return str(self)

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>{self.to_dataset()._repr_html_()}"

    def to_dataset(self, **options: Any) -> xr.Dataset:
        """Labelled arrays; see :func:`bayesoleo.estimation.to_dataset`."""
        from bayesoleo.estimation.estimators.table import to_dataset

        return to_dataset(self, **options)


def _listed(names: tuple[str, ...]) -> str:
    """Names in a sentence; of many the first ones."""
    rest = len(names) - _MOST_NAMES
    return ", ".join(names[:_MOST_NAMES]) + (f" and {rest} more" if rest > 0 else "")
