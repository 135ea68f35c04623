"""Compilation in a process of its own of what a search needs later, where nothing is compiled yet.

The search itself begins with Newton's iteration and the elimination of sensitivities, which share
functions, and compiles these. Meanwhile the rest is made in the order in which it is needed. A
simulation begins with what compares motions with samples; then the other process begins with the
iteration.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayesoleo._compiled import is_compiled
from bayesoleo._parallel import available_cores, thread_limit
from bayesoleo._worker_processes import begin_elsewhere
from bayesoleo.solvers._collocation import linear

if TYPE_CHECKING:
    from bayesoleo.prediction._periodic_run import RunPredictor


def begin_compiling(jobs: int | None, *, simulated: bool = False) -> None:
    """Begin in another process with what has to be compiled, where nothing is yet.

    Parameters
    ----------
    jobs : int, optional
        How many may work at once; alone nothing is begun.
    simulated : bool
        The search follows a simulation by this process.
    """
    if min(thread_limit(), jobs or available_cores()) > 1 and not is_compiled(linear):
        function = compile_after_simulation if simulated else compile_ahead
        begin_elsewhere(__name__, function.__name__)


def compile_ahead() -> None:
    """Compile what compares motions with samples, then what is needed later."""
    _compile_comparison(_oscillator())
    _compile_late()


def compile_after_simulation() -> None:
    """Compile Newton's iteration, then what is needed later."""
    _compile_iteration(_oscillator())
    _compile_late()


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


def _compile_iteration(run: RunPredictor) -> None:
    from bayesoleo.solvers._periodic import solve_periodic

    start = np.zeros((1, run.steps, run.scheme.width))
    solve_periodic(run.boundary, _constants(run), start)


def _compile_comparison(run: RunPredictor) -> None:
    """By a motion that solves nothing, and by the inputs of one."""
    from bayesoleo.solvers._switching import evaluate, periodic_signal

    run.compare_rest(_constants(run))
    evaluate(periodic_signal(1.0, np.zeros((1, 1)), np.zeros((1, 1))), np.zeros(1))


def _constants(run: RunPredictor) -> np.ndarray:
    return np.ones((1, len(run.kernels.derived.constants)))


def _compile_late() -> None:
    """The evidence of structures, then the elimination of what sweeps cannot solve."""
    # Imported once the rest is compiled: libraries take seconds to load.
    from bayesoleo.discovery._structure_evidence import compile_evidence
    from bayesoleo.solvers._collocation import compile_exchange

    compile_evidence()
    compile_exchange()
