"""Numbers that a prediction is judged by: the peak of a pressure, the rms of a force, by run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from bayesoleo._types import Array
from bayesoleo.errors import InputError
from bayesoleo.estimation.problems.campaign_problem import CampaignProblem
from bayesoleo.estimation.problems.problem import Problem

#: A number of one run, from its predicted outputs by name, each shape (n,).
Feature = Callable[[Mapping[str, Array]], float]
#: Vectors predicted together; more would fill the memory with samples.
_BLOCK = 64


@dataclass(frozen=True)
class Features:
    """Features of a problem's predictions, for many parameter vectors.

    Parameters
    ----------
    problem : Problem
        A campaign's problem, or one with a method ``predict``.
    by_name : mapping of str to callable
        Each takes one run's predicted outputs by name and returns a number.
    """

    problem: Problem
    by_name: Mapping[str, Feature]

    @classmethod
    def of(cls, problem: Problem, features: Mapping[str, Feature] | None = None) -> Features:
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
