"""Compilation in a process of its own of what a search needs later, where nothing is compiled yet.

The search itself begins with Newton's iteration, and a simulation with the elimination of
sensitivities; each compiles that. Meanwhile the rest is made in the order in which it is needed.
"""

from __future__ import annotations

import numpy as np

from bayesoleo._compiled import is_compiled
from bayesoleo._parallel import available_cores, thread_limit
from bayesoleo._worker_processes import begin_elsewhere
from bayesoleo.solvers._collocation import compile_elimination, linear


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
    """Compile the elimination of sensitivities, then the evidence of structures."""
    compile_elimination()
    _compile_evidence()


def compile_after_simulation() -> None:
    """Compile Newton's iteration, then the evidence of structures."""
    _compile_iteration()
    _compile_evidence()


def _compile_iteration() -> None:
    """That of an oscillator, which any model has."""
    from bayesoleo.model import Dof, Model, Output, Parameter
    from bayesoleo.prediction._predictor import Predictor
    from bayesoleo.prediction._simulate import RunPlan, motion, record_of
    from bayesoleo.solvers._periodic import solve_periodic

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
    predictor = Predictor(model, [record], jobs=1)
    run = predictor.runs[0]
    start = np.zeros((1, run.steps, run.scheme.width))
    solve_periodic(run.boundary, predictor.constants(np.ones((1, 1)), 0), start)


def _compile_evidence() -> None:
    # Imported once the rest is compiled: libraries take seconds to load.
    from bayesoleo.discovery._structure_evidence import compile_evidence

    compile_evidence()
