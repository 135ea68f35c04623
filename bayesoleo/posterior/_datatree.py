"""Samples as groups of a DataTree that ArviZ reads, with blocks of a period as data points.

One sample is no suitable data point, because neighbouring errors may be correlated; one run is too
much where there are few. A block is one period of one run, or a few consecutive periods where a run
has many. A transient is cut into equal stretches. Each block gives, by output,

* one measured sample (``observed_data``), at another phase in each block, so that all blocks
  together show every part of the motion,
* the predictive distribution of that sample if the run were repeated (``posterior_predictive``),
* the log density of all samples of the block (``log_likelihood``), given the earlier blocks of its
  run and the outputs before it. Its sum over blocks and outputs is the joint log-likelihood.

All three have the one dim ``block``, so no value is missing.

References
----------
Bürkner, Gabry and Vehtari (2021), "Efficient leave-one-out cross-validation for Bayesian
non-factorized normal and Student-t models", *Computational Statistics* 36, section 2.1
(leave-one-out where data depend on each other).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import xarray as xr

from bayesoleo import _schema as schema
from bayesoleo._parallel import thread_map
from bayesoleo._types import Array, Integers
from bayesoleo.error_models._base import RunSamples
from bayesoleo.estimation._campaign_problem import CampaignProblem
from bayesoleo.estimation._problem import ResidualProblem
from bayesoleo.model._correlated_priors import sample_of
from bayesoleo.model._priors import Prior
from bayesoleo.posterior._checkpoints import REASONS
from bayesoleo.posterior._diagnostics import Samples
from bayesoleo.posterior._log_density import LANES, LOG_VARIANCE, LogDensity

#: Blocks of all runs together, at most, as long as each run has one.
MOST_BLOCKS = 128
#: Draws whose residuals are held together, at most, and their number of values.
MOST_LANES, MOST_VALUES = 32, 4_000_000
#: Stretches of a transient: fewer are no check, more would be alike.
STRETCHES = 8
#: Part of a cycle by which sampled phases differ from block to block: no two blocks of a run then
#: show the same phase (Weyl's sequence).
_GOLDEN = 0.5 * (5**0.5 - 1)
#: Chains and draws of the prior's group.
PRIOR_CHAINS, PRIOR_DRAWS = 4, 500


@dataclass(frozen=True)
class Blocks:
    """Division of the samples of one run into blocks.

    Parameters
    ----------
    starts : ndarray of int, shape (B,)
        First sample of each block; they are consecutive and cover the run.
    shown : ndarray of int, shape (B,)
        The one sample of each block that is shown.
    period : ndarray of int, shape (B,)
        Number of the block's first period, or of a transient's stretch, from 1.
    """

    starts: Integers
    shown: Integers
    period: Integers

    @classmethod
    def of(cls, samples: RunSamples, most: int, first: int = 0) -> Blocks:
        """Cut a run into at most ``most`` blocks; ``first`` blocks belong to runs before it."""
        count, together = samples.time.size, 1
        if samples.frequency is None:
            stretches = min(STRETCHES, most, count)
            label = np.arange(count) * stretches // count
        else:
            # A little grace: round-off must not put a period's first sample before it.
            label = np.floor(samples.phase + 1e-6).astype(np.int64)
            together = -(-int(label[-1] + 1) // most)
            label //= together
        starts = np.flatnonzero(np.diff(label, prepend=-1))
        sizes = np.diff(starts, append=count)
        if len(sizes) > 1 and sizes[-1] < 0.5 * sizes[0]:  # the rest of a cut period
            starts = starts[:-1]
            sizes = np.diff(starts, append=count)
        part = (first + np.arange(len(starts))) * _GOLDEN % 1.0
        shown = starts + (part * sizes).astype(np.int64)
        return cls(starts, shown, 1 + label[starts] * together)


def each_sample(density: LogDensity) -> list[Blocks]:
    """Every sample as a block of its own, where the error model allows it."""
    if density.errors.over_runs:
        return cut(density)
    sizes = [run.time.size for run in cast(ResidualProblem, density.problem).samples]
    return [Blocks(np.arange(n), np.arange(n), 1 + np.arange(n)) for n in sizes]


def cut(density: LogDensity) -> list[Blocks]:
    """The blocks of every run; whole runs where runs have errors in common."""
    samples = cast(ResidualProblem, density.problem).samples
    most = 1 if density.errors.over_runs else max(1, MOST_BLOCKS // len(samples))
    found: list[Blocks] = []
    for run in samples:
        found.append(Blocks.of(run, most, sum(len(b.starts) for b in found)))
    return found


def block_groups(
    samples: Samples,
    density: LogDensity,
    inputs: Callable[[int, Integers], Mapping[str, Array]] | None = None,
    *,
    units: Mapping[str, str] | None = None,
    seed: int = 0,
    blocks: list[Blocks] | None = None,
) -> dict[str, xr.Dataset]:
    """Groups ``observed_data``, ``posterior_predictive``, ``log_likelihood``, ``constant_data``.

    Parameters
    ----------
    samples : Samples
        Draws of the posterior.
    density : LogDensity
        What was sampled. Its problem gives ``residuals``, ``samples`` and ``data``.
    inputs : callable, optional
        From a run's number and those of samples among the ones that count, other channels there.
    units : mapping of str to str, optional
        Of outputs and inputs.
    seed : int
        Seeds the predicted errors.
    blocks : list of Blocks, optional
        How each run is cut; by default as by :func:`cut`.

    Returns
    -------
    dict of str to Dataset
        ``<output>(block)``, ``<output>(chain, draw, block)`` twice, and ``phase``, ``time`` and
        inputs ``(block)``; coordinates ``run`` and ``period`` say what a block is.
    """
    problem, units = cast(ResidualProblem, density.problem), units or {}
    blocks, shape = blocks or cut(density), samples.log_density.shape
    measured = _measured(problem)
    likelihood, predicted = _evaluate(samples, density, blocks, measured, seed)
    coords = _block_coordinates(problem.runs, blocks)
    chains = {
        schema.CHAIN: np.arange(shape[0]),
        schema.DRAW: np.arange(shape[1]),
        schema.ENSEMBLE: (schema.CHAIN, samples.ensemble),
    }
    dims = (schema.CHAIN, schema.DRAW, schema.BLOCK)
    observed, drawn, logs = {}, {}, {}
    for b, output in enumerate(problem.outputs):
        about = {schema.UNITS: units.get(output, "1"), schema.LONG_NAME: f"a sample of {output}"}
        values = [y[b, part.shown] for y, part in zip(measured, blocks, strict=True)]
        observed[output] = (schema.BLOCK, np.concatenate(values), about)
        drawn[output] = (dims, predicted[:, b].reshape(*shape, -1), about)
        about = {schema.UNITS: "1", schema.LONG_NAME: f"log density of a block of {output}"}
        logs[output] = (dims, likelihood[:, b].reshape(*shape, -1), about)
    meaning = {"data_points": density.errors.data_points}
    return {
        schema.OBSERVED_DATA: xr.Dataset(observed, coords=coords),
        schema.POSTERIOR_PREDICTIVE: xr.Dataset(drawn, coords={**coords, **chains}),
        schema.LOG_LIKELIHOOD: xr.Dataset(logs, coords={**coords, **chains}, attrs=meaning),
        schema.CONSTANT_DATA: _constant(problem.samples, blocks, inputs, units),
    }


def _measured(problem: ResidualProblem) -> list[Array]:
    """Measured samples of each run, (s, n)."""
    every = np.stack(cast(Any, problem).data)
    ends = np.cumsum(np.asarray(problem.counts)[:, 0])
    return np.split(every, ends[:-1], axis=1)


def _block_coordinates(runs: Sequence[str], blocks: Sequence[Blocks]) -> dict[str, Any]:
    labels = np.repeat(list(runs), [len(part.starts) for part in blocks])
    periods = np.concatenate([part.period for part in blocks])
    return {
        schema.BLOCK: np.arange(len(labels)),
        schema.RUN: (schema.BLOCK, labels),
        schema.PERIOD: (schema.BLOCK, periods),
    }


def _constant(
    samples: Sequence[RunSamples],
    blocks: Sequence[Blocks],
    inputs: Callable[[int, Integers], Mapping[str, Array]] | None,
    units: Mapping[str, str],
) -> xr.Dataset:
    """Times and inputs at the samples that are shown."""
    pairs = list(zip(samples, blocks, strict=True))
    columns: dict[str, list[Array]] = {
        schema.TIME: [run.time[part.shown] - run.time[0] for run, part in pairs],
        schema.PHASE: [run.phase[part.shown] % 1.0 for run, part in pairs],
    }
    tables = [] if inputs is None else [inputs(r, part.shown) for r, part in enumerate(blocks)]
    for name in tables[0] if tables else ():
        columns[name] = [table[name] for table in tables]
    about = {schema.TIME: ("s", "time since the first sample"), schema.PHASE: ("1", "phase")}
    data = {}
    for name, parts in columns.items():
        unit, text = about.get(name, (units.get(name, "1"), name))
        attributes = {schema.UNITS: unit, schema.LONG_NAME: f"{text} at the sample shown"}
        data[name] = (schema.BLOCK, np.concatenate(parts), attributes)
    number = np.arange(sum(len(part.starts) for part in blocks))
    return xr.Dataset(data, coords={schema.BLOCK: number})


def _evaluate(
    samples: Samples,
    density: LogDensity,
    blocks: Sequence[Blocks],
    measured: Sequence[Array],
    seed: int,
) -> tuple[Array, Array]:
    """Log densities and predicted samples, each of shape (draws, s, blocks)."""
    problem = cast(ResidualProblem, density.problem)
    natural = samples.draws.reshape(-1, samples.draws.shape[2])
    # A walker that refuses a proposal stays: a fourth of the draws are those before them.
    different, which = np.unique(natural, axis=0, return_inverse=True)
    likelihood, predicted = (
        found[which.ravel()] for found in _at_draws(different, density, blocks, measured)
    )
    ends = np.cumsum([0, *(len(part.starts) for part in blocks)])
    rng, own = np.random.default_rng(seed), samples.of_errors.reshape(len(natural), -1)
    common = common_to_runs(density, natural, rng)
    for run, part in enumerate(blocks):
        when = problem.samples[run]
        # With the run's first and last sample, by which a transient's length is known.
        places = np.concatenate([[0], part.shown, [when.time.size - 1]])
        taken = RunSamples(when.time[places], when.frequency, when.origin)
        errors = density.errors.draw(own, problem.runs[run], taken, rng, common)
        predicted[:, :, ends[run] : ends[run + 1]] += errors[:, :, 1:-1]
    return likelihood, predicted


def _at_draws(
    natural: Array, density: LogDensity, blocks: Sequence[Blocks], measured: Sequence[Array]
) -> tuple[Array, Array]:
    """Log densities of blocks and expected samples at draws (W, p + m), of shape (W, s, blocks)."""
    problem = cast(ResidualProblem, density.problem)
    block, eta = density.split(density.coordinates(natural))
    theta = density.unknowns.theta(block)
    ends = np.cumsum([0, *(len(part.starts) for part in blocks)])
    shape = (len(natural), len(problem.outputs), int(ends[-1]))
    likelihood, expected = np.empty(shape), np.empty(shape)

    def work(rows: slice) -> None:
        moved = density.errors.moved(theta[rows])
        residuals = [problem.residuals(moved, run)[0] for run in range(len(blocks))]
        found = density.errors.of_blocks(residuals, eta[rows], [part.starts for part in blocks])
        likelihood[rows] = np.concatenate(found, axis=2)
        same = np.array_equal(moved, theta[rows])
        for run, (e, part) in enumerate(zip(residuals, blocks, strict=True)):
            columns = slice(ends[run], ends[run + 1])
            if same:
                shown = measured[run][:, part.shown] - e[:, :, part.shown]
            else:
                shown = _predicted(problem, theta[rows], run, part.shown, measured[run])
            expected[rows, :, columns] = shown

    # What is called for each block of draws takes as long as some draws; all runs are kept of it.
    few = max(LANES, min(MOST_LANES, MOST_VALUES // sum(part.size for part in measured)))
    parts = [slice(k, min(k + few, len(natural))) for k in range(0, len(natural), few)]
    thread_map(work, parts, density.jobs)
    return likelihood, expected


def _predicted(
    problem: ResidualProblem, theta: Array, run: int, shown: Integers, measured: Array
) -> Array:
    """Outputs (L, s, m) of a run at some samples; a campaign's are not computed at all others."""
    if isinstance(problem, CampaignProblem):
        return problem.outputs_at(theta, run, shown)
    return np.asarray(measured[:, shown] - problem.residuals(theta, run)[0][:, :, shown])


def common_to_runs(density: LogDensity, natural: Array, rng: np.random.Generator) -> Array | None:
    """Draws of what the errors of all runs have in common, given the fitted runs.

    Parameters
    ----------
    density : LogDensity
    natural : ndarray, shape (W, p + m)
        Draws of its quantities.
    rng : numpy.random.Generator

    Returns
    -------
    ndarray, shape (W, c), or None
        None where errors have nothing in common that fitted runs inform.
    """
    if not density.errors.over_runs:
        return None
    problem = cast(ResidualProblem, density.problem)
    block, eta = density.split(density.coordinates(natural))
    theta, found = density.unknowns.theta(block), list[Array]()
    for first in range(0, len(natural), LANES):
        rows = slice(first, first + LANES)
        residuals = [problem.residuals(theta[rows], run)[0] for run in range(len(problem.runs))]
        drawn = density.errors.common(residuals, eta[rows], rng)
        if drawn is None:
            return None
        found.append(drawn)
    return np.concatenate(found)


def choose_all(samples: Samples, size: int, *, seed: int) -> tuple[Array, Array]:
    """Pick draws at random, none twice, with the quantities of the error model.

    Parameters
    ----------
    samples : Samples
        Draws of the posterior.
    size : int
        Number of draws; all of them if there are fewer.
    seed : int
        Seeds the choice.

    Returns
    -------
    theta : ndarray, shape (K, l)
        Parameters in their units.
    errors : ndarray, shape (K, m)
        Quantities of the error model in theirs.
    """
    picks = _picks(samples, size, seed)
    return _flat(samples.theta)[picks], _flat(samples.of_errors)[picks]


def _picks(samples: Samples, size: int, seed: int) -> Integers:
    count = samples.log_density.size
    return np.random.default_rng(seed).choice(count, size=min(size, count), replace=False)


def _flat(draws: Array) -> Array:
    return draws.reshape(math.prod(draws.shape[:-1]), draws.shape[-1])  # also of no quantities


def sd_of_averages(errors: Array, phase: Array, bins: int) -> Array:
    """Standard deviation of errors that are averaged over periods, in bins of phase.

    Parameters
    ----------
    errors : ndarray, shape (W, s, n)
        Drawn at all samples of a run.
    phase : ndarray, shape (n,)
        In cycles.
    bins : int
        Of one cycle, equally long.

    Returns
    -------
    ndarray, shape (W, s)
        Root mean square over the bins: errors of a run are alike at any phase.
    """
    index = np.minimum((phase % 1.0 * bins).astype(int), bins - 1)
    order = np.argsort(index, kind="stable")
    _, first, count = np.unique(index[order], return_index=True, return_counts=True)
    means = np.add.reduceat(errors[:, :, order], first, axis=2) / count
    return np.asarray(np.sqrt(np.mean(means**2, axis=2)))


def to_datasets(
    samples: Samples,
    priors: Sequence[Prior],
    *,
    units: Mapping[str, str] | None = None,
    long_names: Mapping[str, str] | None = None,
    seed: int = 0,
    density: LogDensity | None = None,
) -> dict[str, xr.Dataset]:
    """Groups ``posterior``, ``prior``, ``sample_stats``, ``log_likelihood`` and ``log_prior``.

    Parameters
    ----------
    samples : Samples
        Draws of the posterior.
    priors : sequence of Prior
        Of the ``l`` parameters, in the order of ``samples.parameters``.
    units : mapping of str to str, optional
        Unit of each parameter and output (an output's gives that of its variance); ``"1"`` where
        there is none.
    long_names : mapping of str to str, optional
        What each parameter or output is; its name where there is none.
    seed : int
        Seeds the prior's draws.
    density : LogDensity, optional
        What was sampled: gives the prior of all quantities that have a proper one, not only of the
        parameters, and the group ``log_prior``, by which ArviZ scales the prior.

    Returns
    -------
    dict of str to xarray.Dataset
        By group name, dims ``chain``, ``draw`` and ``run``; ready for
        ``xarray.DataTree.from_dict``.
    """
    about = _About(units or {}, long_names or {}, density)
    rng = np.random.default_rng(seed)
    groups = {
        "posterior": _posterior(samples, about),
        "sample_stats": _sample_stats(samples),
        "log_likelihood": _log_likelihood(samples),
    }
    if density is None:
        draws = sample_of(priors, rng, PRIOR_CHAINS * PRIOR_DRAWS)
        return groups | {
            "prior": _prior(dict(zip(samples.parameters, draws.T, strict=True)), about)
        }
    groups["posterior"].attrs["error_model"] = density.errors.word
    if density.reason:
        groups["posterior"].attrs[schema.ERROR_MODEL_REASON] = density.reason
    draws = density.unknowns.sample_prior(rng, PRIOR_CHAINS * PRIOR_DRAWS)
    table = dict(zip(density.unknowns.names, draws.T, strict=True))
    table |= density.errors.sample_prior(rng, PRIOR_CHAINS * PRIOR_DRAWS)
    return groups | {"prior": _prior(table, about), "log_prior": _log_prior(samples, density)}


@dataclass(frozen=True)
class _About:
    """Units and names of what is stored."""

    units: Mapping[str, str]
    long_names: Mapping[str, str]
    density: LogDensity | None

    def attributes(self, name: str) -> dict[str, str]:
        """Of a quantity of the posterior."""
        quantity = None
        if self.density is not None:
            quantity = next((q for q in self.density.errors.quantities if q.name == name), None)
        if quantity is not None:
            output = next((o for o in self.units if f"_{o}" in name), "")
            unit = quantity.unit.format(self.units.get(output, "1"))
            return {"units": unit, "long_name": quantity.long_name}
        if name.startswith(LOG_VARIANCE):
            output = name.removeprefix(LOG_VARIANCE)
            what = self.long_names.get(output, output)
            text = f"logarithm of the error variance of {what}"
            return {"units": f"ln(({self.units.get(output, '1')})^2)", "long_name": text}
        return {
            "units": self.units.get(name, "1"),
            "long_name": self.long_names.get(name, name),
        }


def _coordinates(samples: Samples) -> dict[str, object]:
    chains, draws = samples.log_density.shape
    return {
        "chain": np.arange(chains),
        "draw": np.arange(draws),
        "ensemble": ("chain", samples.ensemble),
    }


def _posterior(samples: Samples, about: _About) -> xr.Dataset:
    variables = {
        name: (("chain", "draw"), samples.draws[:, :, a], about.attributes(name))
        for a, name in enumerate(samples.names)
    }
    return xr.Dataset(variables, coords=_coordinates(samples))


def _prior(draws: Mapping[str, np.ndarray], about: _About) -> xr.Dataset:
    shape = (PRIOR_CHAINS, PRIOR_DRAWS)
    variables = {
        name: (("chain", "draw"), column.reshape(shape), about.attributes(name))
        for name, column in draws.items()
    }
    coords = {"chain": np.arange(PRIOR_CHAINS), "draw": np.arange(PRIOR_DRAWS)}
    return xr.Dataset(variables, coords=coords)


def _log_prior(samples: Samples, density: LogDensity) -> xr.Dataset:
    """Log prior densities in the quantities' own units, where they are proper."""
    chains, draws, dimension = samples.draws.shape
    flat = samples.draws.reshape(-1, dimension)
    size = len(density.unknowns.names)
    found = density.unknowns.natural_log_prior(flat[:, :size])
    for k, quantity in enumerate(density.errors.quantities):
        if quantity.prior is not None:
            found[quantity.name] = quantity.prior.log_density(flat[:, size + k])
    variables = {
        name: (
            ("chain", "draw"),
            np.asarray(values).reshape(chains, draws),
            {"units": "1", "long_name": f"log prior density of {name}"},
        )
        for name, values in found.items()
    }
    return xr.Dataset(variables, coords=_coordinates(samples))


def _sample_stats(samples: Samples) -> xr.Dataset:
    by_name = {
        "autocorrelation_time": samples.autocorrelation_time,
        "effective_sample_size": samples.effective_size,
        "rhat_nested": samples.rhat_nested,
    }
    attributes: dict[str, object] = {
        key: json.dumps(dict(zip(samples.names, values.tolist(), strict=True)))
        for key, values in by_name.items()
    }
    attributes["acceptance"] = json.dumps(samples.acceptance)
    attributes["evaluations"] = samples.evaluations
    attributes["failures"] = json.dumps(samples.failures)
    attributes["branch_jumps"] = samples.branch_jumps
    attributes["reached"] = int(samples.reached)  # netCDF has no truth values
    attributes["warning"] = samples.warning
    if samples.diverging is not None:
        attributes["sampler"], attributes["divergences"] = samples.sampler, samples.divergences
    about = {"units": "1", "long_name": "log posterior density over coordinates without bounds"}
    variables: dict[str, object] = {"lp": (("chain", "draw"), samples.log_density, about)}
    if samples.diverging is not None:
        about = {"units": "1", "long_name": "whether the trajectory to a draw diverged"}
        # netCDF has no truth values
        variables["diverging"] = (("chain", "draw"), samples.diverging.astype(np.int8), about)
    coordinates = _coordinates(samples)
    if len(samples.failed):
        about = {"units": "1", "long_name": "proposals of density zero on the way to a draw"}
        variables["failed"] = (("draw", "reason"), samples.failed, about)
        coordinates = {**coordinates, "reason": list(REASONS)}
    return xr.Dataset(variables, coords=coordinates, attrs=attributes)


def _log_likelihood(samples: Samples) -> xr.Dataset:
    about = {"units": "1", "long_name": "log-likelihood of each run"}
    coords = {**_coordinates(samples), "run": list(samples.runs)}
    variables = {"runs": (("chain", "draw", "run"), samples.log_likelihood, about)}
    return xr.Dataset(variables, coords=coords)
