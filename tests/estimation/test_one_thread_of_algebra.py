"""Factors of a search are small: threads of a linear algebra library that wait for each other took
a third of its time."""

from __future__ import annotations

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from bayesoleo._session.display import kept
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


def test_what_a_session_computes_has_one_thread_and_gives_the_others_back():
    def threads():
        return {item["num_threads"] for item in threadpool_info() if item["user_api"] == "blas"}

    class Session:
        @kept
        def work(self):
            return threads()

    with threadpool_limits(2, user_api="blas"):
        before = threads()
        assert Session().work() == {1}
        assert threads() == before
