"""A straight line in each of several runs: everything about it is known in closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bayesoleo.error_models._base import RunSamples
from bayesoleo.estimation._problem import Evaluation, Misfit
from bayesoleo.model._priors import Normal
from bayesoleo.solvers._orbit import Status

LEVEL = Normal(0.0, 2.0)


@dataclass(frozen=True)
class LinearRuns:
    """``y = level[run] + slope * wave(phase)``, one output or more with the same answer.

    ``y`` holds (s, n) of each run; ``times`` are in seconds, and one second is a period.
    """

    y: tuple
    times: tuple
    by_run: bool = True
    level_prior: object = LEVEL

    @property
    def runs(self):
        return tuple(f"r{k}" for k in range(len(self.y)))

    @property
    def outputs(self):
        return ("force", "pressure")[: len(self.y[0])]

    @property
    def names(self):
        levels = [f"level[{run}]" for run in self.runs] if self.by_run else ["level"]
        return (*levels, "slope")

    @property
    def priors(self):
        return (self.level_prior,) * (len(self.names) - 1) + (Normal(0.0, 10.0),)

    @property
    def start(self):
        return np.zeros(len(self.names))

    @property
    def counts(self):
        return np.array([[y.shape[1]] * len(y) for y in self.y])

    @property
    def samples(self):
        return tuple(RunSamples(time, 1.0) for time in self.times)

    @property
    def data(self):
        return tuple(np.concatenate(self.y, axis=1))

    def columns(self, run):
        """Sensitivities of one output in a run, (n, l)."""
        table = np.zeros((self.times[run].size, len(self.names)))
        table[:, run if self.by_run else 0] = 1.0
        table[:, -1] = np.cos(2 * np.pi * self.times[run])
        return table

    def residuals(self, theta, run):
        table = self.columns(run)
        # Row by row: a matrix product may round a row differently beside others.
        predicted = np.stack([table @ row for row in theta])
        status = np.zeros(len(theta), dtype=int)
        return self.y[run][None] - predicted[:, None, :], status

    def misfit(self, theta):
        parts = [self.residuals(theta, run)[0] for run in range(len(self.y))]
        sums = np.stack([np.sum(part**2, axis=2) for part in parts], axis=1)
        return Misfit(sums, np.zeros(len(theta), dtype=int))

    def evaluate(self, theta):
        runs = range(len(self.y))
        residual = [self.residuals(np.asarray(theta)[None], run)[0][0] for run in runs]
        table = np.concatenate([self.columns(run) for run in runs])
        outputs = range(len(self.outputs))
        return Evaluation(
            tuple(np.concatenate([part[b] for part in residual]) for b in outputs),
            tuple(table for _ in outputs),
            Status.CONVERGED,
        )


def linear_runs(errors, *, levels, slope=1.5, times=None, by_run=True, **options) -> LinearRuns:
    """Data with given errors, (s, n) of each run."""
    times = times or tuple(np.arange(e.shape[1]) / 50 for e in errors)
    wave = [slope * np.cos(2 * np.pi * time) for time in times]
    y = tuple(a + b + e for a, b, e in zip(levels, wave, errors, strict=True))
    return LinearRuns(y, tuple(times), by_run, **options)


def hierarchical_quadrature(problem: LinearRuns, log_v: float = -1.4):
    """Mean and sd of levels, slope, mean and spread, by integrating over spread and variance.

    The levels scatter about the mean by the spread. Given spread and variance, whose logarithm lies
    within one of ``log_v``, all is linear and normal; the slope is integrated out with the levels.
    """
    prior_sd, runs = 2.0, len(problem.y)
    table = np.concatenate([problem.columns(k) for k in range(runs)])
    y = np.concatenate([part[0] for part in problem.y])
    logs, firsts, seconds = [], [], []
    for spread in np.geomspace(1e-3, 8.0, 241):
        # Unknowns: levels, slope, mean; prior precision of the levels about the mean.
        precision = np.zeros((runs + 2, runs + 2))
        each = spread**-2.0
        precision[:runs, :runs] = each * np.eye(runs)
        precision[:runs, -1] = precision[-1, :runs] = -each
        precision[-1, -1] = runs * each + prior_sd**-2.0
        precision[runs, runs] = 0.01
        for log_variance in np.linspace(log_v - 1, log_v + 1, 61):
            whole = precision.copy()
            whole[:-1, :-1] += table.T @ table * np.exp(-log_variance)
            right = np.append(table.T @ y, 0.0) * np.exp(-log_variance)
            covariance = np.linalg.inv(whole)
            centre = covariance @ right
            log = -runs * np.log(spread) - 0.5 * y.size * log_variance
            log += 0.5 * right @ centre - 0.5 * y @ y * np.exp(-log_variance)
            log -= 0.5 * np.linalg.slogdet(whole)[1]
            log += -0.5 * (spread / prior_sd) ** 2 + np.log(spread)  # grid is equal in its log
            logs.append(log)
            firsts.append([*centre, spread])
            seconds.append([*(np.diag(covariance) + centre**2), spread**2])
    weight = np.exp(np.array(logs) - max(logs))
    weight /= weight.sum()
    mean = weight @ np.array(firsts)
    return mean, np.sqrt(weight @ np.array(seconds) - mean**2)
