"""How many steps a run needs to begin with: of a period by its inputs, of a transient by its own.

A model is solved over periodic runs in so many steps a period, and over transients on the mesh that
an integrator chose, cut finer or coarser. One number says both. The steps that a broadband input
asks of a period say nothing of a transient, and the other way round.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bayesoleo.model._model import Model
from bayesoleo.prediction._records import Record

#: Steps for each harmonic of the inputs, and limits.
STEPS_PER_HARMONIC = 4
FEWEST_STEPS, MOST_STEPS = 128, 8192
#: Steps at which a transient's mesh is the integrator's own; twice as many halve each, and fewer
#: join the equal steps of a long record.
WHOLE = 128
#: The fewest: at most three of a highest frequency's radians in a step, which still sees all of it.
COARSEST = WHOLE // 4
#: Steps up to which a mesh is refined of a model that is only compared with others.
MOST_COMPARED = 16 * WHOLE


def first_steps(model: Model, records: Sequence[Record]) -> int:
    """Steps to start from: a few for each significant harmonic of the inputs, a power of two."""
    highest = max(
        (
            int(record.harmonics[name].orders[-1])
            for record in records
            for name in model.inputs
            if name in record.harmonics
        ),
        default=1,
    )
    wanted = max(FEWEST_STEPS, STEPS_PER_HARMONIC * highest)
    return int(min(MOST_STEPS, 2 ** int(np.ceil(np.log2(wanted)))))


def whole_steps(model: Model, records: Sequence[Record]) -> int:
    """Steps that an estimate begins with: fewer only do for comparisons, or for a first look."""
    return first_steps(model, records) if any(r.periodic for r in records) else WHOLE


def coarsest_steps(records: Sequence[Record], steps: int) -> int:
    """The fewest steps for a comparison of models that were estimated on so many.

    A period has the fewest that any has, and an eighth of its own, where a step sees two radians of
    the highest harmonic at six points.
    """
    if not any(record.periodic for record in records):
        return COARSEST
    return min(steps, max(FEWEST_STEPS, steps // 8))


def fineness(model: Model, records: Sequence[Record], steps: int) -> int:
    """How finely transients are cut beside periodic runs of so many steps.

    By as much more than their integrator's own mesh as these take more than the first steps. Where
    all runs are transients, the steps say it themselves.
    """
    if not any(record.periodic for record in records):
        return steps
    finer = WHOLE * steps // first_steps(model, records)
    return max(WHOLE, min(finer, MOST_COMPARED))


def steps_for(model: Model, fitted: Sequence[Record], steps: int, records: Sequence[Record]) -> int:
    """Steps for other runs than those for which so many did.

    Parameters
    ----------
    model : Model
    fitted : sequence of Record
        Runs for which they did.
    steps : int
    records : sequence of Record
        The others.
    """
    if not any(record.periodic for record in records):
        return fineness(model, fitted, steps)
    if any(record.periodic for record in fitted):
        return steps
    return min(first_steps(model, records) * max(1, steps // WHOLE), MOST_STEPS)
