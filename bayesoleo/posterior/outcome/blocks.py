r"""Blocks of samples: the data points by which ArviZ checks and compares models.

A sample is no data point of its own, because neighbouring errors may be alike, and a run is too
much for one where there are few. A block is one period of one run; where a run has many, a few
consecutive ones. A transient is cut into equal stretches. Each block gives, by output,

* one measured sample (``observed_data``), at another phase in each block, so that all blocks
  together show every part of the motion,
* the predictive distribution of that sample if the run were repeated (``posterior_predictive``),
* the log density of all samples of the block (``log_likelihood``), given the earlier blocks of its
  run and the outputs before it. Its sum over blocks and outputs is the joint log-likelihood.

All three have the one dim ``block``, so no value is missing.

References
----------
Bürkner, Gabry and Vehtari (2021), "Efficient leave-one-out cross-validation for Bayesian
non-factorized normal and Student-t models", *Computational Statistics* 36, section 2.1 (what
remains of leaving one out where data depend on each other).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from bayesoleo import schema
from bayesoleo._types import Array
from bayesoleo.error_models.base import RunSamples
from bayesoleo.estimation.problems.residuals import ResidualProblem
from bayesoleo.parallel import thread_map
from bayesoleo.posterior.density.log_density import LANES, LogDensity
from bayesoleo.posterior.sampling.samples import Samples

#: Blocks of all runs together, at most, as long as each run has one.
MOST_BLOCKS = 128
#: Stretches of a transient: fewer are no check, more would be alike.
STRETCHES = 8
#: Part of a cycle by which sampled phases differ from block to block: no two blocks of a run then
#: show the same phase (Weyl's sequence).
_GOLDEN = 0.5 * (5**0.5 - 1)


@dataclass(frozen=True)
class Blocks:
    """How the samples of one run are cut.

    Parameters
    ----------
    starts : ndarray of int, shape (B,)
        First sample of each block; they are consecutive and cover the run.
    shown : ndarray of int, shape (B,)
        The one sample of each block that is shown.
    period : ndarray of int, shape (B,)
        Number of the block's first period, or of a transient's stretch, from 1.
    """

    starts: NDArray[np.int64]
    shown: NDArray[np.int64]
    period: NDArray[np.int64]

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
    inputs: Callable[[int, NDArray[np.int64]], Mapping[str, Array]] | None = None,
    *,
    units: Mapping[str, str] | None = None,
    seed: int = 0,
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

    Returns
    -------
    dict of str to Dataset
        ``<output>(block)``, ``<output>(chain, draw, block)`` twice, and ``phase``, ``time`` and
        inputs ``(block)``; coordinates ``run`` and ``period`` say what a block is.
    """
    problem, units = cast(ResidualProblem, density.problem), units or {}
    blocks, shape = cut(density), samples.log_density.shape
    measured = _measured(problem)
    likelihood, predicted = _evaluate(samples, density, blocks, measured, seed)
    coords = _coordinates(problem.runs, blocks)
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


def _coordinates(runs: Sequence[str], blocks: Sequence[Blocks]) -> dict[str, Any]:
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
    inputs: Callable[[int, NDArray[np.int64]], Mapping[str, Array]] | None,
    units: Mapping[str, str],
) -> xr.Dataset:
    """What was known at the samples that are shown: when they were taken, and the inputs."""
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
    block, eta = density.split(density.coordinates(natural))
    theta = density.unknowns.theta(block)
    ends = np.cumsum([0, *(len(part.starts) for part in blocks)])
    shape = (len(natural), len(problem.outputs), int(ends[-1]))
    likelihood, predicted = np.empty(shape), np.empty(shape)

    def work(rows: slice) -> None:
        residuals = [problem.residuals(theta[rows], run)[0] for run in range(len(blocks))]
        found = density.errors.of_blocks(residuals, eta[rows], [part.starts for part in blocks])
        likelihood[rows] = np.concatenate(found, axis=2)
        for run, (e, part) in enumerate(zip(residuals, blocks, strict=True)):
            columns = slice(ends[run], ends[run + 1])
            predicted[rows, :, columns] = (measured[run][None] - e)[:, :, part.shown]

    parts = [slice(k, min(k + LANES, len(natural))) for k in range(0, len(natural), LANES)]
    thread_map(work, parts, density.jobs)
    rng, own = np.random.default_rng(seed), samples.of_errors.reshape(len(natural), -1)
    for run, part in enumerate(blocks):
        when = problem.samples[run]
        # With the run's first and last sample, by which a transient's length is known.
        places = np.concatenate([[0], part.shown, [when.time.size - 1]])
        taken = RunSamples(when.time[places], when.frequency, when.origin)
        errors = density.errors.draw(own, problem.runs[run], taken, rng)
        predicted[:, :, ends[run] : ends[run + 1]] += errors[:, :, 1:-1]
    return likelihood, predicted
