"""Runs that are killed at random moments, and what becomes of their draws."""

from __future__ import annotations

import multiprocessing
import os
import signal
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from posterior_cases import gas_spring_case
from tqdm import tqdm

from bayesoleo.posterior import LogDensity, Samples, sample

KILLS = 50
#: Seconds that a call of the log density takes besides, so that there is something to interrupt.
PAUSE = 0.002


class Slow(LogDensity):
    """A log density that takes a moment."""

    def __call__(self, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        time.sleep(PAUSE)
        return super().__call__(phi)


def run(
    folder: Path | None, kind: type[LogDensity] = LogDensity, scheduler: str | None = None
) -> Samples:
    """The bimodal gas spring, in many small segments."""
    case = gas_spring_case(0.01)
    return sample(
        kind(case.density.problem),
        case.mixture,
        effective_size=400,
        seed=4,
        out=folder,
        segment=4,
        fingerprint="kills",
        progress=False,
        scheduler=scheduler,
    )


def child(folder: str, ready: str) -> None:
    """In a process of its own."""
    case = gas_spring_case(0.01)  # the modes are found before the clock starts
    assert case.mixture.dimension == 2
    tqdm.set_lock(threading.RLock())  # its own is a semaphore, which a killed process leaves behind
    Path(ready).touch()
    run(Path(folder), Slow)


def killed(folder: Path, moment: float, context) -> None:
    """Start a run and kill it after a moment."""
    ready = folder.with_suffix(".ready")
    process = context.Process(target=child, args=(str(folder), str(ready)))
    process.start()
    while not ready.exists() and process.is_alive():
        time.sleep(0.001)
    time.sleep(moment)
    if process.is_alive():
        os.kill(process.pid, signal.SIGKILL)
    process.join()


def same(one: Samples, other: Samples) -> bool:
    """Whether draws, densities and counts are the same, bit for bit."""
    arrays = ("draws", "log_density", "log_likelihood", "autocorrelation_time")
    numbers = ("acceptance", "evaluations", "failures", "reached")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in arrays) and all(
        getattr(one, name) == getattr(other, name) for name in numbers
    )


def safety_figures() -> dict[str, float]:
    """Each run is killed once, at a moment drawn from its whole length, and then goes on."""
    context = multiprocessing.get_context("forkserver" if os.name == "posix" else "spawn")
    context.set_forkserver_preload(["posterior_safety"])  # so that children need not import
    begin = time.perf_counter()
    whole = run(None, Slow)
    length = time.perf_counter() - begin
    moments = np.random.default_rng(6).uniform(0, length, KILLS)
    identical = amid = 0
    with tempfile.TemporaryDirectory() as place:
        for number, moment in enumerate(tqdm(moments, desc="kills")):
            folder = Path(place) / f"{number:02d}"
            killed(folder, float(moment), context)
            amid += bool(list(folder.glob("segment-*.npz")))
            identical += same(run(folder), whole)
    return {"kills": KILLS, "kills_identical": identical, "kills_amid_segments": amid}
