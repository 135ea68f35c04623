"""What a run of the workflow depends on besides data and model."""

from __future__ import annotations

import difflib
from dataclasses import dataclass

from bayesoleo.discovery._fit import Numerics
from bayesoleo.discovery._inference import Inference
from bayesoleo.discovery._policy import SearchPolicy
from bayesoleo.effects._catalogue import catalogue
from bayesoleo.effects._effect import Effect
from bayesoleo.effects._nonparametric import FAMILY
from bayesoleo.error_models._registry import ERROR_MODELS
from bayesoleo.errors import InputError
from bayesoleo.prediction._periodic_solver import check_solver
from bayesoleo.solvers._schemes import COLLOCATION, DEFAULT_SCHEME


@dataclass(frozen=True)
class Settings:
    """What a run of the workflow depends on besides data and model.

    Parameters
    ----------
    seed : int
        Everything random follows from it.
    jobs : int, optional
        Threads; by default all cores. Results do not depend on it.
    scheduler : str, optional
        Other processes or machines that take part: ``local:4``, or the address of a Dask scheduler;
        see :func:`bayesoleo._dask.connected`. Results do not depend on them either.
    quick : bool
        Draw enough for two-digit intervals only.
    effective_size : int
        Effective draws asked of the sampler.
    scheme : str
        Discretisation: ``radau3`` …, or ``thesis``.
    solver : {"collocation", "adaptive", "shooting", "hybrid", "library"}
        Of periodic runs; see :func:`~bayesoleo.prediction._orbits.periodic_orbit`.
    steps : int, optional
        Steps of the mesh in a period; by default refined until the estimate no longer moves.
    max_effects : int
        Effects added at most.
    drive : str, optional
        Channel that drives the model; ``"model"`` keeps the model's own inputs. By default the
        channel that the rig controls, if the model can be driven by it.
    effects : tuple of Effect, optional
        Instead of the catalogue.
    without : tuple of str
        Ids of effects that are left out of the search, at all their places; ``nonparametric``
        leaves out functions without a name.
    command : str
        Kept in the result.
    nuisance : tuple of {"conditions", "offset", "gain"}
        What is estimated within its declared tolerance: conditions by run (``sd``), offset and gain
        of sensors (``accuracy``).
    error_model : {"independent", "per-run", "full", "correlated", "discrepancy", ...}
        What the errors of the outputs have in common; see
        :mod:`bayesoleo.error_models`.
    between_runs : tuple of str
        Parameters that scatter between runs about a mean that is estimated; see
        :mod:`bayesoleo.posterior._hierarchy`.
    policy : SearchPolicy
        The numbers by which the search for missing effects decides.
    """

    seed: int = 0
    jobs: int | None = None
    quick: bool = False
    effective_size: int = 1000
    scheme: str = DEFAULT_SCHEME
    steps: int | None = None
    max_effects: int = 4
    drive: str | None = None
    effects: tuple[Effect, ...] | None = None
    command: str = ""
    nuisance: tuple[str, ...] = ()
    error_model: str = ERROR_MODELS[0]
    between_runs: tuple[str, ...] = ()
    scheduler: str | None = None
    without: tuple[str, ...] = ()
    solver: str = COLLOCATION
    policy: SearchPolicy = SearchPolicy()

    def __post_init__(self) -> None:
        check_solver(self.solver, self.scheme)
        known = [effect.id for effect in self._offered] + [FAMILY]
        for name in self.without:
            if name not in known:
                close = difflib.get_close_matches(name, known, 3)
                hint = f"did you mean {' or '.join(close)}?" if close else "see bayesoleo effects"
                raise InputError("unknown effect", key="without", value=name, hint=hint)

    @property
    def _offered(self) -> tuple[Effect, ...]:
        return catalogue() if self.effects is None else self.effects

    @property
    def searched(self) -> tuple[Effect, ...]:
        """The effects that are looked for."""
        return tuple(effect for effect in self._offered if effect.id not in self.without)

    @property
    def nonparametric(self) -> bool:
        """Whether a function without a name may be added."""
        return FAMILY not in self.without

    @property
    def inference(self) -> Inference:
        """What is assumed of errors and of runs."""
        return Inference(self.error_model, self.between_runs)

    @property
    def numerics(self) -> Numerics:
        """How models are solved."""
        return Numerics(
            self.scheme,
            self.steps,
            self.jobs,
            scheduler=self.scheduler,
            solver=self.solver,
            policy=self.policy,
        )
