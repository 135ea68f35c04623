"""Compilation of what a search needs, in two processes, where nothing is compiled yet.

Another process compiles Newton's iteration and the elimination of sensitivities, which is mostly
the iteration's own, then what is needed later. Meanwhile this one compiles what follows the first
solution. Each waits where it comes to what the other is compiling.

A search of long runs may have to seek a motion by shooting, once and after minutes: what that needs
is compiled by a process of low priority while the search goes on.
"""

from __future__ import annotations

import os
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from bayesoleo import _first_compilation as first_compilation
from bayesoleo._compiled import is_compiled, is_compiled_elsewhere
from bayesoleo._kept_processes import begin_elsewhere
from bayesoleo.discovery._structure_moments import beside
from bayesoleo.solvers._elimination import close_and_sweep
from bayesoleo.solvers._march import is_march_compiled
from bayesoleo.solvers._periodic_newton import compile_iteration
from bayesoleo.solvers._swept_columns import compile_columns, solve_columns

if TYPE_CHECKING:
    from bayesoleo.prediction._periodic_run import RunPredictor
    from bayesoleo.prediction._predictor import Predictor

#: What a process of low priority gives way to.
NICE = 10


def begin_compiling(jobs: int | None) -> None:
    """Begin to compile in another process, where nothing is compiled yet.

    Parameters
    ----------
    jobs : int, optional
        How many may work at once; alone nothing is compiled before it is needed.
    """
    if _is_done():
        first_compilation.leave_mark()
    else:
        first_compilation.begin(jobs)


def compile_meanwhile(jobs: int | None) -> None:
    """Compile in this process what the other one leaves to it, before an estimate needs both."""
    if not _is_done() and first_compilation.begin(jobs):
        compile_here()


def compile_shooting_meanwhile(predictor: Predictor, jobs: int | None) -> None:
    """Begin to compile in another process what shooting needs, where a run is long and nothing of
    that is compiled yet.

    Parameters
    ----------
    predictor : Predictor
        Of the runs.
    jobs : int, optional
        How many may work at once; alone nothing is begun.
    """
    from bayesoleo.prediction._periodic_run import FEW_STEPS

    # On few steps a factorisation of the period brings most iterations to their end.
    long = any(run.record.periodic and run.steps > FEW_STEPS for run in predictor.runs)
    if long and first_compilation.has_others(jobs) and not is_march_compiled():
        begin_elsewhere(__name__, compile_shooting.__name__)


def compile_shooting() -> None:
    """Find a motion by shooting, in a process that gives way to others."""
    from bayesoleo.prediction._starts import solve_from_shot

    _give_way()
    run = _oscillator()
    p = _constants(run)[0]
    solve_from_shot(run.model, run.kernels, run.record, run.boundary, p, run.guess(p))


def _give_way() -> None:
    """Let the processes that a user waits for go first."""
    with suppress(AttributeError, OSError):  # a system without priorities
        os.nice(NICE)


def _is_done() -> bool:
    """Whether the last of what the other process compiles is there."""
    return is_compiled(beside) and is_compiled(close_and_sweep)


def compile_ahead() -> None:
    """Compile in a process of its own what takes longest, in the order of need.

    What the caller waits for needs no model: this file loads no libraries of one, which take
    seconds.
    """
    if _is_done():
        first_compilation.leave_mark()
        return
    compile_iteration()
    # Where the caller has come to the elimination first, to wait for it would be time lost.
    if not is_compiled_elsewhere(solve_columns):
        compile_columns()
    _give_way()  # what follows is needed once the search has come to structures
    _compile_evidence()
    _compile_batches()
    first_compilation.leave_mark()


def compile_here() -> None:
    """Compile what evaluates, samples and compares a motion."""
    from bayesoleo.solvers._switching import evaluate, periodic_signal

    run = _oscillator()
    run.sample_rest(_constants(run))
    run.compare_rest(_constants(run))
    evaluate(periodic_signal(1.0, np.zeros((1, 1)), np.zeros((1, 1))), np.zeros(1))


def _oscillator() -> RunPredictor:
    """A run of what any model has: a dof, an input, a parameter and an output."""
    from bayesoleo.model import Dof, Model, Output, Parameter
    from bayesoleo.prediction._predictor import Predictor
    from bayesoleo.prediction._simulate import RunPlan, motion, record_of

    model = Model(
        "oscillator",
        inputs={"force": ""},
        dofs={"position": Dof("")},
        parameters={"stiffness": Parameter(1.0, sd=0.1)},
        equations={
            "position": {"all": "ddot(position) + dot(position) + stiffness*position - force"}
        },
        outputs={"position": Output("position", "")},
    )
    record = record_of(model, RunPlan("any", 1.0, {"force": motion(0.0, [1.0])}))
    return Predictor(model, [record], jobs=1).runs[0]


def _constants(run: RunPredictor) -> np.ndarray:
    return np.ones((1, len(run.kernels.derived.constants)))


def _compile_evidence() -> None:
    # Imported once the rest is compiled: libraries take seconds to load.
    from bayesoleo.discovery._structure_evidence import compile_evidence

    compile_evidence()


def _compile_batches() -> None:
    """The iteration for candidates whose equations are not compiled."""
    from bayesoleo.solvers._periodic import solve_in_batch

    run = _oscillator()
    run.set_anchor(_constants(run)[0])
    assert run.anchor is not None
    start = run.anchor.predict(np.zeros((1, len(run.active))))
    solve_in_batch(run.boundary, _constants(run), start, most=1)
    one = np.zeros((1, 1, 1))
    close_and_sweep(np.zeros((1, 2, 1)), one[0], one, False)
