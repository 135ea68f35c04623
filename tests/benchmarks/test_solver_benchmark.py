"""The benchmark's own code on a small system: all solvers find the same motion."""

import importlib.util

import equal_error
import numpy as np
import other_codes
import peers
import pytest
import solves
from cases import cases
from measuring import exponent, time_at

from bayesoleo.prediction._simulate import RunPlan, motion, record_of
from bayesoleo.systems import system


@pytest.fixture(scope="module")
def duffing():
    return system("duffing")


@pytest.fixture(scope="module")
def oscillations(duffing):
    plan = RunPlan("one", 0.2, {"force": motion(0.1, [0.5, 0.1])}, samples_per_period=50)
    return cases(duffing, [record_of(duffing, plan)])


def test_time_is_taken_between_measured_errors():
    errors, seconds = [1e-2, 1e-4, 1e-6], [1.0, 10.0, 100.0]
    assert time_at(1e-5, errors, seconds) == pytest.approx(10**1.5)
    assert time_at(1e-1, errors, seconds) == 1.0
    assert np.isnan(time_at(1e-7, errors, seconds))
    assert exponent([1, 2, 4], [3, 12, 48]) == pytest.approx(2.0)


@pytest.mark.slow
def test_both_schemes_are_measured_at_equal_error(duffing, oscillations):
    """Smooth motion: a high order needs fewer steps, by far where little error is wanted."""
    meshes = {"radau3": (16, 32, 64, 128), "thesis": (100, 400, 1600, 6400, 25_600)}
    found = equal_error.measure(duffing, oscillations, meshes)
    assert found["default_us_at_1e-5"] < found["default_us_at_1e-8"]
    assert found["equal_error_ratio_1e-8"] > 10.0


@pytest.mark.slow
def test_errors_beside_times(duffing, oscillations):
    found = solves.accuracy(duffing, oscillations)
    assert found["default_error_worst"] < 1e-8 < found["error_worst"] < 1e-2


@pytest.mark.slow
@pytest.mark.reference
def test_scipy_finds_the_same_motion(duffing, oscillations):
    found = other_codes.measure(duffing, oscillations)
    for name in other_codes.NAMES:
        assert found[f"{name}_failures"] == 0
        assert found[f"{name}_error_worst"] < 1e-4
        assert found[f"{name}_ms"] > 0.0


@pytest.mark.slow
@pytest.mark.reference
@pytest.mark.skipif(importlib.util.find_spec("casadi") is None, reason="the group bench has CasADi")
def test_casadi_solves_the_same_equations(duffing, oscillations):
    found = peers.with_casadi(duffing, oscillations, vectors=2)
    assert found["casadi_failures"] == 0
    assert found["casadi_gap"] < 1e-8
