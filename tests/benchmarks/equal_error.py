"""Time per solve at equal error: the default scheme against the thesis's backward differences.

One run of each group of the campaign, warm from an anchor on the same mesh, one thread's CPU time;
both schemes solve the same parameters on ever finer meshes, and the time at an error is taken
between the two measured meshes around it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from cases import Case, solve, states
from measuring import cpu, error, time_at

from bayesoleo.model import Model
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.solvers._orbit import Status
from bayesoleo.solvers._schemes import DEFAULT_SCHEME

#: Errors of the stroke over its amplitude.
TARGETS = (1e-5, 1e-8)
MESHES: Mapping[str, Sequence[int]] = {
    DEFAULT_SCHEME: (200, 400, 800, 1600, 3200, 6400, 12_800),
    "thesis": (800, 1600, 3200, 6400, 12_800, 51_200, 204_800),
}
#: Solves timed together: many where one is too short to time.
TOGETHER = 51_200


def measure(
    model: Model, cases: Sequence[Case], meshes: Mapping[str, Sequence[int]] = MESHES
) -> dict[str, float]:
    """Mean microseconds a solve at each target by scheme, and the thesis's over the default's."""
    result: dict[str, float] = {}
    for name, sizes in meshes.items():
        curves = [_curve(model, case, name, sizes) for case in cases]
        for target in TARGETS:
            key = f"{'default' if name == DEFAULT_SCHEME else name}_us_at_{_label(target)}"
            result[key] = float(np.mean([1e6 * time_at(target, *curve) for curve in curves]))
    for target in TARGETS:
        label = _label(target)
        ratio = result[f"thesis_us_at_{label}"] / result[f"default_us_at_{label}"]
        result[f"equal_error_ratio_{label}"] = ratio
    return result


def _label(target: float) -> str:
    return f"{target:.0e}".replace("e-0", "e-")


def _curve(
    model: Model, case: Case, scheme: str, sizes: Sequence[int]
) -> tuple[list[float], list[float]]:
    """Errors and seconds of one case on meshes; those that do not converge are left out."""
    errors, seconds = [], []
    for n in sizes:
        predictor = Predictor(model, [case.record], steps=n, scheme=scheme, jobs=1)
        predictor.set_anchor(predictor.layout.start(model))
        (run,) = predictor.runs
        if run.anchor is None:
            continue
        p = np.repeat(case.p[None], max(1, min(16, TOGETHER // n)), axis=0)
        solution = solve(run, p)
        if not np.all(solution.status == Status.CONVERGED):
            continue
        errors.append(error(states(run, solution.x[0])[0], case.exact[0]))
        seconds.append(cpu(lambda run=run, p=p: solve(run, p)) / len(p))
    return errors, seconds
