"""Threads keep the order, end together, and never wait for themselves; processes end together."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import CancelledError
from pathlib import Path

import pytest

from bayesoleo._parallel import LostError, available_cores, in_own_process, thread_map


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


def _folder_and_process(folder):
    return folder.is_dir(), os.getpid(), available_cores(), os.environ["OMP_NUM_THREADS"]


def test_a_call_in_its_own_process_has_a_folder_and_one_thread(tmp_path):
    found, process, cores, threads = in_own_process(_folder_and_process, within=tmp_path)
    assert (found, cores, threads) == (True, 1, "1")
    assert process != os.getpid()
    assert list(tmp_path.iterdir()) == []


def test_a_process_that_dies_is_lost_with_its_last_words(tmp_path):
    def die(_folder):
        print("first words\nlast words", flush=True)
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(LostError, match="ended with signal 9: last words"):
        in_own_process(die, within=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_what_a_call_raises_is_its_last_word():
    with pytest.raises(LostError, match="exit status 1: ValueError: no number"):
        in_own_process(_raise)


def _raise(_folder):
    raise ValueError("no number")


def test_a_process_is_stopped(tmp_path):
    def work(folder):
        (folder.parent / "begun").touch()
        time.sleep(60)

    begun = time.monotonic()
    with pytest.raises(CancelledError):
        in_own_process(work, (tmp_path / "begun").exists, within=tmp_path)
    assert time.monotonic() - begun < 50


@pytest.mark.skipif(not Path("/proc/self/stat").is_file(), reason="sees processes by /proc")
def test_a_process_ends_with_its_parent(tmp_path):
    script = f"""
import os, sys, time
from pathlib import Path
from bayesoleo._parallel import in_own_process
place = Path({str(tmp_path)!r})
def work(folder):
    (place / "child").write_text(str(os.getpid()))
    time.sleep(60)
in_own_process(work, within=place)
"""
    with subprocess.Popen([sys.executable, "-c", script]) as parent:
        while not (tmp_path / "child").is_file() or not (tmp_path / "child").read_text():
            time.sleep(0.05)
        parent.kill()
    child = int((tmp_path / "child").read_text())
    deadline = time.monotonic() + 20
    while _runs(child):
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _runs(process):
    """Whether a process is there and has not ended; one that nobody has waited for has."""
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"
