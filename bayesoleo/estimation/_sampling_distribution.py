"""Sampling distribution of an estimator over simulated experiments, compared with theory.

References
----------
Verbeek (1993), eqs. 2.18-2.20: mean, bias and covariance of the estimates over replications.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from bayesoleo import _schema as schema
from bayesoleo._schema import LabelledResult, columns, variable
from bayesoleo._storage.resume import Arrays, Slots
from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation._batched_fits import estimate_many
from bayesoleo.estimation._bayesian_estimators import method as find_method
from bayesoleo.estimation._estimate import estimate
from bayesoleo.estimation._intervals import cramer_rao, propagated
from bayesoleo.estimation._least_squares import BatchProblem
from bayesoleo.estimation._objectives import prior_precision
from bayesoleo.estimation._parametric_bootstrap import DataSource, NoiseBlock, data_source
from bayesoleo.estimation._point_estimate import PointEstimate
from bayesoleo.estimation._problem import EstimationProblem, measured_of
from bayesoleo.solvers._orbit import Status, count

_MIXED = "unit of each parameter"


def by_replication(parts: Arrays) -> dict[str, xr.Variable]:
    """What each replication found."""
    each, of_output = ("replication", schema.PARAMETER), ("replication", schema.OUTPUT)
    squared = "square of the output's SI unit"
    return {
        "replicate": variable(each, parts["theta"], "estimate by replication", _MIXED),
        "status": variable(("replication",), parts["status"], "outcome", "1"),
        schema.VARIANCE: variable(
            of_output, parts["variance"], "error variance by replication", squared
        ),
    }


def moments(found: Array, truth: Array, expected: Array, bound: Array) -> dict[str, xr.Variable]:
    """Mean and covariance of estimates (R, l), beside the truth and what theory expects."""
    mean, covariance = np.full_like(truth, np.nan), np.full_like(expected, np.nan)
    if len(found) > 1:
        mean, covariance = found.mean(axis=0), np.atleast_2d(np.cov(found, rowvar=False))
    sd, bound_sd = np.sqrt(np.diag(covariance)), np.sqrt(np.diag(bound))
    one, square = (schema.PARAMETER,), (schema.PARAMETER, schema.PARAMETER_COLUMN)
    products = "product of the parameters' units"
    table = {
        "truth": (one, truth, "true value", _MIXED),
        "mean": (one, mean, "mean of the estimates", _MIXED),
        "bias": (one, mean - truth, "mean of the estimates less the truth", _MIXED),
        "bias_standard_error": (
            one,
            sd / np.sqrt(max(len(found), 1)),
            "standard error of the bias",
            _MIXED,
        ),
        schema.SD: (one, sd, "standard deviation of the estimates", _MIXED),
        "expected_sd": (
            one,
            np.sqrt(np.diag(expected)),
            "standard deviation by linearisation",
            _MIXED,
        ),
        "bound_sd": (one, bound_sd, "least standard deviation (Cramér and Rao)", _MIXED),
        schema.COVARIANCE: (square, covariance, "covariance of the estimates", products),
        "expected_covariance": (square, expected, "covariance by linearisation", products),
        "bound": (square, bound, "least covariance (Cramér and Rao)", products),
        "efficiency": (one, bound_sd**2 / sd**2, "variance of the bound over that found", "1"),
    }
    return {name: variable(*item) for name, item in table.items()}


def sampling_text(data: xr.Dataset) -> str:
    """Bias and scatter against theory, one line a parameter.

    Parameters
    ----------
    data : xarray.Dataset
        The group ``sampling_distribution``.
    """
    head = [
        "parameter",
        "truth",
        "bias",
        "± se",
        "bias/sd",
        "sd",
        "expected",
        "bound",
        "efficiency",
    ]
    rows = []
    for name in data[schema.PARAMETER].values:
        one = data.sel({schema.PARAMETER: name})
        value = {key: float(one[key]) for key in one.data_vars if one[key].ndim == 0}
        cells = [
            f"{value['truth']:.6g}",
            f"{value['bias']:.2e}",
            f"{value['bias_standard_error']:.1e}",
        ]
        cells += [f"{value['bias'] / value['sd']:.3f}", f"{value['sd']:.4g}"]
        cells += [f"{value['expected_sd']:.4g}", f"{value['bound_sd']:.4g}"]
        rows.append([str(name), *cells, f"{value['efficiency']:.3f}"])
    about = data.attrs
    end = (
        f"{about['method']}, {about['converged']} of {about['replications']} replications converged"
    )
    text = f"{columns(head, rows)}\n{end}, {about['iterations']:.1f} iterations on average"
    held = about.get("held", "")
    return f"{text}\nheld at the truth, so that noise alone scatters: {held}" if held else text


@dataclass(frozen=True)
class _ReplicationTask:
    """What every replication has in common."""

    source: DataSource
    theta: Array
    method: str
    seed: int
    tolerance: float
    max_iterations: int

    def generator(self, number: int) -> np.random.Generator:
        """The data of a replication depend on the seed and its own number alone."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(number,)))

    def replicate(self, number: int) -> PointEstimate:
        """One replication."""
        return estimate(
            self.source.draw(self.generator(number)),
            self.method,
            start=self.theta,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
        )

    def block(self, numbers: Sequence[int]) -> Arrays:
        """Replications as arrays; where only outputs are new, all together."""
        if self.source.batch is not None:
            return self._together(self.source.batch, numbers)
        points = [self.replicate(number) for number in numbers]
        return {
            "theta": np.array([point.theta for point in points]),
            "variance": np.array([point.variance for point in points]),
            "status": np.array([int(point.status) for point in points]),
            "iterations": np.array([point.iterations for point in points]),
        }

    def _together(self, problem: BatchProblem, numbers: Sequence[int]) -> Arrays:
        drawn = [self.source.outputs(self.generator(number)) for number in numbers]
        data = [np.stack(column) for column in zip(*drawn, strict=True)]
        found = estimate_many(
            problem,
            data,
            self.method,
            start=self.theta,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
        )
        return {
            "theta": found.theta,
            "variance": found.variance,
            "status": found.status,
            "iterations": found.iterations,
        }


def sampling_distribution(
    problem: EstimationProblem,
    point: PointEstimate | ArrayLike,
    *,
    replications: int = 1000,
    method: str = "mbe",
    variance: ArrayLike | None = None,
    input_noise: bool = True,
    seed: int = 0,
    tolerance: float = 1e-5,
    max_iterations: int = 50,
    block: int = 100,
    out: str | os.PathLike[str] | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    progress: bool | float = False,
) -> LabelledResult:
    """Simulate an experiment again and again, estimate from each, and compare with theory.

    Parameters
    ----------
    problem : EstimationProblem
        Says when and at what inputs is measured; its measured outputs are not used.
    point : PointEstimate or array_like, shape (l,)
        The true parameters.
    replications : int, optional
        Number of experiments.
    method : str, optional
        The estimator. It starts at the truth, so that its own failures to get there do not enter.
    variance : array_like, shape (s,), optional
        Noise variance of each output. Of a campaign it is by default that of the records, run by
        run; otherwise that of the point.
    input_noise : bool, optional
        Whether the inputs of a campaign are measured with noise too. The estimator takes them as
        true.
    seed : int, optional
        With the number of a replication it fixes its noise, whatever the block or the threads.
    tolerance, max_iterations
        As in :func:`~bayesoleo.estimation.estimate`. A relative step of 1e-5 is far below the
        scatter.
    block : int, optional
        Replications that are saved together.
    out : path-like, optional
        Folder in which finished blocks are kept; the same call goes on where it was stopped.
    jobs : int, optional
        Threads over blocks; by default the cores this process may use.
    scheduler : str, optional
        Other processes or machines that make the blocks instead: ``local:4``, or the address of a
        Dask scheduler.
    progress : bool or float, optional
        Whether to show a bar.

    Returns
    -------
    LabelledResult
        The group ``sampling_distribution``: ``replicate(replication, parameter)``,
        ``status(replication)``, ``variance(replication, output)``; ``truth``, ``mean``, ``bias``,
        ``bias_standard_error``, ``sd``, ``expected_sd``, ``bound_sd``, ``efficiency``
        ``(parameter)``; ``covariance``, ``expected_covariance`` and ``bound``
        ``(parameter, parameter_column)``. Expected is the noise propagated through the linearised
        estimator, the bound is that of Cramér and Rao, the efficiency is the bound's variance over
        the one found. Replications that did not converge are counted and left out.
        A method that forgets priors holds nuisance parameters and constants known to a tolerance at
        the truth: the attribute ``held`` names them, and the scatter is that of noise alone.

    Raises
    ------
    InputError
        If the problem cannot be evaluated at the point, or ``out`` holds another calculation.

    References
    ----------
    Verbeek (1993), eqs. 2.18-2.20.
    """
    if replications < 2 or block < 1:
        raise InputError(
            "replications must be two or more, block one or more",
            value=(replications, block),
        )
    theta = np.array(point.theta if isinstance(point, PointEstimate) else point, dtype=float)
    noise = None if variance is None else np.array(variance, dtype=float)
    if noise is None and isinstance(point, PointEstimate) and not hasattr(problem, "predictor"):
        noise = point.variance
    source = data_source(problem, theta, noise, input_noise=input_noise)
    blocks = source.blocks()
    find_method(method)
    work = _ReplicationTask(source, theta, method, seed, tolerance, max_iterations)
    slots = Slots(out, _fingerprint(problem, work, blocks, block))
    parts = _all_blocks(work, slots, replications, block, jobs, scheduler, progress)
    data = _summarise(problem, work, blocks, parts)
    return LabelledResult(data, sampling_text(data))


def _all_blocks(
    work: _ReplicationTask,
    slots: Slots,
    replications: int,
    block: int,
    jobs: int | None,
    scheduler: str | None,
    progress: bool | float,
) -> Arrays:
    """Blocks that are stored, and those that had to be made."""
    from tqdm.auto import tqdm

    numbers = [
        range(first, min(first + block, replications)) for first in range(0, replications, block)
    ]
    delay = 0.0 if progress is True else progress
    with tqdm(
        total=replications, unit="fit", desc="replications", disable=not progress, delay=delay
    ) as bar:
        parts = slots.fill(
            _Blocks(work, numbers),
            len(numbers),
            # The last block of a shorter calculation is made again in full by a longer one.
            whole=lambda index, arrays: len(arrays["status"]) >= len(numbers[index]),
            scheduler=scheduler,
            jobs=jobs,
            done=lambda index: bar.update(len(numbers[index])) and None,
        )
    wanted = [
        {name: values[: len(block)] for name, values in part.items()}
        for part, block in zip(parts, numbers, strict=True)
    ]
    return {name: np.concatenate([part[name] for part in wanted]) for name in wanted[0]}


@dataclass(frozen=True)
class _Blocks:
    """Makes a block of replications by its number, wherever it is sent."""

    work: _ReplicationTask
    numbers: Sequence[range]

    def __call__(self, index: int) -> Arrays:
        return self.work.block(self.numbers[index])


def _fingerprint(
    problem: EstimationProblem, work: _ReplicationTask, blocks: Sequence[NoiseBlock], block: int
) -> str:
    """What the stored replications belong to."""
    settings: list[object] = [
        list(problem.names),
        list(problem.outputs),
        list(problem.runs),
        work.method,
    ]
    settings += [work.seed, work.tolerance, work.max_iterations, block]
    total = hashlib.sha256(json.dumps(settings).encode())
    total.update(np.ascontiguousarray(work.theta).tobytes())
    total.update(np.ascontiguousarray(problem.counts).tobytes())
    for part in blocks:
        total.update(np.ascontiguousarray(part.sd).tobytes())
        total.update(np.int64(part.columns.shape[1]).tobytes())
    return total.hexdigest()


def _summarise(
    problem: EstimationProblem, work: _ReplicationTask, blocks: Sequence[NoiseBlock], parts: Arrays
) -> xr.Dataset:
    """The group ``sampling_distribution`` from finished replications."""
    good = parts["status"] == Status.CONVERGED.value
    precision = None
    free = np.arange(len(work.theta))
    if find_method(work.method).fixed_prior:
        precision = prior_precision(problem.priors, work.theta)
    else:  # held at the truth: they do not scatter
        free = np.flatnonzero(~measured_of(problem))
        blocks = [replace(part, sensitivity=part.sensitivity[:, free]) for part in blocks]
    names, truth = [problem.names[k] for k in free], work.theta[free]
    parts = {**parts, "theta": parts["theta"][:, free]}
    weights = parts["variance"][good].mean(axis=0) if good.any() else np.ones(len(problem.outputs))
    expected, bound = propagated(blocks, weights, precision), cramer_rao(blocks)
    data = xr.Dataset(
        {**by_replication(parts), **moments(parts["theta"][good], truth, expected, bound)},
        coords={
            schema.PARAMETER: names,
            schema.PARAMETER_COLUMN: names,
            schema.OUTPUT: list(problem.outputs),
        },
    )
    data.attrs = {
        "method": work.method,
        "seed": work.seed,
        "replications": len(good),
        "converged": int(good.sum()),
        "outcomes": json.dumps(count(parts["status"])),
        "iterations": float(parts["iterations"].mean()),
        "held": ", ".join(name for name in problem.names if name not in names),
    }
    return data
