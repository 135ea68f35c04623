"""Files of a result appear together, one process writes at a time, and damage is found."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from bayesoleo._storage.files import (
    SUMS,
    changed_files,
    check_free,
    current,
    only_writer,
    sha256,
    together,
)
from bayesoleo._storage.result_files import provenance, read_attributes, read_tree, write_tree
from bayesoleo._workflow.output import FILES, OLDER, PUT_ASIDE, REPORT, RESULTS, ResultFolder
from bayesoleo.errors import DataWarning, ResultsError

posix = pytest.mark.skipif(os.name != "posix", reason="forks")
#: What changes a disk; each of them may be the last thing that a process does.
CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir")


def in_child(work, *, killed_at: int | None = None) -> int:
    """Run in a process of its own, killed just before its n-th change of the disk; its status."""
    child = os.fork()
    if child:
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    count = 0

    def hook(event, arguments):
        nonlocal count
        writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & os.O_CREAT
        if event in CHANGES or writes:
            count += 1
            if count == killed_at:
                os.kill(os.getpid(), signal.SIGKILL)

    try:
        sys.addaudithook(hook)
        work()
        os._exit(0)
    except MemoryError:
        os._exit(7)
    except ResultsError as error:
        os._exit(8 if "\n" not in str(error) else 9)
    except BaseException:  # the status says so; what pytest made of it would be printed twice
        os._exit(1)


def write(folder: Path, content: str, files=FILES) -> None:
    """A result of text, by one process alone."""
    output = ResultFolder.checked(folder)
    with output.alone(), output.draft() as draft:
        for name in files:
            (draft / name).write_text(content)


def contents(folder: Path) -> dict[str, str]:
    return {name: (folder / name).read_text() for name in FILES if (folder / name).exists()}


def small_tree(value: float = 1.0, size: int = 3) -> xr.DataTree:
    labels = [f"ü{k}" for k in range(size)]
    data = xr.Dataset({"x": ("n", np.full(size, value)), "label": ("n", labels)})
    tree = xr.DataTree.from_dict({"/": xr.Dataset(), "g": data})
    tree.attrs.update(provenance(1, summary={"verdict": "nothing is missing"}))
    return tree


@posix
@pytest.mark.parametrize(
    "fewer",
    [
        pytest.param(False, marks=pytest.mark.slow, id="all files"),
        pytest.param(True, id="no report"),
    ],
)
def test_killed_at_any_moment_all_files_are_old_or_all_are_new(tmp_path, fewer):
    files = [name for name in FILES if not (fewer and name == REPORT)]
    seen, killed_at = set(), 1
    while True:
        folder = tmp_path / str(killed_at)
        write(folder, "old")
        status = in_child(partial(write, folder, "new", files), killed_at=killed_at)
        raw = set(contents(folder).values())
        assert len(raw) <= 1, f"files of two results side by side: {contents(folder)}"
        newest = {current(folder / name).read_text() for name in files}
        assert len(newest) == 1, "what a reader finds is of one result"
        with ResultFolder.checked(folder).alone():
            pass
        after = contents(folder)
        assert after in (dict.fromkeys(FILES, "old"), dict.fromkeys(files, "new"))
        assert set(after.values()) == newest
        assert changed_files(folder) == []
        left = {path.name for path in folder.iterdir()} - {*FILES, SUMS, OLDER}
        assert left == set(), "drafts are swept"
        seen |= newest
        if status == 0:
            break
        assert status == -signal.SIGKILL
        killed_at += 1
    assert killed_at > 15
    assert seen == {"old", "new"}
    aside = tmp_path / str(killed_at) / OLDER
    assert contents(aside) == dict.fromkeys(FILES, "old")
    assert (aside / PUT_ASIDE).is_file()


def test_a_page_that_is_written_again_keeps_the_other_files(tmp_path):
    write(tmp_path, "old")
    with together(tmp_path, [REPORT], keep=True) as draft:
        (draft / REPORT).write_text("new")
    assert contents(tmp_path) == dict.fromkeys(FILES, "old") | {REPORT: "new"}
    assert changed_files(tmp_path) == []
    (tmp_path / REPORT).write_text("edited")
    assert changed_files(tmp_path) == [REPORT]


def test_files_that_were_changed_beside_a_result_are_warned_of(tmp_path):
    output = ResultFolder.checked(tmp_path)
    with output.draft() as draft:
        write_tree(small_tree(), draft / RESULTS)
        (draft / REPORT).write_text("as written")
    read_tree(tmp_path / RESULTS)
    (tmp_path / REPORT).write_text("edited")
    with pytest.warns(DataWarning, match=rf"{REPORT}: is not as {SUMS} has it"):
        read_tree(tmp_path / RESULTS)
    (tmp_path / REPORT).unlink()
    read_tree(tmp_path / RESULTS)
    write_tree(small_tree(2.0), tmp_path / RESULTS)
    with pytest.warns(DataWarning, match="of another result than the files beside it"):
        read_tree(tmp_path / RESULTS)


def test_checksums_are_those_that_sha256sum_reads(tmp_path):
    write(tmp_path, "a")
    lines = (tmp_path / SUMS).read_text().splitlines()
    assert lines == [f"{sha256(tmp_path / name)}  {name}" for name in sorted(FILES)]


def test_a_second_writer_is_told_the_folder_and_the_process(tmp_path):
    place = tmp_path / "results"
    with only_writer(place):
        for attempt in (
            check_free,
            ResultFolder.checked,
            lambda path: only_writer(path).__enter__(),
        ):
            told = rf"{place}: another process is writing here \(process {os.getpid()} on .* since"
            with pytest.raises(ResultsError, match=told) as caught:
                attempt(place)
            assert "\n" not in str(caught.value)
    assert not place.exists(), "nothing was written"


@posix
def test_the_lock_of_a_dead_process_is_taken_over(tmp_path):
    def die():
        with only_writer(tmp_path):
            os.kill(os.getpid(), signal.SIGKILL)

    assert in_child(die) == -signal.SIGKILL
    assert (tmp_path / ".lock").exists()
    with only_writer(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_files_that_look_like_drafts_but_are_not_ours_stay(tmp_path):
    for name in (".notes", ".results.mine.nc", ".bayesoleo-plan"):
        (tmp_path / name).write_text("mine")
    write(tmp_path, "new")
    assert {".notes", ".results.mine.nc", ".bayesoleo-plan"} <= {p.name for p in tmp_path.iterdir()}


@pytest.mark.parametrize("ending", ["nc", "zarr"])
def test_a_flipped_byte_changes_nothing_or_is_found(tmp_path, ending):
    path = tmp_path / f"a.{ending}"
    write_tree(small_tree(), path)
    rng = np.random.default_rng(3)
    files = sorted(
        item for item in (path.rglob("*") if path.is_dir() else [path]) if item.is_file()
    )
    found = 0
    for _ in range(60):
        file = files[rng.integers(len(files))]
        whole = bytearray(file.read_bytes())
        whole[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        before = file.read_bytes()
        file.write_bytes(whole)
        try:
            read = read_tree(path)["g"].to_dataset()
        except ResultsError as error:
            found += str(path) in str(error)
        else:
            xr.testing.assert_identical(read, small_tree()["g"].to_dataset())
        file.write_bytes(before)
    assert found > 40
    assert read_tree(path).attrs == small_tree().attrs | {
        name: value for name, value in read_tree(path).attrs.items() if name == "created"
    }


def test_a_result_that_another_program_wrote_again_is_read(tmp_path):
    write_tree(small_tree(), tmp_path / "a.nc")
    with xr.open_datatree(tmp_path / "a.nc") as tree:
        tree.load().to_netcdf(tmp_path / "b.nc", engine="h5netcdf")
    assert float(read_tree(tmp_path / "b.nc")["g/x"][0]) == 1.0


def test_attributes_of_a_damaged_file_are_not_believed(tmp_path):
    path = tmp_path / "a.nc"
    write_tree(small_tree(), path)
    assert read_attributes(path)["seed"] == 1
    content = path.read_bytes()
    path.write_bytes(content.replace(b"nothing is missing", b"nothing is mi55ing"))
    assert read_attributes(path) == {}


@pytest.mark.parametrize("reason", [errno.ENOSPC, errno.EDQUOT, errno.EIO])
def test_a_full_disk_leaves_the_older_result(tmp_path, monkeypatch, reason):
    output = ResultFolder.checked(tmp_path)
    output.write(small_tree(1.0))

    def full(*_, **__):
        raise OSError(reason, os.strerror(reason))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(ResultsError, match=rf"cannot be written: {os.strerror(reason)}"):
        output.write(small_tree(2.0))
    assert float(read_tree(tmp_path / RESULTS)["g/x"][0]) == 1.0
    assert {path.name for path in tmp_path.iterdir()} == {RESULTS, SUMS}


@posix
def test_a_file_that_grows_too_large_is_an_error_not_a_crash(tmp_path):
    import resource

    def work():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
        noise = np.random.default_rng(0).normal(size=40_000)
        write_tree(xr.DataTree(xr.Dataset({"x": ("n", noise)})), tmp_path / "a.nc")

    assert in_child(work) == 8
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(sys.platform != "linux", reason="limits the address space")
def test_memory_that_runs_out_is_a_memory_error_not_a_crash(tmp_path):
    import resource

    large = xr.DataTree(xr.Dataset({"x": ("n", np.zeros(10_000_000))}))

    def work():
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limit = pages * resource.getpagesize() + 30 * 2**20
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
        write_tree(large, tmp_path / "a.nc")

    assert in_child(work) == 7
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def small_disk(tmp_path):
    """A disk of one megabyte."""
    place = tmp_path / "disk"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(place)]
    if sys.platform != "linux" or os.geteuid() or subprocess.run(mount, check=False).returncode:
        pytest.skip("needs a Linux on which disks may be mounted")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def test_a_disk_that_is_full_is_told_in_one_line(small_disk):
    noise = np.random.default_rng(0).normal(size=200_000)
    output = ResultFolder.checked(small_disk)
    output.write(small_tree())
    with pytest.raises(ResultsError, match="No space left on device"):
        output.write(xr.DataTree(xr.Dataset({"x": ("n", noise)})))
    assert float(read_tree(small_disk / RESULTS)["g/x"][0]) == 1.0
    assert {path.name for path in small_disk.iterdir()} == {RESULTS, SUMS}
