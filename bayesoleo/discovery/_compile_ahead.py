"""Compilation in a process of its own of what a search needs later, where nothing is compiled yet.

The search itself begins with Newton's iteration, and a simulation with the elimination of
sensitivities; each compiles that. Meanwhile the other process compiles what is needed next.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayesoleo._compiled import is_compiled
from bayesoleo._parallel import available_cores, thread_limit
from bayesoleo._worker_processes import begin_elsewhere
from bayesoleo.discovery._structure_moments import beside
from bayesoleo.solvers._collocation import Collocation
from bayesoleo.solvers._mesh import tableau
from bayesoleo.solvers._period_arrangement import LEAST_STEPS

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
    if _begun or min(thread_limit(), jobs or available_cores()) < 2 or is_compiled(beside):
        return
    function = compile_after_simulation if simulated else compile_ahead
    _begun.append(function.__name__)
    begin_elsewhere(__name__, function.__name__)


#: What was begun: a search that follows a simulation begins nothing else.
_begun: list[str] = []


def compile_ahead() -> None:
    """Compile what follows Newton's iteration, then the evidence of structures.

    What interpolates a motion is quick to compile, and left to the search.
    """
    from bayesoleo.solvers._switching import evaluate, periodic_signal

    run = _oscillator()
    _compile_columns()
    run.compare_rest(_constants(run))
    evaluate(periodic_signal(1.0, np.zeros((1, 1)), np.zeros((1, 1))), np.zeros(1))
    _compile_evidence()


def compile_after_simulation() -> None:
    """Compile Newton's iteration, then the evidence of structures."""
    _compile_iteration(_oscillator())
    _compile_evidence()


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


def _compile_columns() -> None:
    """Sensitivities: as few steps as can be swept."""
    scheme = Collocation(tableau("radau3"), (2,))
    points = LEAST_STEPS * scheme.method.stages
    gz, right = np.ones((1, 1, 3, points)), np.zeros((1, 1, 1, points))
    scheme.linear(gz, right, None, np.arange(1), 1.0)


def _constants(run: RunPredictor) -> np.ndarray:
    return np.ones((1, len(run.kernels.derived.constants)))


def _compile_evidence() -> None:
    # Imported once the rest is compiled: libraries take seconds to load.
    from bayesoleo.discovery._structure_evidence import compile_evidence

    compile_evidence()
