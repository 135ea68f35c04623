"""The log density is a function of the parameters alone, bit for bit: in both drives of an oleo, by
the default and the thesis's scheme, however the vectors are split and the threads counted."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_runs import answered, oleo_runs

from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.model._drive_and_start import driven_by
from bayesoleo.posterior import LogDensity
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Harmonics
from bayesoleo.solvers._orbit import Status
from bayesoleo.systems._oleo import thermomechanical_oleo

STEPS, VECTORS = 128, 23
ORDERS = np.arange(12)
CASES = [
    "displacement radau3",
    "displacement thesis",
    pytest.param("force radau3", marks=pytest.mark.slow),
    pytest.param("force thesis", marks=pytest.mark.slow),
]


def harmonics_of_samples(record, channel):
    turns = np.exp(2j * np.pi * np.outer(record.phase, ORDERS))
    table = np.hstack([turns.real, -turns.imag[:, 1:]])
    found = np.linalg.lstsq(table, record.samples[channel], rcond=None)[0]
    imaginary = np.concatenate([[0.0], found[ORDERS.size :]])
    return Harmonics(ORDERS, found[: ORDERS.size] + 1j * imaginary, np.zeros(ORDERS.size))


@pytest.fixture(scope="module", params=CASES)
def predictor(request):
    """Three runs, each anchored at the model's own values."""
    drive, scheme = request.param.split()
    own = thermomechanical_oleo(2)
    model = driven_by(own, "displacement")
    records = answered(model, oleo_runs()[1:4], noise=0.01, steps=STEPS)
    if drive == "force":
        model = own
        records = [
            replace(item, harmonics={"force": harmonics_of_samples(item, "force")})
            for item in records
        ]
    found = Predictor(model, records, steps=STEPS, scheme=scheme)
    assert set(found.set_anchor(found.layout.start(model))) == {Status.CONVERGED}
    return found


@pytest.fixture(scope="module")
def density(predictor):
    density = LogDensity(CampaignProblem(predictor))
    start = np.concatenate([predictor.layout.start(predictor.model), [4.0, 16.0]])
    spread = 0.01 * np.random.default_rng(3).standard_normal((VECTORS, start.size))
    phi = density.coordinates(start * (1 + spread))
    phi[4, predictor.layout.names.index("initial_volume")] *= 0.3  # no gas is left: a failure too
    return density, phi


def test_compiled_newton_is_what_is_tested(predictor):
    assert all(run.boundary.arranged is not None for run in predictor.runs)


@pytest.mark.parametrize("jobs", [1, 2])
def test_no_split_and_no_number_of_threads_changes_a_bit(predictor, density, jobs):
    density, phi = density
    predictor.jobs = None
    whole = density(phi)
    assert np.isfinite(whole[0]).sum() == VECTORS - 1
    predictor.jobs = jobs
    rng = np.random.default_rng(11)
    for _ in range(4):
        cuts = np.sort(rng.choice(np.arange(1, VECTORS), size=rng.integers(1, 9), replace=False))
        parts = [density(part) for part in np.split(phi, cuts)]
        for k in (0, 1):
            assert np.concatenate([part[k] for part in parts]).tobytes() == whole[k].tobytes()
    one_by_one = [density(row[None])[0] for row in phi]
    assert np.concatenate(one_by_one).tobytes() == whole[0].tobytes()


def test_neither_neighbours_nor_order_nor_history_change_a_bit(predictor, density):
    density, phi = density
    whole, by_run = density(phi)
    order = np.random.default_rng(8).permutation(VECTORS)
    again, again_by_run = density(phi[order])
    assert again.tobytes() == whole[order].tobytes()
    assert again_by_run.tobytes() == by_run[order].tobytes()
    density(phi + 0.003)
    assert density(phi)[0].tobytes() == whole.tobytes()
