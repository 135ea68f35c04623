"""Residuals with what they may depend on: one series for each output of each run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from bayesoleo import schema
from bayesoleo._types import Array, Float
from bayesoleo.data.averaging import PeriodicAverage, periodic_average
from bayesoleo.errors import InputError, ResultsError
from bayesoleo.estimation.estimators.point import PointEstimate
from bayesoleo.estimation.problems.campaign_problem import CampaignProblem
from bayesoleo.estimation.problems.problem import Problem
from bayesoleo.prediction.input_noise import input_columns

_JUDGED = (
    schema.REPEATING,
    schema.NOISE,
    schema.EXPECTED_ERROR,
    schema.RATIO_TO_NOISE,
    schema.RATIO_TO_EXPECTED,
    schema.CHANCE,
)


@dataclass(frozen=True)
class Series:
    """Residual of one output in one run.

    Parameters
    ----------
    run, output, role, group, unit : str
    residual : ndarray, shape (n,)
        Measured less predicted, SI, in the order of time.
    time_step : float
        Sampling interval, s; 1 where samples have an order only.
    frequency : float
        Hz; NaN where nothing repeats.
    variables : mapping of str to ndarray, shape (n,)
        What the residual may depend on: time, phase, measured channels, velocities, predictions.
    units : mapping of str to str
        Of the variables.
    input_noise : float
        What the noise of the inputs does to the residual averaged over periods, rms, SI.
    judged : mapping of str to float
        What the search of a stored result made of it: ``ratio_to_noise``, ``ratio_to_expected`` and
        ``chance``, the probability of the latter; empty elsewhere.
    """

    run: str
    output: str
    role: str
    group: str
    unit: str
    residual: Float[Array, " samples"]
    time_step: float
    frequency: float
    variables: Mapping[str, Float[Array, " samples"]]
    units: Mapping[str, str] = field(default_factory=dict)
    input_noise: float = 0.0
    judged: Mapping[str, float] = field(default_factory=dict)

    @property
    def periodic(self) -> bool:
        """Whether the run repeats, so that the model's error repeats and noise does not."""
        return bool(np.isfinite(self.frequency))

    @property
    def period(self) -> int:
        """Samples in a period, rounded; the length of the series where nothing repeats."""
        if not self.periodic:
            return self.residual.size
        return max(2, round(1 / (self.frequency * self.time_step)))

    def average(self) -> PeriodicAverage | None:
        """The part that repeats; None where nothing can."""
        if not self.periodic:
            return None
        return periodic_average(self.residual, self.time_step, self.frequency)

    def noise(self) -> Array:
        """What does not repeat of the residual: all of it where nothing can, shape (n,)."""
        average = self.average()
        if average is None:
            return self.residual
        # The average takes a share of the noise with it.
        loss = 1 - average.number / average.samples
        return cast(Array, (self.residual - average.values) / np.sqrt(loss))

    def period_means(self) -> Array:
        """Mean residual of each whole period, shape (periods,); of all where nothing repeats."""
        if not self.periodic:
            return self.residual.mean()[None]
        samples = 1 / (self.frequency * self.time_step)
        # A record of whole periods may end a sample short of them.
        count = int((self.residual.size + 1) / samples)
        starts = np.round(np.arange(count) * samples).astype(int)
        end = min(self.residual.size, round(count * samples))
        sums = np.add.reduceat(self.residual[:end], starts)
        return sums / np.diff([*starts, end])


def series_of_problem(problem: Problem, point: PointEstimate | ArrayLike) -> list[Series]:
    """Residuals of a problem at an estimate.

    Parameters
    ----------
    problem : Problem
        With a campaign's problem the residuals come with everything that was measured.
    point : PointEstimate or array_like, shape (l,)

    Raises
    ------
    InputError
        If the problem cannot be evaluated there.
    """
    theta = np.array(point.theta if isinstance(point, PointEstimate) else point, dtype=float)
    evaluation = problem.evaluate(theta)
    if not evaluation.status.ok:
        raise InputError(
            f"cannot be evaluated: {evaluation.status.message}",
            key="theta",
            value=theta.tolist(),
            hint="give an estimate that converged",
        )
    if isinstance(problem, CampaignProblem):
        return _of_campaign(problem, theta)
    ends = np.cumsum(problem.counts, axis=0)
    found = []
    for b, output in enumerate(problem.outputs):
        for r, run in enumerate(problem.runs):
            residual = evaluation.residual[b][ends[r, b] - problem.counts[r, b] : ends[r, b]]
            order = {"sample": np.arange(residual.size, dtype=float)}
            found.append(Series(str(run), output, "fit", "", "", residual, 1.0, np.nan, order))
    return found


def _of_campaign(problem: CampaignProblem, theta: Array) -> list[Series]:
    predictor, full = problem.predictor, problem.full(theta[None])
    found = []
    for r, run in enumerate(predictor.runs):
        record = run.record
        y = predictor.simulate(full, r).y[0]
        columns = input_columns(run, predictor.constants(full, r)[0])
        spread = np.sqrt(np.mean(np.sum(columns**2, axis=1), axis=1))
        variables = {"time": record.time - record.time[0], **dict(record.samples)}
        units = {"time": "s"} | dict(predictor.model.inputs)
        units |= {name: output.unit for name, output in predictor.model.outputs.items()}
        # With samples missing periods cannot be compared sample by sample.
        periodic = bool(np.isfinite(record.frequency)) and record.kept is None
        if periodic:
            variables["phase"], units["phase"] = record.phase % 1.0, "cycle"
            for name in predictor.model.inputs:
                rate = record.harmonics[name].evaluate(record.phase, record.frequency, 1)
                variables[f"rate of {name}"] = rate
                units[f"rate of {name}"] = f"{units[name]}/s" if units[name] else "1/s"
        step = float((record.time[-1] - record.time[0]) / (record.time.size - 1))
        for b, output in enumerate(problem.outputs):
            found.append(
                Series(
                    run=record.label,
                    output=output,
                    role=record.role,
                    group=record.group,
                    unit=units.get(output, ""),
                    residual=problem.kept(r, record.samples[output] - y[b]),
                    time_step=step,
                    frequency=record.frequency if periodic else np.nan,
                    variables={
                        name: problem.kept(r, values)
                        for name, values in (
                            _without(variables, output) | {f"predicted {output}": y[b]}
                        ).items()
                    },
                    units=units | {f"predicted {output}": units.get(output, "")},
                    input_noise=float(spread[b]),
                )
            )
    return found


def _without(variables: Mapping[str, Array], output: str) -> dict[str, Array]:
    """All but the output itself: its noise is the residual's, so that they always depend."""
    return {name: values for name, values in variables.items() if name != output}


def series_of_tree(tree: xr.DataTree, stage: str | None = None) -> list[Series]:
    """Residuals of a stored result.

    Parameters
    ----------
    tree : DataTree
        Of ``close`` or ``trace``.
    stage : {"before", "after"}, optional
        Of the model as declared or as extended; by default the latter, where there is one.

    Raises
    ------
    ResultsError
        If the result holds no residuals.
    """
    if schema.RESIDUAL not in tree.children:
        raise ResultsError(
            "holds no residuals", key=schema.RESIDUAL,
            hint="give the results.nc that `bayesoleo close` or `bayesoleo trace` wrote",
        )  # fmt: skip
    residual = tree[schema.RESIDUAL].to_dataset()
    observed = tree[schema.RECORDS].to_dataset()
    constant = tree[schema.CONSTANT_DATA].to_dataset()
    outputs = [str(n).removesuffix("_before") for n in residual if str(n).endswith("_before")]
    if stage is None:
        stage = "after" if schema.after(outputs[0]) in residual else "before"
    if stage not in ("before", "after") or f"{outputs[0]}_{stage}" not in residual:
        raise ResultsError(
            "there is no such stage", key="stage", value=stage, hint="use 'before' or 'after'"
        )
    found = []
    for run in residual[schema.RUN].values:
        groups = {"r": residual, "o": observed, "c": constant}
        one = {key: data.sel(run=run) for key, data in groups.items()}
        for output in outputs:
            series = _of_tree(one, str(run), output, stage)
            found.append(replace(series, judged=judged_errors(tree, output, str(run), stage)))
    return found


def judged_errors(
    tree: xr.DataTree, output: str, run: str, stage: str = "after"
) -> dict[str, float]:
    """How a search has held the error of one output in one run against noise and expectation.

    Parameters
    ----------
    tree : DataTree
        Of ``close`` or ``trace``; of anything else nothing is known.
    output, run : str
    stage : {"before", "after"}
        With the model as declared, or with what was added.

    Returns
    -------
    dict of str to float
        ``repeating``, ``noise``, ``expected_error``, ``ratio_to_noise``, ``ratio_to_expected`` and
        ``chance``; empty where the result does not hold them.
    """
    if schema.DISCOVERY not in tree.children:
        return {}
    table = tree[schema.DISCOVERY].to_dataset()
    if schema.CHANCE not in table or output not in table[schema.OUTPUT].values:
        return {}
    if run not in table[schema.RUN].values:
        return {}
    one = table.isel({schema.ROUND: 0 if stage == "before" else -1}).sel(output=output, run=run)
    return {name: float(one[name]) for name in _JUDGED}


def _of_tree(one: Mapping[str, xr.Dataset], run: str, output: str, stage: str) -> Series:
    residual, observed, constant = one["r"], one["o"], one["c"]
    values = residual[f"{output}_{stage}"]
    keep = np.isfinite(values.values)
    time = observed[schema.TIME].values[keep]
    variables, units = {}, {}
    for name in observed.data_vars:
        column = observed[name].values
        if name != output and column.size == keep.size and np.isfinite(column[keep]).all():
            variables[str(name)] = column[keep] % 1.0 if name == schema.PHASE else column[keep]
            units[str(name)] = str(observed[name].attrs.get(schema.UNITS, ""))
    variables[f"predicted {output}"] = observed[output].values[keep] - values.values[keep]
    for name in (schema.STROKE, schema.VELOCITY):
        if name in residual and np.isfinite(residual[name].values[keep]).all():
            # Whose position or velocity it is, which results of older versions do not say.
            what = str(residual[name].attrs.get(schema.LONG_NAME, name))
            variables[what] = residual[name].values[keep]
            units[what] = str(residual[name].attrs.get(schema.UNITS, ""))
    frequency = float(constant[schema.FREQUENCY])
    series = Series(
        run=run,
        output=output,
        role=str(constant[schema.ROLE].values),
        group=str(constant[schema.RUN_GROUP].values),
        unit=str(values.attrs.get(schema.UNITS, "")),
        residual=values.values[keep],
        time_step=float((time[-1] - time[0]) / (time.size - 1)),
        frequency=frequency,
        variables=variables,
        units=units,
    )
    average, name = series.average(), schema.noise(output)
    if average is None or name not in residual or not np.isfinite(residual[name]):
        return series
    # The stored noise holds that of the inputs already.
    more = max(float(residual[name]) ** 2 - average.noise**2, 0.0)
    return replace(series, input_noise=float(np.sqrt(more)))
