"""Tasks on threads, on processes and on workers that are killed."""

import os
import signal
import threading
import time

import numpy as np
import pytest

from bayesoleo import _parallel as parallel
from bayesoleo._parallel import WorkerPool, connected, each_done
from bayesoleo._storage.resume import Slots
from bayesoleo.errors import InputError, ResultsError


class Counting:
    """Tells how often this copy of it was called; slow enough to be interrupted."""

    def __init__(self, pause: float = 0.0) -> None:
        self.pause, self.calls = pause, 0

    def __call__(self, number: int) -> dict[str, np.ndarray]:
        time.sleep(self.pause)
        self.calls += 1
        names = {"square": number**2, "calls": self.calls, "process": os.getpid()}
        return {name: np.array([value]) for name, value in names.items()}


def failing(number: int) -> int:
    if number == 3:
        raise InputError("three is not allowed", value=number)
    return number


@pytest.fixture(scope="module")
def client():
    with connected("local:2") as client:
        yield client


@pytest.mark.parametrize("jobs", [1, 2])
def test_threads_do_every_task_once(jobs):
    found = dict(each_done(lambda number: number**2, range(20), jobs=jobs))
    assert found == {number: number**2 for number in range(20)}


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_a_task_raises_is_raised(jobs):
    with pytest.raises(InputError, match="three is not allowed"):
        dict(each_done(failing, range(6), jobs=jobs))


def test_a_worker_keeps_to_its_threads():
    parallel.limit_threads(1)
    try:
        assert parallel.available_cores() == 1
        names = parallel.thread_map(lambda _: threading.current_thread().name, range(4), jobs=4)
    finally:
        parallel.limit_threads(None)
    assert set(names) == {"MainThread"}


@pytest.mark.parametrize("scheduler", ["local:0", "local:two"])
def test_a_number_of_processes_is_checked(scheduler):
    with pytest.raises(InputError, match="whole number above zero"), connected(scheduler):
        pass


def test_a_scheduler_that_does_not_answer_is_an_error(monkeypatch):
    monkeypatch.setattr(parallel, "PATIENCE", 0.5)
    with pytest.raises(InputError, match="does not answer"), connected("tcp://127.0.0.1:9"):
        pass


def test_only_missing_pieces_are_made(tmp_path):
    make = Counting()
    Slots(tmp_path, "a").fill(make, 4, jobs=1)
    told: list[int] = []
    pieces = Slots(tmp_path, "a").fill(make, 7, jobs=1, done=told.append)
    assert make.calls == 7
    assert [int(piece["square"][0]) for piece in pieces] == [k**2 for k in range(7)]
    assert sorted(told) == list(range(7))


def test_what_a_kill_left_half_written_is_removed(tmp_path):
    (tmp_path / ".slot-000000.1234.npz").write_bytes(b"half")
    Slots(tmp_path, "a").fill(Counting(), 1, jobs=1)
    assert not list(tmp_path.glob(".slot-*"))


def test_two_writers_of_pieces_are_refused(tmp_path):
    def second(_number: int) -> dict[str, np.ndarray]:
        Slots(tmp_path, "a").fill(Counting(), 1, jobs=1)
        return {}

    with pytest.raises(ResultsError, match="another process is writing here"):
        Slots(tmp_path, "a").fill(second, 1, jobs=1)


@pytest.mark.slow
def test_every_task_begins_with_a_fresh_copy(client):
    found = dict(each_done(Counting(), range(12), client=client))
    assert sorted(found) == list(range(12))
    assert {int(piece["calls"][0]) for piece in found.values()} == {1}


@pytest.mark.slow
def test_a_kept_function_is_made_once_a_worker(client):
    pool = WorkerPool(client, Counting(), keep=True)
    assert pool.size == 2
    found = dict(pool.each(range(20)))
    calls = [int(piece["calls"][0]) for piece in found.values()]
    assert max(calls) > 1
    assert len({int(piece["process"][0]) for piece in found.values()}) <= 2


@pytest.mark.slow
def test_what_a_worker_s_task_raises_is_raised(client):
    with pytest.raises(InputError, match="three is not allowed"):
        dict(each_done(failing, range(6), client=client))


@pytest.mark.slow
def test_a_killed_worker_costs_nothing(client, tmp_path):
    workers, told = list(client.run(os.getpid).values()), []

    def killing(number: int) -> None:
        told.append(number)
        if len(told) == 10:
            os.kill(workers[0], signal.SIGKILL)

    pieces = Slots(tmp_path, "a").fill(
        Counting(0.02), 60, scheduler=client.scheduler.address, done=killing
    )
    assert sorted(told) == list(range(60))
    assert [int(piece["square"][0]) for piece in pieces] == [k**2 for k in range(60)]
    assert len(list(tmp_path.glob("slot-*.npz"))) == 60
