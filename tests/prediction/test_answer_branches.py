"""Branches of declared models and limit cycles by name."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.errors import InputError
from bayesoleo.prediction._branches import follow_branch, limit_cycle
from bayesoleo.prediction._simulate import RunPlan, motion
from bayesoleo.solvers._orbit import Status
from bayesoleo.systems import system

#: The swing is read at the mesh's points. The widest gap between Radau's is 0.49 of a step, so that
#: with 64 steps a peak is missed by at most ``1 - cos(2 pi 0.245 / 64)`` of it.
MISSED = 3e-4


def plan(amplitude: float, frequency: float = 1.0) -> RunPlan:
    return RunPlan("sweep", frequency, {"force": motion(0.0, [amplitude])})


def test_swing_along_the_frequency_is_the_linear_response():
    """Closed form of the linear oscillator: ``F / |k - m w**2 + i c w|``."""
    model = system("linear_oscillator")
    found = follow_branch(model, plan(2.0), "frequency", (0.5, 3.0), steps=64)
    assert found.branch.status is Status.CONVERGED
    assert found.branch.special == ()
    assert not found.unstable.any()
    assert str(found).startswith("along frequency [Hz]: branch of ")
    assert len(str(found)) < 400
    rate = 2 * np.pi * found.values
    expected = 2.0 / np.abs(100.0 - rate**2 + 0.5j * rate)
    np.testing.assert_allclose(found.swing("displacement"), expected, rtol=MISSED)


def test_folds_of_the_declared_duffing_along_amplitude_and_frequency_agree():
    """A fold found along the frequency is one along the amplitude too, at its planned value."""
    model = system("duffing")
    by_frequency = follow_branch(model, plan(6.0), "frequency", (1.0, 6.0), steps=64)
    folds = sorted(point.value for point in by_frequency.branch.of_kind("fold"))
    assert len(folds) == 2
    assert set(by_frequency.unstable) == {0, 1}
    by_amplitude = follow_branch(model, plan(6.0, folds[0]), "amplitude", (0.2, 1.8), steps=64)
    places = [point.value for point in by_amplitude.branch.of_kind("fold")]
    assert min(abs(place - 1.0) for place in places) < 1e-6


def test_along_a_parameter_and_downward():
    model = system("linear_oscillator")
    found = follow_branch(
        model, plan(1.0), "stiffness", (50.0, 150.0), {"damping": 2.0}, downward=True, steps=64
    )
    assert found.values[0] == 150.0
    assert found.values[-1] < 50.0
    rate = 2 * np.pi
    expected = 1.0 / np.abs(found.values - rate**2 + 2.0j * rate)
    np.testing.assert_allclose(found.swing("displacement"), expected, rtol=MISSED)


def test_period_of_a_limit_cycle_by_name():
    cycle = limit_cycle(system("van_der_pol"), {"position": 1.0}, 40.0, steps=256)
    assert str(cycle) == f"stable limit cycle of period {cycle.solution.value:.8g} s"
    assert cycle.orbit.status is Status.CONVERGED
    assert cycle.orbit.period == pytest.approx(6.6632868593, rel=1e-8)
    assert cycle.own == pytest.approx(1.0, abs=1e-7)
    # Steps of 1/32 of a period leave an error that is told, and is larger than the period's.
    coarse = limit_cycle(system("van_der_pol"), {"position": 1.0}, 40.0, steps=32)
    late = abs(coarse.orbit.period / 6.6632868593 - 1.0)
    assert cycle.orbit.error < 1e-5
    assert coarse.orbit.error > max(late, 10 * cycle.orbit.error)


def test_bad_input_is_named():
    model = system("duffing")
    with pytest.raises(InputError, match=r"no branch along this.*'mas'.*frequency, amplitude"):
        follow_branch(model, plan(1.0), "mas", (0.0, 1.0))
    with pytest.raises(InputError, match="a span goes from less to more"):
        follow_branch(model, plan(1.0), "mass", (1.0, 1.0))
    with pytest.raises(InputError, match=r"key scheme.*one-step scheme.*use radau3"):
        follow_branch(model, plan(1.0), "mass", (1.0, 2.0), scheme_name="thesis")
    with pytest.raises(InputError, match=r"no such dof.*there are position"):
        limit_cycle(system("van_der_pol"), {"x": 1.0}, 40.0)
    with pytest.raises(InputError, match=r"does not come back.*longer time"):
        limit_cycle(system("van_der_pol"), {"position": 1.0}, 2.0)
