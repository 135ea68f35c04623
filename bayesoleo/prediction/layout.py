"""Where the unknowns of an estimate go in a model: shared ones once, by-run ones once a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayesoleo._types import Array
from bayesoleo.errors import ModelError
from bayesoleo.model import Model, Prior


@dataclass(frozen=True)
class Layout:
    """Maps a vector of unknowns to each run's model parameters.

    Parameters
    ----------
    names : tuple of str
        Unknowns: ``damping``, or ``offset[run]`` for a parameter that varies by run.
    parameters : tuple of str
        The model's parameter behind each unknown.
    runs : tuple of str
        Labels of the runs.
    columns : ndarray of int, shape (N, na)
        For each run, the unknown behind each active parameter.
    active : tuple of str
        Estimated parameters in the model's order.
    """

    names: tuple[str, ...]
    parameters: tuple[str, ...]
    runs: tuple[str, ...]
    columns: NDArray[np.int64]
    active: tuple[str, ...]

    @classmethod
    def of(cls, model: Model, runs: Sequence[str]) -> Layout:
        """Layout of a model's estimated parameters over runs."""
        names: list[str] = []
        owners: list[str] = []
        active = model.estimated()
        columns = np.empty((len(runs), len(active)), dtype=np.int64)
        for k, name in enumerate(active):
            if model.parameters[name].by_run:
                columns[:, k] = len(names) + np.arange(len(runs))
                names += [f"{name}[{run}]" for run in runs]
                owners += [name] * len(runs)
            else:
                columns[:, k] = len(names)
                names.append(name)
                owners.append(name)
        return cls(tuple(names), tuple(owners), tuple(runs), columns, active)

    def priors(self, model: Model) -> tuple[Prior, ...]:
        """Prior of each unknown.

        Raises
        ------
        ModelError
            If an estimated parameter has none.
        """
        priors = []
        for name in self.parameters:
            prior = model.parameters[name].prior
            if prior is None:
                raise ModelError(
                    f"model {model.name!r}: parameter {name!r} has no prior",
                    hint="give it sd=…, relative_sd=…, bounds=(low, high) or prior=…, "
                    "or write fixed=True",
                )
            priors.append(prior)
        return tuple(priors)

    def start(self, model: Model) -> Array:
        """Nominal values of the unknowns, shape (l,)."""
        return np.array([model.parameters[name].value for name in self.parameters])
