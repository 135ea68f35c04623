"""Two processes do not compile the same function: one waits, and reads what the other has made."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time

import pytest
from scipy.special import erfcx

from bayesoleo import _compiled as compiled, _one_compilation as one
from bayesoleo.discovery._structure_moments import _scaled_tail

HOLD = """
import sys, time
from bayesoleo._one_compilation import in_one_process
with in_one_process(sys.argv[1], str):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("BAYESOLEO_CACHE", str(tmp_path))
    return tmp_path


@pytest.fixture
def holder(cache):
    """Another process that is compiling a function called f."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", HOLD, "f"], text=True, **pipes) as process:
        assert process.stdout.readline().strip() == "held"
        yield process
        process.kill()


def entered(name: str) -> float:
    """Seconds until a function may be compiled here."""
    begin = time.monotonic()
    with one.in_one_process(name, str):
        return time.monotonic() - begin


def test_what_another_process_compiles_is_seen_while_it_does(holder):
    assert one.is_elsewhere("f")
    assert not one.is_elsewhere("g")
    holder.kill()
    holder.wait()
    assert not one.is_elsewhere("f")


def test_where_there_is_no_cache_nothing_is_compiled_elsewhere(tmp_path, monkeypatch):
    monkeypatch.setenv("BAYESOLEO_CACHE", str(tmp_path / "not made"))
    assert not one.is_elsewhere("f")


@pytest.mark.parametrize("end", ["done", "killed"])
def test_one_waits_until_the_other_is_done_or_gone(holder, end):
    wait = 0.5

    def release():
        holder.kill() if end == "killed" else holder.stdin.close()

    timer = threading.Timer(wait, release)
    timer.start()
    assert entered("f") > 0.9 * wait  # a timer is not early by a tenth
    timer.join()


def test_another_function_is_not_waited_for(holder):
    assert entered("g") < 0.5 * one.PATIENCE
    assert holder.poll() is None


def test_nobody_waits_for_ever(holder, monkeypatch):
    monkeypatch.setattr(one, "PATIENCE", 0.2)
    assert entered("f") >= 0.2
    assert holder.poll() is None


def test_a_disk_without_locks_stops_nothing(cache, monkeypatch):
    def refuses(*_):
        raise OSError(37, "no locks available")

    monkeypatch.setattr(one, "try_lock", refuses)
    assert entered("f") < one.PATIENCE


def test_an_error_within_is_passed_on(cache):
    with pytest.raises(ZeroDivisionError), one.in_one_process("f", str):
        raise ZeroDivisionError
    with pytest.raises(FileNotFoundError), one.in_one_process("f", str):
        raise FileNotFoundError(os.fspath(cache))  # not taken for a disk without locks


class Dispatcher:
    """As Numba's, as far as it is used: what it compiles, and whether that is on disk."""

    def __init__(self, compile_one, known=False):
        self.py_func, self.compile, self.targetctx = entered, compile_one, None
        self._cache, self.overloads = self, {}
        self.known = known

    def holds(self, *_):
        return self.known


def test_the_level_of_optimisation_is_given_back(cache):
    config = compiled._config
    before = config.OPT
    seen = []
    compiled._compiler_of(Dispatcher(lambda _: seen.append(int(config.OPT))))(None)
    assert seen == [min(int(before), compiled.LEVEL)]
    assert before == config.OPT
    with pytest.raises(ZeroDivisionError):
        compiled._compiler_of(Dispatcher(lambda _: 1 // 0))(None)
    assert before == config.OPT
    assert not compiled._compiling


def test_what_is_on_disk_is_not_waited_for_and_waiting_is_told(cache, monkeypatch):
    asked, told = [], []
    monkeypatch.setattr(one, "try_lock", lambda *_: asked.append(1) or len(asked) > 1)
    with compiled.compilation_told(told.append):
        compiled._compiler_of(Dispatcher(lambda _: None, known=True))(None)
        assert (asked, told) == ([], [])
        compiled._compiler_of(Dispatcher(lambda _: None))(None)
    assert (len(asked), told) == (2, [compiled.COMPILED_ONCE])


def test_what_was_told_is_not_told_again_within(cache):
    outer, inner, later = [], [], []
    with compiled.compilation_told(outer.append):
        compiled._tell()
        with compiled.compilation_told(inner.append):
            compiled._tell()
    with compiled.compilation_told(later.append):
        compiled._tell()
    assert (outer, inner, later) == ([compiled.COMPILED_ONCE], [], [compiled.COMPILED_ONCE])


@pytest.mark.skipif(not hasattr(_scaled_tail, "signatures"), reason="nothing is compiled")
def test_a_function_that_was_compiled_is_held_for_its_types_alone():
    assert _scaled_tail(1.0) == pytest.approx(erfcx(1.0), rel=1e-14)
    (signature, *_) = _scaled_tail.signatures
    assert _scaled_tail._cache.holds(signature, _scaled_tail.targetctx)
    assert not _scaled_tail._cache.holds((*signature, *signature), _scaled_tail.targetctx)
