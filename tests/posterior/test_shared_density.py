"""A density that other processes evaluate too: the same draws, whatever becomes of them."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from small_campaigns import damper, damper_campaign, with_friction

import bayesoleo._kept_processes as kept_processes
import bayesoleo._process_messages as messages
import bayesoleo._worker_processes as processes
from bayesoleo.discovery._assembly import assign
from bayesoleo.discovery._fit import fit_model
from bayesoleo.discovery._numerics import Numerics
from bayesoleo.posterior import LogDensity, sample
from bayesoleo.posterior._laplace import laplace_mixture
from bayesoleo.posterior._shared_density import SharedDensity


@pytest.fixture
def eager(monkeypatch):
    """A process is there, and is waited for."""
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    monkeypatch.setattr(processes.StandingCall, "WORTH", (0.0, 0.0))
    begin = processes.StandingCall.begin

    def waited(self, took, item):
        begin(self, took, item)
        for thread in self._begun:
            thread.join(60)

    monkeypatch.setattr(processes.StandingCall, "begin", waited)
    # It answers once it has begun.
    kept_processes.process_of(0).ask(messages.dumps((None, None, None)))


@pytest.fixture(scope="module", autouse=True)
def ended():
    yield
    kept_processes.end_processes()


@pytest.fixture(scope="module")
def fit(tmp_path_factory):
    campaign = damper_campaign(tmp_path_factory.mktemp("damper"), with_friction)
    numerics = Numerics(steps=64, jobs=1, backend="numpy")
    return fit_model(damper(), assign(campaign.records).fitted, numerics, check_mesh=False)


def density_of(fit, jobs=2):
    return LogDensity(fit.problem, jobs, errors="correlated")


def near(fit, count=40, far=0):
    """Coordinates about the estimate; the last ones so far that nothing can be solved there."""
    density = density_of(fit)
    mixture = laplace_mixture(density, fit.point.theta[None])
    phi = mixture.sample(np.random.default_rng(1), count)
    phi[count - far :] += 1e6
    return phi


def ready(shared, phi):
    """The density once other processes take part."""
    shared(phi)
    assert shared._rows.others == 1
    return shared


@pytest.mark.slow
def test_rows_are_the_same_to_the_last_bit(fit, eager):
    phi = near(fit, far=3)
    alone = density_of(fit, 1)
    shared = ready(SharedDensity(density_of(fit)), phi)
    before, failures = shared.evaluations, Counter(shared.failures)
    try:
        found, by_run = shared(phi)
    finally:
        shared.end()
    expected, expected_by_run = alone(phi)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(by_run, expected_by_run)
    assert not np.isfinite(found[-3:]).any()
    # What was evaluated and what failed elsewhere is counted as here.
    assert shared.evaluations - before == alone.evaluations == len(phi)
    assert shared.failures - failures == alone.failures
    assert alone.failures.total() == 3


@pytest.mark.parametrize("known", [False, True])
def test_a_lost_process_costs_nothing_but_time(fit, eager, known):
    """Whether or not it is known to be lost when it is asked next."""
    phi = near(fit)
    expected, _ = density_of(fit, 1)(phi)
    shared = ready(SharedDensity(density_of(fit)), phi)
    try:
        kept_processes.kept[0].process.kill()
        if known:
            kept_processes.kept[0].process.wait()
        np.testing.assert_array_equal(shared(phi)[0], expected)
        assert shared._rows.others == 0
        np.testing.assert_array_equal(shared(phi)[0], expected)
        assert shared.evaluations == 3 * len(phi)
    finally:
        shared.end()
    # Whatever comes next may use processes again.
    assert processes._in_use.acquire(blocking=False)
    processes._in_use.release()


@pytest.mark.slow
def test_draws_do_not_depend_on_processes(fit, eager, monkeypatch):
    density = density_of(fit)
    start = laplace_mixture(density, fit.point.theta[None])
    used = []
    call = processes.StandingCall.__call__
    monkeypatch.setattr(
        processes.StandingCall, "__call__", lambda self, items: used.append(1) or call(self, items)
    )
    options = {"seed": 3, "progress": False, "quick": True, "climbs": 0, "effective_size": 60}
    shared = sample(density, start, **options)
    assert used
    monkeypatch.setenv("BAYESOLEO_PROCESSES", "0")
    alone = sample(density_of(fit, 1), start, **options)
    np.testing.assert_array_equal(shared.draws, alone.draws)
    np.testing.assert_array_equal(shared.log_likelihood, alone.log_likelihood)
    assert shared.evaluations == alone.evaluations
    assert shared.failures == alone.failures


def test_short_sampling_starts_no_process(fit, monkeypatch):
    kept_processes.end_processes()
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    shared = SharedDensity(density_of(fit))
    shared(near(fit))
    shared.end()
    assert not kept_processes.kept


def test_an_error_elsewhere_is_raised_here(eager):
    def call(limit, item):
        if item > limit:
            raise ValueError(f"{item} is too large")
        return item

    standing = processes.StandingCall(call, 5, 2)
    standing.begin(1.0, 1)
    assert standing.others == 1
    try:
        assert standing([1, 2, 3]) == [1, 2, 3]
        with pytest.raises(ValueError, match="9 is too large"):
            standing([1, 9])
        assert standing([1, 2]) == [1, 2]
    finally:
        standing.end()
