"""Compilation in a process of its own of what a search needs later, where nothing is compiled yet.

The search itself begins with Newton's iteration and the elimination of sensitivities, which is
mostly the iteration's own, and compiles these. Meanwhile the other process compiles what is needed
next.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from bayesoleo._compiled import is_compiled
from bayesoleo._parallel import available_cores, thread_limit
from bayesoleo._worker_processes import begin_elsewhere
from bayesoleo.discovery._structure_moments import beside

if TYPE_CHECKING:
    from bayesoleo.prediction._periodic_run import RunPredictor


def begin_compiling(jobs: int | None) -> None:
    """Begin in another process with what has to be compiled, where nothing is yet.

    Parameters
    ----------
    jobs : int, optional
        How many may work at once; alone nothing is begun.
    """
    if _begun or min(thread_limit(), jobs or available_cores()) < 2 or is_compiled(beside):
        return
    _begun.append(compile_ahead.__name__)
    begin_elsewhere(__name__, compile_ahead.__name__)


#: What was begun: a search that follows a simulation begins nothing again.
_begun: list[str] = []


def compile_ahead() -> None:
    """Compile what follows the first solution, then the evidence of structures, then what scores
    need for equations that are not compiled: by then the search has the elimination."""
    from bayesoleo.solvers._switching import evaluate, periodic_signal

    run = _oscillator()
    run.sample_rest(_constants(run))
    run.compare_rest(_constants(run))
    evaluate(periodic_signal(1.0, np.zeros((1, 1)), np.zeros((1, 1))), np.zeros(1))
    _compile_evidence()
    _compile_batches(run)


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


def _compile_batches(run: RunPredictor) -> None:
    from bayesoleo.solvers._elimination import close_and_sweep
    from bayesoleo.solvers._periodic import solve_in_batch

    assert run.anchor is not None
    start = run.anchor.predict(np.zeros((1, len(run.active))))
    solve_in_batch(run.boundary, _constants(run), start, most=1)
    one = np.zeros((1, 1, 1))
    close_and_sweep(np.zeros((1, 2, 1)), one[0], one, False)


def _compile_evidence() -> None:
    # Imported once the rest is compiled: libraries take seconds to load.
    from bayesoleo.discovery._structure_evidence import compile_evidence

    compile_evidence()
