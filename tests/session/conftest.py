"""A small campaign and a fit of it, shared by the tests of the session."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import bayesoleo as bo
from tests.small_campaigns import damper, damper_campaign, spring_damper_force


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A spring and a damper, with a cubic spring that the fitted model lacks."""
    path = tmp_path_factory.mktemp("session") / "damper"
    damper_campaign(path, spring_damper_force)
    return path


@pytest.fixture(scope="session")
def campaign(folder: Path) -> bo.Campaign:
    return bo.load_campaign(folder)


@pytest.fixture(scope="session")
def problem(campaign: bo.Campaign) -> bo.Problem:
    return bo.Problem(campaign, damper(cubic=False), quick=True, jobs=1, without=["nonparametric"])


@pytest.fixture(scope="session")
def fit(problem: bo.Problem) -> bo.Fit:
    return problem.fit()


@pytest.fixture(scope="session")
def table() -> dict[str, np.ndarray]:
    """A straight line with a cubic term, and noise."""
    rng = np.random.default_rng(1)
    x = np.linspace(0.0, 2.0, 60)
    return {"x": x, "y": 1.5 * x + 0.4 * x**3 + 0.05 * rng.standard_normal(60)}


def line(x, slope, offset):
    return slope * x + offset


@pytest.fixture(scope="session")
def line_problem(table: dict[str, np.ndarray]) -> bo.Problem:
    parameters = {"slope": bo.Parameter(1.0, sd=5.0), "offset": bo.model.Normal(0.0, 1.0)}
    return bo.Problem(table, line, parameters=parameters, quick=True, jobs=1)


@pytest.fixture(scope="session")
def line_fit(line_problem: bo.Problem) -> bo.Fit:
    return line_problem.fit()
