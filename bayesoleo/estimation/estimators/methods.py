"""The estimators by name."""

from __future__ import annotations

from typing import Any

from bayesoleo.errors import InputError
from bayesoleo.estimation.estimators.levenberg_marquardt import LevenbergMarquardtStep
from bayesoleo.estimation.estimators.steps import (
    BayesianStep,
    GaussNewtonStep,
    MinimumVarianceStep,
    ModifiedBayesianStep,
    ModifiedMinimumVarianceStep,
    NewtonStep,
    Step,
)

METHODS: dict[str, Step[Any]] = {
    step.name: step
    for step in (
        BayesianStep(),
        MinimumVarianceStep(),
        ModifiedMinimumVarianceStep(),
        ModifiedBayesianStep(),
        GaussNewtonStep(),
        LevenbergMarquardtStep(),
        NewtonStep(),
    )
}

# What people type.
_SHORT = {"lm": "levenberg-marquardt", "gn": "gauss-newton"}


def method(name: str | Step[Any]) -> Step[Any]:
    """Estimator of this name, or the step itself.

    Raises
    ------
    InputError
        If there is no estimator of that name.
    """
    if isinstance(name, Step):
        return name
    name = _SHORT.get(name, name)
    if name not in METHODS:
        raise InputError(
            "there is no such estimator",
            key="method",
            value=name,
            hint=f"use {', '.join(METHODS)}, or scipy: and one of SciPy's optimisers",
        )
    return METHODS[name]
