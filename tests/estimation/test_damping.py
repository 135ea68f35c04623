"""Damped steps: fewer evaluations in curved valleys, and nothing where halving helps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bayesoleo.estimation import FunctionProblem, estimate
from bayesoleo.estimation._bayesian_estimators import method as step_of
from bayesoleo.estimation._damping import Damping, weight_within
from bayesoleo.estimation._least_squares import WhitenedEquations
from bayesoleo.model import Normal

TIME = np.linspace(0.0, 60.0, 601)


def swinging(time: np.ndarray, theta: np.ndarray) -> np.ndarray:
    """A decay over many swings, damped by an amplitude and an exponent that make up for each other.

    The frequency follows the amplitude, so that the phase turns far before the amplitude does.
    """
    damping, exponent, frequency = theta
    amplitude = (1.0 + exponent * damping * time) ** (-1.0 / exponent)
    return amplitude * np.cos(frequency * time * (1.0 - 0.1 * amplitude**2))


def problem_of(truth: tuple[float, ...], start: tuple[float, ...]) -> FunctionProblem:
    noise = np.random.default_rng(0).normal(0.0, 1e-3, TIME.size)
    data = swinging(TIME, np.array(truth)) + noise
    priors = [Normal(value, 5.0 * abs(value)) for value in start]
    return FunctionProblem(swinging, TIME, data, priors, start=start)


@pytest.mark.parametrize("name", ["be", "mbe"])
def test_a_curved_valley_takes_fewer_evaluations(name: str) -> None:
    problem = problem_of((0.05, 1.0, 6.28), (0.1, 0.2, 6.27))
    limits = {"tolerance": 1e-6, "max_iterations": 100}
    plain = estimate(problem, name, **limits)  # type: ignore[arg-type]
    damped = estimate(problem, replace(step_of(name), damped=True), **limits)  # type: ignore[arg-type]
    assert damped.status.ok
    # Objectives are log densities: a thousandth of one means nothing.
    assert damped.objective >= plain.objective - 1e-3
    assert damped.evaluations < 0.7 * plain.evaluations


@pytest.mark.parametrize("name", ["be", "mbe"])
def test_nothing_is_damped_where_few_halvings_suffice(name: str) -> None:
    problem = problem_of((0.05, 1.0, 6.28), (0.051, 0.99, 6.28))
    plain = estimate(problem, name)
    assert plain.halvings <= 2
    damped = estimate(problem, replace(step_of(name), damped=True))
    assert np.array_equal(damped.theta, plain.theta)


def equations(slope: float) -> WhitenedEquations:
    rng = np.random.default_rng(1)
    jacobian, residual = rng.normal(size=(30, 3)) * [1.0, 20.0, 300.0], rng.normal(size=30)
    room = (np.full(3, np.inf), np.full(3, np.inf))
    pull = slope * np.array([1.0, -2.0, 0.5])
    return WhitenedEquations(jacobian, residual, pull, room, np.eye(3), np.zeros(3), noise=0.1)


@pytest.mark.parametrize("slope", [0.0, 3.0])
def test_a_damped_step_is_as_long_as_the_radius_and_goes_uphill(slope: float) -> None:
    known = equations(slope)
    whole = known.solve(known.root)
    damping = Damping(np.zeros(3)).at(known, known.root)
    assert damping.shortened(whole, known, known.root) is whole
    size = float(np.linalg.norm(damping.length * whole))
    for part in (0.5, 1e-2, 1e-6):
        short = replace(damping, radius=part * size).shortened(whole, known, known.root)
        # The secular equation is solved to a tenth.
        assert np.linalg.norm(damping.length * short) == pytest.approx(part * size, rel=0.11)
        assert short @ known.gradient > 0
    # The shortest step goes along the gradient in the units of the lengths.
    steepest = known.gradient / damping.length**2
    cosine = (damping.length * short) @ (damping.length * steepest)
    cosine /= np.linalg.norm(damping.length * short) * np.linalg.norm(damping.length * steepest)
    assert cosine > 1 - 1e-6


def test_a_refused_step_shortens_the_radius_and_success_lengthens_it() -> None:
    damping, step = Damping(np.ones(2)), np.array([3.0, 4.0])
    assert damping.accepted(step, 0.1).radius == np.inf  # nothing was refused yet
    refused = damping.refused(step)
    assert refused.radius == pytest.approx(1.25)
    assert refused.refused(step).radius == pytest.approx(1.25 / 4)
    short = step / 5
    assert refused.accepted(short, 0.1).radius == pytest.approx(0.5)
    assert refused.accepted(short, 0.5).radius == pytest.approx(1.25)
    assert refused.accepted(short, 0.9).radius == pytest.approx(2.0)


def test_no_weight_is_needed_within_the_radius() -> None:
    assert weight_within(np.eye(2), np.array([0.3, 0.4]), 0.5) == 0.0
    weight = weight_within(np.eye(2), np.array([3.0, 4.0]), 0.5)
    assert np.linalg.norm(np.array([3.0, 4.0]) / (1 + weight)) == pytest.approx(0.5, rel=0.11)
