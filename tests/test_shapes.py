"""Results have the shapes that their types and their docstrings declare."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from collections.abc import Iterator
from dataclasses import is_dataclass, replace
from typing import get_args

import numpy as np
import pytest
from shapes import check_shapes, declared

import bayesoleo
from bayesoleo.estimation import FunctionProblem, estimate
from bayesoleo.model._priors import Normal
from bayesoleo.posterior import LogDensity, laplace_mixture, sample
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._simulate import RunPlan, motion, record_of, simulate_run
from bayesoleo.systems import system


def line() -> FunctionProblem:
    x = np.linspace(0.0, 1.0, 20)
    y = 1.0 + 2.0 * x + 0.1 * np.random.default_rng(0).standard_normal(20)
    return FunctionProblem(lambda x, theta: theta[0] + theta[1] * x, x, y, [Normal(0, 10)] * 2)


def test_problem_estimate_and_samples():
    problem = line()
    point = estimate(problem)
    assert check_shapes(problem.evaluate(point.theta), problem.misfit(np.ones((3, 2))), point) > 12
    density = LogDensity(problem)
    mixture = laplace_mixture(density, point.theta[None])
    samples = sample(density, mixture, seed=1, effective_size=50, quick=True, progress=False)
    assert check_shapes(mixture, samples) > 10
    height, by_run = density(mixture.sample(np.random.default_rng(0), 4))
    assert (height.shape, by_run.shape) == ((4,), (4, 1))


def test_records_and_predictions():
    model = system("duffing")
    plan = RunPlan("a", 1.1, {"force": motion(0.1, [3.0])})
    record, simulated = record_of(model, plan), simulate_run(model, plan, steps=32)
    predictor = Predictor(model, [record], steps=32, backend="numpy", jobs=1)
    theta = np.array([[prior.mean for prior in predictor.layout.priors(model)]])
    predictions = predictor.evaluate(theta[0])
    assert check_shapes(record, *record.harmonics.values(), simulated, *predictions) > 9
    assert check_shapes(predictor.simulate(theta, 0), predictor.runs[0].anchor) > 7


def test_a_wrong_shape_is_found():
    misfit = line().misfit(np.ones((3, 2)))
    with pytest.raises(AssertionError, match=r"Misfit.status is \(2,\)"):
        check_shapes(replace(misfit, status=misfit.status[:2]))
    with pytest.raises(AssertionError, match=r"Misfit\.status is \(3,\)"):
        check_shapes(replace(misfit, status=misfit.status.astype(float)))


def dataclasses_of_the_package() -> Iterator[type]:
    for found in pkgutil.walk_packages(bayesoleo.__path__, "bayesoleo."):
        module = importlib.import_module(found.name)
        for kind in vars(module).values():
            if inspect.isclass(kind) and is_dataclass(kind) and kind.__module__ == found.name:
                yield kind


def test_types_have_as_many_dimensions_as_docstrings_say():
    compared = 0
    for kind in dataclasses_of_the_package():
        for name, declaration in declared(kind).items():
            said = re.search(rf"^\s*(?:\w+, )*{name}(?:, \w+)* : (.*)$", kind.__doc__ or "", re.M)
            shapes = re.findall(r"\(([^()]+)\)", said[1]) if said else []
            arrays = [one for one in (declaration, *get_args(declaration)) if hasattr(one, "dims")]
            if len(shapes) == 1 and len(arrays) == 1:
                sizes = [size for size in shapes[0].split(",") if size.strip()]
                assert len(arrays[0].dims) == len(sizes), f"{kind.__name__}.{name}: {said[0]}"
                compared += 1
    assert compared > 100
