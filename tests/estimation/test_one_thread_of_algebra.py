"""Factors of a search are small: threads of a linear algebra library that wait for each other took
a third of its time."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from bayesoleo._parallel import ONE_THREAD, single_blas_thread
from bayesoleo._session.display import kept
from bayesoleo.data._reduction import reduce_run
from bayesoleo.data._run_samples import Run
from bayesoleo.estimation import FunctionProblem, estimate
from bayesoleo.model._priors import Normal


@pytest.fixture
def seen(monkeypatch):
    """Threads that decompositions might have used, one entry a call."""
    calls: list[int] = []

    def watch(name):
        original = getattr(np.linalg, name)

        def watched(*arguments, **options):
            blas = [item for item in threadpool_info() if item["user_api"] == "blas"]
            calls.append(max(item["num_threads"] for item in blas))
            return original(*arguments, **options)

        monkeypatch.setattr(np.linalg, name, watched)

    for name in ("qr", "svd"):
        watch(name)
    return calls


def test_an_estimate_decomposes_in_the_calling_thread(seen):
    rng = np.random.default_rng(0)
    design = rng.normal(size=(50, 2))
    data = design @ [1.0, 2.0] + rng.normal(size=50)
    problem = FunctionProblem(lambda x, t: x @ t, design, data, [Normal(0.0, 5.0)] * 2)
    with threadpool_limits(2, user_api="blas"):
        assert estimate(problem, "be").status.ok
    assert seen
    assert set(seen) == {1}


def test_a_transient_is_reduced_in_the_calling_thread(seen):
    """One run, as several on as many threads: the curve's ends are decompositions."""
    rng, time = np.random.default_rng(0), 1e-3 * np.arange(4000)
    values = np.sin(2 * np.pi * 3.0 * time) + 1e-4 * rng.standard_normal(time.size)
    run = Run("1", "1.csv", "1", "fit", "transient", None, time, {"position": values})
    with threadpool_limits(2, user_api="blas"):
        reduce_run(run)
    assert seen
    assert set(seen) == {1}


def threads():
    return {item["num_threads"] for item in threadpool_info() if item["user_api"] == "blas"}


@pytest.mark.parametrize("asked", [False, True])
def test_what_a_session_computes_has_one_thread_unless_asked_for_more(asked, monkeypatch):
    for name in ONE_THREAD:
        monkeypatch.delenv(name, raising=False)
    if asked:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")

    class Session:
        @kept
        def work(self):
            return threads()

    with threadpool_limits(2, user_api="blas"):
        before = threads()
        assert Session().work() == (before if asked else {1})
        assert threads() == before


def test_the_last_of_several_threads_gives_the_others_back():
    first, second = single_blas_thread(), single_blas_thread()
    with threadpool_limits(2, user_api="blas"):
        before = threads()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert threads() == {1}
        second.__exit__(None, None, None)
        assert threads() == before
