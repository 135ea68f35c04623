"""Sensitivity analysis: local derivatives and Sobol indices of predicted features.

A feature is one number of a predicted run, such as the peak of a pressure or the rms of a force.
Local derivatives hold near an estimate, Sobol indices over the prior.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._schema import LabelledResult, columns, variable
from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._problem import EstimationProblem
from bayesoleo.model._priors import LogNormal, Normal, Prior, TruncatedNormal, Uniform

#: A number of one run, from its predicted outputs by name, each shape (n,).
Feature = Callable[[Mapping[str, Array]], float]
#: Vectors predicted together; more would fill the memory with samples.
_BLOCK = 64
Per = Literal["prior", "percent"]
# Central differences over this part of the step that is reported.
_STEP = 0.02
_DRAWS = 2**17


@dataclass(frozen=True)
class Features:
    """Features of a problem's predictions, for many parameter vectors.

    Parameters
    ----------
    problem : EstimationProblem
        A campaign's problem, or one with a method ``predict``.
    by_name : mapping of str to callable
        Each takes one run's predicted outputs by name and returns a number.
    """

    problem: EstimationProblem
    by_name: Mapping[str, Feature]

    @classmethod
    def of(
        cls, problem: EstimationProblem, features: Mapping[str, Feature] | None = None
    ) -> Features:
        """Features as given, or the mean and the rms about it of every output."""
        if not isinstance(problem, CampaignProblem) and not hasattr(problem, "predict"):
            raise InputError(
                "problem has no predictions, only residuals",
                key="problem",
                value=type(problem).__name__,
                hint="use a FunctionProblem or a CampaignProblem",
            )
        if features is not None:
            return cls(problem, dict(features))
        chosen: dict[str, Feature] = {}
        for name in problem.outputs:
            chosen[f"mean of {name}"] = _mean_of(name)
            chosen[f"rms of {name}"] = _rms_of(name)
        return cls(problem, chosen)

    @property
    def names(self) -> list[str]:
        """Features by run: ``mean of force[a]``; without the run where there is one only."""
        runs = self.problem.runs
        if len(runs) == 1:
            return list(self.by_name)
        return [f"{name}[{run}]" for run in runs for name in self.by_name]

    def __call__(self, theta: Array) -> Array:
        """Features at vectors (L, l), shape (L, F); NaN where the prediction fails."""
        theta = np.atleast_2d(np.asarray(theta, dtype=float))
        if not isinstance(self.problem, CampaignProblem):
            predict = cast(Any, self.problem).predict
            (output,) = self.problem.outputs
            return np.array([self._row({output: predict(vector)}) for vector in theta])
        blocks = [self._block(theta[k : k + _BLOCK]) for k in range(0, len(theta), _BLOCK)]
        return np.concatenate(blocks) if blocks else np.empty((0, len(self.names)))

    def _block(self, theta: Array) -> Array:
        problem = cast(CampaignProblem, self.problem)
        full, columns = problem.full(theta), []
        for r in range(len(problem.runs)):
            y = problem.predictor.simulate(full, r).y
            columns.append([self._row(dict(zip(problem.outputs, lane, strict=True))) for lane in y])
        return np.concatenate(columns, axis=1)

    def _row(self, outputs: Mapping[str, Array]) -> list[float]:
        if not all(np.isfinite(values).all() for values in outputs.values()):
            return [np.nan] * len(self.by_name)
        return [float(feature(outputs)) for feature in self.by_name.values()]


def _mean_of(name: str) -> Feature:
    return lambda outputs: float(np.mean(outputs[name]))


def _rms_of(name: str) -> Feature:
    return lambda outputs: float(np.std(outputs[name]))


def local_sensitivity(
    problem: EstimationProblem,
    theta: ArrayLike,
    features: Mapping[str, Feature] | None = None,
    *,
    per: Per = "prior",
) -> LabelledResult:
    """Change of each feature by one step of each parameter, by linearisation.

    Parameters
    ----------
    problem : EstimationProblem
        A campaign's problem, or one with a method ``predict``.
    theta : array_like, shape (l,)
        Where.
    features : mapping of str to callable, optional
        By name, functions of one run's predicted outputs, a mapping of str to ndarray, that return
        a number; by default the mean of every output and the rms about it.
    per : {"prior", "percent"}, optional
        A step is one standard deviation of the prior, or one per cent of the value.

    Returns
    -------
    LabelledResult
        ``change(feature, parameter)`` in the feature's own unit, ``percent(feature, parameter)`` of
        its value, ``value(feature)``, ``step(parameter)``.

    Raises
    ------
    InputError
        If the problem cannot be predicted there.
    """
    if per not in ("prior", "percent"):
        raise InputError("unknown step", key="per", value=per, hint="use 'prior' or 'percent'")
    centre = np.array(theta, dtype=float)
    _anchor(problem, centre)
    found = Features.of(problem, features)
    spread = np.array([prior.sd for prior in problem.priors])
    step = spread if per == "prior" else 0.01 * np.abs(centre)
    if not (step > 0).all():
        raise InputError(
            "one per cent of zero is no step",
            key=problem.names[int(np.argmin(step))],
            hint="use per='prior'",
        )
    offsets = np.diag(_STEP * step)
    table = found(np.concatenate((centre[None], centre + offsets, centre - offsets)))
    if not np.isfinite(table).all():
        raise InputError(
            "cannot be predicted near these parameters",
            key="theta",
            value=centre.tolist(),
            hint="give parameters inside the admissible region",
        )
    unknowns = len(centre)
    change = (table[1 : unknowns + 1] - table[unknowns + 1 :]).T / (2 * _STEP)
    with np.errstate(divide="ignore", invalid="ignore"):
        percent = 100 * change / np.abs(table[0])[:, None]
    square = ("feature", schema.PARAMETER)
    words = "one prior standard deviation" if per == "prior" else "one per cent"
    data = xr.Dataset(
        {
            "change": variable(square, change, f"change by {words}", "unit of each feature"),
            "percent": variable(square, percent, f"change by {words}", "%"),
            "value": variable(("feature",), table[0], "value", "unit of each feature"),
            "step": variable((schema.PARAMETER,), step, words, "unit of each parameter"),
        },
        coords={"feature": found.names, schema.PARAMETER: list(problem.names)},
    )
    data.attrs = {"per": per}
    return LabelledResult(data, _percent_text(data))


def global_sensitivity(
    problem: EstimationProblem,
    features: Mapping[str, Feature] | None = None,
    *,
    priors: Sequence[Prior] | None = None,
    samples: int = 1024,
    seed: int = 0,
    level: float = 0.95,
) -> LabelledResult:
    """Sobol indices of each feature over the priors; see :func:`sobol`.

    Parameters
    ----------
    problem : EstimationProblem
        A campaign's problem, or one with a method ``predict``.
    features : mapping of str to callable, optional
        By default the mean and the rms of every output.
    priors : sequence of Prior, length l, optional
        Instead of the problem's own.
    samples, seed, level
        As in :func:`sobol`.
    """
    _anchor(problem, problem.start)
    found = Features.of(problem, features)
    return sobol(
        found,
        problem.priors if priors is None else priors,
        problem.names,
        found.names,
        samples=samples,
        seed=seed,
        level=level,
    )


def sobol(
    function: Callable[[Array], Array],
    priors: Sequence[Prior],
    names: Sequence[str],
    features: Sequence[str],
    *,
    samples: int = 1024,
    seed: int = 0,
    level: float = 0.95,
) -> LabelledResult:
    """Share of a feature's variance that each parameter causes, alone and in all.

    Parameters
    ----------
    function : callable
        ``function(theta)`` for vectors (L, l) returns features (L, F); NaN where it fails.
    priors : sequence of Prior, length l
        Independent.
    names, features : sequence of str
        Labels of parameters and features.
    samples : int, optional
        Base samples, a power of two; the function is called for ``samples (l + 2)`` vectors.
    seed : int, optional
    level : float, optional
        Coverage of the bootstrap intervals.

    Returns
    -------
    LabelledResult
        ``first``, ``total``, each with ``_low`` and ``_high``, ``(feature, parameter)``;
        ``variance(feature)``. Where the function failed, the whole sample is left out; attributes
        say how many.

    Raises
    ------
    InputError
        If ``samples`` is no power of two, or the function fails too often.

    References
    ----------
    Sobol (2001); Saltelli et al. (2010), by ``scipy.stats.sobol_indices``.
    """
    from scipy import stats  # what needs it is rare, and importing it takes half a second

    if samples < 8 or samples & (samples - 1):
        raise InputError(
            "samples must be a power of two", key="samples", value=samples, hint="use 1024"
        )
    unknowns = len(priors)
    uniform = stats.qmc.Sobol(2 * unknowns, rng=np.random.default_rng(seed)).random(samples)
    draws = _quantiles([*priors, *priors], uniform)
    first, second = draws[:, :unknowns], draws[:, unknowns:]
    mixed = np.repeat(first[None], unknowns, axis=0)
    for k in range(unknowns):
        mixed[k, :, k] = second[:, k]
    f_first, f_second = np.asarray(function(first)), np.asarray(function(second))
    f_mixed = np.array([function(block) for block in mixed])
    good = np.isfinite(f_first) & np.isfinite(f_second) & np.isfinite(f_mixed).all(axis=0)
    rows = np.flatnonzero(good.all(axis=1))
    # The routine needs a power of two, also after failures were left out.
    kept = 1 << (int(rows.size).bit_length() - 1) if rows.size else 0
    if kept < max(8, samples // 4):
        raise InputError(
            f"only {rows.size} of {samples} samples can be predicted",
            hint="give narrower priors with priors=",
        )
    rows = rows[:kept]
    found = stats.sobol_indices(
        func={
            "f_A": f_first[rows].T,
            "f_B": f_second[rows].T,
            "f_AB": np.moveaxis(f_mixed[:, rows], 1, 2),
        },
        n=kept,
        rng=np.random.default_rng(seed),
    )
    with warnings.catch_warnings(), np.errstate(invalid="ignore", divide="ignore"):
        # A parameter that a feature does not depend on has no scatter to resample: NaN.
        warnings.simplefilter("ignore", stats.DegenerateDataWarning)
        spread = found.bootstrap(confidence_level=level, n_resamples=200)
    data = _indices(found, spread, names, features, np.var(f_first[rows], axis=0))
    data.attrs = {"samples": kept, "failed": int(samples - good.all(axis=1).sum()), "level": level}
    return LabelledResult(data, _sobol_text(data))


def quantile(prior: Prior, part: ArrayLike) -> Array:
    """Value below which a part of the prior lies, any shape."""
    u = np.asarray(part, dtype=float)
    if isinstance(prior, Normal):
        return cast(Array, prior.centre + prior.spread * distributions.norm.ppf(u))
    if isinstance(prior, Uniform):
        return prior.low + (prior.high - prior.low) * u
    if isinstance(prior, LogNormal):
        return cast(Array, prior.median * np.exp(prior.log_spread * distributions.norm.ppf(u)))
    if isinstance(prior, TruncatedNormal):
        return prior.quantile(u)
    # A prior of one's own has draws at least.
    return cast(Array, np.quantile(prior.sample(np.random.default_rng(0), _DRAWS), u))


def _quantiles(priors: Sequence[Prior], uniform: Array) -> Array:
    # The first point of a scrambled sequence may round to an end of the interval.
    inside = np.clip(uniform, 1e-12, 1 - 1e-12)
    return np.column_stack([quantile(p, inside[:, k]) for k, p in enumerate(priors)])


def _anchor(problem: EstimationProblem, theta: Array) -> None:
    """A campaign's solver starts every solution from a known one."""
    freeze = getattr(problem, "freeze", None)
    if freeze is not None:
        freeze(np.array(theta, dtype=float))


def _indices(
    found: object, spread: object, names: Sequence[str], features: Sequence[str], variance: Array
) -> xr.Dataset:
    square, shape = ("feature", schema.PARAMETER), (len(features), len(names))
    variables = {}
    for key, attribute, text in (
        ("first", "first_order", "share of the variance, alone"),
        ("total", "total_order", "share of the variance, with all interactions"),
    ):
        interval = getattr(spread, attribute).confidence_interval
        for end, numbers in (
            ("", getattr(found, attribute)),
            ("_low", interval.low),
            ("_high", interval.high),
        ):
            values = np.reshape(numbers, shape)
            variables[key + end] = variable(square, values, text, "1")
    variables["variance"] = variable(
        ("feature",), np.asarray(variance), "variance over the priors", "square of its unit"
    )
    return xr.Dataset(variables, coords={"feature": list(features), schema.PARAMETER: list(names)})


def _percent_text(data: xr.Dataset) -> str:
    names = [str(name) for name in data[schema.PARAMETER].values]
    rows = [
        [str(feature), *(f"{float(v):+.3g}" for v in data["percent"].sel(feature=feature).values)]
        for feature in data["feature"].values
    ]
    step = "one prior sd" if data.attrs["per"] == "prior" else "1 %"
    return columns([f"% change by {step}", *names], rows)


def _sobol_text(data: xr.Dataset) -> str:
    names = [str(name) for name in data[schema.PARAMETER].values]
    rows = []
    for feature in data["feature"].values:
        one = data.sel(feature=feature)
        pairs = zip(one["first"].values, one["total"].values, strict=True)
        rows.append([str(feature), *(f"{a:.2f} / {b:.2f}" for a, b in pairs)])
    end = f"{data.attrs['samples']} samples"
    if data.attrs["failed"]:
        end += f"; {data.attrs['failed']} left out, for which there is no prediction"
    return columns(["Sobol: first / total", *names], rows) + f"\n{end}"
