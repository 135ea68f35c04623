"""The part of a transient that tells where it starts.

A motion that is damped forgets its start. What a long record says of it stands in its first
samples, and to solve the rest again and again for another start is time lost.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bayesoleo._types import Array
from bayesoleo.discovery._fit import RESOLUTION
from bayesoleo.discovery._samples_that_count import weights
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._problem import Evaluation
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._records import Record

#: Part of the information on a start that may be left in the rest of a record; the estimate moves
#: by a root of it, in standard deviations.
LEFT = 1e-3
#: Directions of less information, beside the best, are told by no part of the record.
UNSEEN = 1e-10
#: A beginning is worth a solution of its own if it is no longer than this part of the record. It
#: has a reserve, as a start that moves may change what it is seen by, and never few samples.
SHORT, RESERVE, FEWEST = 0.25, 1.5, 256
#: Of estimates of a run's own parameters: its prediction asks for no certified digits, and a rough
#: model of a long record for no hundred iterations.
LIMITS = {"tolerance": 1e-4, "max_iterations": 30, "resolution": RESOLUTION}


def on_beginning(
    problem: CampaignProblem, held: dict[str, float], start: Array
) -> CampaignProblem | None:
    """The same problem on the part of its transient that tells its unknowns.

    Parameters
    ----------
    problem : CampaignProblem
        Of one run, whose unknowns say where it starts.
    held : dict of str to float
        What it holds.
    start : ndarray, shape (l,)
        Unknowns at which the part is chosen.

    Returns
    -------
    CampaignProblem or None
        None where most of the record is needed, or nothing can be solved at ``start``.
    """
    evaluation, predictor = problem.evaluate(start), problem.predictor
    (run,) = predictor.runs
    part = beginning_of(run.record, evaluation) if evaluation.status.ok else None
    if part is None:
        return None
    shorter = Predictor(
        predictor.model, [part], steps=predictor.steps, scheme=predictor.scheme,
        solver=predictor.solver, backend=predictor.backend, jobs=predictor.jobs, share=predictor,
    )  # fmt: skip
    return CampaignProblem(shorter).holding(held)


def beginning_of(record: Record, evaluation: Evaluation) -> Record | None:
    """A transient without what says next to nothing of some unknowns.

    Parameters
    ----------
    record : Record
    evaluation : Evaluation
        Residuals and sensitivities by these unknowns, of samples that count.

    Returns
    -------
    Record or None
        None where most of it is needed, or the unknowns are not seen at all.
    """
    counted = np.flatnonzero(weights(record) > 0)
    rows = np.stack(
        [
            sensitivity / max(float(np.std(residual)), 1e-300)
            for residual, sensitivity in zip(
                evaluation.residual, evaluation.sensitivity, strict=True
            )
        ]
    )
    if rows.shape[1] != counted.size or not np.isfinite(rows).all():
        return None
    later = _information_after(rows)
    if later is None:
        return None
    needed = int(counted[np.argmax(later <= LEFT)]) + 1
    size = max(int(RESERVE * needed), FEWEST)
    return first_samples(record, size) if size <= SHORT * record.time.size else None


def _information_after(rows: Array) -> Array | None:
    """Part of the information in what follows each sample, summed over independent directions.

    Of ``rows (outputs, samples, unknowns)``, in units of the noise.
    """
    information = np.einsum("bna,bnc->ac", rows, rows)
    scale = np.sqrt(np.diag(information))
    if not scale.any():
        return None
    scale[scale == 0.0] = 1.0
    size, axes = np.linalg.eigh(information / np.outer(scale, scale))
    seen = size > UNSEEN * size[-1]
    whitened = (rows / scale) @ (axes[:, seen] / np.sqrt(size[seen]))
    share = np.sum(whitened**2, axis=(0, 2))
    return np.asarray(np.cumsum(share[::-1])[::-1] - share)


def first_samples(record: Record, size: int) -> Record:
    """The first samples of a transient; its curves go on behind them."""
    return replace(
        record,
        time=record.time[:size],
        samples={name: values[:size] for name, values in record.samples.items()},
        kept=None if record.kept is None else record.kept[:size],
    )
