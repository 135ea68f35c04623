"""Workers and schedulers of a cluster on this machine, killed amid the work.

Three kinds of work are done: replications of an experiment, draws of a posterior, and many loops of
``close``. Each is done once undisturbed. Then workers are killed at moments drawn at random, and
last the scheduler, after which the same call on another cluster goes on. A task is lost whose
result is missing or differs from that of the undisturbed run, bit for bit: a block of replications,
an array of the draws, a loop's summary.

Run as ``python tests/benchmarks/lost_workers.py --json``; ``faults.py`` counts the same.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import numpy as np

from bayesoleo import Settings, close_each
from bayesoleo._parallel import ONE_THREAD, connected
from bayesoleo.errors import BayesoleoError, InputError
from bayesoleo.estimation import sampling_distribution

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "posterior"))
from posterior_cases import gas_spring_case
from posterior_safety import Slow, run as draw
from small_campaigns import damper, damper_campaign, spring_damper_force, with_friction

#: Calls work on a cluster, with checkpoints in a folder; gives what is compared, by name.
Work = Callable[[str | None, Path | None], dict[str, object]]
REPLICATIONS, BLOCK = 1000, 10
#: Commands of Dask.
KINDS = ("scheduler", "worker")
QUICK = Settings(quick=True, max_effects=1)


def replicated(scheduler: str | None, out: Path | None) -> dict[str, object]:
    """Blocks of replications of the gas spring."""
    problem = gas_spring_case(0.1).density.problem
    found = sampling_distribution(
        problem, [1.2], variance=[0.0792**2], replications=REPLICATIONS, block=BLOCK, seed=3,
        out=out, jobs=None if scheduler else 1, scheduler=scheduler,
    )  # fmt: skip
    rows = found["replicate"].values
    return {f"block {k}": rows[k : k + BLOCK].tobytes() for k in range(0, len(rows), BLOCK)}


def drawn(scheduler: str | None, out: Path | None) -> dict[str, object]:
    """Draws of the gas spring's two modes, whose density takes a moment."""
    found = draw(out, Slow, scheduler)
    arrays = ("draws", "log_density", "log_likelihood", "autocorrelation_time")
    numbers = ("acceptance", "evaluations", "failures", "reached")
    return {name: np.asarray(getattr(found, name)).tobytes() for name in arrays} | {
        name: getattr(found, name) for name in numbers
    }


def closed(scheduler: str | None, out: Path | None, *, rigs: Path) -> dict[str, object]:
    """Summaries of two loops."""
    assert out is not None
    campaigns = []
    for name, force in (("rubbing", with_friction), ("free", spring_damper_force)):
        if not (rigs / name).exists():
            damper_campaign(rigs / name, force)
        campaigns.append(rigs / name)
    done = close_each(
        campaigns, damper(), out=out, jobs=None if scheduler else 2, scheduler=scheduler,
        settings=QUICK, retries=5,
    )  # fmt: skip
    return {
        task.folder: (out / task.folder / "summary.json").read_text()
        for task in done.tasks
        if task.state == "done"
    }


class Killer:
    """Kills at moments drawn from a time, while work is done.

    Parameters
    ----------
    victims : callable
        Processes of which one is killed.
    moments : ndarray
        Seconds from the start.
    rng : numpy.random.Generator
        Chooses the process.
    """

    def __init__(
        self, victims: Callable[[], list[int]], moments: np.ndarray, rng: np.random.Generator
    ) -> None:
        self.victims, self.moments, self.rng, self.killed = victims, np.sort(moments), rng, 0
        self._done = threading.Event()

    def _watch(self) -> None:
        begin = time.monotonic()
        for moment in self.moments:
            if self._done.wait(max(0.0, begin + moment - time.monotonic())):
                return
            living = self.victims()
            if living:
                with suppress(ProcessLookupError):
                    os.kill(living[int(self.rng.integers(len(living)))], signal.SIGKILL)
                    self.killed += 1

    @contextmanager
    def at_work(self) -> Iterator[None]:
        """Kill meanwhile."""
        thread = threading.Thread(target=self._watch)
        thread.start()
        try:
            yield
        finally:
            self._done.set()
            thread.join()


def with_killed_workers(
    work: Work, out: Path, moments: np.ndarray, rng: np.random.Generator
) -> tuple[dict[str, object], int]:
    """What comes of work whose workers are killed, and how many were."""
    with connected("local:2") as client:
        assert client is not None
        nannies = client.cluster.workers

        def workers() -> list[int]:
            return [nanny.pid for nanny in list(nannies.values()) if nanny.pid]

        killer = Killer(workers, moments, rng)
        # On a busy machine new workers may come too late; the same call then goes on.
        with killer.at_work(), suppress(BayesoleoError):
            return work(client.scheduler.address, out), killer.killed
    with cluster() as (address, _):
        return work(address, out), killer.killed


@contextmanager
def cluster() -> Iterator[tuple[str, int]]:
    """Address and process of a scheduler with two workers, each a process of its own."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    environment = os.environ | dict.fromkeys(ONE_THREAD, "1")
    environment["PYTHONPATH"] = os.pathsep.join(sys.path)
    begin = partial(subprocess.Popen, env=environment, stderr=subprocess.DEVNULL)
    scheduler, worker = ([sys.executable, "-m", f"distributed.cli.dask_{k}"] for k in KINDS)
    with tempfile.TemporaryDirectory() as place:
        here = ["--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
        first = begin([*scheduler, *here], cwd=place)
        more = ["--no-nanny", "--nthreads", "1", "--no-dashboard", "--local-directory", place]
        rest = [begin([*worker, address, *more]) for _ in range(2)]
        try:
            _await(address)
            yield address, first.pid
        finally:
            for process in (*rest, first):
                process.kill()
                process.wait()


def _await(address: str) -> None:
    """Until two workers are there."""
    deadline = time.monotonic() + 600
    while time.monotonic() < deadline:
        with suppress(InputError), connected(address) as client:
            assert client is not None
            client.wait_for_workers(2, timeout=600)
            return
        time.sleep(0.2)
    raise TimeoutError(address)


def with_killed_scheduler(
    work: Work, out: Path, moment: float, rng: np.random.Generator
) -> tuple[dict[str, object], int]:
    """What comes of work whose scheduler is killed and that goes on with another one."""
    with cluster() as (address, process):
        killer = Killer(lambda: [process], np.array([moment]), rng)
        with killer.at_work(), suppress(BayesoleoError):
            return work(address, out), killer.killed
    with cluster() as (address, _):
        return work(address, out), killer.killed


def lost(found: dict[str, object], right: dict[str, object]) -> list[str]:
    """Names of what is missing or differs."""
    return [name for name, value in right.items() if found.get(name) != value]


def figures(
    kills: int = 4, only: str = "", say: Callable[[str], None] = lambda _: None
) -> dict[str, int]:
    """Kills and lost tasks of all kinds of work.

    Parameters
    ----------
    kills : int
        Workers killed during each kind of work.
    only : str
        Kinds of work, by comma; by default all.
    say : callable
        Told what is done.
    """
    rng, table = np.random.default_rng(8), {"workers_killed": 0, "tasks": 0, "tasks_lost": 0}
    with tempfile.TemporaryDirectory(prefix="lost-") as name:
        root = Path(name)
        kinds: dict[str, Work] = {
            "replicate": replicated,
            "sample": drawn,
            "each": partial(closed, rigs=root / "rigs"),
        }
        for kind, work in kinds.items():
            if only and kind not in only.split(","):
                continue
            with connected("local:2") as client:
                assert client is not None
                begin = time.monotonic()
                right = work(client.scheduler.address, root / f"{kind}-right")
                length = time.monotonic() - begin
            moments = rng.uniform(0.1, 0.9, kills + 1) * length
            for how, (found, killed) in (
                ("workers", with_killed_workers(work, root / f"{kind}-1", moments[1:], rng)),
                ("scheduler", with_killed_scheduler(work, root / f"{kind}-2", moments[0], rng)),
            ):
                gone = lost(found, right)
                say(f"{kind}, {how}: {killed} killed, {len(gone)} of {len(right)} lost {gone}")
                table["workers_killed"] += killed
                table["tasks"] += len(right)
                table["tasks_lost"] += len(gone)
    return table


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--json", action="store_true", help="one flat object")
    parser.add_argument("--kills", type=int, default=4, help="workers killed, each kind of work")
    parser.add_argument("--only", default="", help="replicate,sample,each")
    given = parser.parse_args()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of Dask, of workers that are gone
        table = figures(given.kills, given.only, partial(print, file=sys.stderr, flush=True))
    print(json.dumps(table) if given.json else "\n".join(f"{k:16}{v:6}" for k, v in table.items()))


if __name__ == "__main__":
    main()
