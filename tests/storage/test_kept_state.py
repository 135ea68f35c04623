"""A state is read back by the same calculation alone, and a digest says the same in any process."""

from __future__ import annotations

import subprocess
import sys
import tracemalloc
from functools import partial

import numpy as np
import pytest
from small_campaigns import damper

from bayesoleo._storage.files import check_writable, path_of
from bayesoleo._storage.resume import digest, keep_state, kept_state
from bayesoleo.effects import catalogue, force_effect
from bayesoleo.errors import InputError, ResultsError

KEY = {"campaign": "a", "model": "b"}


def test_a_state_comes_back_as_it_was(tmp_path):
    path = tmp_path / "deep" / "state.pickle"
    keep_state(path, KEY, {"values": np.arange(3.0), "function": lambda x: 2 * x})
    found, reason = kept_state(path, KEY)
    assert reason == ""
    assert found["function"](found["values"][2]) == 4.0


def test_a_large_state_is_written_without_a_copy_in_memory(tmp_path):
    path, size = tmp_path / "state.pickle", 20_000_000
    state = {"values": np.arange(size // 8, dtype=float)}
    tracemalloc.start()
    keep_state(path, KEY, state)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < size / 4
    np.testing.assert_array_equal(kept_state(path, KEY)[0]["values"], state["values"])


def test_what_cannot_be_kept_leaves_the_older_state(tmp_path):
    path = tmp_path / "state.pickle"
    keep_state(path, KEY, "older")
    with pytest.raises(TypeError, match="cannot pickle"):
        keep_state(path, KEY, [np.zeros(100_000), (number for number in range(3))])
    assert kept_state(path, KEY) == ("older", "")
    assert list(tmp_path.iterdir()) == [path]


def test_another_calculation_or_a_damaged_file_has_none_and_a_reason(tmp_path):
    path = tmp_path / "state.pickle"
    assert kept_state(path, KEY) == (None, "")
    keep_state(path, KEY, [1])
    assert kept_state(path, KEY | {"model": "c"}) == (None, "it belongs to another model")
    fewer = {name: value for name, value in KEY.items() if name != "model"}
    assert kept_state(path, fewer) == (None, "it belongs to another model")
    content = path.read_bytes()
    for broken in (content[:-1], content + b"x"):
        path.write_bytes(broken)
        assert kept_state(path, KEY) == (None, "it is damaged")
    for foreign in (b"", b"\xff\xfe", b"[1, 2]\n", b'{"format": "else"}\n'):
        path.write_bytes(foreign)
        assert kept_state(path, KEY) == (None, "it cannot be read")


def test_nothing_of_another_kind_is_unpickled(tmp_path):
    path = tmp_path / "state.pickle"

    class Loud:
        def __reduce__(self):
            return pytest.fail, ("it was unpickled",)

    keep_state(path, KEY, Loud())
    assert kept_state(path, {"campaign": "b", "model": "b"})[0] is None


def test_digests_differ_where_anything_does():
    two = [force_effect("drag", "damping", text, {"c3": "force/(position/s)**3"})
           for text in ("c3*velocity**3", "2*c3*velocity**3")]  # fmt: skip
    values = [0, 0.0, "0", b"0", None, False, (), [], {}, {0}, np.zeros(1), np.zeros(2),
              np.zeros(1, dtype=int), {"a": 1, "b": 2}, {"a": 2, "b": 1}, (1, (2, 3)), (1, 2, 3),
              damper(), damper(cubic=False), lambda: 1, lambda: 2, lambda x=1: x, *two,
              *catalogue()]  # fmt: skip
    found = [digest(value) for value in values]
    assert len(set(found)) == len(found)


def test_a_function_is_known_by_what_it_encloses():
    def scaled(factor):
        return lambda x: factor * x

    assert digest(scaled(1.0)) == digest(scaled(1.0))
    assert digest(scaled(1.0)) != digest(scaled(2.0))
    assert digest(partial(max, 1)) != digest(partial(max, 2))


def test_a_value_that_holds_itself_has_a_digest():
    ring: list[object] = [1]
    ring.append(ring)
    assert digest(ring) == digest(ring)


def test_digests_do_not_depend_on_the_process():
    code = (
        "from bayesoleo.effects import catalogue; from bayesoleo._storage.resume import digest;"
        "print(digest((catalogue(), {'a', 'b', 'c'})))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == digest((catalogue(), {"a", "b", "c"}))


def test_a_folder_is_tried_and_left_as_it_is(tmp_path, monkeypatch):
    assert check_writable(str(tmp_path / "a" / "b")) == tmp_path / "a" / "b"
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is not a folder; nothing can be written there"):
        check_writable(tmp_path / "file" / "below")

    def denied(**_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.TemporaryDirectory", denied)
    with pytest.raises(InputError, match="cannot be written to: Permission denied"):
        check_writable(tmp_path / "new")


def test_a_working_folder_that_is_not_utf_8_is_refused_too(tmp_path, monkeypatch):
    monkeypatch.setattr("os.getcwd", lambda: "/tmp/r\udcff")
    with pytest.raises(InputError, match=r"is not UTF-8 \(got '/tmp/r.*udcff/results'\)"):
        path_of("results")


def test_a_full_disk_leaves_the_older_state(tmp_path, monkeypatch):
    path = tmp_path / "state.pickle"
    keep_state(path, KEY, "older")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(ResultsError, match="No space left on device"):
        keep_state(path, KEY, "newer")
    assert kept_state(path, KEY) == ("older", "")
