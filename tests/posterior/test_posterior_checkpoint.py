"""Runs that are killed, files that are broken, processes that compete."""

import errno
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from kill_target import run
from posterior_targets import Gaussian

from bayesoleo._storage import files as atomic
from bayesoleo.errors import ResultsError
from bayesoleo.posterior import _checkpoints as checkpoint

CHILD = Path(__file__).with_name("kill_target.py")


def same(one, other) -> None:
    np.testing.assert_array_equal(one.draws, other.draws)
    np.testing.assert_array_equal(one.log_density, other.log_density)
    np.testing.assert_array_equal(one.log_likelihood, other.log_likelihood)
    assert one.acceptance == other.acceptance
    assert one.evaluations == other.evaluations


def kill_after(folder: Path, moment: float) -> None:
    """Start a run, wait for a new segment, then for a moment, and kill it (SIGKILL on POSIX)."""
    before = len(list(folder.glob("segment-*.npz")))
    child = subprocess.Popen([sys.executable, str(CHILD), str(folder)])
    limit = time.monotonic() + 60
    while child.poll() is None and time.monotonic() < limit:
        if len(list(folder.glob("segment-*.npz"))) > before:
            time.sleep(moment)
            break
        time.sleep(0.002)
    child.kill()
    child.wait()


def killed_run_is_the_same(folder: Path, kills: int, seed: int) -> None:
    for moment in np.random.default_rng(seed).uniform(0, 0.03, size=kills):
        kill_after(folder, moment)
    assert list(folder.glob("segment-*.npz"))
    same(run(Gaussian(np.ones(2)), folder), run(Gaussian(np.ones(2)), None))


@pytest.mark.slow
def test_a_killed_run_ends_with_the_same_draws(tmp_path):
    killed_run_is_the_same(tmp_path, 1, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_run_killed_five_times_ends_with_the_same_draws(tmp_path, seed):
    killed_run_is_the_same(tmp_path, 5, seed)


def test_a_complete_run_is_read_without_evaluations(tmp_path):
    first = run(Gaussian(np.ones(2)), tmp_path)
    target = Gaussian(np.ones(2))
    same(run(target, tmp_path), first)
    assert target.evaluations == 0


@pytest.mark.parametrize("damage", ["truncated", "altered", "empty", "missing"])
def test_a_broken_segment_is_set_aside_and_made_again(tmp_path, damage):
    first = run(Gaussian(np.ones(2)), tmp_path)
    files = sorted(tmp_path.glob("segment-*.npz"))
    victim = files[4]
    content = victim.read_bytes()
    if damage == "truncated":
        victim.write_bytes(content[: len(content) // 2])
    elif damage == "altered":
        middle = len(content) // 2
        victim.write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
    elif damage == "empty":
        victim.write_bytes(b"")
    else:
        victim.unlink()
    same(run(Gaussian(np.ones(2)), tmp_path), first)
    aside = len(list(tmp_path.glob("*.broken-0")))
    assert aside == len(files) - 4 - (damage == "missing")
    assert sorted(tmp_path.glob("segment-*.npz")) == files


def test_another_fingerprint_is_refused(tmp_path):
    run(Gaussian(np.ones(2)), tmp_path)
    with (
        pytest.raises(ResultsError, match="another problem, seed or setting"),
        checkpoint.open_store(tmp_path, "other"),
    ):
        pass


def test_two_writers_are_refused(tmp_path):
    with (
        checkpoint.open_store(tmp_path, "x"),
        pytest.raises(ResultsError, match="another process is writing here"),
        checkpoint.open_store(tmp_path, "x"),
    ):
        pass
    with checkpoint.open_store(tmp_path, "x") as store:  # the lock went with the writer
        assert store.segments == []


def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch):
    first = run(Gaussian(np.ones(2)), None)
    real, calls = atomic.os.fsync, []

    def full(descriptor):
        calls.append(descriptor)
        if len(calls) == 9:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(descriptor)

    monkeypatch.setattr(atomic.os, "fsync", full)
    with pytest.raises(ResultsError, match="cannot be written: No space left"):
        run(Gaussian(np.ones(2)), tmp_path)
    assert not list(tmp_path.glob(".segment-*"))
    same(run(Gaussian(np.ones(2)), tmp_path), first)


@pytest.mark.skipif(sys.platform == "win32", reason="has no limit on the size of files")
def test_a_disk_that_takes_no_more_ends_the_run_and_room_lets_it_go_on(tmp_path):
    import resource

    first = run(Gaussian(np.ones(2)), None)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # Room for the first segment, of one draw, and not for one of the warm-up.
    resource.setrlimit(resource.RLIMIT_FSIZE, (12_000, hard))
    try:
        with pytest.raises(ResultsError, match="cannot be written: File too large"):
            run(Gaussian(np.ones(2)), tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [path.name for path in tmp_path.glob("*.npz")] == ["segment-000000.npz"]
    same(run(Gaussian(np.ones(2)), tmp_path), first)


def test_what_a_kill_left_half_written_is_removed(tmp_path):
    (tmp_path / ".segment-000000.1234.npz").write_bytes(b"half")
    first = run(Gaussian(np.ones(2)), tmp_path)
    assert not list(tmp_path.glob(".segment-*"))
    same(first, run(Gaussian(np.ones(2)), None))
