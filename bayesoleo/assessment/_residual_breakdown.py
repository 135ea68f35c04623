"""Breakdown of the repeating residual by harmonic and by coordinate.

The residuals of each output of each run are held beside the quantities that they may depend on. All
runs are pooled, in units of the noise of their averages, so that a function of velocity, for
example, is one function for all of them. If it explains most of the repeating residual, it is close
to the missing law.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import cast

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from bayesoleo import _schema as schema
from bayesoleo._types import Array, Float
from bayesoleo.data._noise import PeriodicAverage, periodic_average
from bayesoleo.errors import InputError, ResultsError
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.estimation._problem import EstimationProblem
from bayesoleo.prediction._run_errors import input_columns

_JUDGED = (
    schema.REPEATING,
    schema.NOISE,
    schema.EXPECTED_ERROR,
    schema.RATIO_TO_NOISE,
    schema.RATIO_TO_EXPECTED,
    schema.CHANCE,
)

#: Harmonics told one by one; what lies above counts together, under the order after the last.
ORDERS = 12
#: Bins of a coordinate, each with as many points.
BINS = 24
#: Coordinates that a run's mean is, and the mean of all runs of a group.
RUN, GROUP, SIGN = "run", "group", "direction"


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


def series_of_problem(problem: EstimationProblem, point: PointEstimate | ArrayLike) -> list[Series]:
    """Residuals of a problem at an estimate.

    Parameters
    ----------
    problem : EstimationProblem
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


def residual_breakdown(tree: xr.DataTree) -> xr.Dataset:
    """Share of the repeating error, beyond its noise, by harmonic and by coordinate.

    Parameters
    ----------
    tree : DataTree
        Of ``close`` or ``trace``. Periodic runs only.

    Returns
    -------
    Dataset
        ``power(stage, output, harmonic)`` and ``share(stage, output, coordinate)`` over the excess
        of the first stage, ``before``; ``excess(output)``, that excess as a mean square over the
        noise's. The last harmonic stands for itself and all above. A coordinate's share is what one
        function of it, the same in all runs, explains; ``direction`` is the sign of the velocity,
        ``run`` and ``group`` a constant for each.

    Raises
    ------
    InputError
        If the result holds no residual of a periodic run.
    """
    residual = tree[schema.RESIDUAL].to_dataset() if schema.RESIDUAL in tree.children else None
    if residual is None:
        raise InputError("the result holds no residual", hint="give the result of close or trace")
    observed = tree[schema.RECORDS].to_dataset()
    periodic = np.isfinite(observed[schema.PHASE].values).any(axis=1)
    if not periodic.any():
        raise InputError("no run is periodic", hint="transients have no harmonics")
    stages = [
        s for s in ("before", "after") if any(str(n).endswith(f"_{s}_mean") for n in residual)
    ]
    end = schema.mean(schema.before(""))
    outputs = [str(n)[: -len(end)] for n in residual.data_vars if str(n).endswith(end)]
    places = _coordinates(tree, residual, periodic)
    power = np.zeros((len(stages), len(outputs), ORDERS + 1))
    share = np.zeros((len(stages), len(outputs), len(places)))
    excess = np.zeros(len(outputs))
    for b, output in enumerate(outputs):
        noise = residual[schema.noise(output)].values[periodic]
        for s, stage in enumerate(stages):
            mean = residual[f"{output}_{stage}_mean"].values[periodic] / noise[:, None]
            solved = np.isfinite(mean).all(axis=1)
            if s == 0:
                excess[b] = float(np.mean(mean[solved] ** 2) - 1.0)
            # Where only noise is left, shares of it mean nothing.
            whole = max(excess[b], 2.0 / np.sqrt(mean[solved].size))
            power[s, b] = _by_order(mean[solved]) / whole
            share[s, b] = [_explained(mean[solved], x[solved]) / whole for x in places.values()]
    return xr.Dataset(
        {
            "power": (("stage", schema.OUTPUT, "harmonic"), power),
            "share": (("stage", schema.OUTPUT, "coordinate"), share),
            "excess": (schema.OUTPUT, excess),
        },
        coords={
            "stage": stages,
            schema.OUTPUT: outputs,
            "harmonic": np.arange(ORDERS + 1),
            "coordinate": list(places),
        },
    )


def _by_order(mean: Array) -> Array:
    """Mean square by harmonic less that of noise, the last with all above, shape (ORDERS + 1,)."""
    count = mean.shape[1]
    squares = np.abs(np.fft.rfft(mean, axis=1) / count) ** 2
    # White noise of unit mean square holds as much in each real coefficient: two of most orders,
    # one of the mean and, with an even number of phases, of the last.
    coefficients = np.full(squares.shape[1], 2.0)
    coefficients[[0] if count % 2 else [0, -1]] = 1.0
    squares *= coefficients
    beyond = squares.mean(axis=0) - coefficients / count
    return np.append(beyond[:ORDERS], beyond[ORDERS:].sum())


def _explained(mean: Array, place: Array) -> float:
    """Mean square that a function of a coordinate explains, less what it would of noise."""
    x, m = place.ravel(), mean.ravel()
    labels = np.unique(x)
    if labels.size <= BINS:
        which = np.searchsorted(labels, x)
    else:
        which = np.empty(x.size, dtype=np.int64)
        for k, part in enumerate(np.array_split(np.argsort(x, kind="stable"), BINS)):
            which[part] = k
    sizes = np.bincount(which)
    sums = np.bincount(which, weights=m)
    return float((np.sum(sums**2 / sizes) - sizes.size) / m.size)


def _coordinates(
    tree: xr.DataTree, residual: xr.Dataset, periodic: NDArray[np.bool_]
) -> dict[str, Array]:
    """What the error may be a function of, on the phases of the averages, each (runs, phases)."""
    phases = residual.sizes[schema.PHASE]
    observed = tree[schema.RECORDS].to_dataset()
    phase = observed[schema.PHASE].values[periodic]
    count = phase.shape[0]
    found: dict[str, Array] = {"phase": np.tile(np.arange(phases) / phases, (count, 1))}
    for coordinate in (schema.STROKE, schema.VELOCITY):
        if coordinate in residual:
            values = _folded(phase, residual[coordinate].values[periodic], phases)
            found[str(residual[coordinate].attrs.get(schema.LONG_NAME, coordinate))] = values
            if coordinate == schema.VELOCITY:
                found[SIGN] = np.sign(values)
    for name, item in observed.data_vars.items():
        if name not in (schema.TIME, schema.PHASE):
            values = _folded(phase, item.values[periodic], phases)
            # The channel that drives is as a rule the position itself.
            if not any(_same(values, other) for other in found.values()):
                found[str(name)] = values
    found[RUN] = np.tile(np.arange(float(count))[:, None], (1, phases))
    constant = tree[schema.CONSTANT_DATA].to_dataset()
    groups = constant[schema.RUN_GROUP].values[periodic]
    names, which = np.unique(groups.astype(str), return_inverse=True)
    if names.size > 1:
        found[GROUP] = np.tile(which.astype(float)[:, None], (1, phases))
    return {name: values for name, values in found.items() if np.isfinite(values).all()}


def _same(values: Array, other: Array) -> bool:
    """Whether two coordinates agree but for noise."""
    return bool(np.ptp(values - other) < 0.01 * np.ptp(values))


def _folded(phase: Array, values: Array, count: int) -> Array:
    """A channel at ``count`` phases of a period, averaged over neighbouring samples of all periods;
    where samples are few, interpolated between them."""
    rows = []
    for place, row in zip(phase, values, strict=True):
        keep = np.isfinite(place) & np.isfinite(row)
        which = np.round(place[keep] % 1.0 * count).astype(int) % count
        sizes = np.bincount(which, minlength=count)
        sums = np.bincount(which, weights=row[keep], minlength=count)
        at = np.flatnonzero(sizes)
        rows.append(np.interp(np.arange(count), at, sums[at] / sizes[at], period=count))
    return np.array(rows)
