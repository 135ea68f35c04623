"""What a run of the workflow depends on besides data and model."""

from __future__ import annotations

from dataclasses import dataclass

from bayesoleo.effects import Effect
from bayesoleo.posterior.density.error_models import ERROR_MODELS
from bayesoleo.solvers.schemes.choose import DEFAULT_SCHEME
from bayesoleo.tracing.fitting.fit import Numerics
from bayesoleo.tracing.outcome.inference import Inference


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
        see :func:`bayesoleo.machines.connected`. Results do not depend on them either.
    quick : bool
        Draw enough for two-digit intervals only.
    effective_size : int
        Effective draws asked of the sampler.
    scheme : str
        Discretisation: ``radau3`` …, or ``thesis``.
    steps : int, optional
        Steps of the mesh in a period; by default refined until the estimate no longer moves.
    max_effects : int
        Effects added at most.
    drive : str, optional
        Channel that drives the model; ``"model"`` keeps the model's own inputs. By default the
        channel that the rig controls, if the model can be driven by it.
    effects : tuple of Effect, optional
        Instead of the catalogue.
    command : str
        Kept in the result.
    nuisance : tuple of {"conditions", "offset", "gain"}
        What is estimated within its declared tolerance: conditions by run (``sd``), offset and gain
        of sensors (``accuracy``).
    error_model : {"independent", "per-run", "full", "correlated", "discrepancy", ...}
        What the errors of the outputs have in common; see
        :mod:`bayesoleo.posterior.density.error_models`.
    between_runs : tuple of str
        Parameters that scatter between runs about a mean that is estimated; see
        :mod:`bayesoleo.posterior.density.hierarchy`.
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

    @property
    def inference(self) -> Inference:
        """What is assumed of errors and of runs."""
        return Inference(self.error_model, self.between_runs)

    @property
    def numerics(self) -> Numerics:
        """How models are solved."""
        return Numerics(self.scheme, self.steps, self.jobs, scheduler=self.scheduler)
