"""What the commands do when the machine, or the input, fails them.

Each command that writes is killed at moments spread over all its changes of the disk, and then
run once more: the result must be the one of a run that nobody disturbed. Then the disk fills up at
each of these moments, bytes of stored files are flipped, the clock and the locale are odd, and the
input is hostile. A fault is answered by the right result, or by one line that says what is wrong.
Workers of a cluster are killed: see ``lost_workers.py``. Last, the package itself is made faulty:
see ``mutants.py``.

Run ``python tests/benchmarks/faults.py --json``; ``--few`` tries a sample. What is tried,
and what was not answered, is told on standard error. It takes long: with ``--store FILE`` a run
that was stopped goes on after its last whole step.
"""

from __future__ import annotations

import argparse
import errno
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from hostile import INPUTS

from bayesoleo._cli import main
from bayesoleo._machine_code import cache_folder
from bayesoleo._storage.files import SUMS, current, write_text_atomic
from bayesoleo._storage.result_files import read_tree
from bayesoleo._storage.resume import package_digest

sys.path.insert(0, str(Path(__file__).parents[1] / "cli"))
from small_rig import CAMPAIGN, MODEL, rows, write_rows

#: What commands import when they run; the children of this process find it imported.
MODULES = (
    "_cli.assessing", "_report.page", "_session.results", "_workflow.closing",
    "_workflow.estimating", "_workflow.predicting", "_workflow.simulating", "assessment._assess",
    "estimation._between_runs", "estimation._sampling_distribution", "plots._discovery",
    "plots._estimates", "plots._posterior", "plots._predictions", "plots._residuals", "plots._runs",
)  # fmt: skip

#: What changes a disk, beside opening a file to write to it.
CHANGES = ("os.rename", "os.remove", "os.mkdir", "os.rmdir")
#: CPU seconds that a command may take, and seconds in which it must take some. A limit of time that
#: passes would call a command slow because the machine is busy with others.
PATIENCE = 600
FAST = ["--jobs", "1", "--quiet"]
#: Commands by name; what they write is in ``out``.
VERBS = {
    "estimate": ["estimate", "rig", "-m", "spring.py", "--out", "out", *FAST],
    "each": ["estimate", "rig", "-m", "spring.py", "--each", "--out", "out", *FAST],
    "report": ["report", "closed/results.nc", "--out", "out/report.html"],
    "reduce": ["reduce", "rig", "--out", "out/records.nc", *FAST],
    "assess": ["assess", "closed/results.nc", "--figure", "out/tests.png"],
    "simulate": ["simulate", "spring.py", "--like", "rig", "--out", "out", "--jobs", "1"],
    "replicate": ["replicate", "rig", "-m", "spring.py", "-n", "40", "--out", "out", *FAST],
    "trace": ["trace", "rig", "-m", "spring.py", "--out", "out", *FAST],
    "sample": ["sample", "rig", "-m", "spring.py", "--quick", "--out", "out", *FAST],
    "close": ["close", "rig", "-m", "spring.py", "--quick", "--max-effects", "1", "--out", "out",
              *FAST],
}  # fmt: skip
SEGFAULTS = (-signal.SIGSEGV, -signal.SIGABRT, -signal.SIGBUS)


@dataclass
class Outcome:
    """How a command ended.

    Parameters
    ----------
    status : int
        Exit status; the negative of a signal.
    told : str
        What it said on standard error.
    changes : int
        How often it changed the disk.
    """

    status: int
    told: str = ""
    changes: int = 0

    @property
    def answered(self) -> bool:
        """Whether it said in one line what is wrong."""
        lines = [line for line in self.told.splitlines() if line.startswith("error: ")]
        return self.status in (2, 3) and len(lines) == 1 and "Traceback" not in self.told


@dataclass
class Count:
    """What happened so far."""

    kills: int = 0
    kills_recovered: int = 0
    faults: int = 0
    faults_answered: int = 0
    silent_changes: int = 0
    segfaults: int = 0
    mutants: int = 0
    mutants_killed: int = 0
    workers_killed: int = 0
    tasks_lost: int = 0
    remarks: list[str] = field(default_factory=list)

    def fault(self, name: str, outcome: Outcome, right: bool) -> None:
        """Count a fault; ``right`` says whether the result is that of an undisturbed run."""
        self.faults += 1
        self.segfaults += outcome.status in SEGFAULTS
        if outcome.answered or (outcome.status == 0 and right):
            self.faults_answered += 1
            return
        self.silent_changes += outcome.status == 0
        self.remark(name, outcome)

    def kill(self, name: str, outcome: Outcome, recovered: bool) -> None:
        """Count a kill, and whether the same command then came to the same result."""
        self.kills += 1
        self.kills_recovered += recovered
        self.segfaults += outcome.status in SEGFAULTS
        if not recovered:
            self.remark(name, outcome)

    def remark(self, name: str, outcome: Outcome) -> None:
        self.remarks.append(f"{name}: status {outcome.status}; {outcome.told.strip()[-400:]}")


def command(
    arguments: list[str], folder: Path, before: Callable[[], None] = lambda: None
) -> Outcome:
    """Run a command in a process of its own, which begins with everything imported."""
    told, counted = folder / ".told", folder / ".counted"
    child = os.fork()
    if child == 0:
        _be_command(arguments, folder, told, counted, before)
    watch = Watch(child)
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        if watch.over():
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return Outcome(-signal.SIGALRM, watch.said)
        time.sleep(0.01)
    text = told.read_text("utf-8", "replace")
    changes = int(counted.read_text() or 0) if counted.exists() else 0
    for file in (told, counted):
        file.unlink(missing_ok=True)
    return Outcome(os.waitstatus_to_exitcode(status), text, changes)


class Watch:
    """Whether a command has taken too long, or does nothing any more.

    Parameters
    ----------
    group : int
        Process group of the command: it and the processes that it began.
    """

    def __init__(self, group: int) -> None:
        self.group, self.used, self.said = group, 0.0, ""
        self.looked = self.moved = time.monotonic()

    def over(self) -> bool:
        """Whether it must be ended; ``said`` tells why."""
        now = time.monotonic()
        if now < self.looked + 1.0:
            return False
        self.looked = now
        used = cpu_of(self.group)
        if used is None or used > self.used:  # where CPU times cannot be read, only a limit counts
            self.moved = now if used is not None else self.moved
            self.used = used or 0.0
        if self.used > PATIENCE:
            self.said = f"took too long: {self.used:.0f} s of CPU"
        elif now > self.moved + PATIENCE:
            self.said = f"hangs: no CPU used for {PATIENCE} s"
        return bool(self.said)


def cpu_of(group: int) -> float | None:
    """CPU seconds of the processes of a group and of those that they waited for."""
    if sys.platform != "linux":
        return None
    ticks = 0
    for file in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):  # it has ended
            words = file.read_text("utf-8", "replace").rpartition(")")[2].split()
            if int(words[2]) == group:
                ticks += sum(map(int, words[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def _be_command(
    arguments: list[str], folder: Path, told: Path, counted: Path, before: Callable[[], None]
) -> None:
    """The child of :func:`command`; it never returns."""
    status = 1
    try:
        os.setpgid(0, 0)  # with what it begins, so that all of it can be watched and ended
        os.chdir(folder)
        for number, file in ((1, os.devnull), (2, told)):
            os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
        sys.stderr = open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
        sys.argv = ["bayesoleo", *arguments]
        file = os.open(counted, os.O_WRONLY | os.O_CREAT)
        sys.addaudithook(Changes(lambda number: os.pwrite(file, str(number).encode(), 0)))
        before()
        main()
    except SystemExit as stop:
        status = int(stop.code or 0)
    except BaseException as error:
        print(f"Traceback: {type(error).__name__}: {error}", file=sys.stderr)
    finally:
        sys.stderr.flush()
        os._exit(status)


class Changes:
    """An audit hook that is told each change of the disk, just before it happens."""

    def __init__(self, act: Callable[[int], object]) -> None:
        self.count, self.act = 0, act

    def __call__(self, event: str, arguments: tuple[object, ...]) -> None:
        if event == "open":
            path, _, flags = arguments
            if not (isinstance(flags, int) and flags & os.O_CREAT) or path == os.devnull:
                return
        elif event not in CHANGES:
            return
        self.count += 1
        self.act(self.count)


def killed_at(number: int) -> Callable[[], None]:
    """Have the process killed at its n-th change of the disk."""

    def act(count: int) -> None:
        if count == number:
            os.kill(os.getpid(), signal.SIGKILL)

    return lambda: sys.addaudithook(Changes(act))


def full_from(number: int, only: bool = False) -> Callable[[], None]:
    """Have the disk full from the n-th change on, or at that one only."""

    def act(count: int) -> None:
        if count == number or (count > number and not only):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def hook(event: str, arguments: tuple[object, ...]) -> None:
        if event in ("open", "os.mkdir"):  # removing and renaming need no room
            changes(event, arguments)

    changes = Changes(act)
    return lambda: sys.addaudithook(hook)


# -- what a result holds ----------------------------------------------------------------------


#: Of a summary and of a page: what differs from run to run.
MOMENTS = re.compile(rb"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d)?(\+\d\d:\d\d)?")


def content(out: Path) -> dict[str, str]:
    """Digest of what each file of a folder says; moments, and what resuming needs, left out."""
    found = {}
    for file in sorted(item for item in out.rglob("*") if item.is_file()):
        name = file.relative_to(out).as_posix()
        if name.startswith(("checkpoints/", "block-", "slot-", "replication-")) or "/." in name:
            continue
        if name.startswith(".") or file.name == "SHA256SUMS":
            continue
        total = hashlib.sha256()
        if file.suffix == ".nc":
            for node in read_tree(file).subtree:
                for key, variable in sorted(node.to_dataset(inherit=False).variables.items()):
                    total.update(f"{node.path} {key} {variable.dims}".encode())
                    total.update(np.ascontiguousarray(variable.values).tobytes())
        elif file.suffix in (".html", ".png"):  # pictures hold moments and numbers of their own
            total.update(b"whole" if file.read_bytes().rstrip(b"\n").endswith(ENDS) else b"cut")
        else:
            total.update(MOMENTS.sub(b"", file.read_bytes()))
        found[name] = total.hexdigest()
    return found


ENDS = (b"</html>", b"IEND\xaeB`\x82")


def one_result(out: Path) -> bool:
    """Whether files that stand side by side are of one result: they name the same moment."""
    moments = set()
    # The package itself reads what was decided but not yet moved to its place.
    summary, results = current(out / "summary.json"), current(out / "results.nc")
    if summary.exists() and results.exists():
        tree = read_tree(results)
        moments = {summary.read_text(encoding="utf-8"), str(tree.attrs.get("summary"))}
    return len(moments) <= 1


# -- the bench --------------------------------------------------------------------------------


class Bench:
    """A folder with a small campaign and a model, and the results of undisturbed commands."""

    def __init__(self, root: Path, few: bool) -> None:
        for name in MODULES:
            import_module(f"bayesoleo.{name}")
        self.root, self.few, self.count = root, few, Count()
        # A cache of its own, whose bits are flipped; what is compiled already need not be again.
        shutil.copytree(cache_folder(), root / "cache" / "kernels")
        os.environ["BAYESOLEO_CACHE"] = str(root / "cache")
        self.clean = root / "clean"
        make_rig(self.clean)
        self.right: dict[str, tuple[dict[str, str], int]] = {}

    def need_result(self) -> None:
        """Have a result of ``trace`` beside the campaign, for the commands that read one."""
        if not (self.clean / "closed").exists():
            trace = ["trace", "rig", "-m", "spring.py", "--out", "closed", *FAST]
            done = command(trace, self.clean)
            if done.status:
                raise RuntimeError(done.told)

    def place(self, *, after: str | None = None) -> Path:
        """A new folder with the campaign; with the result of a command, if one is named."""
        folder = Path(tempfile.mkdtemp(dir=self.root))
        shutil.copytree(self.clean, folder, dirs_exist_ok=True)
        if after is not None:
            shutil.copytree(self.root / f"right-{after}", folder / "out", dirs_exist_ok=True)
        (folder / "out").mkdir(exist_ok=True)
        return folder

    def undisturbed(self, verb: str) -> tuple[dict[str, str], int]:
        """What a command writes, and how often it changes the disk."""
        if verb not in self.right:
            if verb in ("report", "assess", "trace", "close"):
                self.need_result()
            folder = self.place()
            done = command(VERBS[verb], folder)
            if done.status:
                raise RuntimeError(f"{verb}: {done.told}")
            shutil.copytree(folder / "out", self.root / f"right-{verb}")
            self.right[verb] = content(folder / "out"), done.changes
        return self.right[verb]

    def moments(self, verb: str, most: int) -> list[int]:
        """Changes of the disk at which something happens: the first ones, the last, between."""
        changes = self.undisturbed(verb)[1]
        return sorted(set(np.linspace(1, changes, min(most, changes)).round().astype(int).tolist()))

    def kills(self, verb: str, most: int) -> None:
        """Kill a command, look at what is left, and run it once more."""
        right, _ = self.undisturbed(verb)
        for number in self.moments(verb, most):
            folder = self.place()
            if number % 2 and verb in ("trace", "close"):  # there is an older result
                shutil.copytree(self.clean / "closed", folder / "out", dirs_exist_ok=True)
            first = command(VERBS[verb], folder, killed_at(number))
            whole = one_result(folder / "out")
            # A folder that holds a whole campaign is refused, and need not be made again.
            refused = 2 if verb == "simulate" and content(folder / "out") == right else 0
            again = command(VERBS[verb], folder)
            same = content(folder / "out") == right
            name, ended = f"{verb} killed at {number}", again.status in (0, refused)
            if not (ended and whole and same):
                name += f" (one result {whole}, the same {same})"
            killed = first.status == -signal.SIGKILL or first.status == 0
            self.count.kill(name, again, killed and ended and whole and same)
            shutil.rmtree(folder)

    def full_disk(self, verb: str, most: int) -> None:
        """Let the disk be full from a moment on; an older result must be as it was."""
        right, _ = self.undisturbed(verb)
        for number in self.moments(verb, most):
            folder = self.place()
            done = command(VERBS[verb], folder, full_from(number, only=number % 3 == 0))
            left = content(folder / "out")
            half = not one_result(folder / "out") or any(
                name in right and name.endswith((".html", ".png")) and digest != right[name]
                for name, digest in left.items()
            )
            name = f"{verb}, disk full at {number}"
            if half:
                done = Outcome(0, f"half a result: {sorted(left)}; {done.told}")
            self.count.fault(name, done, left == right)
            shutil.rmtree(folder)

    def real_disk(self) -> None:
        """Write to a disk of so many kilobytes, where such a one can be mounted."""
        for size in (64, 200, 400) if not self.few else (64,):
            folder = self.place()
            mount = ["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", str(folder / "out")]
            if subprocess.run(mount, check=False, capture_output=True).returncode:
                return
            try:
                for verb in ("trace", "sample") if not self.few else ("trace",):
                    done = command(VERBS[verb], folder)
                    right = content(folder / "out") == self.undisturbed(verb)[0]
                    self.count.fault(f"{verb} on a disk of {size} kB", done, right)
            finally:
                subprocess.run(["umount", "-l", str(folder / "out")], check=False)

    def memory(self, verb: str, spare: int) -> None:
        """Leave a command so many megabytes more than it has at its start."""

        def limit() -> None:
            import resource

            pages = int(Path("/proc/self/statm").read_text().split()[0])
            most = pages * resource.getpagesize() + spare * 2**20
            resource.setrlimit(resource.RLIMIT_AS, (most, most))

        if sys.platform != "linux":
            return
        folder = self.place()
        done = command(VERBS[verb], folder, limit)
        right = content(folder / "out") == self.undisturbed(verb)[0]
        self.count.fault(f"{verb} with {spare} MB", done, right)

    def flips(self, many: int) -> None:
        """Flip a bit of a stored file, and read it."""
        rng = np.random.default_rng(17)
        stored = {"trace": "out", "sample": "out", "cache": "../cache"}
        for verb in ("trace", "sample"):
            self.undisturbed(verb)
        for number in range(many):
            kind = list(stored)[number % 3]
            verb = "sample" if kind == "cache" else kind
            folder = self.place(after=verb)
            base = self.root / "cache" if kind == "cache" else folder / "out"
            # A file that is asked for: of each kind, a large one more often than a small one.
            files = sorted(item for item in base.rglob("*") if item.is_file())
            file = files[rng.integers(len(files))]
            flip(file, rng)
            self._read(kind, verb, folder, file)
            shutil.rmtree(folder)

    def _read(self, kind: str, verb: str, folder: Path, file: Path) -> None:
        """Read what was flipped by the command that uses it."""
        name = f"byte of {file.name} flipped"
        if kind == "trace":  # a result, by a command that reads all of it
            arguments = ["assess", "out/results.nc", "--json"]
            done = command(arguments, folder)
            # The sum of another file is not asked for: what is read is right.
            right = file.name == SUMS and done.status == 0
            self.count.fault(name, done, right or str(file.name) in done.told)
        else:  # draws and compiled code, by the command that goes on from them
            done = command(VERBS[verb], folder)
            same = content(folder / "out") == self.undisturbed(verb)[0]
            self.count.fault(name, done, same)

    def clocks(self) -> None:
        """Wrong clocks: a time zone, files from the future and the past, time that runs back."""
        right = self.undisturbed("estimate")[0]

        def zone() -> None:
            os.environ["TZ"] = "Pacific/Kiritimati"
            time.tzset()

        def backwards() -> None:
            now, begun = time.time, time.time()
            time.time = lambda: 2 * begun - now()

        for name, before, moment in (
            ("time zone", zone, None),
            ("time runs back", backwards, None),
            ("files of 2100", lambda: None, 4102444800),
            ("files of 1970", lambda: None, 0),
        ):
            folder = self.place()
            if moment is not None:
                for file in [*folder.rglob("*"), *(self.root / "cache").rglob("*")]:
                    os.utime(file, (moment, moment))
            done = command(VERBS["estimate"], folder, before)
            self.count.fault(name, done, content(folder / "out") == right)

    def locales(self) -> None:
        """Other languages and encodings, which a process has from its start."""
        right = self.undisturbed("estimate")[0]
        odd = [
            {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
            {"LC_ALL": "de_DE.UTF-8", "LANG": "de_DE.UTF-8"},
            {"LC_ALL": "tr_TR.UTF-8", "PYTHONIOENCODING": "ascii"},
        ]
        for environment in odd[: 1 if self.few else None]:
            folder = self.place()
            done = subprocess.run(
                [sys.executable, "-m", "bayesoleo", *VERBS["estimate"]],
                cwd=folder, env=os.environ | environment, capture_output=True, check=False,
            )  # fmt: skip
            outcome = Outcome(done.returncode, done.stderr.decode("utf-8", "replace"))
            self.count.fault(str(environment), outcome, content(folder / "out") == right)

    def inputs(self) -> None:
        """Hostile campaigns; see ``hostile.py``."""
        for name, spoil in list(INPUTS.items())[:: 8 if self.few else 1]:
            folder = self.place()
            arguments, right = spoil(folder)
            around = sorted(self.root.iterdir())
            done = command(arguments, folder)
            kept = sorted(self.root.iterdir()) == around
            self.count.fault(name, done, done.status == 0 and kept and right(folder))
            shutil.rmtree(folder)

    def workers(self) -> None:
        """Kill workers and schedulers of a cluster; see ``lost_workers.py``."""
        self._other("lost_workers.py", *(["--only", "replicate"] if self.few else []))

    def mutants(self) -> None:
        """Change what numbers mean, which the tests must notice; see ``mutants.py``."""
        self._other("mutants.py", *(["--few"] if self.few else []))

    def _other(self, name: str, *options: str) -> None:
        """Count what another benchmark counts, in a process of its own.

        It must not be forked from here: mutants are tried in processes that have not imported the
        package, and clusters begin threads.
        """
        script = Path(__file__).with_name(name)
        arguments = [sys.executable, str(script), "--json", *options]
        done = subprocess.run(arguments, stdout=subprocess.PIPE, text=True, check=True)
        for key, value in json.loads(done.stdout).items():
            if hasattr(self.count, key):
                setattr(self.count, key, value)


def make_rig(folder: Path) -> None:
    """The small campaign of the tests of the command line, and its model."""
    (folder / "rig").mkdir(parents=True)
    (folder / "rig" / "campaign.toml").write_text(CAMPAIGN, encoding="utf-8")
    for label, frequency in (("slow", 1.0), ("fast", 2.0)):
        write_rows(folder / "rig" / f"{label}.csv", rows(frequency))
    (folder / "spring.py").write_text(MODEL, encoding="utf-8")


def flip(file: Path, rng: np.random.Generator) -> None:
    """Turn one bit of a file."""
    whole = bytearray(file.read_bytes())
    if whole:
        whole[rng.integers(len(whole))] ^= 1 << int(rng.integers(8))
    file.write_bytes(whole)


#: Commands that take seconds, and the moments of each that are tried.
SLOW, OFTEN, SELDOM = ("trace", "sample", "close"), 8, 4


def measure(
    few: bool = False,
    only: str = "",
    share: float = 1.0,
    report: Callable[[str], None] = lambda _: None,
    store: Path | None = None,
) -> Count:
    """Try all faults, a sample of them, or those whose name begins with one of some words.

    ``share`` is that of the moments at which a command is killed, and of the bits. Steps that
    ``store`` has counted are not taken again.
    """
    options = {"code": package_digest(), "few": few, "share": share}
    counted = counted_before(store, options)
    with tempfile.TemporaryDirectory(prefix="faults-") as root:
        bench = Bench(Path(root), few)
        for name, step in steps(bench, share):
            if not name.startswith(tuple(only.split(","))):
                continue
            report(name)
            if name not in counted:
                bench.count = Count()
                step()
                counted[name] = vars(bench.count)
                if store is not None:
                    write_text_atomic(store, json.dumps(options | {"counted": counted}, indent=1))
            for remark in counted[name]["remarks"]:
                report(f"  {remark}")
    total = Count()
    for one in counted.values():
        for key, value in one.items():
            setattr(total, key, getattr(total, key) + value)
    return total


def counted_before(store: Path | None, options: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What a run of the same code with the same options counted, by step."""
    if store is None or not store.exists():
        return {}
    found = json.loads(store.read_text(encoding="utf-8"))
    if any(found[key] != value for key, value in options.items()):
        raise SystemExit(f"error: {store} is of other code or other options; choose another file")
    return dict(found["counted"])


def steps(bench: Bench, share: float) -> Iterator[tuple[str, Callable[[], None]]]:
    """What is tried, one after the other."""
    for verb in ("reduce", "simulate") if bench.few else VERBS:
        most = 2 if bench.few else max(1, round(share * (SELDOM if verb in SLOW else OFTEN)))
        yield f"kill {verb}", partial(bench.kills, verb, most)
        yield f"fill the disk of {verb}", partial(bench.full_disk, verb, most)
    yield "hostile input", bench.inputs
    if not bench.few:
        yield "a small disk", bench.real_disk
        yield "flipped bits", partial(bench.flips, max(3, round(share * 51)))
        yield "clocks", bench.clocks
        yield "locales", bench.locales
        for spare in (1, 30, 100):
            yield f"{spare} MB", partial(bench.memory, "estimate", spare)
    yield "workers", bench.workers
    yield "mutants", bench.mutants


def cli() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--few", action="store_true", help="a sample of the faults")
    parser.add_argument("--only", default="", help="steps, by their first words: kill,clocks")
    parser.add_argument("--share", type=float, default=1.0, help="of moments and bits tried")
    parser.add_argument("--store", type=Path, help="file of steps that are counted, to go on from")
    wanted = parser.parse_args()
    warnings.filterwarnings("ignore", message=".*multi-threaded.*")  # the child starts no thread
    told = partial(print, file=sys.stderr, flush=True)
    count = measure(wanted.few, wanted.only, wanted.share, told, wanted.store)
    figures = {key: int(value) for key, value in vars(count).items() if key != "remarks"}
    if wanted.json:
        print(json.dumps(figures))
    else:
        print("\n".join(f"{key:18}{value:6}" for key, value in figures.items()))


if __name__ == "__main__":
    cli()
