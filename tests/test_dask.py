"""Tasks on threads, on processes and on workers that are killed."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bayesoleo import _parallel as parallel
from bayesoleo._parallel import LostError, Machines, WorkerPool, connected, each_done, loss_of
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


class Cluster:
    """As a client is seen by a pool: without workers at first, or with its scheduler lost."""

    def __init__(self, *problems, loses=False):
        self.problems, self.loses, self.status = list(problems), loses, "running"

    def scatter(self, payloads, **_):
        if self.problems:
            self.status = "closed" if self.loses else self.status
            raise self.problems.pop(0)
        return payloads

    def submit(self, *_, **__):
        return "sent"

    def closing(self, *_, **__):
        self.status = "closed" if self.loses else self.status
        raise LookupError("an error of Dask's own")


def test_a_cluster_without_workers_is_waited_for():
    # What Dask raises where there is no worker, and where one ends while it is sent to.
    cluster = Cluster(TimeoutError("No valid workers found"), KeyError("tcp://"), OSError())
    assert WorkerPool(cluster, failing)._submit({5: 1}) == {"sent": 5}
    assert cluster.problems == []


def test_workers_that_never_come_are_an_error(monkeypatch):
    monkeypatch.setattr(parallel, "WAIT", 0.0)
    cluster = Cluster(*(TimeoutError("No valid workers found") for _ in range(3)))
    with pytest.raises(ResultsError, match="no workers"):
        WorkerPool(cluster, failing)._submit({5: 1})


def test_a_lost_scheduler_is_not_waited_for():
    # The second is what Dask raises where the client closes between the look at it and the call.
    for problem in (OSError(), RuntimeError("ConnectionPool is closed")):
        cluster = Cluster(problem, loses=True)
        with pytest.raises(ResultsError, match="scheduler was lost"):
            WorkerPool(cluster, failing)._submit({5: 1})


def test_a_scheduler_lost_while_tasks_are_sent_is_named():
    cluster = Cluster(loses=True)
    cluster.submit = cluster.closing
    with pytest.raises(ResultsError, match="scheduler was lost"):
        WorkerPool(cluster, failing)._submit({5: 1})


def test_other_errors_of_sending_are_raised_as_they_are():
    cluster = Cluster()
    cluster.submit = cluster.closing
    with pytest.raises(LookupError):
        WorkerPool(cluster, failing)._submit({5: 1})


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


class Noted:
    """A call in a process of its own, which leaves its number and waits."""

    def __init__(self, place, name, seconds=0.0):
        self.place, self.name, self.seconds = place, name, seconds

    def __call__(self, folder):
        with (self.place / self.name).open("a") as stream:
            stream.write(f"{os.getpid()} {os.getppid()}\n")
        time.sleep(self.seconds)
        return self.name

    def begun(self):
        """Its process and that of the worker, of each time."""
        path = self.place / self.name
        lines = path.read_text().splitlines() if path.is_file() else []
        return [tuple(map(int, line.split())) for line in lines]

    def wait(self, times=1):
        """Until it was begun so often."""
        deadline = time.monotonic() + 300
        while len(self.begun()) < times:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        return self.begun()[times - 1]


def await_end(process):
    """Until a process is gone."""
    deadline = time.monotonic() + 300
    while Path(f"/proc/{process}").exists():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_workers_of_which_none_begins_again_are_not_waited_for_without_end(monkeypatch):
    """All workers of a machine may be lost with what would begin them again."""
    clock, threads = [10.0], {"a": 2}
    monkeypatch.setattr(parallel.time, "monotonic", lambda: clock[0])
    pool = Machines(SimpleNamespace(status="running", nthreads=lambda: threads))
    assert (pool.size, pool.lost) == (2, "")
    clock[0] += 10.0 * parallel.WAIT  # in which tasks were prepared, and nobody looked
    assert pool.lost == ""
    threads.clear()
    clock[0] += 10.0 * parallel.WAIT
    assert pool.lost == ""  # the first look that finds none
    clock[0] += parallel.WAIT - 1.0
    assert (pool.size, pool.lost) == (1, "")  # work is sent: a worker may be on its way
    threads["b"] = 1
    clock[0] += 2.5
    assert (pool.size, pool.lost) == (1, "")
    threads.clear()
    clock[0] += 2.5
    assert pool.lost == ""
    clock[0] += parallel.WAIT + 1.0
    assert pool.lost == "the scheduler has had no workers for 300 seconds"
    threads["c"] = 4
    clock[0] += 2.5
    assert (pool.size, pool.lost) == (4, "")


@pytest.mark.slow
def test_calls_on_a_cluster_have_processes_of_their_own(client, tmp_path):
    client.wait_for_workers(2, timeout=300)  # one that another test killed comes again
    pool = Machines(client)
    assert (pool.size, pool.lost) == (2, "")
    calls = [Noted(tmp_path, f"call-{k}") for k in range(3)]
    assert [one.result() for one in [pool.submit(call) for call in calls]] == [
        "call-0", "call-1", "call-2",
    ]  # fmt: skip
    assert len({call.begun()[0][0] for call in calls}) == 3
    pool.close()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="sees processes by /proc")
def test_a_cancelled_call_ends_its_process(client, tmp_path):
    call = Noted(tmp_path, "call", 600.0)
    pool = Machines(client)
    pending = pool.submit(call)
    process, _ = call.wait()
    pool.close()
    with pytest.raises(Exception, match="cancel") as caught:
        pending.result()
    assert loss_of(caught.value).times == 1
    await_end(process)


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc").is_dir(), reason="sees processes by /proc")
def test_a_killed_worker_s_call_is_made_by_another(client, tmp_path):
    call = Noted(tmp_path, "call", 5.0)
    pending = Machines(client).submit(call)
    process, worker = call.wait()
    os.kill(worker, signal.SIGKILL)
    await_end(process)
    assert pending.result() == "call"
    assert len(call.begun()) == 2


@pytest.mark.slow
def test_a_process_that_dies_on_a_worker_is_lost(client):
    with pytest.raises(LostError, match="exit status 7"):
        Machines(client).submit(dying).result()


def dying(_folder):
    os._exit(7)


@pytest.mark.slow
def test_a_scheduler_that_is_killed_is_noticed(monkeypatch, tmp_path):
    monkeypatch.setattr(parallel, "PATIENCE", 3)
    port = 8700 + os.getpid() % 1000
    command = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--port", str(port)]
    command += ["--host", "127.0.0.1", "--no-dashboard"]
    with subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.DEVNULL) as scheduler:
        address = f"tcp://127.0.0.1:{port}"
        _await_scheduler(address)
        with connected(address) as client:
            pool = Machines(client)
            pending = pool.submit(dying)  # no worker ever comes
            scheduler.kill()
            with pytest.raises(Exception, match="lost the connection") as caught:
                pending.result()
            assert loss_of(caught.value).times == 0
            assert pool.size == 0
            deadline = time.monotonic() + 60
            while not pool.lost:
                assert time.monotonic() < deadline
                time.sleep(0.1)
            pool.close()
            with pytest.raises(ResultsError, match="scheduler was lost"):
                dict(each_done(failing, range(2), client=client))


def _await_scheduler(address):
    deadline = time.monotonic() + 300
    while True:
        try:
            with connected(address):
                return
        except InputError:
            assert time.monotonic() < deadline
