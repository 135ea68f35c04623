"""Problems with known answers, and where certified data are found."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.estimation import FunctionProblem
from bayesoleo.model._priors import Normal


@pytest.fixture(scope="session")
def gas_spring():
    """Make the ideal gas spring of Verbeek (1993), section 3.4.2, for a seed and a relative sd.

    The fitted model's factor 0.95 is the undeclared error in the initial pressure.
    """
    position = np.linspace(0.0, 0.9, 100)
    noise = 0.005 * 10**1.2  # two standard deviations are 1 % of full scale

    def assumed(x, theta):
        return 0.95 * (1 / (1 - x)) ** theta[0]

    def make(seed, relative_sd, centre=1.0, start=None):
        rng = np.random.default_rng(seed)
        force = (1 / (1 - position)) ** 1.2 + rng.normal(0.0, noise, position.size)
        prior = Normal(centre, relative_sd * centre)
        return FunctionProblem(assumed, position, force, [prior], ["exponent"], start=start)

    return make
