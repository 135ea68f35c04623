"""Work of one calculation in several processes: the same results, whatever becomes of them."""

from __future__ import annotations

import importlib.util
import io
import os
import platform
import signal
import subprocess
import sys
import threading
import time
import types
from pathlib import Path

import numpy as np
import pytest

import bayesoleo._kept_processes as kept_processes
import bayesoleo._process_messages as messages
import bayesoleo._worker_processes as processes
from bayesoleo._compiled import COMPILED_ONCE, compilation_told, is_compiled
from bayesoleo._parallel import limit_threads
from bayesoleo._worker_processes import process_map


@pytest.fixture
def eager(monkeypatch):
    """A process is there, and is asked as soon as there is work."""
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    monkeypatch.setattr(processes, "WORTH_STARTING", 0.0)
    monkeypatch.setattr(processes, "WORTH_ASKING", 0.0)
    # It answers once it has begun.
    kept_processes.process_of(0).ask(messages.dumps((None, None, None)))


@pytest.fixture(scope="module", autouse=True)
def ended():
    yield
    kept_processes.end_processes()


def slow_square(shared, item):
    time.sleep(0.1)
    return os.getpid(), shared["unit"] * item**2


def square_in_company(folder, item):
    """It waits until two processes are at work: on a busy machine one could have done all."""
    (folder / str(os.getpid())).touch()
    for _ in range(1200):
        if len(list(folder.iterdir())) > 1:
            break
        time.sleep(0.05)
    return os.getpid(), item**2


def test_results_come_in_order_from_several_processes(eager, tmp_path):
    found = process_map(square_in_company, tmp_path, range(12), 2)
    assert [value for _, value in found] == [k**2 for k in range(12)]
    assert len({number for number, _ in found}) == 2


def test_a_process_is_kept_for_the_next_call(eager, tmp_path):
    (tmp_path / "first").mkdir()
    (tmp_path / "again").mkdir()
    first = {n for n, _ in process_map(square_in_company, tmp_path / "first", range(12), 2)}
    again = {n for n, _ in process_map(square_in_company, tmp_path / "again", range(12), 2)}
    assert len(first) == 2
    assert again == first


def test_what_a_process_loads_is_kept_out_of_searches_for_garbage(tmp_path):
    (tmp_path / "lasting.py").write_text("kept = [[number] for number in range(1000)]\n")
    code = (
        "import gc; from bayesoleo._kept_processes import load; before = gc.get_freeze_count();"
        " load(['lasting']); import lasting; loaded = gc.get_freeze_count();"
        " later = [[]]; load(['lasting']); assert gc.isenabled();"
        " print(before, loaded - before >= 1000, gc.get_freeze_count() == loaded,"
        " gc.get_threshold()[0] > 2000)"
    )
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": path}
    command = [sys.executable, "-c", code]
    said = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["0", "True", "True", "True"]


def test_searches_for_garbage_that_are_off_stay_off(tmp_path):
    code = (
        "import gc; from bayesoleo._kept_processes import load; gc.set_threshold(0);"
        " load(['wave']); assert gc.get_threshold()[0] == 0"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library")
def test_memory_that_arrays_have_left_serves_the_next_ones():
    """In a process of its own, since the setting lasts: no new page, which the system would fill
    with zeros."""
    code = (
        "import resource, sys; import numpy as np;"
        " from bayesoleo._kept_processes import keep_memory;"
        " faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt;"
        " work = lambda: [len([np.ones(300_000) for _ in range(4)]) for _ in range(20)];"
        " keep_memory() if sys.argv[1] == 'kept' else None;"
        " work(); before = faults(); work(); print(faults() - before)"
    )
    kept, usual = (
        int(
            subprocess.run(
                [sys.executable, "-c", code, how], capture_output=True, check=True
            ).stdout
        )
        for how in ("kept", "usual")
    )
    # 80 arrays of 586 pages, or of fewer where the system gives larger ones: a few faults are those
    # of Python itself.
    assert kept < 500
    assert 5 * kept + 500 < usual


@pytest.mark.parametrize("library", [OSError, TypeError, None])
def test_where_the_library_cannot_be_told_nothing_happens(monkeypatch, library):
    def opened(name):
        if library is not None:
            raise library
        return object()

    monkeypatch.setattr(kept_processes.ctypes, "CDLL", opened)
    kept_processes.keep_memory()
    kept_processes.give_back_memory()


def test_a_process_serves_where_its_pipes_cannot_be_widened(eager, monkeypatch, tmp_path):
    """A user's pipes may hold 64 MiB together, and the system may allow less of one."""
    fcntl = pytest.importorskip("fcntl")

    def refused(*_):
        raise PermissionError(1, "Operation not permitted")

    kept_processes.end_processes()
    monkeypatch.setattr(fcntl, "fcntl", refused)
    found = process_map(square_in_company, tmp_path, range(12), 2)
    assert len({number for number, _ in found}) == 2


def test_threads_that_ask_at_once_get_the_same_process(monkeypatch):
    """A second process would be forgotten, and its pipes left open."""
    made, both = [], threading.Barrier(2)

    def slow(_modules):
        made.append(types.SimpleNamespace(process=types.SimpleNamespace(poll=lambda: None)))
        time.sleep(0.1)  # the other thread asks meanwhile
        return made[-1]

    def ask():
        both.wait()
        got.append(kept_processes.process_of(0))

    got: list = []
    monkeypatch.setattr(kept_processes, "Worker", slow)
    monkeypatch.setattr(kept_processes, "kept", {})
    threads = [threading.Thread(target=ask) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1
    assert got == [made[0], made[0]]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no copies of processes on this system")
def test_a_forked_copy_can_start_processes_of_its_own(monkeypatch):
    """A thread held the lock at the time of the fork; the copy has no such thread."""
    monkeypatch.setattr(kept_processes, "kept", {0: "of the first one"})
    begun, end = threading.Event(), threading.Event()

    def hold():
        with kept_processes._starting:
            begun.set()
            end.wait(60)

    thread = threading.Thread(target=hold)
    thread.start()
    assert begun.wait(60)
    child = os.fork()
    if not child:
        free = kept_processes._starting.acquire(timeout=10)
        os._exit(0 if free and not kept_processes.kept else 1)
    end.set()
    thread.join()
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert kept_processes.kept  # the first one keeps its own


def test_short_work_after_something_long_starts_no_process(monkeypatch):
    kept_processes.end_processes()
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    found = process_map(shifted, 1, range(200), 3, before=lambda: time.sleep(0.3))
    assert {number for number, _ in found} == {os.getpid()}
    assert not kept_processes.kept


def test_the_time_of_items_is_counted_from_the_first_one_done_here(monkeypatch):
    """Others may have done some before it, in no time of this process."""
    call = processes._Call(shifted, 1, list(range(130)), lambda _: (), range(130), 2)
    monkeypatch.setattr(kept_processes, "kept", {})
    monkeypatch.setattr(processes, "kept", {})
    call.found = dict.fromkeys(range(30))
    call.begun -= 10.0
    assert not call._worth(1)  # nothing is done here yet
    call.begin()
    call.found[30] = None
    call.begun -= 0.35  # its time: some thirty seconds are left
    assert call._worth(1)


@pytest.mark.skipif(sys.platform == "win32", reason="pipes cannot be waited for")
def test_a_process_that_rests_gives_back_its_memory(monkeypatch):
    calls = []
    monkeypatch.setattr(kept_processes, "RESTING", 0.05)
    monkeypatch.setattr(kept_processes, "IDLE", 0.1)
    monkeypatch.setattr(kept_processes, "give_back_memory", lambda: calls.append("given back"))
    source, target = os.pipe()
    with os.fdopen(source, "rb") as stream:
        assert not kept_processes._waits(stream)
        assert calls == ["given back"]
        os.write(target, b"something")
        assert kept_processes._waits(stream)
        assert calls == ["given back"]
    os.close(target)


def test_short_work_starts_no_process(monkeypatch):
    kept_processes.end_processes()
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    pids = {number for number, _ in process_map(slow_square, {"unit": 1.0}, range(3), 2)}
    assert pids == {os.getpid()}
    assert not kept_processes.kept


@pytest.mark.parametrize("reason", ["one job", "limited", "forbidden"])
def test_everything_is_done_here(eager, monkeypatch, reason):
    if reason == "forbidden":
        monkeypatch.setenv("BAYESOLEO_PROCESSES", "0")
    if reason == "limited":  # as in a process that is a worker itself
        limit_threads(1)
    try:
        found = process_map(slow_square, {"unit": 1.0}, range(4), 1 if reason == "one job" else 2)
    finally:
        limit_threads(None)
    assert found == [(os.getpid(), float(k**2)) for k in range(4)]


def leaves_a_mark(folder, item):
    (folder / str(os.getpid())).touch()
    return item


def test_other_work_comes_first_here_while_another_process_does_items(eager, tmp_path):
    seen = set()

    def first():
        for _ in range(1200):  # a busy machine takes its time
            seen.update(path.name for path in tmp_path.iterdir())
            if seen:
                return
            time.sleep(0.05)

    assert process_map(leaves_a_mark, tmp_path, range(4), 2, before=first) == [0, 1, 2, 3]
    assert seen
    assert str(os.getpid()) not in seen


def test_other_work_comes_first_where_everything_is_done_here(tmp_path):
    done = []
    found = process_map(leaves_a_mark, tmp_path, range(4), 1, before=lambda: done.append(1))
    assert (found, done) == ([0, 1, 2, 3], [1])


def test_what_comes_first_here_may_fail(eager):
    def first():
        raise ValueError("no place")

    with pytest.raises(ValueError, match="no place"):
        process_map(slow_square, {"unit": 1.0}, range(4), 2, before=first)
    assert len(process_map(slow_square, {"unit": 1.0}, range(4), 2)) == 4


def fails_late(shared, item):
    time.sleep(0.1)
    if item == shared:
        raise ValueError(f"item {item}")
    return item


@pytest.mark.parametrize("where", [0, 11])
def test_an_error_is_passed_on_from_either_process(eager, where):
    with pytest.raises(ValueError, match=f"item {where}"):
        process_map(fails_late, where, range(12), 2)


def fails_or_takes_long(parent, item):
    if os.getpid() != parent and item == 11:
        raise ValueError("item 11")
    time.sleep(0.1 if os.getpid() == parent else 60.0)
    return item


def test_an_error_does_not_wait_for_what_a_process_has_in_hand(eager):
    began = time.monotonic()
    with pytest.raises(ValueError, match="item 11"):
        process_map(fails_or_takes_long, os.getpid(), range(12), 2)
    assert time.monotonic() - began < 30.0  # half of what the item in hand would take
    assert len(process_map(slow_square, {"unit": 1.0}, range(4), 2)) == 4


def fails_beside_others(parent, item):
    """Another process than the one that fails has long items, this one short ones."""
    if os.getpid() != parent and item == 29:
        time.sleep(1.0)  # until the other one has its next in hand
        raise ValueError("item 29")
    time.sleep(0.3 if os.getpid() == parent else 6.0)
    return item


def test_an_error_does_not_wait_for_what_others_have_in_hand(eager):
    for number in (0, 1):
        kept_processes.process_of(number).ask(messages.dumps((None, None, None)))
    began = time.monotonic()
    with pytest.raises(ValueError, match="item 29"):
        process_map(fails_beside_others, os.getpid(), range(30), 3)
    assert time.monotonic() - began < 10.0  # two items of the other one take twelve
    kept_processes.forget(1)


def test_what_nobody_waits_for_is_not_given_to_another_process():
    call = processes._Call(slow_square, {"unit": 1.0}, list(range(3)), lambda _: (), range(3), 1)
    index = call._take(last=True)
    call._give_back(index)
    assert call._take(last=False) == index
    call.stop()
    call._give_back(index)
    assert not call.left


def square_behind_another(shared, item):
    """This process waits for three items of the other one, which a busy machine may hold up."""
    parent, folder = shared
    if os.getpid() != parent:
        (folder / str(item)).touch()
    for _ in range(1200 if os.getpid() == parent else 0):
        if len(list(folder.iterdir())) > 2:
            break
        time.sleep(0.05)
    return item**2


def test_a_process_has_its_next_item_before_its_answer_is_read(eager, monkeypatch, tmp_path):
    """None of the last few: another process may be through before it begins with one."""
    events, rightly = [], processes.content_of
    send, answer = kept_processes.Worker.send, kept_processes.Worker.answer

    def noted(name, function):
        def called(*given):
            events.append(name)
            return function(*given)

        return called

    monkeypatch.setattr(kept_processes.Worker, "send", noted("send", send))
    monkeypatch.setattr(kept_processes.Worker, "answer", noted("answer", answer))
    monkeypatch.setattr(processes, "content_of", noted("read", rightly))
    count = 3 * processes.LEFT_TO_OTHERS
    found = process_map(square_behind_another, (os.getpid(), tmp_path), range(count), 2)
    assert found == [k**2 for k in range(count)]
    # First it is told what to do, and at last that there is no more.
    items = events[events.index("send", 1) : -2]
    assert items[:4] == ["send", "answer", "send", "read"]
    assert items.count("send") == items.count("answer") == items.count("read")


def kills_its_process(parent, item):
    time.sleep(0.1)
    if os.getpid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


def test_the_work_of_a_lost_process_is_done_here(eager):
    assert process_map(kills_its_process, os.getpid(), range(12), 2) == list(range(12))


def test_processes_that_were_killed_are_not_asked_again(eager):
    first = kept_processes.process_of(0)
    for _ in range(3):
        killed = kept_processes.process_of(0)
        kept_processes.kill_processes()
        assert kept_processes.process_of(0) is not killed
    assert first.process.returncode == -signal.SIGKILL
    kept_processes.process_of(0).ask(messages.dumps((None, None, None)))


class UnknownElsewhere:
    """Cannot be read by another process."""

    def __reduce__(self):
        return _only_here, (os.getpid(),)


def _only_here(number):
    if os.getpid() != number:
        raise ImportError("a module that only one process has")
    return UnknownElsewhere()


def times_two(shared, item):
    time.sleep(0.1)
    return 2 * item


def test_what_cannot_be_sent_is_done_here(eager):
    assert process_map(times_two, UnknownElsewhere(), range(12), 2) == [2 * k for k in range(12)]


def same_array(shared, item):
    time.sleep(0.1)
    return shared[item % 2], item


def test_results_refer_to_what_is_known(eager):
    shared = (np.arange(3.0), np.arange(4.0))
    found = process_map(same_array, shared, range(12), 2, known=tuple)
    assert all(array is shared[item % 2] for array, item in found)


def leave_a_mark():
    Path(os.environ["MARK"]).write_text(str(os.getpid()))


def test_a_call_that_nobody_waits_for(eager, tmp_path, monkeypatch):
    monkeypatch.setenv("MARK", str(tmp_path / "mark"))
    kept_processes.begin_elsewhere("test_worker_processes", "leave_a_mark")
    deadline = time.monotonic() + 60  # a busy machine takes seconds to start a process
    while not (tmp_path / "mark").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(0.1)
    assert int((tmp_path / "mark").read_text()) != os.getpid()


SLOW_SUM = """
from bayesoleo._compiled import jit

@jit
def total(a, b):
    return a + b
"""


def test_that_something_is_compiled_is_told_once(tmp_path):
    (tmp_path / "summing.py").write_text(SLOW_SUM)
    spec = importlib.util.spec_from_file_location("summing", tmp_path / "summing.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    said: list[str] = []
    assert not is_compiled(module.total)
    with compilation_told(said.append):
        assert module.total(1.0, 2.0) == 3.0
        assert module.total(1, 2) == 3
    assert said == [COMPILED_ONCE]
    assert is_compiled(module.total)
    with compilation_told(said.append):
        module.total(2.0, 2.0)
    assert said == [COMPILED_ONCE]
    module.total(True, 1.0)  # nobody listens any more
    assert said == [COMPILED_ONCE]


def with_a_lock(shared, item):
    time.sleep(0.1)
    return threading.Lock()


@pytest.mark.parametrize("shared", [None, threading.Lock()], ids=["result", "shared"])
def test_what_cannot_be_pickled_is_done_here(eager, shared):
    assert len(process_map(with_a_lock, shared, range(8), 2)) == 8


def test_two_threads_do_not_take_each_others_results(eager):
    found = {}

    def work(unit):
        found[unit] = [v for _, v in process_map(slow_square, {"unit": unit}, range(12), 2)]

    threads = [threading.Thread(target=work, args=(unit,)) for unit in (1.0, 100.0)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert found == {unit: [unit * k**2 for k in range(12)] for unit in (1.0, 100.0)}


def test_files_of_the_folder_are_not_run_and_odd_paths_do_no_harm(eager, tmp_path, monkeypatch):
    kept_processes.end_processes()
    (tmp_path / "json.py").write_text("raise SystemExit")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", [*sys.path, tmp_path / "no text"])
    kept_processes.process_of(0).ask(messages.dumps((None, None, None)))
    (tmp_path / "marks").mkdir()
    found = process_map(square_in_company, tmp_path / "marks", range(12), 2)
    assert len({number for number, _ in found}) == 2


def test_the_largest_of_several_comes_back_as_it_was():
    """Without comparing its arguments anew, nested ones included."""
    import sympy as sp  # other processes load this file, and wait for what it loads

    x, y, z = sp.symbols("x y z", real=True)
    sent = sp.Max(x, y - 1, sp.Min(z, x * y, 3)) ** 2 + sp.Abs(x)
    found = messages.loads(messages.dumps({"term": sent}))["term"]
    assert found == sent
    assert hash(found) == hash(sent)
    assert sp.diff(found, x) == sp.diff(sent, x)
    assert found.subs({x: 2, y: 5, z: 1}) == sent.subs({x: 2, y: 5, z: 1}) == 18


def where_and_twice(value):
    if value == "wrong":
        raise ValueError(value)
    if isinstance(value, list):
        return os.getpid(), 2 * value[0]
    return os.getpid(), 2 * value


def test_a_long_call_is_done_beside(eager):
    pid, value = processes.Beside.begun(where_and_twice, 21, 2).result()
    assert value == 42
    assert pid != os.getpid()
    assert processes.Beside.begun(where_and_twice, 1, 2).result() == (pid, 2)  # it is free again


def test_what_it_raises_is_raised_where_the_result_is_asked_for(eager):
    beside = processes.Beside.begun(where_and_twice, "wrong", 2)
    with pytest.raises(ValueError, match="wrong"):
        beside.result()
    assert processes.Beside.begun(where_and_twice, 3, 2).result()[1] == 6


@pytest.mark.parametrize("lost", [False, True])
def test_the_argument_is_taken_as_it_was(eager, monkeypatch, lost):
    """What this process does to it meanwhile counts nowhere, in the other process or here."""
    if lost:
        kept_processes.process_of(0).process.kill()
        monkeypatch.setattr(processes, "process_of", lambda number: kept_processes.kept[number])
    argument = [4]
    beside = processes.Beside.begun(where_and_twice, argument, 2)
    argument[0] = 7
    pid, value = beside.result()
    assert beside.result() == (pid, value)
    assert value == 8
    assert (pid == os.getpid()) == lost


def shifted(shared, item):
    if item == "wrong":
        raise ValueError(item)
    return os.getpid(), shared + item


def test_the_process_goes_on_with_other_work_until_that_is_taken(eager):
    then = shifted, 100, [1, 2, "wrong", 4]
    beside = processes.Beside.begun(where_and_twice, 21, 2, then)
    pid, value = beside.result()
    assert value == 42
    beside._thread.join()  # until all is done
    assert beside.taken() == {0: (pid, 101), 1: (pid, 102), 3: (pid, 104)}
    assert processes.Beside.begun(where_and_twice, 1, 2).result() == (pid, 2)  # it is free again


def waits(shared, item):
    time.sleep(item)
    return item


def test_no_more_of_it_is_begun_once_it_is_taken(eager):
    beside = processes.Beside.begun(where_and_twice, 1, 2, (waits, None, [0.05, 1.0, *[30.0] * 9]))
    assert beside.result()[1] == 2
    while 0 not in beside._items:
        time.sleep(0.01)
    found = beside.taken()  # the one that it is at comes too
    assert found == {0: 0.05, 1: 1.0}
    assert not processes._in_use.locked()


def test_a_process_lost_in_other_work_costs_only_that(eager):
    beside = processes.Beside.begun(where_and_twice, 1, 2, (waits, None, [0.1, 60.0]))
    assert beside.result()[1] == 2
    while 0 not in beside._items:
        time.sleep(0.01)
    kept_processes.kill_processes()
    assert beside.taken() == {0: 0.1}
    assert beside.result()[1] == 2
    assert processes.Beside.begun(where_and_twice, 3, 2).result()[1] == 6


def test_other_work_may_be_named_once_the_call_goes_on(eager):
    beside = processes.Beside.begun(waits_and_doubles, 1.0, 2)
    beside.go_on_with(shifted, 100, [1, 2])
    assert beside.result() == 2.0
    beside._thread.join()
    assert [value for _, value in beside.taken().values()] == [101, 102]
    # Too late: it has answered, and ends.
    beside = processes.Beside.begun(where_and_twice, 4, 2)
    beside._thread.join()
    beside.go_on_with(shifted, 100, [1, 2])
    assert not beside._more
    assert beside.result()[1] == 8
    assert beside.taken() == {}
    # What cannot be sent is told, and takes nothing from the call.
    beside = processes.Beside.begun(where_and_twice, 5, 2)
    with pytest.raises(kept_processes.LostError):
        beside.go_on_with(shifted, 100, [Unsendable()])
    assert beside.result()[1] == 10
    assert beside.taken() == {}
    assert not processes._in_use.locked()


def test_it_may_end_with_one_more_item_before_all_others(eager):
    beside = processes.Beside.begun(where_and_twice, 1, 2, (waits, None, [0.05, 1.0, *[30.0] * 9]))
    assert beside.result()[1] == 2
    while 0 not in beside._items:
        time.sleep(0.01)
    assert beside.goes_on
    beside.end_with(shifted, 100, 7)
    found = beside.taken()
    assert (found.pop(0), found.pop(1)) == (0.05, 1.0)  # the one that it was at comes too
    assert [value for _, value in found.values()] == [107]
    assert not beside.goes_on
    beside.end_with(shifted, 100, 8)  # too late
    assert beside.taken() == {0: 0.05, 1: 1.0, **found}
    assert not processes._in_use.locked()


def test_what_it_cannot_be_sent_takes_nothing_from_the_rest(eager):
    beside = processes.Beside.begun(where_and_twice, 1, 2, (waits, None, [0.5, 0.01]))
    assert beside.result()[1] == 2
    with pytest.raises(kept_processes.LostError):
        beside.end_with(shifted, 100, Unsendable())
    beside._thread.join()
    assert beside.taken() == {0: 0.5, 1: 0.01}


def test_a_process_lost_before_its_last_item_leaves_what_it_had_done(eager):
    beside = processes.Beside.begun(where_and_twice, 1, 2, (waits, None, [0.01, 60.0]))
    assert beside.result()[1] == 2
    while 0 not in beside._items:
        time.sleep(0.01)
    beside.end_with(shifted, 100, 7)
    kept_processes.kill_processes()
    assert beside.taken() == {0: 0.01}
    assert not beside.goes_on


def waits_and_doubles(seconds):
    time.sleep(seconds)
    return 2 * seconds


class Unsendable(int):
    def __reduce__(self):
        raise TypeError("it stays here")


@pytest.mark.parametrize("reason", ["one job", "many jobs", "cannot be sent", "forbidden"])
def test_nothing_is_begun_beside_where_that_makes_no_sense(eager, monkeypatch, reason):
    jobs = {"one job": 1, "many jobs": 8}.get(reason, 2)
    monkeypatch.setattr(processes.parallel, "thread_limit", lambda: 8)
    if reason == "forbidden":
        monkeypatch.setenv("BAYESOLEO_PROCESSES", "0")
    argument = Unsendable(4) if reason == "cannot be sent" else 4
    assert processes.Beside.begun(where_and_twice, argument, jobs) is None
    monkeypatch.delenv("BAYESOLEO_PROCESSES", raising=False)
    other = processes.Beside.begun(time.sleep, 0.5, 2)  # the processes are free
    assert processes.Beside.begun(where_and_twice, 1, 2) is None  # and are not now
    assert other.result() is None
    assert not processes._in_use.locked()


def test_one_that_nobody_waits_for_is_ended(eager):
    with pytest.raises(KeyboardInterrupt), processes.Beside.begun(time.sleep, 60.0, 2):
        raise KeyboardInterrupt
    assert not processes._in_use.locked()
    assert processes.Beside.begun(where_and_twice, 5, 2).result()[1] == 10


def test_an_interrupt_while_it_begins_frees_the_processes_once(eager, monkeypatch):
    start, errors = threading.Thread.start, []

    def interrupted(thread):
        start(thread)
        raise KeyboardInterrupt

    monkeypatch.setattr(threading, "excepthook", errors.append)
    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", interrupted)
        with pytest.raises(KeyboardInterrupt):
            processes.Beside.begun(time.sleep, 60.0, 2)
    assert not errors  # a second release is one
    assert not processes._in_use.locked()
    assert processes.Beside.begun(where_and_twice, 5, 2).result()[1] == 10


def test_a_thread_that_cannot_start_leaves_the_processes_free(eager, monkeypatch):
    def refused(thread):
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patch:
        patch.setattr(threading.Thread, "start", refused)
        with pytest.raises(RuntimeError, match="new thread"):
            processes.Beside.begun(time.sleep, 60.0, 2)
    assert not processes._in_use.locked()


def test_a_process_that_is_done_is_not_ended(eager):
    beside = processes.Beside.begun(where_and_twice, 5, 2)
    pid, _ = beside.result()
    beside.drop()
    assert processes.Beside.begun(where_and_twice, 6, 2).result() == (pid, 12)


def test_a_call_that_is_dropped_before_there_is_a_process_is_not_made(eager, monkeypatch):
    rightly, begin = processes.process_of, threading.Event()

    def late(number):
        begin.wait(60.0)
        return rightly(number)

    monkeypatch.setattr(processes, "process_of", late)
    beside = processes.Beside.begun(time.sleep, 60.0, 2)
    threading.Timer(0.2, begin.set).start()
    begun = time.monotonic()
    beside.drop()
    assert time.monotonic() - begun < 30.0  # a process is started at most
    assert not processes._in_use.locked()
    assert processes.Beside.begun(where_and_twice, 5, 2).result()[1] == 10


@pytest.mark.parametrize("size", [3, 400], ids=["within the pickle", "beside it"])
def test_arrays_come_as_they_were_and_are_their_owners(eager, size):
    rng = np.random.default_rng(3)
    table = rng.standard_normal((size, size + 1))
    shared = {"table": table.copy(), "strided": np.asfortranarray(table)[::2, ::3]}
    assert (table.nbytes >= messages.LARGE) == (size > 100)
    pid, found = processes.Beside.begun(where_and_copied, shared, 2).result()
    assert pid != os.getpid()
    found["table"] += 1.0
    np.testing.assert_array_equal(found["table"], table + 1.0)
    np.testing.assert_array_equal(found["strided"], shared["strided"])
    np.testing.assert_array_equal(shared["table"], table)


def where_and_copied(value):
    return os.getpid(), value


def where_and_doubled(value):
    value *= 2.0  # what a call gets is its own
    return os.getpid(), value


@pytest.mark.parametrize("lost", [False, True])
def test_a_large_argument_is_taken_as_it_was(eager, monkeypatch, lost):
    if lost:
        kept_processes.process_of(0).process.kill()
        monkeypatch.setattr(processes, "process_of", lambda number: kept_processes.kept[number])
    argument = np.ones(2 * messages.LARGE)
    beside = processes.Beside.begun(where_and_doubled, argument, 2)
    argument[:] = 7.0
    assert np.all(beside.result()[1] == 2.0)
    assert np.all(argument == 7.0)


def test_a_message_cut_short_is_no_message():
    message = messages.dumps({"large": np.arange(1e5), "small": 3})
    assert len(message) == 2
    stream = io.BytesIO()
    messages.send(stream, message)
    whole = stream.getvalue()
    assert len(whole) > 8e5
    read = messages.loads(messages.receive(io.BytesIO(whole)))
    np.testing.assert_array_equal(read["large"], np.arange(1e5))
    for cut in (0, 5, 8, 20, 30, 1000, len(whole) - 1):
        assert messages.receive(io.BytesIO(whole[:cut])) is None


class Labelled:
    def __init__(self, label, table):
        self.label, self.table = label, table


def test_attributes_that_nobody_reads_are_left_out():
    """And nothing else: who has them still has, and what was one object is one."""
    one, other = Labelled("one", np.ones(messages.LARGE)), Labelled("other", 3)
    less = messages.dumps([one, other, one], without={Labelled: ("table",)})
    assert len(less) == 1 < len(messages.dumps([one, other, one]))
    first, second, again = messages.loads(less)
    assert first is again
    assert (first.label, first.table, second.label, second.table) == ("one", None, "other", None)
    assert one.table.all()


def label_and_table(value):
    return os.getpid(), value.label, value.table


@pytest.mark.parametrize("lost", [False, True])
def test_a_long_call_gets_what_it_reads_alone(eager, monkeypatch, lost):
    if lost:
        kept_processes.process_of(0).process.kill()
        monkeypatch.setattr(processes, "process_of", lambda number: kept_processes.kept[number])
    beside = processes.Beside.begun(
        label_and_table, Labelled("one", 3), 2, without={Labelled: ("table",)}
    )
    pid, label, table = beside.result()
    assert (pid == os.getpid()) == lost
    assert (label, table) == ("one", None)


def begun_at(shared, item):
    begun = time.monotonic()
    time.sleep(item)
    return os.getpid(), begun


def test_what_takes_long_is_begun_first_and_here(eager):
    processes.Beside.begun(where_and_twice, 1, 2).result()  # it has loaded this module
    items = [0.02] * 12 + [0.3] + [0.02] * 12 + [0.2]
    found = process_map(begun_at, None, items, 2, cost=lambda item: item)
    here = [(begun, k) for k, (pid, begun) in enumerate(found) if pid == os.getpid()]
    assert min(here)[1] == 12
    assert len({pid for pid, _ in found}) == 2
    # The process that helps takes the short ones, from the last on.
    helped = [(begun, k) for k, (pid, begun) in enumerate(found) if pid != os.getpid()]
    assert min(helped)[1] == 24


def test_a_message_is_made_while_another_thread_loads_sympy(monkeypatch):
    """Until it is loaded it has no extremes, and nothing holds one."""
    monkeypatch.setitem(sys.modules, "sympy", types.ModuleType("sympy"))
    assert messages.loads(messages.dumps((1, "one"))) == (1, "one")
