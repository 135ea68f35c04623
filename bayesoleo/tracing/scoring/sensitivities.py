"""How outputs change with parameters that a fitted model lacks or holds fixed, at its estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.model import Model
from bayesoleo.prediction.predictor import Predictor
from bayesoleo.prediction.run import RunPredictor
from bayesoleo.solvers.status import Status
from bayesoleo.tracing.fitting.fit import Fit
from bayesoleo.tracing.scoring.visible import resolved_sensitivities


@dataclass(frozen=True)
class Block:
    """Sensitivities of the new unknowns at one set of shapes.

    Parameters
    ----------
    names : tuple of str
        Unknowns, by-run ones expanded.
    by_run : list of ndarray, shape (ny, k, N)
        One a run, SI.
    """

    names: tuple[str, ...]
    by_run: list[Array]


def sensitivities_of(
    fit: Fit, model: Model, shapes: Sequence[Mapping[str, float]]
) -> list[Block] | Status:
    """Derivatives with respect to a model's estimated parameters at a fitted model's estimate.

    Parameters
    ----------
    fit : Fit
        Of a model that the other one extends, or whose constants it frees.
    model : Model
        Estimates the parameters that are asked for, and no others.
    shapes : sequence of mapping of str to float
        Values of shape parameters, one set a block.

    Returns
    -------
    list of Block, or Status
        Why there are none.
    """
    predictor = Predictor(
        model,
        fit.records,
        steps=fit.steps,
        scheme=fit.numerics.scheme,
        backend="numpy",
        jobs=1,
        share=fit.predictor,
    )
    if predictor.outputs != fit.predictor.outputs:
        return Status.SINGULAR
    layout = predictor.layout
    theta = layout.start(model)
    found: list[list[Array]] = [[] for _ in shapes]
    for r, run in enumerate(predictor.runs):
        p = _constants(fit, r, run, predictor.constants(theta[None], r), shapes)
        derivatives = _of_run(fit, r, run, p)
        if isinstance(derivatives, Status):
            return derivatives
        for k, y_p in enumerate(derivatives):
            full = np.zeros((y_p.shape[0], theta.size, y_p.shape[2]))
            full[:, layout.columns[r]] = y_p
            found[k].append(full)
    return [Block(layout.names, item) for item in found]


def _constants(
    fit: Fit, r: int, run: RunPredictor, start: Array, shapes: Sequence[Mapping[str, float]]
) -> Array:
    """Constants of an extended model: present estimates, by-run values included, and shapes."""
    p = np.repeat(start, len(shapes), axis=0)
    position = {name: k for k, name in enumerate(run.kernels.derived.constants)}
    names = fit.predictor.runs[r].kernels.derived.constants
    for name, value in zip(names, present_constants(fit, r), strict=True):
        if name in position:
            p[:, position[name]] = value
    for k, values in enumerate(shapes):
        for name, value in values.items():
            p[k, position[name]] = value
    return p


def _of_run(fit: Fit, r: int, run: RunPredictor, p: Array) -> Array | Status:
    """Derivatives of one run's outputs, shape (L, ny, na, N)."""
    run.motions = fit.predictor.runs[r].known_motions()
    run.watched = False  # at the null nothing has moved
    if len(p) == 1:
        samples = run.evaluate(p[0])
    else:
        status = run.set_anchor(p[0])
        if status is not Status.CONVERGED:
            return status
        samples = run.predict(p, derivatives=True)
    if (samples.status != Status.CONVERGED.value).any() or samples.y_p is None:
        return Status(int(samples.status.max()))
    constants = run.kernels.derived.constants
    own = [k for k, name in enumerate(constants) if name in fit.model.parameters]
    return resolved_sensitivities(run, p, samples, own)


def present_constants(fit: Fit, r: int) -> Array:
    """Constants of a fitted run at the estimate, shape (np,)."""
    return cast(Array, fit.predictor.constants(fit.problem.full(fit.point.theta[None]), r)[0])
