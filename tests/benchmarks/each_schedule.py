"""Many loops on many machines: what the calling process costs, and where it saturates.

Run as ``python tests/benchmarks/each_schedule.py [--manifest FILE] [--json]``. Task times come from
the ``manifest.json`` of a run of ``bayesoleo each``; without one, two small campaigns are run. The
calling process is measured here: it packs campaigns one after the other, writes results with some
threads, and the manifest. A simulation of the schedule then says what workers do with that. The
network is assumed to carry ``--bandwidth`` bytes a second, and a worker's new process to start in
``--startup`` seconds.
"""

from __future__ import annotations

import argparse
import heapq
import json
import pickle
import sys
import tempfile
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from measuring import best

from bayesoleo import Settings, close_each
from bayesoleo._workflow.each import AHEAD, FETCHED, MANIFEST, SAVING, Book
from bayesoleo._workflow.each_task import EachTask, Outcome, every_task, store
from bayesoleo._workflow.output import FILES

sys.path.insert(0, str(Path(__file__).parents[1]))
from small_campaigns import damper, damper_campaign, spring_damper_force, with_friction

WORKERS = (16, 128, 1000)
TASKS_PER_WORKER = 10


@dataclass(frozen=True)
class Costs:
    """What a task costs.

    Parameters
    ----------
    pack, store : float
        Time of the calling process to read and compress a campaign, and to write a result, s.
    save : float
        Time to write the manifest, s for each task in it.
    sent, returned : int
        Bytes.
    """

    pack: float
    store: float
    save: float
    sent: int
    returned: int


def measured_costs(manifest: Path) -> Costs:
    """Costs of the first task of a run that is done, measured anew."""
    tasks = [EachTask(**entry) for entry in json.loads(manifest.read_text())["tasks"]]
    done = next(task for task in tasks if task.state == "done")
    (wanted,) = every_task(done.campaign, damper(), 1, Settings())
    folder = manifest.parent / done.folder
    files = {name: (folder / name).read_bytes() for name in FILES}
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        book = Book(root, {(str(k), "", 0): done for k in range(1000)})
        return Costs(
            pack=best(lambda: wanted.work(None)),
            store=best(lambda: store(root / "result", Outcome("", 1.0, files))),
            save=best(book.save) / len(book.tasks),
            sent=len(pickle.dumps(wanted.work(None).files)),
            returned=sum(map(len, files.values())),
        )


@dataclass(frozen=True)
class Schedule:
    """How a run goes.

    Parameters
    ----------
    workers, tasks : int
    hours : float
    efficiency : float
        Time of all tasks over that of all workers.
    sending, fetching : float
        Part of the time in which the calling process sends tasks and writes the manifest, and in
        which its threads fetch and write results.
    longest_wait : float
        Of a result that is ready until the calling process begins to fetch it, s.
    """

    workers: int
    tasks: int
    hours: float
    efficiency: float
    sending: float
    fetching: float
    longest_wait: float


def simulate(
    seconds: Sequence[float], workers: int, costs: Costs, *, bandwidth: float, startup: float
) -> Schedule:
    """The loop of ``Course.run`` with a cluster of workers of one thread.

    Parameters
    ----------
    seconds : sequence of float
        Of each task, without the start of its process.
    """
    waiting, free = deque(seconds), [0.0] * workers  # when each worker is
    ended: list[float] = []
    fetching = Fetching(costs, bandwidth)
    now = busy = rest = 0.0
    saving = costs.save * len(seconds)
    running, most = 0, workers + max(1, int(AHEAD * workers))
    while waiting or running:
        begin = now
        while waiting and running < most:
            now += costs.pack + costs.sent / bandwidth
            end = max(now, heapq.heappop(free)) + startup + waiting.popleft()
            heapq.heappush(free, end)
            heapq.heappush(ended, end)
            running += 1
        if now >= rest:
            now += saving
            rest = now + saving / SAVING
        busy += now - begin
        while ended and not (fetching.done and fetching.done[0] <= ended[0]):
            fetching.fetch(heapq.heappop(ended))
        now = max(now, fetching.done[0])
        while fetching.done and fetching.done[0] <= now:
            heapq.heappop(fetching.done)
            running -= 1
    return Schedule(
        workers, len(seconds), now / 3600, sum(seconds) / (workers * now), busy / now,
        fetching.busy / (FETCHED * now), fetching.longest,
    )  # fmt: skip


class Fetching:
    """Threads of the calling process that fetch results over one network and write them.

    Parameters
    ----------
    costs : Costs
    bandwidth : float
        Bytes a second.
    """

    def __init__(self, costs: Costs, bandwidth: float) -> None:
        self.transfer, self.store = costs.returned / bandwidth, costs.store
        self.free, self.network = [0.0] * FETCHED, 0.0
        self.done: list[float] = []
        self.busy = self.longest = 0.0

    def fetch(self, ready: float) -> None:
        """Fetch a result that is ready at a time; results come in this order."""
        begin = max(ready, heapq.heappop(self.free))
        self.longest = max(self.longest, begin - ready)
        self.network = max(begin, self.network) + self.transfer
        end = self.network + self.store
        heapq.heappush(self.free, end)
        heapq.heappush(self.done, end)
        self.busy += end - begin


def small_run(folder: Path) -> Path:
    """Manifest of two small campaigns with two seeds."""
    for name, force in (("rubbing", with_friction), ("free", spring_damper_force)):
        damper_campaign(folder / name, force)
    given, quick = [folder / "rubbing", folder / "free"], Settings(quick=True)
    close_each(given, damper(), out=folder / "all", seeds=2, jobs=1, settings=quick, progress=True)
    return folder / "all" / MANIFEST


def figures(manifest: Path, lengths: Sequence[float], **options: float) -> dict[str, Any]:
    """Costs, the rate at which the calling process saturates, and schedules.

    Parameters
    ----------
    manifest : Path
    lengths : sequence of float
        Mean times of a task for which schedules are simulated, s, beside the measured one.
    """
    entries = json.loads(manifest.read_text())["tasks"]
    times = np.array([task["seconds"] for task in entries if task["state"] == "done"])
    costs, rng = measured_costs(manifest), np.random.default_rng(0)
    bandwidth = options["bandwidth"]
    sent = costs.pack + costs.sent / bandwidth
    fetched = max(costs.returned / bandwidth, costs.store / FETCHED)
    caller = max(sent, fetched)
    schedules = []
    for mean in (float(times.mean()), *lengths):
        for workers in WORKERS:
            drawn = rng.choice(times, workers * TASKS_PER_WORKER) * mean / times.mean()
            found = simulate(drawn.tolist(), workers, costs, **options)
            schedules.append({"mean_seconds": mean, **asdict(found)})
    return {
        "task_seconds": times.tolist(),
        "costs": asdict(costs),
        "caller_seconds": caller,
        "tasks_a_second": 1 / caller,
        "workers_kept_busy": float(times.mean()) / caller,
        "schedules": schedules,
    }


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--manifest", type=Path, help="of a run of bayesoleo each")
    parser.add_argument("--bandwidth", type=float, default=1e8, help="bytes a second")
    parser.add_argument("--startup", type=float, default=5.0, help="of a process, seconds")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        manifest = options.manifest or small_run(Path(place))
        given = {"bandwidth": options.bandwidth, "startup": options.startup}
        found = figures(manifest, (300.0, 1800.0), **given)
    if options.json:
        print(json.dumps(found, indent=1))
        return
    print(f"calling process: {1e3 * found['caller_seconds']:.0f} ms a task; {found['costs']}")
    print("mean task [s]  workers   tasks  hours  efficiency  sending  fetching  longest wait [s]")
    for one in found["schedules"]:
        print(
            f"{one['mean_seconds']:13.0f} {one['workers']:8d} {one['tasks']:7d} "
            f"{one['hours']:6.2f} {one['efficiency']:11.2f} {one['sending']:8.2f} "
            f"{one['fetching']:9.2f} "
            f"{one['longest_wait']:17.1f}"
        )


if __name__ == "__main__":
    main()
