"""Replications on processes of this machine: two against one, and one that is killed."""

from __future__ import annotations

import os
import signal
import tempfile
import time
from pathlib import Path

import numpy as np
from posterior_cases import gas_spring_case, oleo_case
from tqdm import tqdm

from bayesoleo._parallel import connected, each_done
from bayesoleo.estimation import sampling_distribution
from bayesoleo.estimation._parametric_bootstrap import data_source
from bayesoleo.estimation._sampling_distribution import _Blocks, _ReplicationTask

#: Replications of the campaign of 14 runs, one a task.
TASKS = 48
REPLICATIONS, BLOCK = 1000, 10


class Clocked:
    """A task that says when and how long it was busy."""

    def __init__(self, work: _Blocks) -> None:
        self.work = work

    def __call__(self, index: int) -> tuple[np.ndarray, float, float]:
        wall, used = time.perf_counter(), time.process_time()
        found = self.work(index)["theta"]
        return found, time.perf_counter() - wall, time.process_time() - used


def campaign_work() -> Clocked:
    """Replications of the campaign with new noise on inputs and outputs."""
    problem = oleo_case().density.problem
    theta = problem.start
    source = data_source(problem, theta, None, input_noise=True)
    work = _ReplicationTask(source, theta, "mbe", 0, 1e-5, 50)
    return Clocked(_Blocks(work, [range(k, k + 1) for k in range(TASKS)]))


def on(workers: int, work: Clocked) -> tuple[list[np.ndarray], float, float, float]:
    """Estimates, wall time, busy wall time and CPU time of all tasks, without starting workers."""
    with connected(f"local:{workers}") as client:
        dict(each_done(work, range(2 * workers), client=client))  # compiled code is loaded
        begin = time.perf_counter()
        tasks = each_done(work, range(TASKS), client=client)
        found = dict(tqdm(tasks, total=TASKS, desc=f"replications, workers: {workers}"))
        wall = time.perf_counter() - begin
    parts = [found[index] for index in range(TASKS)]
    return (
        [part[0] for part in parts],
        wall,
        sum(part[1] for part in parts),
        sum(part[2] for part in parts),
    )


def efficiency() -> dict[str, float]:
    """Time of one worker over twice that of two.

    ``dask_occupied`` is the part of the two workers' time in which they were busy with tasks, and
    ``dask_cpu_ratio`` the CPU time of the tasks on one over that on two: their product is what the
    efficiency would be on a machine that does nothing else.
    """
    work = campaign_work()
    first, one, _, used_one = on(1, work)
    second, two, busy, used_two = on(2, work)
    return {
        "dask_efficiency": one / (2 * two),
        "dask_occupied": busy / (2 * two),
        "dask_cpu_ratio": used_one / used_two,
        "dask_same": int(all(map(np.array_equal, first, second))),
    }


def killed_worker() -> dict[str, float]:
    """A thousand replications, of whose workers one is killed amid them."""
    problem = gas_spring_case(0.1).density.problem
    options = {"variance": [0.0792**2], "replications": REPLICATIONS, "block": BLOCK, "seed": 3}
    whole = sampling_distribution(problem, [1.2], jobs=1, **options)
    with tempfile.TemporaryDirectory() as place, connected("local:2") as client:
        victim = next(iter(client.run(os.getpid).values()))
        folder = Path(place)
        watch = _Watch(folder, REPLICATIONS // BLOCK // 4, victim)
        found = watch.during(
            lambda: sampling_distribution(
                problem, [1.2], out=folder, scheduler=client.scheduler.address, **options
            )
        )
        slots = len(list(folder.glob("slot-*.npz")))
    rows, expected = found["replicate"].values, whole["replicate"].values
    return {
        "worker_killed": int(watch.killed),
        "replications": len(rows),
        "replications_lost": int(REPLICATIONS - len(rows)),
        "replications_doubled": int(slots - REPLICATIONS // BLOCK),
        "replications_identical": int(np.array_equal(rows, expected)),
    }


class _Watch:
    """Kills a process when so many slots are filled."""

    def __init__(self, folder: Path, slots: int, victim: int) -> None:
        self.folder, self.slots, self.victim, self.killed = folder, slots, victim, False

    def during(self, work):
        """Result of the work."""
        from threading import Event, Thread

        done = Event()

        def watch() -> None:
            while not done.wait(0.005) and not self.killed:
                if len(list(self.folder.glob("slot-*.npz"))) >= self.slots:
                    os.kill(self.victim, signal.SIGKILL)
                    self.killed = True

        thread = Thread(target=watch)
        thread.start()
        try:
            return work()
        finally:
            done.set()
            thread.join()


def machines_figures() -> dict[str, float]:
    """Both."""
    return efficiency() | killed_worker()
