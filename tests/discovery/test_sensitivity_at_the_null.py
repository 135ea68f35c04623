"""What a score takes for the effect of an amplitude is what a full solve with it gives."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from fitted_states import NUMERICS
from test_recognised_gas_effects import Oleo, campaign

from bayesoleo.discovery import _score_basis
from bayesoleo.discovery._assembly import Assembly, assign
from bayesoleo.discovery._ranking import scales_of
from bayesoleo.discovery._score_basis import sensitivities_of
from bayesoleo.discovery._state import fit_state
from bayesoleo.effects import find_effect
from bayesoleo.prediction._periodic_run import PredictedSamples
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.solvers._orbit import Status
from bayesoleo.systems import system

#: With a step that moves the outputs by a part in a thousand or so.
STEPS = {
    "wall_heat_capacity": 1e-3,
    "oil_heat_capacity": 1e-3,
    "absolute_pressure_work": 1e-3,
    "oil_compressibility": 1e-14,
    "cylinder_expansion": 1e-14,
    "gas_exponent_error": 1e-5,
    "stroke_dependent_damping": 1e-3,
    "dahl_friction": 1e-2,
    "periodic_force": 1e-2,
    "sensor_lag": 1e-5,
}


@pytest.fixture(scope="module")
def oleo(tmp_path_factory):
    reduced = campaign(tmp_path_factory.mktemp("oleo") / "rig", Oleo())
    return fit_state(Assembly(system("f16n2d2"), "displacement"), assign(reduced.records), NUMERICS)


@pytest.mark.slow
@pytest.mark.parametrize("effect", STEPS)
def test_sensitivity_is_the_slope_of_a_full_solve(oleo, effect):
    scales = scales_of(oleo.fit, "displacement", oleo.assembly.native)
    for option in oleo.assembly.options(scales, [find_effect(effect)]):
        shapes = {n: grid[len(grid) // 2] for n, grid in option.candidate.shapes.items()}
        kept = option.candidate.parameters
        others = [name for name in option.model.estimated() if name not in kept]
        (block,) = sensitivities_of(oleo.fit, option.model.fixing(*others), [shapes])
        # The extended model, with everything else at the estimate, solved on either side.
        model = option.model.with_values({**oleo.fit.shared, **shapes}).fixing(*others)
        predictor = Predictor(
            model, oleo.fit.records, steps=oleo.fit.steps, backend="numpy", jobs=1
        )
        step, null = STEPS[effect], np.zeros(len(block.names))
        for k in range(len(block.names)):
            sides = []
            for sign in (-1.0, 1.0):
                theta = null.copy()
                theta[k] = sign * step
                sides.append([run.y for run in predictor.evaluate(theta)])
            for r, by_parameter in enumerate(block.by_run):
                slope = (sides[1][r] - sides[0][r]) / (2 * step)
                expected = by_parameter[:, k]
                size = np.abs(expected).max(axis=1, keepdims=True)
                error = np.abs(slope - expected) / np.where(size > 0, size, 1.0)
                # Differences of solves that are iterated to a part in some 1e9 of their size.
                assert error.max() < 2e-3, (effect, option.key, block.names[k])


@pytest.mark.parametrize("followed", [False, True])
def test_a_second_look_judges_each_set_by_itself(monkeypatch, followed):
    """Round-off does not repeat; what has no solution there is left as it is."""
    rng = np.random.default_rng(2)
    y_p = rng.standard_normal((3, 1, 1, 5))
    second = y_p.copy()
    second[0] += 1.0  # round-off
    second[2] = np.nan
    ok, lost = Status.CONVERGED.value, Status.NO_CONVERGENCE.value
    looks = []

    def look(p, derivatives=True):
        looks.append(p)
        return PredictedSamples(np.zeros((3, 1, 5)), second, np.array([ok, ok, lost]))

    def never(p, derivatives=True):
        pytest.fail("looked at the other way")

    monkeypatch.setattr(_score_basis, "_suspects", lambda run, y_p: np.ones(y_p.shape[:3], bool))
    run = SimpleNamespace(anchor=object(), predict=never if followed else look)
    samples = PredictedSamples(np.zeros((3, 1, 5)), y_p, np.full(3, ok))
    again = look if followed else None
    found = _score_basis.resolved_sensitivities(run, np.ones((3, 2)), samples, [1], again)
    np.testing.assert_array_equal(found[0], 0.0)
    np.testing.assert_array_equal(found[1:], y_p[1:])
    (nearby,) = looks
    assert (nearby[:, 0] == 1.0).all()
    assert (nearby[:, 1] != 1.0).all()


def test_without_a_second_solution_nothing_is_taken_for_round_off(monkeypatch):
    y_p = np.ones((1, 1, 1, 5))
    monkeypatch.setattr(_score_basis, "_suspects", lambda run, y_p: np.ones(y_p.shape[:3], bool))
    samples = PredictedSamples(np.zeros((1, 1, 5)), y_p, np.array([Status.CONVERGED.value]))
    run = SimpleNamespace(anchor=object())
    found = _score_basis.resolved_sensitivities(
        run, np.ones((1, 2)), samples, [1], lambda nearby: None
    )
    np.testing.assert_array_equal(found, y_p)
