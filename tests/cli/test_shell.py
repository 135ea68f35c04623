"""How errors, warnings and interrupts reach the terminal, and where results go."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import warnings

import pytest

from bayesoleo import (
    _cli,
    _kept_processes as kept_processes,
    _worker_processes as processes,
    _workflow as workflow,
)
from bayesoleo._cli import shell
from bayesoleo.errors import DataWarning, InputError, ModelError


def test_error_in_a_process_of_its_own(process):
    done = process("effects", "nothing")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: unknown effect (got 'nothing'); ")
    assert done.stderr.count("\n") == 1


def test_debug_lets_the_error_out_with_its_traceback(run, monkeypatch):
    assert isinstance(run("systems", "nothing").exception, SystemExit)
    monkeypatch.setenv("BAYESOLEO_DEBUG", "1")
    error = run("systems", "nothing").exception
    assert isinstance(error, ModelError)
    assert str(error).startswith("unknown system (got 'nothing')")
    assert error.__traceback__ is not None


def test_unexpected_exceptions_are_not_hidden(run, monkeypatch, campaign):
    def broken(*_, **__):
        raise RuntimeError("a mistake of ours")

    monkeypatch.setattr(workflow, "reduce", broken)
    result = run("reduce", campaign)
    assert isinstance(result.exception, RuntimeError)


@pytest.mark.skipif(sys.platform == "win32", reason="there is no such limit")
def test_too_small_a_limit_of_memory_is_named_before_libraries_meet_it():
    """One of them would end the process with a line of its own and status 1."""
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_AS, (300 * 2**20,) * 2)\n"
        "from bayesoleo._cli import main; sys.argv = ['bayesoleo', 'systems']; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: not enough memory: a limit of 300 MB is set")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(("how", "status"), [("", 0), ("sys.exit()", 0), ("sys.exit(2)", 2)])
def test_the_process_ends_with_its_status_and_all_that_it_printed(how, status):
    code = (
        "import atexit, sys; import bayesoleo._cli as cli\n"
        "atexit.register(lambda: print('at the end'))\n"
        f"def main():\n    print('x' * 100_000)\n    {how or 'pass'}\n"
        "cli.main = main; cli.run()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (status, "")
    assert done.stdout == "x" * 100_000 + "\nat the end\n"


@pytest.mark.parametrize(
    ("how", "status", "told"),
    [("sys.exit('a message')", 1, "a message"), ("raise ValueError('mistake')", 1, "ValueError")],
)
def test_what_python_has_to_say_at_the_end_is_said(how, status, told):
    code = (
        f"import sys; import bayesoleo._cli as cli\ndef main(): {how}\ncli.main = main; cli.run()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == status
    assert told in done.stderr


def test_what_is_quicker_to_load_early_is_loaded_before_the_rest():
    """Loaded while draws are judged it took four times as long, with a user waiting."""
    text = (
        "import sys; from bayesoleo._cli.shell import begin; begin('close', {'quiet': True},"
        " search=False); names = list(sys.modules);"
        " print(names.index('arviz_base') < names.index('bayesoleo._workflow.closing'))"
    )
    said = subprocess.run([sys.executable, "-c", text], capture_output=True, check=True, text=True)
    assert said.stdout == "True\n"


def test_what_nobody_reads_is_no_traceback():
    code = "import bayesoleo._cli as cli\ndef main(): print('x')\ncli.main = main; cli.run()"
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"},
    )
    process.stdout.close()  # before the child has loaded anything
    assert process.stderr.read() == ""
    process.stderr.close()
    assert process.wait() == _cli.UNREAD


def test_a_library_without_room_before_a_command_begins_is_named(monkeypatch, capsys):
    def full():
        raise ImportError("x.so: failed to map segment from shared object")

    monkeypatch.setattr(_cli, "app", full)
    with pytest.raises(SystemExit) as stop:
        _cli.main()
    assert stop.value.code == 2
    assert capsys.readouterr().err.startswith("error: not enough memory: a library cannot be")

    def other():
        raise ImportError("no such module")

    monkeypatch.setattr(_cli, "app", other)
    with pytest.raises(ImportError, match="no such module"):
        _cli.main()


def test_no_limit_or_a_large_one_is_no_error(monkeypatch):
    resource = pytest.importorskip("resource")
    needed = shell.LIBRARIES + shell.TOOLS
    monkeypatch.setattr(shell, "_address_space", lambda: shell.LIBRARIES)
    for limit in (resource.RLIM_INFINITY, needed):
        monkeypatch.setattr(resource, "getrlimit", lambda _, limit=limit: (limit, limit))
        shell.check_address_space()


def test_a_limit_that_leaves_the_tools_no_room_is_named(monkeypatch):
    """Compiler and linear algebra end the process where they get no memory, and say nothing."""
    resource = pytest.importorskip("resource")
    needed = shell.LIBRARIES + shell.TOOLS
    monkeypatch.setattr(resource, "getrlimit", lambda _: (needed - 1, needed - 1))
    with pytest.raises(MemoryError, match="libraries alone need 1156 MB"):
        shell.check_address_space()
    monkeypatch.setattr(resource, "getrlimit", lambda _: (needed, needed))
    monkeypatch.setattr(shell, "_address_space", lambda: shell.LIBRARIES + 1)
    with pytest.raises(MemoryError, match=r"900 MB are taken, .* needs 256 MB more"):
        shell.check_address_space()


def test_warning_is_one_line(run, monkeypatch, campaign):
    def warns(*_, **__):
        warnings.warn("noise\nis large", DataWarning, stacklevel=1)
        raise InputError("stop here")

    monkeypatch.setattr(workflow, "reduce", warns)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        result = run("reduce", campaign)
    assert result.stderr.splitlines() == ["warning: noise is large", "error: stop here"]


@pytest.mark.parametrize("kept", [False, True])
def test_interrupt_says_what_is_kept(run, monkeypatch, campaign, model, tmp_path, kept):
    out = tmp_path / "out"

    def interrupted(*_, out, **__):
        if kept:
            (out / "checkpoints" / "a").mkdir(parents=True)
            (out / "checkpoints" / "a" / "segment-000000.npz").touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(workflow, "close", interrupted)
    result = run("close", campaign, "--model", model, "--out", out)
    assert result.exit_code == 130
    begun, line = result.stderr.splitlines()
    assert begun == f"close {campaign}: loading libraries"
    if kept:
        assert line.startswith("stopped: no result was written; draws made so far are kept there")
    else:
        assert line == "stopped: nothing was written"


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_interrupt_of_a_process(tmp_path):
    # The model file waits, so that the signal comes while a command is at work.
    file = tmp_path / "slow.py"
    # Tests that run in the background ignore the signal, and what they start does as well.
    file.write_text(
        "import signal, time\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "print('waiting', flush=True)\ntime.sleep(60)\n"
    )
    command = [sys.executable, "-m", "bayesoleo", "systems", str(file)]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "waiting\n"
        time.sleep(0.1)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert errors == "stopped; nothing was written\n"


def test_default_folder_carries_the_name_of_the_campaign(campaign):
    toml = campaign / "campaign.toml"
    assert shell.campaign_name(campaign) == "mass-on-a-spring"
    toml.write_text(toml.read_text().replace("mass on a spring", "../a:b/ c/"))
    assert shell.campaign_name(toml) == "a-b-c"


def test_probing_a_folder_leaves_nothing(tmp_path):
    shell.check_writable(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []


def test_paragraphs_flow_but_for_marked_ones():
    text = "Head.\n\n    One\n    two.\n\n    \b\n    a\n      b\n    "
    assert shell.flowing(text) == "Head.\n\nOne two.\n\n\b\na\n  b"


@pytest.mark.parametrize(
    ("asked", "threads"), [("", 1), ("OPENBLAS_NUM_THREADS", 2), ("OMP_NUM_THREADS", 2)]
)
def test_linear_algebra_has_one_thread_unless_asked_for_more(asked, threads, tmp_path):
    """A command loads it after that."""
    code = (
        "import contextlib, json, sys; from bayesoleo._cli import main;"
        " sys.argv = ['bayesoleo', '--version']\n"
        "with contextlib.suppress(SystemExit): main()\n"
        "import numpy, threadpoolctl; found = threadpoolctl.threadpool_info()\n"
        "print(json.dumps([item['num_threads'] for item in found if item['user_api'] == 'blas']))"
    )
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    environment |= {asked: "2"} if asked else {}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    found = done.stdout.splitlines()[-1]
    if found == "[]":
        pytest.skip("no library of linear algebra that is known")
    assert set(json.loads(found)) == {min(threads, os.cpu_count() or 1)}


@pytest.mark.parametrize("command", ["close", "sample"])
def test_libraries_load_in_both_processes_of_a_search_at_once(
    run, monkeypatch, campaign, model, command
):
    begun = []
    monkeypatch.setattr(processes, "start_ahead", lambda **given: begun.append(given))
    monkeypatch.setattr(kept_processes, "load", begun.append)

    def stopped(*_, **__):
        raise InputError("stop here")

    monkeypatch.setattr(workflow, command, stopped)
    result = run(command, campaign, "--model", model, "--jobs", 2)
    assert result.stderr.splitlines()[-1] == "error: stop here"
    loaded = [kept_processes.EARLY, "bayesoleo._workflow.closing"]
    assert begun == ([{"jobs": 2}, loaded] if command == "close" else [loaded])
    assert run(command, campaign / "nowhere", "--model", model).exit_code == 2
    assert len(begun) == (2 if command == "close" else 1)
