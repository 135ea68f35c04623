"""Estimates of candidates start where a part of what the score expects is an improvement."""

from __future__ import annotations

import numpy as np
import pytest
from fitted_states import NUMERICS
from scipy.integrate import solve_ivp

from bayesoleo.discovery import _other_starts as starts_of, _refit as refits
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._numerics import problem_on
from bayesoleo.discovery._other_starts import likeliest
from bayesoleo.discovery._ranking import score_candidates
from bayesoleo.discovery._refit import STARTS, refit, start_from
from bayesoleo.discovery._score_basis import Base
from bayesoleo.discovery._score_tests import Score
from bayesoleo.discovery._state import fit_state
from bayesoleo.effects import find_effect
from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction._mesh_steps import WHOLE
from bayesoleo.prediction._records import transient_record

STEP, COUNT, SWINGS = 0.02, 3001, 2 * np.pi
VISCOUS, DRAG = 0.02, 0.12


def free_swing(start: float, label: str, rng: np.random.Generator):
    """A free decay of sixty swings, by another solver, with drag that the model does not know."""
    time = STEP * np.arange(COUNT)

    def rates(_: float, state: np.ndarray) -> list[float]:
        angle, rate = state
        return [rate, -(SWINGS**2) * angle - VISCOUS * rate - DRAG * abs(rate) * rate]

    found = solve_ivp(rates, (0.0, time[-1]), [start, 0.0], t_eval=time, rtol=1e-9, atol=1e-12)
    samples = {"angle": found.y[0] + rng.normal(0.0, 1e-5, COUNT)}
    return transient_record(label, time, samples)


@pytest.fixture(scope="module")
def scored() -> tuple[Base, Score]:
    rng = np.random.default_rng(3)
    records = [free_swing(1.0, "high", rng), free_swing(0.3, "low", rng)]
    model = Model(
        "pendulum",
        dofs={"swing": Dof("rad", guess="1.0")},
        parameters={
            "stiffness": Parameter(SWINGS**2, "1/s**2", relative_sd=0.1),
            "viscous": Parameter(0.1, "1/s", relative_sd=1.0),
        },
        equations={
            "swing": {
                "inertia": "ddot(swing)",
                "damping": "viscous*dot(swing)",
                "gravity": "stiffness*swing",
            }
        },
        outputs={"angle": Output("swing", "rad")},
    )
    state = fit_state(Assembly(model, starts=True), assign(records), NUMERICS)
    base = state.base()
    (score,), _ = score_candidates(base, state.assembly, (find_effect("quadratic_damping"),), 1)
    return base, score


@pytest.mark.slow
def test_a_score_says_how_the_present_unknowns_move(scored: tuple[Base, Score]) -> None:
    base, score = scored
    moved = dict(zip(base.fit.problem.names, score.beside, strict=True))
    # Drag takes over what the viscous part had of it.
    assert score.expected[0] > 0 > moved["viscous"]


def test_starts_are_parts_of_what_is_expected(scored: tuple[Base, Score]) -> None:
    base, score = scored
    model = score.option.assembly.model()
    model = model.with_values({score.names[0]: float(score.expected[0])})
    starts = refits._starts(base, score, model)
    moved = dict(zip(base.fit.problem.names, score.beside, strict=True))
    for part, start in zip(STARTS, starts, strict=True):
        assert start[score.names[0]] == pytest.approx(part * score.expected[0])
        expected = base.fit.values["viscous"] + part * moved["viscous"]
        assert start["viscous"] == pytest.approx(expected)


def test_an_estimate_finds_what_the_score_points_to(scored: tuple[Base, Score]) -> None:
    base, score = scored
    found = refit(base, score, NUMERICS)
    assert found.share > 0.999
    assert found.fit.values["viscous"] == pytest.approx(VISCOUS, rel=1e-3)
    drag = next(value for name, value in found.fit.values.items() if "quadratic" in name)
    assert drag == pytest.approx(DRAG, rel=1e-3)


def test_the_likeliest_start_is_taken(scored: tuple[Base, Score]) -> None:
    problem = scored[0].fit.problem
    best = scored[0].fit.point.theta
    starts = np.array([1.3 * best, best, 1.01 * best])
    assert np.array_equal(likeliest(problem, starts), best)


def test_starts_beyond_some_that_are_worse_are_not_looked_at(
    scored: tuple[Base, Score], monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = scored[0].fit.problem
    best = scored[0].fit.point.theta
    asked: list[float] = []
    cost = starts_of._cost

    def counted(problem, vectors):
        asked.extend(vectors[:, 0] / best[0])
        return cost(problem, vectors)

    monkeypatch.setattr(starts_of, "_cost", counted)
    starts = np.outer([3.0, 1.3, 1.2, 1.1, 1.0, 1.01], best)
    assert np.array_equal(likeliest(problem, starts), best)
    assert asked == pytest.approx([1.01, 1.0, 1.1, 1.2])


@pytest.mark.parametrize("effect", ["sensor_offset", "sensor_offset_by_run", "sensor_lag"])
def test_a_free_motion_starts_where_it_was_whatever_its_sensor_does(
    scored: tuple[Base, Score], effect: str
) -> None:
    """The null of an effect on a sensor is the present model, its start included."""
    base = scored[0]
    step = scored[1].option.assembly.steps[-1]
    assembly = scored[1].option.assembly.without(step)
    (option,) = assembly.options(step.scales, (find_effect(effect),))
    problem = problem_on(option.model, base.fit.records, NUMERICS, WHOLE, base.fit.predictor)
    start = start_from(base.fit, base.fit.values, option.model)
    assert problem.freeze(start).ok
    (other,) = starts_of._cost(problem, start[None])
    (own,) = starts_of._cost(base.fit.problem, base.fit.point.theta[None])
    # Meshes of both may change this by one each; from rest it is some ten thousand more.
    assert other == pytest.approx(own, abs=2.0)


def test_the_first_start_is_taken_where_the_last_cannot_be_solved(
    scored: tuple[Base, Score],
) -> None:
    problem = scored[0].fit.problem
    best = scored[0].fit.point.theta
    starts = np.array([1.01 * best, best, np.full_like(best, np.nan)])
    assert np.array_equal(likeliest(problem, starts), starts[0])
    problem.freeze(best)
