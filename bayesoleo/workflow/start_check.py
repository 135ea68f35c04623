"""What the model says at its nominal values, held against what was measured, before anything is
estimated: a sign that is turned and a unit that is wrong show here."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from bayesoleo.model import Model
from bayesoleo.prediction.predictor import Predictor
from bayesoleo.prediction.records import Record
from bayesoleo.solvers.schemes.choose import COLLOCATION
from bayesoleo.solvers.status import Status

#: Correlation, averaged over the runs, below which a sign looks turned. Starts drawn from wide
#: priors about a resonance, which lies on the wrong side of some runs, stay above -0.25.
TURNED = -0.5
#: Ratio of sizes that no start is expected to be off by, in all runs.
LARGE = 100.0
#: A power of ten is looked for where the shapes agree like this, and sizes that well with it.
ALIKE, NEAR = 0.95, 0.05
#: Sizes are compared of what stands above the noise by this factor.
ABOVE_NOISE = 3.0


@dataclass(frozen=True)
class StartCheck:
    """An output of one run at the nominal values.

    Parameters
    ----------
    run, output : str
    status : str
        Of the solution; the numbers are None where there is none.
    correlation : float or None
        With what was measured, about the means; None where either does not move.
    ratio : float or None
        Standard deviation predicted over that measured.
    """

    run: str
    output: str
    status: str
    correlation: float | None = None
    ratio: float | None = None


def starts_of(
    model: Model,
    records: Sequence[Record],
    steps: int,
    scheme: str,
    jobs: int | None,
    solver: str = COLLOCATION,
) -> list[StartCheck]:
    """Predict runs at a model's nominal values and compare.

    Parameters
    ----------
    model : Model
        Driven.
    records : sequence of Record
    steps : int
        Of the mesh.
    scheme : str
        Discretisation.
    jobs : int or None
        Threads.
    solver : str
        Of periodic runs.
    """
    predictor = Predictor(
        model, records, steps=steps, scheme=scheme, solver=solver, backend="numpy", jobs=jobs
    )
    theta = predictor.layout.start(model)
    statuses = predictor.set_anchor(theta) if model.dofs else [Status.CONVERGED] * len(records)
    found = []
    for r, (record, status) in enumerate(zip(records, statuses, strict=True)):
        samples = predictor.simulate(theta[None], r) if status.ok else None
        for b, output in enumerate(predictor.outputs):
            if samples is None or samples.status[0] != Status.CONVERGED:
                said = status if samples is None else Status(int(samples.status[0]))
                found.append(StartCheck(record.label, output, said.message))
            else:
                found.append(_compared(record, output, samples.y[0, b]))
    return found


def _compared(record: Record, output: str, predicted: np.ndarray) -> StartCheck:
    kept = slice(None) if record.kept is None else record.kept
    measured = record.samples[output][kept]
    moved, seen = predicted[kept] - predicted[kept].mean(), measured - measured.mean()
    size, noise = float(np.std(seen)), record.signal_noise.get(output, 0.0)
    message = Status.CONVERGED.message
    if size <= ABOVE_NOISE * noise or not np.isfinite(moved).all():
        return StartCheck(record.label, output, message)
    ratio = float(np.std(moved)) / size
    correlation = None
    if ratio > 0:
        correlation = float(moved @ seen / (np.linalg.norm(moved) * np.linalg.norm(seen)))
    return StartCheck(record.label, output, message, correlation, ratio)


def about_start(starts: Sequence[StartCheck], model: Model) -> list[str]:
    """Sentences about what looks like a mistake, with its figures.

    Only what the runs show together is told: from a poor start a resonance may lie on the wrong
    side of one.

    Parameters
    ----------
    starts : sequence of StartCheck
    model : Model
    """
    failed = [f"run {item.run} ({item.status})" for item in _by_run(starts) if item.ratio is None]
    failed = [text for text in failed if Status.CONVERGED.message not in text]
    found = []
    if failed:
        found.append(
            f"the model has no solution at its nominal values in {', '.join(failed)}: check signs,"
            " units and nominal values"
        )
    for output in model.outputs:
        own = [item for item in starts if item.output == output and item.ratio is not None]
        if own:
            found += _about_output(output, own, bool(model.dofs))
    return found


def _by_run(starts: Sequence[StartCheck]) -> list[StartCheck]:
    """One entry for each run."""
    return list({item.run: item for item in starts}.values())


def _about_output(output: str, starts: Sequence[StartCheck], resonates: bool) -> list[str]:
    correlations = [item.correlation for item in starts if item.correlation is not None]
    ratios = np.array([item.ratio for item in starts], dtype=float)
    found = []
    if correlations and np.mean(correlations) < TURNED:
        more = ", or a resonance on the wrong side of the runs" if resonates else ""
        found.append(
            f"at the nominal values {output} answers with the opposite sign (correlation with what"
            f" was measured {_range(correlations)}): a channel or a term whose sign is turned looks"
            f" so{more}"
        )
    if (ratios >= LARGE).all() or (ratios <= 1 / LARGE).all():
        found.append(
            f"at the nominal values {output} moves {_range(ratios)} times as much as was measured"
            " in every run: check the units of channels and parameters"
        )
        return found
    power = 10.0 ** np.round(np.log10(np.maximum(ratios, 1e-300)).mean())
    shaped = bool(correlations) and all(abs(value) > ALIKE for value in correlations)
    if shaped and power != 1 and (np.abs(ratios / power - 1) < NEAR).all():
        found.append(
            f"at the nominal values {output} has the shape that was measured and {_range(ratios)}"
            f" times its size in every run, a power of ten: check the units of its channel"
        )
    return found


def _range(values: Sequence[float] | np.ndarray) -> str:
    """The numbers, or from which to which they go."""
    low, high = f"{min(values):.3g}", f"{max(values):.3g}"
    return low if low == high else f"{low} to {high}"


def as_plain(starts: Sequence[StartCheck]) -> list[dict[str, Any]]:
    """The same for programs."""
    return [asdict(item) for item in starts]
