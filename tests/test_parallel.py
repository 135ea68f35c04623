"""Threads keep the order, end together, and never wait for themselves."""

import multiprocessing
import threading
import time

import pytest

from bayesoleo._parallel import thread_map


def test_results_keep_the_order_of_the_items():
    delays = [0.02, 0.0, 0.01, 0.0]
    assert thread_map(lambda d: (time.sleep(d), d)[1], delays, jobs=4) == delays


def test_threads_are_kept_from_one_call_to_the_next():
    def names() -> set[str]:
        barrier = threading.Barrier(3, timeout=30)
        return set(
            thread_map(lambda _: (barrier.wait(), threading.current_thread().name)[1], "abc", 3)
        )

    assert names() == names()


def test_maps_within_maps_do_not_wait_for_each_other():
    outer = thread_map(lambda i: sum(thread_map(lambda j: i * j, range(5), 2)), range(6), 2)
    assert outer == [10 * i for i in range(6)]


def test_an_error_comes_out_when_all_is_at_rest():
    running, ended = [], []

    def work(item: int) -> None:
        if item == 0:
            raise ValueError("the first")
        running.append(item)
        time.sleep(0.05)
        ended.append(item)

    with pytest.raises(ValueError, match="the first"):
        thread_map(work, range(50), 2)
    # What had begun has ended; what had not never will.
    assert sorted(running) == sorted(ended)
    assert len(running) < 49


def _in_child() -> None:
    assert thread_map(abs, [-1, -2], 2) == [1, 2]


@pytest.mark.skipif(
    "fork" not in multiprocessing.get_all_start_methods(), reason="needs a system that forks"
)
@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
def test_a_forked_process_starts_threads_of_its_own():
    thread_map(abs, [-1, -2], 2)
    child = multiprocessing.get_context("fork").Process(target=_in_child)
    child.start()
    child.join(30)
    assert child.exitcode == 0
