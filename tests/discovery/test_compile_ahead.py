"""What is compiled ahead, in another process, is what is called later, with the same types."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

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


@pytest.mark.slow
@pytest.mark.parametrize(
    ("function", "compiled"),
    [
        (
            "compile_ahead",
            [("_swept_columns", "solve_columns"), ("_sum_of_squares", "_compare"), *EVIDENCE],
        ),
        ("compile_after_simulation", [("_periodic_newton", "solve_lanes"), *EVIDENCE]),
    ],
)
def test_another_process_finds_compiled_what_it_needs_next(tmp_path, function, compiled):
    code = f"import bayesoleo.discovery._compile_ahead as m; m.{function}()"
    folders = {"NUMBA_CACHE_DIR": str(tmp_path / "numba"), "BAYESOLEO_CACHE": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], check=True, env={**os.environ, **folders})
    found = {file.name for file in tmp_path.rglob("*.nbi")}
    for module, name in compiled:
        assert any(file.startswith(f"{module}.{name}-") for file in found), name


@pytest.mark.parametrize(
    ("jobs", "compiled", "begun"),
    [(2, False, True), (2, True, False), (1, False, False)],
)
@pytest.mark.parametrize("simulated", [True, False])
def test_it_is_begun_where_it_helps(monkeypatch, jobs, compiled, begun, simulated):
    asked = []
    monkeypatch.setattr(ahead, "begin_elsewhere", lambda *call: asked.append(call))
    monkeypatch.setattr(ahead, "is_compiled", lambda _: compiled)
    monkeypatch.setattr(ahead, "thread_limit", lambda: 2)
    monkeypatch.setattr(ahead, "_begun", [])
    ahead.begin_compiling(jobs, simulated=simulated)
    ahead.begin_compiling(jobs)  # the search after a simulation
    assert len(asked) == begun
    for module, name in asked:
        assert callable(getattr(sys.modules[module], name))
