"""What is compiled ahead, in another process, is what is called later, with the same types."""

from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from bayesoleo import _first_compilation as first
from bayesoleo.discovery import (
    _compile_ahead as ahead,
    _structure_evidence as evidence,
    _structure_moments as moments,
)
from bayesoleo.discovery._structure_columns import Group, Likelihood, Reduced

EVIDENCE = ("_structure_moments", "singles"), ("_structure_moments", "pairs")
COMPILED = (evidence.singles, evidence.pairs, evidence.beside, moments._over)


def signatures() -> list[set[object]]:
    return [set(function.signatures) for function in COMPILED]


@pytest.mark.skipif(not hasattr(moments._over, "signatures"), reason="nothing is compiled")
def test_a_comparison_needs_nothing_that_was_not_compiled_ahead():
    evidence.compile_evidence()
    before = signatures()
    assert all(before)
    rng = np.random.default_rng(5)
    rows = rng.standard_normal((7, 40))
    products = rows @ rows.T
    likelihood, sizes = Likelihood(40, 30.0), np.array([0.2, 1.0])
    groups = [Group((0,), 0.9), Group((1,)), Group((2, 3))]
    for count in (1, 3):
        part = Reduced.of(np.stack([products] * count), np.zeros(count), 2, np.zeros(2))
        evidence.effect_evidence(part, likelihood, groups, sizes)
        evidence.pair_evidence(part, likelihood, groups[0], groups[1:2], sizes)
        one = part.with_effects(groups[:1], [1.0])
        evidence.effect_evidence(one, likelihood, [Group((0,)), Group((1, 2))], sizes)
        for own in (one, part.with_effects(groups, [0.2, 1.0, 1.0])):
            own.log_moment(likelihood)
    assert signatures() == before


LONG = ("_periodic_newton", "solve_lanes"), ("_swept_columns", "solve_columns"), *EVIDENCE
SHORT = ("_collocation", "rows"), ("_sum_of_squares", "_compare"), ("_switching", "rows_at")


def folders(place) -> dict[str, str]:
    return {**os.environ, "NUMBA_CACHE_DIR": str(place / "numba"), "BAYESOLEO_CACHE": str(place)}


def run(code, place) -> str:
    command = [sys.executable, "-c", code]
    return subprocess.run(
        command, check=True, env=folders(place), capture_output=True, text=True
    ).stdout


def compiled(place) -> set[str]:
    return {file.name for file in place.rglob("*.nbi")}


@pytest.mark.slow
def test_two_processes_compile_everything_once(tmp_path):
    """Each waits where the other compiles: together they take all that either of them needs, and
    what one has compiled the other one reads."""
    code = "import bayesoleo.discovery._compile_ahead as ahead; ahead.{}()"
    other = subprocess.Popen(
        [sys.executable, "-c", code.format("compile_ahead")], env=folders(tmp_path)
    )
    run(code.format("compile_here"), tmp_path)
    assert other.wait() == 0
    for module, name in (*LONG, *SHORT):
        own = [file for file in compiled(tmp_path) if file.startswith(f"{module}.{name}-")]
        assert len(own) == 1, name
    # Without a problem they were compiled for what a problem calls them with.
    for _, name in LONG[:2]:
        made = [file.name for file in tmp_path.rglob("*.nbc") if f".{name}-" in file.name]
        assert len(made) == 1
    assert list(tmp_path.glob("compiled-*"))
    before = {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.nb[ic]")}
    run(
        code.format("compile_meanwhile(2) or ahead.begin_compiling(2) or ahead.compile_here"),
        tmp_path,
    )
    assert {file: file.stat().st_mtime_ns for file in tmp_path.rglob("*.nb[ic]")} == before


@pytest.mark.parametrize("elsewhere", [False, True])
def test_what_the_caller_compiles_is_left_to_it(monkeypatch, tmp_path, elsewhere):
    """Its own process goes on with what comes next, at low priority, and says when all is done."""
    done = []
    monkeypatch.setenv("BAYESOLEO_CACHE", str(tmp_path))
    monkeypatch.setattr(ahead, "is_compiled", lambda _: False)
    monkeypatch.setattr(ahead, "is_compiled_elsewhere", lambda _: elsewhere)
    for name in ("compile_iteration", "compile_columns", "_compile_evidence", "_compile_batches"):
        monkeypatch.setattr(ahead, name, lambda name=name: done.append(name))
    monkeypatch.setattr(ahead, "_give_way", lambda: done.append("gives way"))
    ahead.compile_ahead()
    columns = [] if elsewhere else ["compile_columns"]
    later = ["gives way", "_compile_evidence", "_compile_batches"]
    assert done == ["compile_iteration", *columns, *later]
    assert list(tmp_path.glob("compiled-*"))


@pytest.mark.parametrize(
    ("jobs", "compiled", "begun"),
    [(2, False, True), (2, True, False), (1, False, False)],
)
def test_it_is_begun_where_it_helps(monkeypatch, tmp_path, jobs, compiled, begun):
    asked, here = [], []

    def elsewhere(*call):
        asked.append(call)
        return True

    monkeypatch.setenv("BAYESOLEO_CACHE", str(tmp_path))
    monkeypatch.setattr(first, "begin_elsewhere", elsewhere)
    monkeypatch.setattr(first, "thread_limit", lambda: 2)
    monkeypatch.setattr(first, "_begun", [])
    monkeypatch.setattr(ahead, "is_compiled", lambda _: compiled)
    monkeypatch.setattr(ahead, "compile_here", lambda: here.append(1))
    assert first.begin_early(jobs) == (jobs > 1)  # nothing is known yet
    assert len(asked) == (jobs > 1)
    ahead.begin_compiling(jobs)
    assert not here  # before the input has been looked at
    ahead.compile_meanwhile(jobs)
    ahead.begin_compiling(jobs)  # the search after a simulation
    assert len(asked) == (jobs > 1)
    assert bool(here) == begun
    for module, name in asked:
        assert callable(getattr(sys.modules[module], name))
    assert bool(list(tmp_path.glob("compiled-*"))) == compiled
    monkeypatch.setattr(first, "_begun", [])
    asked.clear()
    assert first.begin_early(jobs) == (jobs > 1 and not compiled)
    assert len(asked) == (jobs > 1 and not compiled)


def test_where_no_process_may_be_begun_everything_is_compiled_when_it_is_needed(
    monkeypatch, tmp_path
):
    monkeypatch.setenv("BAYESOLEO_CACHE", str(tmp_path))
    monkeypatch.setenv("BAYESOLEO_PROCESSES", "0")
    monkeypatch.setattr(first, "_begun", [])
    monkeypatch.setattr(ahead, "is_compiled", lambda _: False)
    monkeypatch.setattr(ahead, "compile_here", lambda: pytest.fail("nobody compiles the rest"))
    assert not first.begin_early(2)
    ahead.compile_meanwhile(2)


@pytest.mark.parametrize(
    ("steps", "jobs", "compiled", "begun"),
    [(2048, 2, False, 1), (1024, 2, False, 0), (2048, 1, False, 0), (2048, 2, True, 0)],
)
def test_shooting_is_prepared_for_in_long_runs(monkeypatch, steps, jobs, compiled, begun):
    asked = []
    oscillator = ahead._oscillator()
    oscillator.steps = steps
    monkeypatch.setattr(ahead, "begin_elsewhere", lambda *call: asked.append(call))
    monkeypatch.setattr(first, "thread_limit", lambda: 2)
    monkeypatch.setattr(ahead, "is_march_compiled", lambda: compiled)
    ahead.compile_shooting_meanwhile(SimpleNamespace(runs=[oscillator]), jobs)
    assert len(asked) == begun
    for module, name in asked:
        assert callable(getattr(sys.modules[module], name))


SHOT = """
import numpy as np
from bayesoleo.discovery._compile_ahead import compile_shooting
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._simulate import RunPlan, motion, record_of
from bayesoleo.prediction._starts import solve_from_shot

dofs = {"a": Dof(""), "b": Dof("")}
terms = {"a": {"all": "ddot(a) + dot(a) + abs(a)*a + k*(a - b) - u"},
         "b": {"all": "dot(b) + b - a"}}
model = Model("two", inputs={"u": ""}, dofs=dofs, parameters={"k": Parameter(1.0, sd=0.1)},
              equations=terms, outputs={"a": Output("a", "")})
run = Predictor(model, [record_of(model, RunPlan("any", 1.0, {"u": motion(0.0, [1.0])}))]).runs[0]
p = np.ones(1)
assert solve_from_shot(model, run.kernels, run.record, run.boundary, p, run.guess(p)).status[0] == 0
"""


@pytest.mark.slow
def test_a_shot_at_another_model_needs_nothing_that_was_not_compiled_for_it(tmp_path):
    run("import bayesoleo.discovery._compile_ahead as ahead; ahead.compile_shooting()", tmp_path)
    marched = {name for name in compiled(tmp_path) if name.startswith(("_march.", "_switching."))}
    assert any(name.startswith("_march._walk-") for name in marched)
    index = {file: file.read_bytes() for file in tmp_path.rglob("*.nbi")}
    run(SHOT, tmp_path)
    again = {file: file.read_bytes() for file in tmp_path.rglob("*.nbi")}
    changed = {file.name.split("-")[0] for file in again if again[file] != index.get(file)}
    # Of two unknowns an iteration has types of its own; the march has not.
    assert not {name for name in changed if name.startswith(("_march.", "_radau_step."))}
