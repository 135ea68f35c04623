"""The package's estimators and SciPy's optimisers on the same certified regressions.

Run as ``python tests/benchmarks/optimisers.py``. All go through the one interface ``estimate``: the
same objective (maximum likelihood), unknowns measured in the size of their starts, the same exact
derivatives for whoever takes them, the same tolerance, at most 300 iterations, or 2000 calls for
each unknown where a method takes no derivatives. A fit counts if its parameters agree with the
certified ones to so many digits, whatever the method says of itself. It takes some minutes.
"""

from __future__ import annotations

import sys
import time
import warnings
from pathlib import Path

import numpy as np

from bayesoleo.data import dataset_folder
from bayesoleo.estimation import FunctionProblem, estimate
from bayesoleo.estimation._scipy_methods import LEAST_SQUARES, MINIMISERS
from bayesoleo.model._priors import Normal

sys.path.insert(0, str(Path(__file__).parents[1] / "estimation"))
from nist_models import FUNCTIONS, complex_step, read

OURS = ("mbe", "gauss-newton", "levenberg-marquardt", "newton")
METHODS = (*OURS, *(f"scipy:{name}" for name in (*LEAST_SQUARES, *MINIMISERS)))
TOLERANCE = 1e-8
# The interface gives methods without derivatives twenty calls for each unknown and iteration. Those
# of COBYQA cost a millisecond each and bring more than others'.
MOST = {"scipy:Nelder-Mead": 100, "scipy:Powell": 100, "scipy:COBYLA": 100, "scipy:COBYQA": 5}


def problems() -> list[tuple[FunctionProblem, np.ndarray]]:
    """Each set from both starts, with its certified parameters."""
    folder, made = dataset_folder("nist"), []
    for name, function in FUNCTIONS.items():
        data = read(folder / f"{name}.dat")
        for start in data.starts:
            priors = [Normal(value, abs(value)) for value in start]
            x, y = data.x.astype(float), data.y.astype(float)
            problem = FunctionProblem(function, x, y, priors, jacobian=complex_step(function))
            made.append((problem, data.theta))
    return made


def measure(method: str, made: list[tuple[FunctionProblem, np.ndarray]]) -> dict[str, float]:
    """How many fits are right, how many claim to have converged, and what all of them cost."""
    right, claimed, evaluations, begin = {4: 0, 6: 0}, 0, [], time.process_time()
    for problem, certified in made:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            point = estimate(
                problem,
                method,
                objective="likelihood",
                tolerance=TOLERANCE,
                max_iterations=MOST.get(method, 300),
            )
        error = np.max(np.abs(point.theta / certified - 1))
        for digits in right:
            right[digits] += bool(error <= 10.0**-digits)
        claimed += point.status.ok
        evaluations.append(point.evaluations)
    return {
        "6 digits": right[6],
        "4 digits": right[4],
        "converged": claimed,
        "evaluations": float(np.median(evaluations)),
        "cpu s": time.process_time() - begin,
    }


def table() -> str:
    """One line for each method."""
    made = problems()
    lines = [f"{'of ' + str(len(made)):22} 6 digits  4 digits  converged  median calls    CPU s"]
    for method in METHODS:
        row = measure(method, made)
        lines.append(
            f"{method:22} {row['6 digits']:8}  {row['4 digits']:8}  {row['converged']:9}"
            f"  {row['evaluations']:12.0f}  {row['cpu s']:7.1f}"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    print(table())
