"""A period closes the same in whatever unit its time is counted."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.model import Dof, Model, Output, Parameter
from bayesoleo.prediction._predictor import Predictor
from bayesoleo.prediction._simulate import RunPlan, motion, record_of
from bayesoleo.solvers._elimination import balance
from bayesoleo.solvers._orbit import Status

UNITS = (1e-12, 1e-9, 1.0, 1e9)


def duffing(unit: float) -> Model:
    """``q'' + c q' + q + q**3 = force`` with primes by a time of ``unit`` seconds."""
    terms = {
        "inertia": f"{unit**2!r}*ddot(q)",
        "damping": f"damping*{unit!r}*dot(q)",
        "spring": "q + q**3",
        "excitation": "-force",
    }
    return Model(
        "duffing",
        inputs={"force": "N"},
        dofs={"q": Dof("m")},
        parameters={"damping": Parameter(0.3, sd=0.1)},
        equations={"q": terms},
        outputs={"displacement": Output("q", "m")},
    )


def solved(unit: float, scheme: str, backend: str) -> tuple[Status, np.ndarray, np.ndarray]:
    model = duffing(unit)
    plan = RunPlan("a", 0.2 / unit, {"force": motion(0.1, [0.5, 0.1])})
    predictor = Predictor(model, [record_of(model, plan)], scheme=scheme, backend=backend, steps=64)
    theta = predictor.layout.start(model)
    (status,) = predictor.set_anchor(theta)
    (prediction,) = predictor.predict(theta)
    return status, prediction.y, prediction.sensitivity


@pytest.mark.parametrize("backend", ["numba", "numpy"])
@pytest.mark.parametrize("scheme", ["radau3", "thesis"])
def test_unit_of_time_changes_neither_status_nor_solution(scheme: str, backend: str) -> None:
    results = [solved(unit, scheme, backend) for unit in UNITS]
    assert {status for status, _, _ in results} == {Status.CONVERGED}
    _, y, sensitivity = results[UNITS.index(1.0)]
    for _, other, slope in results:
        # Same equations but for rounding, which the closure amplifies by less than a thousand.
        np.testing.assert_allclose(other, y, rtol=0, atol=1e-12 * np.ptp(y))
        np.testing.assert_allclose(slope, sensitivity, rtol=0, atol=1e-11 * np.ptp(sensitivity))


def test_balanced_matrix_does_not_depend_on_units() -> None:
    rng = np.random.default_rng(3)
    matrix = rng.standard_normal((5, 5))
    units = 10.0 ** rng.uniform(-9, 9, 5)
    balanced, scale = matrix.copy(), np.empty(5)
    balance(balanced, 5, scale)
    other, other_scale = matrix * units / units[:, None], np.empty(5)
    balance(other, 5, other_scale)
    # Exact for powers of two; other units leave a factor of at most two a side.
    ratio = np.abs(other / balanced)
    assert ratio.max() <= 4.0 * (1 + 1e-9)
    assert ratio.min() >= 0.25 * (1 - 1e-9)
    np.testing.assert_array_equal(matrix * scale / scale[:, None], balanced)
    eigenvalues = [np.sort_complex(np.linalg.eigvals(m)) for m in (matrix, other)]
    np.testing.assert_allclose(*eigenvalues, rtol=1e-10)
