r"""Posterior against point estimate and prior, BayesBag over runs, calibration of posteriors.

The comparison shows where the posterior differs from the point estimate with its covariances and
regions. Sensitivity to the prior is computed without sampling again.

Calibration is simulation-based. Where parameters are drawn from their prior and data from the
model, the rank of each parameter among independent draws of its posterior is uniform. An error in
the sampler or the density shows as a slope (bias), a U shape (too narrow) or a hump (too wide) of
the ranks.

BayesBag is the mean of the posteriors of runs that are drawn anew with replacement. Where a model
is wrong in a way that differs from run to run, estimates from other runs would have been others, by
more than the posterior of these runs says. BayesBag shows how much: its covariance is the mean
covariance of the posteriors of resampled campaigns plus the covariance of their means,

.. math:: C = E[C_k] + \operatorname{cov}[m_k].

Where the model is right, both are equal, so that the variance is about twice that of the posterior.
An error that all runs have in common is not seen. All posteriors are linearised about the estimate,
which makes them normal.

References
----------
Talts, Betancourt, Simpson, Vehtari and Gelman (2018), "Validating Bayesian inference algorithms
with simulation-based calibration", arXiv:1804.06788. Säilynoja, Bürkner and Vehtari (2022),
"Graphical test for discrete uniformity and its applications in goodness-of-fit evaluation and
multiple sample comparison", *Statistics and Computing* 32, section 2 (the band).
Bühlmann (2014), Statistica Sinica 24, 59-74; Huggins and Miller (2023), Bayesian Analysis 18, eqs.
1 and 3: BayesBag.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy import linalg

from bayesoleo import _distributions as distributions, _schema as schema
from bayesoleo._schema import columns
from bayesoleo._types import Array, Integers
from bayesoleo.errors import InputError, ResultsError
from bayesoleo.estimation._least_squares import PriorScale
from bayesoleo.estimation._problem import EstimationProblem
from bayesoleo.posterior._diagnostics import Samples

#: References with which the posterior is compared.
LINEARISED, MONTE_CARLO, REGION = "linearised", "monte carlo", "indifference"
#: A larger sensitivity deserves attention (Kallioinen et al. 2024, section 2.4).
THRESHOLD = 0.05
_WEAK = "strong prior or weak data"
#: Draws that a truth is ranked among: ranks 0 to 99.
DRAWS = 99
# Simulated sets of ranks from which the band's level is found.
_SETS = 4000


def compare(groups: Mapping[str, xr.Dataset] | xr.DataTree) -> xr.Dataset:
    """Compare the posterior with the estimate and its measures of uncertainty.

    Parameters
    ----------
    groups : DataTree or mapping of str to Dataset
        ``posterior`` and ``point``; ``sampling_distribution`` and ``indifference`` where there are.

    Returns
    -------
    Dataset
        The group ``comparison``. ``shift(parameter)``: posterior mean minus estimate in linearised
        standard deviations. ``sd_ratio(reference, parameter)``: posterior standard deviation over
        the linearised one, over the scatter of simulated experiments, and over the indifference
        region's half-width, scaled to one standard deviation of a normal posterior.
        ``variance_ratio(reference, extreme)``: least and greatest ratio of the posterior's variance
        to the reference's over all directions. ``skewness(parameter)``,
        ``excess_kurtosis(parameter)``. NaN where there is nothing to compare with.

    Raises
    ------
    ResultsError
        If there is no posterior, or no point.

    References
    ----------
    Verbeek (1993), eqs. 2.36-2.41 (linearised), 2.18-2.20 (Monte Carlo), 2.43 (region).
    """
    for name in (schema.POSTERIOR, schema.POINT):
        if name not in groups:
            raise ResultsError(f"needs the group {name!r}", hint="sample the posterior first")
    point, posterior = _dataset(groups, schema.POINT), _dataset(groups, schema.POSTERIOR)
    names = [str(n) for n in point[schema.PARAMETER].values if str(n) in posterior]
    draws = np.stack([posterior[name].values.ravel() for name in names])
    covariance = np.atleast_2d(np.cov(draws))
    keep = point.sel({schema.PARAMETER: names, schema.PARAMETER_COLUMN: names})
    references = {LINEARISED: keep[schema.COVARIANCE].values}
    references[MONTE_CARLO] = _monte_carlo(groups, names)
    region = _region(groups, names)
    sd = np.sqrt(np.diag(covariance))
    linear = np.sqrt(np.diag(references[LINEARISED]))
    ratio = [sd / np.sqrt(np.diag(matrix)) for matrix in references.values()]
    extremes = [_extremes(covariance, matrix) for matrix in references.values()]
    each, both = (schema.PARAMETER,), ("reference", schema.PARAMETER)
    return xr.Dataset(
        {
            "shift": (
                each,
                (draws.mean(axis=1) - keep[schema.ESTIMATE].values) / linear,
                _about("posterior mean minus estimate, in linearised standard deviations"),
            ),
            "sd_ratio": (
                both,
                np.array([*ratio, sd / region]),
                _about("posterior standard deviation over the reference's"),
            ),
            "variance_ratio": (
                ("reference", "extreme"),
                np.array([*extremes, (np.nan, np.nan)]),
                _about("posterior variance over the reference's, over all directions"),
            ),
            "skewness": (each, distributions.skewness(draws), _about("skewness")),
            "excess_kurtosis": (each, distributions.kurtosis(draws) - 3, _about("excess kurtosis")),
        },
        coords={
            schema.PARAMETER: names,
            "reference": [LINEARISED, MONTE_CARLO, REGION],
            "extreme": ["least", "greatest"],
        },
    )


def comparison_text(found: xr.Dataset) -> str:
    """A comparison as a table: one line for each parameter, and one over all directions.

    Parameters
    ----------
    found : Dataset
        Of :func:`compare`, or the group ``comparison`` of a result.

    Returns
    -------
    str
        Columns of references that there are not are left out.
    """
    there = found["sd_ratio"].notnull().any(schema.PARAMETER)
    references = [str(name) for name in found["reference"].values[there.values]]
    head = ["parameter", "shift in sd", *(f"sd / {name}" for name in references), "skewness"]
    rows = []
    for name in found[schema.PARAMETER].values:
        one = found.sel({schema.PARAMETER: name})
        ratios = [float(one["sd_ratio"].sel(reference=r)) for r in references]
        numbers = [float(one["shift"]), *ratios, float(one["skewness"])]
        rows.append([str(name), *("–" if np.isnan(x) else f"{x:.2f}" for x in numbers)])
    lines = [columns(head, rows)]
    for reference in references:
        least, greatest = found["variance_ratio"].sel(reference=reference).values
        if np.isfinite(least):
            between = f"{least:.2f} to {greatest:.2f}"
            lines.append(f"variance over the {reference} one, over all directions: {between}")
    return "\n".join(lines)


def _about(text: str) -> dict[str, str]:
    return {schema.UNITS: "1", schema.LONG_NAME: text}


def _dataset(groups: Mapping[str, xr.Dataset] | xr.DataTree, name: str) -> xr.Dataset:
    found = groups[name]
    return found.to_dataset() if isinstance(found, xr.DataTree) else found  # type: ignore[return-value]


def _monte_carlo(groups: Mapping[str, xr.Dataset] | xr.DataTree, names: list[str]) -> Array:
    """Covariance of simulated estimates, (l, l); NaN where not all parameters were simulated."""
    missing = np.full((len(names), len(names)), np.nan)
    if schema.SAMPLING_DISTRIBUTION not in groups:
        return missing
    data = _dataset(groups, schema.SAMPLING_DISTRIBUTION)
    if not set(names) <= {str(n) for n in data[schema.PARAMETER].values}:
        return missing
    chosen = data.sel({schema.PARAMETER: names, schema.PARAMETER_COLUMN: names})
    return np.asarray(chosen[schema.COVARIANCE].values, dtype=float)


def _region(groups: Mapping[str, xr.Dataset] | xr.DataTree, names: list[str]) -> Array:
    """Half of each parameter's extent of the region, as a standard deviation, (l,).

    A normal posterior falls by ``epsilon`` at ``sqrt(2 epsilon)`` standard deviations.
    """
    half = np.full(len(names), np.nan)
    if schema.INDIFFERENCE not in groups:
        return half
    data = _dataset(groups, schema.INDIFFERENCE)
    # The shadow of the region if it was made; with two parameters there is one section only.
    contour = data["contour"].isel(section=-1)
    for k, name in enumerate(names):
        where = np.argwhere(data["name"].values == name)
        if where.size:
            pair, side = where[0]
            values = contour.isel(pair=int(pair), side=int(side)).values
            half[k] = 0.5 * (values.max() - values.min())
    return np.asarray(half / np.sqrt(2 * float(data.attrs["epsilon"])))


def _extremes(covariance: Array, reference: Array) -> tuple[float, float]:
    """Least and greatest eigenvalue of ``reference^-1 covariance``."""
    if not np.isfinite(reference).all():
        return np.nan, np.nan
    try:
        values = linalg.eigh(covariance, reference, eigvals_only=True)
    except linalg.LinAlgError:  # a reference that is not positive definite is useless
        return np.nan, np.nan
    return float(values[0]), float(values[-1])


def prior_sensitivity(tree: xr.DataTree) -> xr.Dataset:
    """Sensitivity of every quantity of the posterior to its prior and to its likelihood.

    Prior or likelihood are raised to a power near one; how far each marginal posterior then moves,
    by the distance of its cumulative distributions per doubling of the power, is the sensitivity.

    Parameters
    ----------
    tree : DataTree
        Needs ``posterior``, ``log_prior`` and ``log_likelihood``.

    Returns
    -------
    Dataset
        ``prior(quantity)``, ``likelihood(quantity)`` and ``diagnosis(quantity)``: empty;
        ``prior-data conflict`` where both are above 0.05; ``strong prior or weak data`` where only
        the prior's is.

    Raises
    ------
    ResultsError
        If a group is missing.

    References
    ----------
    Kallioinen, Paananen, Bürkner and Vehtari (2024), "Detecting and diagnosing prior and
    likelihood sensitivity with power-scaling", *Statistics and Computing* 34, eqs. 3-7.
    """
    import arviz_stats as az

    for group in (schema.POSTERIOR, schema.LOG_PRIOR, schema.LOG_LIKELIHOOD):
        if group not in tree.children:
            raise ResultsError(f"needs the group {group!r}", hint="sample the posterior first")
    found = {group: az.psense(tree, group=group) for group in ("prior", "likelihood")}
    names = [str(name) for name in tree[schema.POSTERIOR].data_vars]
    values = {
        group: np.array([float(data[name]) for name in names]) for group, data in found.items()
    }
    leans = values["prior"] > THRESHOLD
    words = np.where(values["likelihood"] > THRESHOLD, "prior-data conflict", _WEAK)
    data = {
        group: (
            schema.QUANTITY,
            array,
            {schema.UNITS: "1", schema.LONG_NAME: f"sensitivity to the {group}"},
        )
        for group, array in values.items()
    }
    return xr.Dataset(
        {**data, "diagnosis": (schema.QUANTITY, np.where(leans, words, ""))},
        coords={schema.QUANTITY: names},
    )


def rank_of(samples: Samples, truth: ArrayLike, rng: np.random.Generator) -> Integers:
    """Rank of each true value, shape (k,), among :data:`DRAWS` draws of its posterior.

    Parameters
    ----------
    samples : Samples
        Of a posterior, with far more effective draws than are ranked among.
    truth : array_like, shape (k,)
        True values of the first ``k`` quantities, in their units.
    rng : numpy.random.Generator
        Picks the draws.
    """
    flat = samples.draws.reshape(-1, samples.draws.shape[-1])
    picks = rng.choice(len(flat), DRAWS, replace=False)
    values = np.asarray(truth, dtype=float)
    return np.sum(flat[picks][:, : values.size] < values, axis=0)


@dataclass(frozen=True)
class Uniformity:
    """The distribution function of ranks against a uniform one's.

    Parameters
    ----------
    places : ndarray, shape (p,)
        Parts of the range of ranks.
    difference : ndarray, shape (p,)
        Part of the ranks up to there, minus that of a uniform variable.
    low, high : ndarray, shape (p,)
        Band that uniform ranks stay inside, everywhere at once, with probability ``level``.
    p_value : float
        Probability that uniform ranks leave such bands as far as these.
    level : float
    """

    places: Array
    difference: Array
    low: Array
    high: Array
    p_value: float
    level: float

    @property
    def inside(self) -> bool:
        """Whether the ranks stay inside the band."""
        return self.p_value >= 1 - self.level


def uniformity(
    ranks: ArrayLike, *, draws: int = DRAWS, level: float = 0.95, seed: int = 0
) -> Uniformity:
    """Compare ranks with a uniform distribution over 0 to ``draws``.

    Parameters
    ----------
    ranks : array_like of int, shape (R,)
        By replication.
    draws : int
        Draws that each truth was ranked among.
    level : float
        Of the simultaneous band.
    seed : int
        Of the simulation that finds it.
    """
    from scipy import stats  # what needs it is rare, and importing it takes half a second

    ranks = np.asarray(ranks, dtype=np.int64)
    count, places = ranks.size, np.arange(1, draws + 1) / (draws + 1)
    counts = _counts(ranks[None], draws)
    least = _least_p(counts, _two_sided(count, draws))[0]
    reference = _reference(count, draws, seed)
    gamma = float(np.quantile(reference, 1 - level))
    low, high = (stats.binom.ppf(p, count, places) / count for p in (gamma / 2, 1 - gamma / 2))
    p_value = float((np.searchsorted(reference, least, side="right") + 1) / (_SETS + 1))
    found = counts[0] / count
    return Uniformity(places, found - places, low - places, high - places, p_value, level)


@lru_cache(maxsize=16)
def _two_sided(count: int, draws: int) -> Array:
    """Binomial probabilities of so many ranks or further off, shape (count + 1, draws)."""
    from scipy import stats  # as in :func:`uniformity`

    places = np.arange(1, draws + 1) / (draws + 1)
    number = np.arange(count + 1)[:, None]
    below = stats.binom.cdf(number, count, places)
    above = stats.binom.sf(number - 1, count, places)
    return np.asarray(np.minimum(2 * np.minimum(below, above), 1.0))


@lru_cache(maxsize=16)
def _reference(count: int, draws: int, seed: int) -> Array:
    """Smallest probabilities of simulated sets of uniform ranks, ascending."""
    rng = np.random.default_rng(seed)
    sets = rng.integers(0, draws + 1, (_SETS, count))
    return np.sort(_least_p(_counts(sets, draws), _two_sided(count, draws)))


def _counts(ranks: Integers, draws: int) -> Integers:
    """Ranks below 1, 2 ... draws, shape (S, draws), of sets of ranks, shape (S, R)."""
    table = np.zeros((len(ranks), draws + 1), dtype=np.int64)
    np.add.at(table, (np.arange(len(ranks))[:, None], ranks), 1)
    return np.cumsum(table, axis=1)[:, :-1]


def _least_p(counts: Integers, table: Array) -> Array:
    """Smallest probability over the places, shape (S,), of counts (S, draws)."""
    return np.asarray(table[counts, np.arange(counts.shape[1])].min(axis=1))


#: Fewest runs: of two, half of the resampled campaigns hold one run only.
FEWEST_RUNS = 3


@dataclass(frozen=True)
class BayesBag:
    """Mean and covariance of the unknowns over resampled campaigns.

    Parameters
    ----------
    mean : ndarray, shape (l,)
        In the units of the unknowns.
    covariance : ndarray, shape (l, l)
    posterior : ndarray, shape (l, l)
        Covariance of the linearised posterior of the runs themselves.
    names : tuple of str
        The ``l`` unknowns.
    """

    mean: Array
    covariance: Array
    posterior: Array
    names: tuple[str, ...]


def bayesbag(
    problem: EstimationProblem, theta: Array, *, sets: int = 400, seed: int = 0
) -> BayesBag:
    """Average the posterior over campaigns whose runs are drawn with replacement.

    Errors are independent, with the variances of the outputs that the residual at the estimate has.

    Parameters
    ----------
    problem : EstimationProblem
        Of three runs or more.
    theta : ndarray, shape (l,)
        The estimate.
    sets : int
        Number of resampled campaigns.
    seed : int
        Draws them.

    Raises
    ------
    InputError
        If there are too few runs, or the problem cannot be evaluated at the estimate.
    """
    runs = len(problem.runs)
    if runs < FEWEST_RUNS:
        raise InputError(
            "BayesBag draws whole runs with replacement, and these are too few",
            key="runs",
            value=runs,
            hint=f"measure {FEWEST_RUNS} or more, or use the error model power",
        )
    grams, gradients, scale = _by_run(problem, np.asarray(theta, dtype=float))
    prior, slope = scale.root.T @ scale.root, np.nan_to_num(scale.slope(theta))
    rng = np.random.default_rng(seed)
    means, covariances = [], []
    for counts in rng.multinomial(runs, np.full(runs, 1.0 / runs), sets):
        covariance = np.linalg.inv(prior + np.einsum("r,rij->ij", counts, grams))
        covariances.append(covariance)
        means.append(covariance @ (counts @ gradients + slope))
    unit = scale.unit(theta)
    whole = np.mean(covariances, axis=0) + np.cov(np.array(means).T, ddof=1)
    own = np.linalg.inv(prior + grams.sum(axis=0))
    square = np.outer(unit, unit)
    centre = theta + unit * np.mean(means, axis=0)
    return BayesBag(centre, whole * square, own * square, tuple(problem.names))


def _by_run(problem: EstimationProblem, theta: Array) -> tuple[Array, Array, PriorScale]:
    """Information (N, l, l) and gradient (N, l) of each run's log-likelihood, per unit of prior."""
    scale = PriorScale.of(problem.priors, problem.names)
    found = problem.evaluate(theta)
    if not found.status.ok:
        raise InputError("the model cannot be solved at the estimate", value=found.status.message)
    unit, runs, size = scale.unit(theta), len(problem.runs), theta.size
    grams, gradients = np.zeros((runs, size, size)), np.zeros((runs, size))
    for b, (e, j) in enumerate(zip(found.residual, found.sensitivity, strict=True)):
        variance = max(float(np.mean(e * e)), 1e-300)
        ends = np.cumsum(np.asarray(problem.counts)[:, b])
        for r, (rows, left) in enumerate(
            zip(np.split(j * unit, ends[:-1]), np.split(e, ends[:-1]), strict=True)
        ):
            grams[r] += rows.T @ rows / variance
            gradients[r] += rows.T @ left / variance
    return grams, gradients, scale
