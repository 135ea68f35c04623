"""The offset of an output that drifts, as far as the fitted runs have it in common.

The mean of a channel that drifts is an unknown of each run. A constant offset of its sensor is part
of all these means, and no parameter: a prediction of another record lacks it. What the means of the
fitted runs have in common stands for it, with their scatter as its uncertainty.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
import xarray as xr

from bayesoleo import _distributions as distributions
from bayesoleo._schema import UNIT
from bayesoleo._types import Array
from bayesoleo.data._disturbances import baseline_of
from bayesoleo.errors import InputError
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._nuisance import error_of, sd_of
from bayesoleo.model._model import Model
from bayesoleo.prediction._records import Record

#: Attribute of the group ``point`` that holds baselines as JSON.
ATTRIBUTE = "baselines"


@dataclass(frozen=True)
class Baseline:
    """Common offset of an output that drifts.

    Parameters
    ----------
    output : str
    unit : str
        SI.
    value, sd : float
        Offset and standard deviation of it in another run, SI.
    runs : tuple of str
        Fitted runs that it follows from.
    priors : tuple of float
        Prior standard deviation of the mean of each, SI.
    """

    output: str
    unit: str
    value: float
    sd: float
    runs: tuple[str, ...]
    priors: tuple[float, ...]

    def __str__(self) -> str:
        number = f"{self.value:.3g} ± {self.sd:.2g} {self.unit}".rstrip()
        return f"{self.output} {number}, from {', '.join(self.runs)}"


def common_baselines(problem: CampaignProblem, theta: Array, covariance: Array) -> list[Baseline]:
    """Offsets of the outputs that drift in the fitted runs.

    The value is the mean over the runs. Another run deviates from it as these do from each other,
    by a standard deviation that makes 1.96 of it the 95 % interval of Student's t for one more run:
    few runs say little of a scatter. It is no larger than that of the priors, which stand for it
    where there is one run. The errors of the estimates are added.

    Parameters
    ----------
    problem : CampaignProblem
    theta : ndarray, shape (l,)
        Estimate.
    covariance : ndarray, shape (l, l)
    """
    model, names, found = problem.predictor.model, list(problem.names), []
    for output, declared in model.outputs.items():
        name = baseline_of(output)
        if sd_of(name) not in model.conditions:
            continue
        rows, columns = [], list[int]()
        for record in problem.predictor.records:
            prior = record.conditions.get(sd_of(name), 0.0)
            error = f"{error_of(name)}[{record.label}]"
            if prior > 0.0 and error in names:
                k = names.index(error)
                rows.append((record.label, prior, prior * theta[k]))
                columns.append(k)
        if not rows:
            continue
        labels, priors, means = zip(*rows, strict=True)
        value, count = float(np.mean(means)), len(rows)
        between = min(_scatter(means), float(np.sqrt(np.mean(np.square(priors)))))
        # What all runs share, such as an error of a preload, does not show in their scatter.
        part = np.array(priors) / count
        errors = float(part @ covariance[np.ix_(columns, columns)] @ part)
        sd = float(np.hypot(between * np.sqrt(1.0 + 1.0 / count), np.sqrt(max(errors, 0.0))))
        found.append(Baseline(output, declared.unit, value, sd, labels, tuple(map(float, priors))))
    return found


def _scatter(means: Sequence[float]) -> float:
    """Standard deviation between runs, widened by how few there are; infinite of one."""
    if len(means) < 2:
        return np.inf
    widened = distributions.t.isf(0.025, len(means) - 1) / distributions.norm.isf(0.025)
    return float(widened * np.std(means, ddof=1))


def to_attribute(found: Sequence[Baseline]) -> str:
    """As JSON."""
    return json.dumps([asdict(one) for one in found], ensure_ascii=False)


def baselines_in(point: xr.Dataset) -> list[Baseline]:
    """Those that a result holds in its group ``point``."""
    rows = json.loads(point.attrs.get(ATTRIBUTE, "[]"))
    return [
        Baseline(**{**row, "runs": tuple(row["runs"]), "priors": tuple(row["priors"])})
        for row in rows
    ]


def table(found: Sequence[Baseline]) -> xr.Dataset:
    """Value, standard deviation, unit and runs, over ``output``."""
    return xr.Dataset(
        {
            "offset": ("output", [one.value for one in found]),
            "sd": ("output", [one.sd for one in found]),
            UNIT: ("output", np.array([one.unit for one in found], dtype=object)),
            "runs": ("output", np.array([", ".join(one.runs) for one in found], dtype=object)),
        },
        coords={"output": [one.output for one in found]},
    )


def check_baselines(found: Sequence[Baseline], model: Model) -> None:
    """Refuse to add offsets that there are not.

    Raises
    ------
    InputError
        If no output of the fitted runs drifts, or the model does not have these outputs.
    """
    if not found:
        raise InputError(
            "no common offset is known: a model has none, and in the fitted runs of this result no"
            " output drifts, or it is of an earlier version",
            key="common_offset", hint="leave it out, or fit again",
        )  # fmt: skip
    for one in found:
        if baseline_of(one.output) not in model.conditions:
            raise InputError(
                f"the model has no offset of {one.output}", key="common_offset",
                value=model.name, hint="predict with the model of the result, or leave it out",
            )  # fmt: skip


def with_common_baselines(
    records: Sequence[Record],
    found: Sequence[Baseline],
    same: Callable[[Record, str], bool] = lambda record, output: True,
) -> tuple[Record, ...]:
    """Records with the offsets as known conditions and their uncertainty.

    A run that was fitted has the mean that was estimated on it.

    Parameters
    ----------
    records : sequence of Record
    found : sequence of Baseline
    same : callable
        Whether the samples of an output are those of the fitted run of this label.

    Raises
    ------
    InputError
        If a run has the label of a fitted one, and is another.
    """
    for record in records:
        for one in found:
            if record.label in one.runs and not same(record, one.output):
                raise InputError(
                    "another run of this label was fitted, with a mean of its own",
                    run=record.label, key="common_offset", hint="give this run another label",
                )  # fmt: skip
    return tuple(_with_baselines(record, found) for record in records)


def _with_baselines(record: Record, found: Sequence[Baseline]) -> Record:
    conditions, sds = dict(record.conditions), dict(record.condition_sd)
    for one in found:
        name = baseline_of(one.output)
        if record.label in one.runs:
            sds[name] = one.priors[one.runs.index(record.label)]
        else:
            conditions[name], sds[name] = one.value, one.sd
    return replace(record, conditions=conditions, condition_sd=sds)


def added_text(found: Sequence[Baseline]) -> str:
    """What was added to a prediction, in one line for each output."""
    return "\n".join(
        f"offset and standard deviation added to runs that were not fitted: {one}" for one in found
    )


def notes_on(found: Sequence[Baseline]) -> list[str]:
    """What a result says of its common offsets, one sentence an output."""
    return [
        f"{one.output} drifts, and its mean is an unknown of each run; what the fitted runs have in"
        f" common is an offset of {str(one).removeprefix(one.output).strip()}. A prediction of"
        f" another run has it with common_offset only"
        for one in found
    ]
