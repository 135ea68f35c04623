"""How models are solved in a search, and the problem of estimating one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.model._model import Model
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Record
from bayesoleo.solvers._schemes import COLLOCATION, DEFAULT_SCHEME


@dataclass(frozen=True)
class Numerics:
    """How models are solved.

    Parameters
    ----------
    scheme : str
        Discretisation.
    solver : str
        Of periodic runs, see :func:`~bayesoleo.prediction.periodic_orbit`.
    steps : int or None
        Steps of the mesh; ``None`` refines until the estimate no longer moves.
    jobs : int or None
        Threads.
    backend : str
        ``numba`` or ``numpy``.
    scheduler : str or None
        Other processes or machines for fits that do not depend on each other: ``local:4``, or the
        address of a Dask scheduler.
    policy : SearchPolicy
        By which fits are judged and compared.
    """

    scheme: str = DEFAULT_SCHEME
    steps: int | None = None
    jobs: int | None = None
    backend: str = "numba"
    scheduler: str | None = None
    solver: str = COLLOCATION
    policy: SearchPolicy = SearchPolicy()


def problem_on(
    model: Model, records: Sequence[Record], numerics: Numerics, steps: int, share: Predictor | None
) -> CampaignProblem:
    predictor = Predictor(
        model,
        records,
        steps=steps,
        scheme=numerics.scheme,
        solver=numerics.solver,
        backend=numerics.backend,
        jobs=numerics.jobs,
        share=share,
    )
    return CampaignProblem(predictor)
