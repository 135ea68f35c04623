"""Assessment of an estimate: every residual test by output and run.

The tests are those of Verbeek (1993), section 2.4, as numbers by output and run. A further test
compares the mean residuals between runs and between groups of runs: a model error differs more
between runs than within one and shows as means that noise cannot explain (section 6.2).

References
----------
Verbeek (1993), section 2.4; Bard (1974), chapter 7.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._schema import LabelledResult, columns, variable
from bayesoleo._types import Array
from bayesoleo.assessment import _residual_tests as tests
from bayesoleo.assessment._residual_breakdown import Series, series_of_problem, series_of_tree
from bayesoleo.assessment._residual_tests import autocorrelation_time
from bayesoleo.errors import InputError
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.estimation._problem import EstimationProblem

#: What is found, in words.
ACROSS = {
    "share_of_runs": "part of the variance that differs from run to run",
    "share_of_runs_p": "its probability",
    "share_of_groups": "part of the variance of run means that differs from group to group",
    "share_of_groups_p": "its probability",
}
_TINY = np.finfo(float).tiny

#: Outliers listed of each series, the farthest.
LISTED = 5
#: Lags of a correlogram over one period, and periods that it spans.
LAGS, CYCLES = 40, 2
#: A test is marked where its probability, times the number of series, is below this.
MARKED = 0.01
_MOST_ROUNDS = 20
_NUMBERS = {
    "rms": "root mean square",
    "mean": "mean",
    "runs_z": "test on runs of signs",
    "runs_p": "its probability",
    "skewness": "skewness",
    "kurtosis": "excess kurtosis",
    "normality": "test of normality, chi-square with two degrees of freedom",
    "normality_p": "its probability",
    "autocorrelation_time": "samples that hold the information of one, of what does not repeat",
    "intraclass_correlation": "correlation of the same phase in different periods",
    "lack_of_fit": "mean square that repeats over that of its noise",
    "lack_of_fit_p": "its probability",
    "ratio_to_noise": "root of the lack of fit",
    "ratio_to_expected": "repeating error over what noise and the parameters' posterior let expect",
    "outliers": "number of outliers",
    "outlier_limit": "robust standard deviations beyond which a sample is one",
}
_IN_UNIT = ("rms", "mean")


def between_means(chosen: Sequence[Series]) -> dict[str, float]:
    """Shares of the variance that differ between runs and groups, with their probabilities.

    Parameters
    ----------
    chosen : sequence of Series
        Of one output, one a run.

    Returns
    -------
    dict
        The keys of ``ACROSS``; NaN where there are too few runs or groups.
    """
    found = dict.fromkeys(ACROSS, np.nan)
    if len(chosen) < 2:
        return found
    means = np.array([one.residual.mean() for one in chosen])
    whole = np.concatenate([one.residual for one in chosen])
    sizes = np.array([one.residual.size for one in chosen])
    total = max(float(np.sum((whole - whole.mean()) ** 2)), _TINY)
    found["share_of_runs"] = float(np.sum(sizes * (means - whole.mean()) ** 2)) / total
    found["share_of_runs_p"] = _runs_differ(chosen, means)
    labels = np.array([one.group for one in chosen])
    members = [means[labels == label] for label in dict.fromkeys(labels)]
    if 1 < len(members) < len(chosen):
        share, p_value = _groups_differ(means, members)
        found |= {"share_of_groups": share, "share_of_groups_p": p_value}
    return found


def _runs_differ(chosen: Sequence[Series], means: Array) -> float:
    """Probability of means so far apart, each with an error of its own.

    Errors follow from the autocorrelation time of the noise, which a short record knows badly.
    Periods are replicates; the scatter of their means corrects all errors by a common factor.
    """
    noise = [one.noise() for one in chosen]
    effective = np.array([e.size / autocorrelation_time(e) for e in noise])
    weight = effective / np.maximum([float(np.var(e)) for e in noise], _TINY)
    centre = float(np.sum(weight * means) / weight.sum())
    chi_square = float(np.sum(weight * (means - centre) ** 2))
    periods = [one.period_means() for one in chosen]
    free = sum(part.size - 1 for part in periods)
    if free == 0:
        return float(distributions.chi2.sf(chi_square, len(chosen) - 1))
    scatter = sum(
        w * np.sum((part - part.mean()) ** 2) / part.size
        for w, part in zip(weight, periods, strict=True)
    )
    ratio = chi_square / (len(chosen) - 1) / max(float(scatter) / free, _TINY)
    return float(distributions.f.sf(ratio, len(chosen) - 1, free))


def _groups_differ(means: Array, members: Sequence[Array]) -> tuple[float, float]:
    """Share of the variance of run means between groups, and its probability."""
    total = float(np.sum((means - means.mean()) ** 2))
    inside = float(sum(np.sum((part - part.mean()) ** 2) for part in members))
    between, free = len(members) - 1, means.size - len(members)
    ratio = (total - inside) / between / max(inside / free, _TINY)
    return 1 - inside / max(total, _TINY), float(distributions.f.sf(ratio, between, free))


def assess(
    subject: EstimationProblem | xr.DataTree | Sequence[Series],
    point: PointEstimate | ArrayLike | None = None,
    *,
    stage: str | None = None,
) -> LabelledResult:
    """Test the residuals of an estimate.

    Parameters
    ----------
    subject : EstimationProblem, DataTree or sequence of Series
        What was fitted, the result of ``close`` or ``trace``, or residuals from elsewhere.
    point : PointEstimate or array_like, shape (l,), optional
        The estimate; only of a problem.
    stage : {"before", "after"}, optional
        Of a result: the model as declared or as extended; by default the latter.

    Returns
    -------
    LabelledResult
        The group ``assessment``. By ``(output, run)``: ``rms``, ``mean``; ``runs_z``, the test on
        runs of signs; ``skewness``, ``kurtosis``, ``normality``; ``autocorrelation_time``,
        ``intraclass_correlation``; ``lack_of_fit`` (pure error between periods),
        ``ratio_to_noise``; ``outliers``, each with
        its probability ``_p`` where it has one. Of a result of ``close`` or ``trace`` also
        ``ratio_to_expected``, and ``lack_of_fit_p`` is then its probability. ``share`` and
        ``share_p`` ``(output, run, variable)``: the part of the residual's variance that a variable
        explains.
        ``outlier_time``, ``outlier_score`` ``(output, run, rank)``. ``correlogram`` and
        ``noise_correlogram`` ``(output, run, lag)`` over two periods. ``share_of_runs``,
        ``share_of_runs_p``, ``share_of_groups``, ``share_of_groups_p`` ``(output)``: do mean
        residuals differ between runs and between groups.

    Raises
    ------
    InputError
        If the estimate is missing, or the problem cannot be evaluated there.
    """
    if isinstance(subject, xr.DataTree):
        series = series_of_tree(subject, stage)
    elif isinstance(subject, Sequence):
        series = list(subject)
    elif point is None:
        raise InputError("the estimate is missing", key="point", hint="pass assess(problem, point)")
    else:
        series = series_of_problem(subject, point)
    data = _dataset(series)
    return LabelledResult(data, assessment_text(data))


def _numbers(series: Series) -> dict[str, float]:
    """All single numbers of one series."""
    noise, average = series.noise(), series.average()
    signs = tests.runs_of_signs(series.residual)
    skewness, kurtosis, normal = tests.normality(series.residual)
    places, _, limit = outliers_of(series)
    found = {
        "rms": float(np.sqrt(np.mean(series.residual**2))),
        "mean": float(series.residual.mean()),
        "runs_z": signs.statistic,
        "runs_p": signs.p_value,
        "skewness": skewness,
        "kurtosis": kurtosis,
        "normality": normal.statistic,
        "normality_p": normal.p_value,
        "autocorrelation_time": tests.autocorrelation_time(noise),
        "outliers": float(places.size),
        "outlier_limit": limit,
    }
    missing = dict.fromkeys(
        (
            "intraclass_correlation",
            "lack_of_fit",
            "lack_of_fit_p",
            "ratio_to_noise",
            "ratio_to_expected",
        ),
        np.nan,
    )
    missing |= _judged(series)
    if average is None:
        return found | missing
    size = average.repeating, average.sigma, average.samples, average.number
    fit = tests.lack_of_fit(*size, series.input_noise, tests.autocorrelation_time(noise, 2))
    own = {
        "intraclass_correlation": tests.intraclass_correlation(*size),
        "lack_of_fit": fit.statistic,
        "lack_of_fit_p": fit.p_value,
        "ratio_to_noise": float(np.sqrt(fit.statistic)),
    }
    return found | missing | own | _judged(series)


def _judged(series: Series) -> dict[str, float]:
    """What the search said of the same residual: there is one answer."""
    known = series.judged
    if not known:
        return {}
    return {
        "ratio_to_noise": known["ratio_to_noise"],
        "ratio_to_expected": known["ratio_to_expected"],
        "lack_of_fit": known["ratio_to_noise"] ** 2,
        "lack_of_fit_p": known["chance"],
    }


def _dataset(series: Sequence[Series]) -> xr.Dataset:
    outputs = list(dict.fromkeys(one.output for one in series))
    runs = list(dict.fromkeys(one.run for one in series))
    names = list(dict.fromkeys(name for one in series for name in one.variables))
    units = {one.output: one.unit for one in series}
    grid, shape = (schema.OUTPUT, schema.RUN), (len(outputs), len(runs))
    tables = {key: np.full(shape, np.nan) for key in _NUMBERS}
    share, share_p = np.full((2, *shape, len(names)), np.nan)
    far_time, far_score = np.full((2, *shape, LISTED), np.nan)
    lags = CYCLES * LAGS + 1
    whole, noise = np.full((2, *shape, lags), np.nan)
    for one in series:
        at = outputs.index(one.output), runs.index(one.run)
        for key, value in _numbers(one).items():
            tables[key][at] = value
        share[at], share_p[at] = _shares(one, names)
        far_time[at], far_score[at] = _farthest(one)
        whole[at], noise[at] = correlograms(one)
    across = [between_means([one for one in series if one.output == o]) for o in outputs]
    data = xr.Dataset(
        {
            **{
                key: variable(
                    grid, table, _NUMBERS[key], "output's SI unit" if key in _IN_UNIT else "1"
                )
                for key, table in tables.items()
            },
            "share": variable((*grid, "variable"), share, "part of the variance explained", "1"),
            "share_p": variable((*grid, "variable"), share_p, "its probability", "1"),
            "outlier_time": variable((*grid, "rank"), far_time, "time of the outlier", "s"),
            "outlier_score": variable(
                (*grid, "rank"), far_score, "distance of the outlier in robust sd", "1"
            ),
            "correlogram": variable((*grid, "lag"), whole, "autocorrelation of the residual", "1"),
            "noise_correlogram": variable(
                (*grid, "lag"), noise, "autocorrelation of what does not repeat", "1"
            ),
            **{
                key: variable((schema.OUTPUT,), np.array([row[key] for row in across]), text, "1")
                for key, text in ACROSS.items()
            },
            schema.UNIT: ((schema.OUTPUT,), np.array([units[o] for o in outputs], dtype=object)),
        },
        coords={
            schema.OUTPUT: outputs,
            schema.RUN: runs,
            "variable": names,
            "lag": ("lag", np.arange(lags) / LAGS, {schema.UNITS: "cycle"}),
        },
    )
    periodic = {one.run: one.periodic for one in series}
    data.attrs = {"series": len(series), "periodic": int(all(periodic.values()))}
    return data


def _shares(series: Series, names: Sequence[str]) -> tuple[Array, Array]:
    """How much each variable explains, and its probability."""
    share, p_value = np.full((2, len(names)), np.nan)
    for k, name in enumerate(names):
        if name in series.variables:
            found = dependence_on(series, name)
            share[k], p_value[k] = found.share, found.outcome.p_value
    return share, p_value


def dependence_on(series: Series, name: str) -> tests.Dependence:
    """How a residual depends on one of its variables.

    Parameters
    ----------
    series : Series
    name : str
        One of ``series.variables``.

    Returns
    -------
    Dependence
        Where nothing repeats, noise and the model's error cannot be told apart; noise is then
        taken as white.
    """
    effective = tests.autocorrelation_time(series.noise()) if series.periodic else 1.0
    # Bins of time shorter than a period would show the dependence on phase.
    whole = name == schema.TIME and series.periodic
    bins = max(2, series.residual.size // series.period) if whole else tests.BINS
    return tests.dependence(series.residual, series.variables[name], effective, bins)


def outliers_of(series: Series) -> tuple[NDArray[np.int64], Array, float]:
    """Places and scores of outliers, the farthest first, and the score from which one counts.

    An outlier pulls on the average over periods, and so on all samples of its phase; the farthest
    are taken out before the others are looked at.
    """
    found: dict[int, float] = {}
    cleaned, limit = series, np.nan
    for _ in range(_MOST_ROUNDS):
        noise, average = cleaned.noise(), cleaned.average()
        scores, places, limit = tests.outliers(noise)
        if places.size == 0:
            break
        near = np.abs(scores[places]) >= 0.5 * abs(scores[places[0]])
        first = places if average is None else places[near]
        found |= {int(k): float(scores[k]) for k in first if int(k) not in found}
        if average is None:
            break
        residual = cleaned.residual.copy()
        # What the other periods say of this phase: the sample's own leverage is removed.
        kept = 1 - average.number / average.samples
        residual[first] = residual[first] - noise[first] / np.sqrt(kept)
        cleaned = replace(series, residual=residual)
    order = sorted(found, key=lambda k: -abs(found[k]))
    return np.array(order, dtype=np.int64), np.array([found[k] for k in order]), float(limit)


def _farthest(series: Series) -> tuple[Array, Array]:
    """Times and scores of the farthest outliers, padded with NaN."""
    places, scores, _ = outliers_of(series)
    listed = places[:LISTED]
    time, score = np.full((2, LISTED), np.nan)
    time[: listed.size] = listed * series.time_step
    score[: listed.size] = scores[:LISTED]
    return time, score


def correlograms(series: Series) -> tuple[Array, Array]:
    """Autocorrelation of the residual and of what does not repeat, at ``LAGS`` lags a period.

    Where nothing repeats, an eighth of the record stands for a period.
    """
    steps = np.arange(CYCLES * LAGS + 1) / LAGS
    unit = series.period if series.periodic else max(series.residual.size // (4 * CYCLES), 1)
    lags = np.round(steps * unit).astype(int)
    lags = lags[lags < series.residual.size - 2]
    found = np.full((2, steps.size), np.nan)
    for row, values in zip(found, (series.residual, series.noise()), strict=True):
        row[: lags.size] = tests.autocorrelation(values, int(lags[-1]))[lags]
    return found[0], found[1]


def assessment_text(data: xr.Dataset) -> str:
    """One line a series; a star marks what chance alone hardly gives."""
    head = ["output", "run", "rms", "unit", "runs z", "skew", "kurt.", "corr. time", "intraclass"]
    head += ["over noise", "over expected", "outliers", "depends on"]
    rows = []
    for output in data[schema.OUTPUT].values:
        for run in data[schema.RUN].values:
            one = data.sel(output=output, run=run)
            if np.isfinite(float(one["rms"])):
                rows.append([str(output), str(run), *_cells(one, data.attrs["series"])])
    number = data.attrs["series"]
    end = f"* less than {MARKED:g} by chance over all {number} series, each test by itself"
    lines = [columns(head, rows), end]
    for output in data[schema.OUTPUT].values:
        one = data.sel(output=output)
        for key, words in (("runs", "from run to run"), ("groups", "from group to group")):
            p_value = float(one[f"share_of_{key}_p"])
            if p_value < MARKED:
                part = 100 * float(one[f"share_of_{key}"])
                what = "the residual's variance" if key == "runs" else "that of run means"
                lines.append(f"{output}: means differ {words} ({part:.2g} % of {what})")
    return "\n".join(lines)


def _cells(one: xr.Dataset, series: int) -> list[str]:
    def marked(text: str, p_value: float) -> str:
        return text + ("*" if p_value * series < MARKED else " ")

    number = {str(key): float(one[key]) for key in _NUMBERS}
    share, p_value = one["share"].values, one["share_p"].values
    best = "–"
    sure = np.flatnonzero(p_value * series * share.size < MARKED)
    if sure.size:
        k = int(sure[np.argmax(share[sure])])
        best = f"{one['variable'].values[k]} ({100 * share[k]:.2g} %)"
    intraclass = number["intraclass_correlation"]
    ratio, expected = number["ratio_to_noise"], number["ratio_to_expected"]
    return [
        f"{number['rms']:.3g}",
        str(one[schema.UNIT].values) or "1",
        marked(f"{number['runs_z']:.1f}", number["runs_p"]),
        f"{number['skewness']:.2f}",
        marked(f"{number['kurtosis']:.2f}", number["normality_p"]),
        f"{number['autocorrelation_time']:.1f}",
        f"{intraclass:.2f}" if np.isfinite(intraclass) else "–",
        marked(f"{ratio:.2f}", number["lack_of_fit_p"]) if np.isfinite(ratio) else "–",
        f"{expected:.2f}" if np.isfinite(expected) else "–",
        f"{number['outliers']:.0f}",
        best,
    ]
