"""Densities on which samplers are compared."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from posterior_gas_spring import gas_spring

from bayesoleo.data import dataset_folder, load_campaign, reduce_campaign
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.model import driven_by
from bayesoleo.posterior import LogDensity, Mixture, laplace_mixture
from bayesoleo.systems import system


@dataclass(frozen=True)
class Case:
    """A density and where to start.

    Parameters
    ----------
    density : LogDensity
    mixture : Mixture
        Laplace approximations at its modes.
    """

    density: LogDensity
    mixture: Mixture

    @property
    def dimension(self) -> int:
        """Number of coordinates."""
        return len(self.density.names)


@cache
def oleo_case() -> Case:
    """``f16n2d2`` driven by displacement on the 14 runs of ``shaker-plain``: seven theta and v."""
    records = reduce_campaign(load_campaign(dataset_folder("shaker-plain"))).records
    fit = fit_model(driven_by(system("f16n2d2"), "displacement"), records, Numerics())
    density = LogDensity(fit.problem)
    return Case(density, laplace_mixture(density, fit.point.theta[None]))


def gas_spring_case(relative_sd: float, seed: int = 13) -> Case:
    """The gas spring with its undeclared 0.95.

    With this noise and a standard deviation of 0.01 a third of the posterior lies in the mode near
    the prior.
    """
    density = LogDensity(gas_spring(relative_sd=relative_sd, seed=seed))
    starts = np.array([[1.225], [1.0456], [1.0]])
    return Case(density, laplace_mixture(density, starts))
