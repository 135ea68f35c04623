"""Generated kernels of extended models are finite where motion turns: at zero velocity too."""

from __future__ import annotations

import numpy as np
import pytest

from bayesoleo.model import driven_by
from bayesoleo.model._expressions import symbol
from bayesoleo.model._kernels import kernels
from bayesoleo.systems import system

#: Position, velocity and what higher derivatives there are, at points that include reversals.
POINTS = np.array([[0.1, 0.1, 0.1, 0.03, 0.2], [0, 0.1, -0.1, 0, 1e-3], [0, 0.5, -0.5, 0, 1]])


def rows(names_and_orders) -> np.ndarray:
    found = []
    for name, order in names_and_orders:
        warm = name == "temperature" and order == 0
        found.append(POINTS[min(order, 2)] + (300.0 if warm else 0.0))
    return np.array(found).reshape(len(found), POINTS.shape[1])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["f16n1d2", "viscous_damper"])
def test_kernels_are_finite_at_the_null(name, offered):
    for candidate in offered(system(name)):
        model = candidate.model
        if (candidate.effect, candidate.target) != ("sensor_hum", "displacement"):
            model = driven_by(model, "displacement")
        compiled = kernels(model, backend="numpy")
        derived = compiled.derived
        orders = zip(derived.dofs, derived.orders, strict=True)
        z = rows((dof, k) for dof, order in orders for k in range(order + 1))[None]
        u = rows(derived.inputs)
        p = np.array([[float(model.nominal()[symbol(name)]) for name in derived.constants]])
        d, nz, n = len(derived.dofs), z.shape[1], POINTS.shape[1]
        ny, na = len(derived.outputs), len(derived.active)
        lanes = np.array([0])
        shapes = {
            "jacobian": [(1, d, n), (1, d, nz, n)],
            "parameters": [(1, d, na, n)],
            "output": [(1, ny, n)],
            "output_jacobian": [(1, ny, nz, n), (1, ny, na, n)],
        }
        for kernel, sizes in shapes.items():
            filled = [np.zeros(size) for size in sizes]
            getattr(compiled, kernel)(z, u, p, lanes, *filled)
            assert all(np.isfinite(item).all() for item in filled), (candidate.effect, kernel)
